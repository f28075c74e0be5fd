# SPDX-License-Identifier: Apache-2.0
"""Each advice about a parameter or an option is followed with its own words and numbers."""

import re
from argparse import ArgumentTypeError

import pytest
from remedies import check_remedy, members
from robots import with_modules, write_robot

from musculoskeletal_ae import options
from musculoskeletal_ae.control.settings import METHODS, Settings
from musculoskeletal_ae.control.stop_memory import StopMemory
from musculoskeletal_ae.estimation.lengths.length_calibration import stated_theta
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.training import train_on
from musculoskeletal_ae.mujoco_version import check_mujoco
from musculoskeletal_ae.nodes.declared_parameters import PARAMETERS, check_names
from musculoskeletal_ae.presets.registry import preset_named
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tools.experiment import _names as experiment_names

EVERY = {
    f'{node}.{name}': parameter
    for node, table in PARAMETERS.items()
    for name, parameter in table.items()
}
#: what the text about a value of the wrong kind promises, and values that keep the promise
KINDS = {
    'true or false': [True, False],
    'a whole number': [],
    'a finite number': [],
    'a text': ['', 'text'],
    'a list of finite numbers': [[]],
    'a list of names': [['a', 'b'], []],
}
NUMBER = r'(-?[\d.]+(?:e[+-]?\d+)?)'


@pytest.mark.parametrize('name', EVERY)
def test_a_parameter_accepts_what_its_refusal_states(name):
    parameter = EVERY[name]
    with pytest.raises(MusculoskeletalError) as refused:
        parameter.checked(object())
    legal = str(refused.value).partition('; legal: ')[2]
    if parameter.legal:
        accepted = legal.split(', ')
    else:
        kind, _, span = legal.partition(', ')
        accepted = list(KINDS[kind])
        if ends := re.match(f'{NUMBER} to {NUMBER}', span):
            accepted += map(float, ends.groups())
        elif least := re.match(f'at least {NUMBER}', span):
            accepted += [float(least[1]), 1e6]
        elif 'number' in kind and not accepted:
            accepted = [0.0, 12.5]
        if isinstance(parameter.default, int) and not isinstance(parameter.default, bool):
            accepted = [round(value) for value in accepted]
        if 'list of finite numbers' in kind:
            accepted = [value if value == [] else [value] for value in accepted]
    for value in accepted:
        parameter.checked(value)


def test_a_name_that_no_node_has_is_accepted_as_the_refusal_corrects_it():
    check_remedy(
        lambda name: check_names([name], 'controller'),
        'max_agee',
        'nearest: (.*)$',
        [lambda match: match[1]],
    )
    check_remedy(
        lambda node: check_names(['explore'], node),
        'estimator',
        'only (.*) has one of this name',
        [lambda match: match[1]],
    )


@pytest.mark.parametrize('name', ['arm26', 'musashi_left_arm', 'narrow'])
def test_a_posture_at_the_ends_that_a_refusal_states_is_accepted(name, tmp_path):
    if name == 'narrow':
        directory = write_robot(tmp_path, slider=True)
        file = directory / 'robot.urdf'
        text = file.read_text().replace('lower="-0.3" upper="0.6"', 'lower="0.1463" upper="0.3557"')
        file.write_text(text)
        name = directory
    robot = Robot.load(name)
    span = f'{NUMBER} to {NUMBER}'
    check_remedy(
        lambda posture: stated_theta(robot, posture),
        (0.5,) * (robot.joint_count + 1),
        'legal: an empty list, or (.*)$',
        [
            (),
            lambda match: tuple(float(low) for low, _ in re.findall(span, match[1])),
            lambda match: tuple(float(high) for _, high in re.findall(span, match[1])),
        ],
    )


def test_a_stiffness_at_the_ends_that_a_refusal_states_is_accepted(tmp_path):
    robot = Robot.load(write_robot(tmp_path, slider=True))
    check_remedy(
        lambda values: Settings(joint_stiffness=values).desired_stiffness(robot.units),
        [1.0],
        r'legal: (\d+) numbers of at least 0, at most (.*) \[N·m/rad or N/m\], or \[\]',
        [
            [],
            lambda match: [0.0] * int(match[1]),
            lambda match: [float(most) for most in match[2].split(', ')],
        ],
    )


@pytest.mark.parametrize('source', ['none', 'current'])
@pytest.mark.parametrize('preset', ['default', 'paper'])
def test_the_methods_that_a_refusal_names_are_accepted(source, preset):
    robot = Robot.load('arm26')
    description = with_modules(robot.description, 'position', source)
    own, refusals = Robot(description), 0
    for method in METHODS:
        try:
            Settings(method=method, preset=preset).check_fit(own)
        except MusculoskeletalError as refused:
            refusals += 1
            for legal in re.search('legal.*: (.*)$', str(refused))[1].split(', '):
                Settings(method=legal, preset=preset).check_fit(own)
    assert refusals


def test_a_directory_for_stops_can_be_chosen_as_the_refusal_says(tmp_path):
    first = StopMemory(tmp_path / 'a')

    def use(directory):
        StopMemory(directory).close()

    check_remedy(use, tmp_path / 'a', 'state_directory to another directory', [tmp_path / 'b'])
    (tmp_path / 'file').write_text('')
    check_remedy(
        use,
        tmp_path / 'file' / 'a',
        "set the parameter state_directory to a writable directory, or to '' to start",
        [tmp_path / 'c', lambda _: None],
    )
    first.close()
    use(tmp_path / 'a')


#: what a user chooses, a wrong choice, the advice, and the right ones
CHOICES = {
    'preset': (preset_named, 'best', 'legal: (.*)$', members()),
    'device': (train_on, 'cuda:99', r'legal: (cpu)\.', members()),
    'version of MuJoCo': (
        check_mujoco, '3.2.0', r'legal: >=([\d.]+),<', [lambda match: f'{match[1]}.0', '3.99.1'],
    ),
}  # fmt: skip
#: options, as CHOICES
OPTIONS = {
    'whole': (options.whole(1, 8), '9', r'expected (\d+) to (\d+)', [
        lambda match: match[1], lambda match: match[2]]),
    'minutes': (options.minutes, '0', r'expected (\S+) to (\S+)', [
        lambda match: match[1], lambda match: match[2]]),
    'seed': (options.seed, '-1', r'expected (\d+) to (\d+)', [
        lambda match: match[1], lambda match: match[2]]),
    'seeds': (options.seeds, '1,1', r'as in (\S+)$', [lambda match: match[1]]),
    'numbers': (options.numbers, '1;2', r'as in (\S+)$', [lambda match: match[1]]),
    'names': (options.names, ',', 'expected a name', ['a', 'a,b']),
    'not negative': (options.not_negative, '-1', r'of at least (\S+)$', [lambda match: match[1]]),
    'positive': (options.positive, '0', r'above 0$', ['1e-9']),
    'experiments': (experiment_names, 'al', 'legal: (.*)$', members()),
}  # fmt: skip


@pytest.mark.parametrize('name', CHOICES)
def test_a_choice_is_accepted_after_its_advice(name):
    check_remedy(*CHOICES[name])


@pytest.mark.parametrize('name', OPTIONS)
def test_an_option_is_accepted_after_its_advice(name):
    check_remedy(*OPTIONS[name], error=ArgumentTypeError)


def test_a_picture_is_accepted_with_each_ending_that_the_refusal_names(tmp_path):
    check_remedy(
        options.picture,
        str(tmp_path / 'a.bmp'),
        'a file in an existing directory that ends in one of (.*)$',
        members(lambda ending: str(tmp_path / f'a{ending}')),
        error=ArgumentTypeError,
    )
