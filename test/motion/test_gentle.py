# SPDX-License-Identifier: Apache-2.0
"""Motion while the length offsets are unknown: only exploration, with gentle limits."""

from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.motion.calibration_motion import SPEED, gentle_limit
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import LengthOffsets

DT = 0.01


class Loop:
    """A controller and an emulated arm whose lengths have offsets."""

    def __init__(self, robot, mae):
        self.arm, self.core, self.now = EmulatedArm(robot, 1), Controller(robot), 0.0
        self.offset = np.zeros(robot.muscle_count)
        self.core.use(mae)
        self.commands, self.pulls = [], []
        self.has_estimates = True
        self.begin_calibration()

    def begin_calibration(self):
        """Inform the controller that a length calibration has begun, so its offsets are unknown."""
        offsets = LengthOffsets.unknown(len(self.offset))
        self.core.use_body(self.core.stream.body.with_offsets(offsets))

    def know(self, offset):
        """Give the controller the length offsets [m], (M,), as at the end of a calibration."""
        offsets = LengthOffsets.of(offset, np.zeros(len(offset)))
        self.core.use_body(self.core.stream.body.with_offsets(offsets))

    def sent(self, command):
        """Return the true muscle lengths [m], (M,), that the modules reach with a command."""
        return command.value + self.core.stream.body.offsets.offset - self.offset

    def run(self, seconds):
        for _ in range(round(seconds / DT)):
            self.now += DT
            read = self.arm.sense().muscles
            self.core.take(read.replace(length=read.length + self.offset), self.now)
            if self.has_estimates:
                self.core.estimated(self.arm.theta, self.now)
            command = self.core.step(self.now)
            if command is not None:
                self.commands.append(self.sent(command))
                self.arm.command_length(self.commands[-1])
            self.pulls.append(read.tension.max())
            self.arm.step(DT)


@pytest.fixture
def loop(trained):
    return Loop(Robot.load('arm26'), trained['default'])


def test_a_target_waits_until_the_length_offsets_are_known(loop):
    loop.run(0.1)
    loop.core.target(dict.fromkeys(loop.arm.robot.joints, (0.5, 0.0)))
    loop.run(0.5)
    assert not loop.commands
    assert 'length offsets are unknown' in loop.core.report(loop.now).message
    loop.know(loop.offset)
    loop.run(0.5)
    assert loop.commands


def test_exploration_without_length_offsets_moves_the_arm_slowly_and_with_low_tension(loop):
    loop.offset[:] = [0.1, -0.13, 0.08, -0.06, 0.12, 0.05]
    loop.core.explore(True)
    observed = []
    for _ in range(100):
        loop.run(0.1)
        observed.append(loop.arm.theta)
    assert not loop.core.supervisor.condition
    assert np.ptp(observed, axis=0).min() > 0.3
    speed = np.abs(np.diff(loop.commands, axis=0)) / DT
    # Few commands are faster: they pay out a muscle to keep its tension below the limit.
    assert np.quantile(speed, 0.99) < 1.2 * SPEED
    assert max(loop.pulls) < gentle_limit(loop.arm.robot)[0] + 30.0


def test_new_length_offsets_do_not_move_the_arm(loop):
    loop.offset[:] = [0.1, -0.1, 0.05, 0.02, -0.02, 0.03]
    loop.core.explore(True)
    loop.run(1.0)
    before = loop.commands[-1]
    loop.know(loop.offset)
    # The controller may compute a command with the new offsets before it receives new lengths.
    assert np.abs(loop.sent(loop.core.step(loop.now)) - before).max() < 0.002
    loop.run(DT)
    assert np.abs(loop.commands[-1] - before).max() < 0.002


def test_a_length_calibration_moves_the_arm_only_after_its_first_estimate_even_after_a_stop(loop):
    loop.core.explore(True)
    loop.run(1.0)
    loop.know(loop.offset)
    loop.begin_calibration()
    loop.has_estimates = False
    before = loop.commands[-1]
    loop.run(0.5)
    loop.core.stop(ConditionKind.OPERATOR)
    loop.run(0.1)
    assert loop.core.reset(loop.now) is None
    loop.core.explore(True)
    loop.run(0.5)
    np.testing.assert_array_equal(loop.commands[-110:], np.tile(before, (110, 1)))
    assert 'waiting for the first estimate' in loop.core.report(loop.now).message
    loop.has_estimates = True
    loop.run(0.5)
    assert np.abs(loop.commands[-1] - before).max() > 0.001


def test_with_a_small_rate_limit_the_arm_rests_nevertheless(loop):
    loop.core.configure(replace(loop.core.settings, rate_limit=0.005))
    loop.core.explore(True)
    loop.run(40.0)
    still = (np.diff(loop.commands, axis=0) == 0.0).all(axis=1)
    longest = max(sum(1 for _ in run) for is_still, run in groupby(still) if is_still)
    assert longest * DT >= 0.2
