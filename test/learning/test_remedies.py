# SPDX-License-Identifier: Apache-2.0
"""Each advice about the learner's state directory is followed in the situation that prints it."""

import errno
from contextlib import closing, nullcontext
from pathlib import Path

import pytest
from remedies import check_remedy, members
from robots import with_modules

from musculoskeletal_ae.exceptions import StateError
from musculoskeletal_ae.learning import state_directory as states
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.learning.state_directory import NETWORK, StateStore
from musculoskeletal_ae.robot.robot import Robot

from .test_learner import IdleTrainer
from .test_state_directory import be_foreign, full_disk, no_pause, written

assert no_pause  # a fixture
SPACE = '[Ff]ree disk space or make .* writable'
OR_NONE = "or to '' to save nothing"


@pytest.mark.parametrize(
    ('directory', 'advice'),
    [
        ('~nobody_here/x', f'set the parameter state_directory to an absolute path, {OR_NONE}'),
        ('file/x', f'set the parameter state_directory to a writable directory, {OR_NONE}'),
        ('nul\0', f'set the parameter state_directory to a writable directory, {OR_NONE}'),
        ('in use', 'set the parameter state_directory to another directory'),
    ],
)
def test_a_learner_starts_with_a_directory_as_the_refusal_says(
    directory, advice, arm26, initial, tmp_path
):
    (tmp_path / 'file').write_text('')

    def use(path):
        path = None if path == '' else Path(path)
        Learner(arm26, initial, trainer=IdleTrainer, directory=path).close()

    bad = directory if directory.startswith('~') else tmp_path / directory
    with closing(StateStore(tmp_path / 'in use', arm26)):
        check_remedy(use, bad, advice, [tmp_path / 'own', ''], StateError)
    use(tmp_path / 'in use')  # the other way: that learner was stopped


def test_nothing_can_be_saved_until_the_learner_is_restarted_with_a_directory(
    arm26, initial, tmp_path
):
    def use(directory):
        with closing(Learner(arm26, initial, trainer=IdleTrainer, directory=directory)) as learner:
            learner.save()

    advice = 'restart the learner with the path of a directory'
    check_remedy(use, None, advice, [tmp_path / 'a'], StateError)


class Full:
    """Lets one operation fail as on a full disk, until space is freed."""

    def __init__(self, operation, fails=lambda *_: True):
        self.operation, self.fails, self.is_full = operation, fails, True

    def __call__(self, *arguments):
        if self.is_full and self.fails(*arguments):
            raise OSError(errno.ENOSPC, 'No space left on device')
        return self.operation(*arguments)


@pytest.mark.parametrize('situation', ['state', 'backup', 'network', 'unusable state'])
def test_the_state_is_saved_after_space_was_freed(situation, arm26, stage, tmp_path, monkeypatch):
    store = written(tmp_path, arm26, stage, 2)
    full = Full(Path.rename)
    if situation == 'unusable state':
        be_foreign(tmp_path / states.NEWEST)
        monkeypatch.setattr(Path, 'rename', lambda *paths: full(*paths))
    if situation == 'network':
        full = Full(states.write_whole, lambda file, *_: file.name == NETWORK)
        monkeypatch.setattr(states, 'write_whole', full)
    with closing(StateStore(tmp_path, arm26)) as state:
        work = {
            'state': lambda: state.save(store, None),
            'backup': lambda: state.back_up(store, None),
            'network': lambda: state.save(store, b'network'),
            'unusable state': lambda: state.load(SampleStore()),
        }[situation]
        disk = full_disk if situation in ('state', 'backup') else nullcontext

        def use(is_full):
            full.is_full = is_full
            with disk() if is_full else nullcontext():
                work()

        check_remedy(use, True, SPACE, [False], StateError)


def test_a_source_of_joint_angles_that_the_refusal_names_is_accepted(arm26):
    robot = Robot(with_modules(arm26.description, 'position', 'none'))
    check_remedy(
        lambda source: Learner(robot, joint_source=source, trainer=IdleTrainer).close(),
        'none',
        'legal: (.*)$',
        members(),
    )
