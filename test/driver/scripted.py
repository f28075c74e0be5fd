# SPDX-License-Identifier: Apache-2.0
"""A driver of the emulated arm without ROS, with faults that a test selects."""

from collections import deque
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from readings import reading

from musculoskeletal_ae.driver.listening import Listening
from musculoskeletal_ae.driver.position_motion_test import Positioning
from musculoskeletal_ae.driver.stiffness_motion_test import Winding
from musculoskeletal_ae.driver.verdict import Verdict
from musculoskeletal_ae.emulator.faults import ArmReadings, Faults
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.motor_interface import MotorInterface

PERIOD = 0.01  # time between two published messages [s]


class RecordedArm:
    """Stands in for an emulated arm: replays its recorded readings, whatever is commanded."""

    def __init__(self, robot: Robot, readings: Sequence[ArmReadings]) -> None:
        self.faults = Faults(robot, np.random.default_rng(0))
        self._readings, self._next = readings, -1

    def step(self, _: float) -> None:
        self._next += 1

    def sense(self) -> ArmReadings:
        return self._readings[self._next]

    def set_wrench(self, _: np.ndarray) -> None:
        """Do nothing: the recorded arm was moved, or it was not."""


def muscle_rows(read: ArmReadings) -> np.ndarray:
    """Return the rows l [m], T [N] and temperature [°C] of a reading of an emulated arm, (3, M)."""
    muscles = read.muscles
    return np.stack([muscles.length, muscles.tension, muscles.temperature])


class Driver:
    """Publishes muscle_states and follows muscle_length_command, with the selected faults."""

    def __init__(self, robot: Robot, seed: int = 0, arm: Any = None) -> None:
        self.robot, self.arm = robot, arm or EmulatedArm(robot, seed)
        # Tests inject faults: `publish` changes the published rows (3, M), `take` the received
        # targets (M,), and `angles` the published θ (D,). `late` delays commands [s].
        self.publish: Callable = lambda rows: rows
        self.take: Callable = lambda target: target
        self.names = robot.joints
        self.angles: Callable = lambda theta: theta
        # Converts rows (3, M) and a time [s] into a message, which is passed to `Listening`.
        self.message: Callable = lambda rows, _: array(rows)
        self.motors: MotorInterface | None = None
        self.period, self.late = PERIOD, 0.0
        self.now = 0.0
        #: highest true T [N] of any muscle in each phase of `wind`
        self.pulled: dict[str, float] = {}
        self._commands: deque = deque()
        # Computes T [N] from l_target and the measured rows; if None, the arm's own law does.
        self.in_tension: Callable | None = None
        self.law_period = PERIOD  # time between two evaluations of `in_tension` [s]
        self._target = None
        self._sent = -1.0

    def step(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Advance by 10 ms; return the published messages: θ (D,) and rows (3, M) of each."""
        self.now += PERIOD
        while self._commands and self._commands[0][0] <= self.now:
            self._target = self._commands.popleft()[1]
        if self._target is not None and self.in_tension:
            for _ in range(round(PERIOD / self.law_period)):
                rows = muscle_rows(self.arm.sense())
                self.arm.command_tension(self.in_tension(self._target, rows))
                self.arm.step(self.law_period)
        else:
            if self._target is not None:
                self.arm.command_length(self._target)
            self.arm.step(PERIOD)
        if self.now - self._sent < self.period - 1e-9:
            return []
        self._sent = self.now
        read = self.arm.faults.deliver(self.arm.sense(), self.now)
        return [(each.theta, self.publish(muscle_rows(each))) for each in read]

    def command(self, target: np.ndarray) -> None:
        """Receive l_target [m], (M,); follow it after `late` seconds."""
        self._commands.append((self.now + self.late, self.take(target.copy())))

    def listen(
        self, seconds: float = 3.0, moved: bool = False, joints: bool = True, zeroed: bool = True
    ) -> Verdict:
        """Return the verdict of `Listening` after some seconds of messages.

        Args:
            seconds: Duration of listening [s].
            moved: Whether a force on the hand moves the arm.
            joints: Whether joint sensors publish.
            zeroed: Whether the lengths are stated to have no offsets.
        """
        listening = Listening(self.robot, 1.0 / PERIOD, None, zeroed, self.motors)
        for k in range(round(seconds / PERIOD)):
            if moved:
                self.arm.set_wrench(hand(k))
            for theta, rows in self.step():
                if joints:
                    angles = self.angles(theta)
                    listening.joints(joint_state(dict(zip(self.names, angles))))
                listening.muscles(self.message(rows, self.now), self.now)
        self.arm.set_wrench(np.zeros(6))
        return listening.verdict(self.now)

    def wind(
        self, muscles: tuple[int, ...] = (), highest: float | None = None, heard: Any = None
    ) -> Verdict:
        """Return the verdict of check_driver's motion test, which winds in the muscles in turn.

        Nothing moves if `heard`, the verdict of listening, does not allow motion.

        Args:
            muscles: Indices of the muscles to test; by default all.
            highest: Largest tension that the test may cause [N]; None: that of check_driver.
            heard: Verdict of listening; None: no faults so far.
        """
        if heard and not heard.allows_motion:
            return heard
        kind = self.robot.actuation.choose(Winding, Positioning)
        winding = kind(heard or Verdict(self.robot), muscles, highest)
        while not winding.done:
            for theta, rows in self.step():
                tension = max(self.pulled.get(winding.trying, 0.0), self.arm.tension.max())
                self.pulled[winding.trying] = tension
                if (
                    target := winding.step(reading(rows), self.now, self.angles(theta))
                ) is not None:
                    self.command(target)
        return winding.verdict


def hand(k: int) -> np.ndarray:
    """Return the wrench (6,) of a hand that moves the arm, in the step number k."""
    wrench: np.ndarray = 30.0 * np.sin(0.02 * k * np.array([1.0, 0.7, 1.3, 0, 0, 0]))
    return wrench


def record(robot: Robot, seconds: float, moved: bool) -> list[ArmReadings]:
    """Return the readings of an arm that receives no commands; a hand may move it."""
    arm, readings = EmulatedArm(robot), []
    for k in range(round(seconds / PERIOD)):
        if moved:
            arm.set_wrench(hand(k))
        arm.step(PERIOD)
        readings.append(arm.sense())
    return readings


def array(rows: np.ndarray) -> SimpleNamespace:
    """Return a stand-in for a Float64MultiArray without a layout."""
    return SimpleNamespace(data=rows.ravel(), layout=SimpleNamespace(dim=[], data_offset=0))


def joint_state(values: dict[str, float]) -> SimpleNamespace:
    """Return a stand-in for a JointState."""
    return SimpleNamespace(
        name=list(values), position=list(values.values()), velocity=[], effort=[]
    )
