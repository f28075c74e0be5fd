# SPDX-License-Identifier: Apache-2.0
"""The advice on a checkpoint that cannot be used is followed: another one is used."""

import numpy as np
import pytest
from remedies import check_remedy
from robots import copy_robot, read_muscles, write_muscles

from mae.test_checkpoint import GOOD, rewritten, with_metadata
from musculoskeletal_ae.exceptions import CheckpointError
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.checkpoint import MAX_BYTES
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tools.train import main as train

SIZE = int.from_bytes(GOOD[:8], 'little')
#: one file for each check; test_checkpoint.py has the wrong values that each of them refuses
FILES = {
    'empty': b'',
    'another format': b'\x80\x02}q\x00.' * 10,
    'truncated': GOOD[:-9],
    'without metadata': rewritten(lambda header: {'a': header['mean']}),
    'other version': with_metadata(format_version=99),
    'metadata': with_metadata(preset='best'),
    'no numbers': GOOD[: 8 + SIZE] + np.full((len(GOOD) - 8 - SIZE) // 8, np.nan).tobytes(),
    'another robot': GOOD,
    'huge': bytes(MAX_BYTES + 1),
}


@pytest.mark.parametrize('name', [*FILES, 'missing', 'a directory'])
def test_another_checkpoint_is_used_after_the_advice(name, trained_file, tmp_path):
    file, robot = tmp_path / 'a.safetensors', Robot.load('arm26')
    if name in FILES:
        file.write_bytes(FILES[name])
    elif name == 'a directory':
        file.mkdir()
    check_remedy(
        lambda path: checkpoint.load(path, robot),
        file,
        'use another checkpoint, or make one with `train`$',
        [trained_file],
        CheckpointError,
    )


@pytest.mark.thorough
def test_a_checkpoint_that_train_makes_is_used_after_the_advice(trained_file, tmp_path):
    """The robot was changed, so its checkpoint names other muscles."""
    document = read_muscles(copy_robot('arm26', tmp_path))
    del document['muscles'][2]
    robot = Robot.load(write_muscles(tmp_path, document))
    made = tmp_path / 'made.safetensors'

    def trained(_):
        assert train(['--robot', str(tmp_path), '--out', str(made), '--quick']) == 0
        return made

    check_remedy(
        lambda path: checkpoint.load(path, robot),
        trained_file,
        'make one with `train`$',
        [trained],
        CheckpointError,
    )
