# SPDX-License-Identifier: Apache-2.0
"""`train --mujoco`: one command from a MuJoCo file to a network and a learned model."""

import re
from collections import Counter
from pathlib import Path

import bodies
import mujoco
import numpy as np
import pytest

from musculoskeletal_ae.emulator.foreign.arm import ForeignArm
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, ClosedLoop
from musculoskeletal_ae.importing.convert import import_robot
from musculoskeletal_ae.learning import convergence
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tools.train import main

EXAMPLE = Path(__file__).parents[2] / 'examples' / 'two_joint_arm.xml'


def test_a_mujoco_file_is_imported_explored_and_learned_until_the_emulated_arm_diverges(
    tmp_path, capsys, monkeypatch
):
    step, steps = ForeignArm.step, Counter()

    def thrown(arm, duration):
        steps[arm] += 1
        if len(steps) == 2 and steps[arm] == 2000:  # the second arm explores
            arm.set_wrench(np.full(6, 1e7))
        step(arm, duration)

    monkeypatch.setattr(ForeignArm, 'step', thrown)
    monkeypatch.setattr(convergence, 'MOST_UPDATES', 1)
    out = tmp_path / 'arm.safetensors'
    options = ['--mujoco', str(EXAMPLE), '--minutes', '0.4', '--quick', '--seed', '1']
    assert main([*options, '--out', str(out)]) == 0
    printed = capsys.readouterr()
    # A busy computer checks fewer than 150 postures.
    assert re.search(r'^([1-9]\d*) of \1 random postures can be held', printed.out, re.M)
    assert re.search(r'warning: the emulated arm has diverged: joint \w+ moves at', printed.err)
    # Nothing is learned from the diverged arm, and what was learned before is kept.
    assert re.search(r'0\.333 min of exploration .*, [1-9]\d* samples', printed.out)
    before, after = re.search(r'held-out motion: (\S+) → (\S+) rad', printed.out).groups()
    assert float(after) < float(before)
    robot = Robot.load(tmp_path / 'arm_robot')
    assert checkpoint.load(out, robot).joints == robot.joints
    mujoco.MjModel.from_xml_path(str(tmp_path / 'arm_model' / EXAMPLE.name))


@pytest.mark.thorough
def test_a_finger_with_a_spring_return_explores_and_learns(tmp_path):
    (tmp_path / 'finger.xml').write_text(bodies.SNAPPING)
    robot = import_robot(tmp_path / 'finger.xml', tmp_path / 'robot').robot
    mae = initial_mae(robot, steps=300)
    arm = make_arm(robot, 1, str(tmp_path / 'robot' / 'model.xml'), deviates=True)
    loop, learner = ClosedLoop(arm, mae, seed=101), Learner(robot, mae, seed=1)
    theta = []
    for n in range(2500):
        if learner.mae is not loop.mae:
            loop.use(learner.mae)
        true, read, length, tension, _ = loop.explore()
        learner.step(n * SAMPLE_TIME, read, tension, length)
        theta.append(true[0])
    assert np.ptp(theta) > 0.8 * (robot.upper - robot.lower)[0]
    # A stop that yields would let a strong muscle press the light finger far beyond its limits.
    assert max(theta) < robot.upper[0] + 0.02
    assert len(learner.samples) >= 3
    assert learner.mae is not mae


def test_a_model_that_its_muscles_cannot_hold_is_refused_before_any_training(tmp_path, capsys):
    (tmp_path / 'heavy.xml').write_text(bodies.HEAVY)
    options = ['--mujoco', str(tmp_path / 'heavy.xml'), '--out', str(tmp_path / 'a.safetensors')]
    assert main(options) == 1
    streams = capsys.readouterr()
    assert re.search(
        r'\b0 of [1-9]\d* random postures can be held: training is pointless', streams.out
    )
    assert 'the muscles cannot hold the arm' in streams.err


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
