# SPDX-License-Identifier: Apache-2.0
"""`train --mujoco`: one command from a MuJoCo file to a network and a learned model."""

import re
from pathlib import Path

import mujoco
import pytest

from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tools.train import main

EXAMPLE = Path(__file__).parents[2] / 'examples' / 'two_joint_arm.xml'


def test_a_mujoco_file_is_imported_explored_learned_and_reported(tmp_path, capsys):
    out = tmp_path / 'arm.safetensors'
    options = ['--mujoco', str(EXAMPLE), '--minutes', '0.7', '--quick', '--seed', '1']
    assert main([*options, '--out', str(out)]) == 0
    printed = capsys.readouterr().out
    assert re.search(r'150 of 150 random postures can be held', printed)
    before, after = re.search(r'held-out motion: (\S+) → (\S+) rad', printed).groups()
    assert float(after) < float(before)
    robot = Robot.load(tmp_path / 'arm_robot')
    assert checkpoint.load(out, robot).joints == robot.joints
    mujoco.MjModel.from_xml_path(str(tmp_path / 'arm_model' / EXAMPLE.name))


def test_a_model_that_its_muscles_cannot_hold_is_refused_before_any_training(tmp_path, capsys):
    heavy = EXAMPLE.read_text().replace('mass="1.2"', 'mass="9000"')
    (tmp_path / 'heavy.xml').write_text(heavy)
    options = ['--mujoco', str(tmp_path / 'heavy.xml'), '--out', str(tmp_path / 'a.safetensors')]
    assert main(options) == 1
    streams = capsys.readouterr()
    assert '0 of 150 random postures can be held: training is pointless' in streams.out
    assert 'cannot hold it' in streams.err


@pytest.mark.parametrize(
    'options',
    [
        ['--robot', 'arm26', '--mujoco', 'a.xml'],
        ['--robot', 'arm26', '--joints', 'elbow'],
        ['--mujoco', 'a.xml', '--from-bag', 'bag'],
        [],
    ],
)
def test_options_that_exclude_each_other_are_refused(options, tmp_path, capsys):
    with pytest.raises(SystemExit) as error:
        main([*options, '--out', str(tmp_path / 'a.safetensors')])
    assert error.value.code == 2
    assert '--mujoco' in capsys.readouterr().err
