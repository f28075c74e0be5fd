# SPDX-License-Identifier: Apache-2.0
"""An emulated arm with a script: a weight put into the hand, muscles cut and mended on the way."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME
from musculoskeletal_ae.robot.robot import Robot

PAYLOAD = 3.6  # [kg], the paper's dumbbell
#: a muscle carries tension if it pulls this much more than T_bias, far beyond the sensor's noise
CARRYING = 10.0  # [N]
SLOT = 20.0  # [s] for each muscle: wait until it carries tension, cut, mend, recover
LATEST_CUT, CUT_TIME = 14.0, 3.0  # [s]
FALLEN = 0.1  # [s] after a cut, when no tension is left
RECOVERED = 2.0  # [s] after the mending, while the arm swings back
EARLIEST_CUT = 5.0  # [s] drawn uniformly up to it, so that cuts fall into motion and into rest


def message_rows(start: float, end: float) -> slice:
    """Return the rows of a recording between two times [s]."""
    return slice(round(start / SAMPLE_TIME), round(end / SAMPLE_TIME))


def frictionless(robot: Robot, seed: int) -> EmulatedArm:
    """Return an individual as it would be without friction in wires and joints."""
    individual = Individual(robot, seed)
    individual.cable_friction[:] = 0.0
    individual.joint_friction[:] = 0.0
    return EmulatedArm(robot, seed, individual)


class ScriptedArm(EmulatedArm):
    """An arm that asks its script before every step.

    Attributes:
        time: Since it was built [s].
        script: Told the arm, which it may change.
    """

    def __init__(self, robot: Robot, seed: int, script: Callable[[ScriptedArm], None]) -> None:
        """Build individual `seed`."""
        super().__init__(robot, seed)
        self.time = 0.0
        self.script = script

    def step(self, duration: float) -> None:
        """Let the script act, then time pass [s]."""
        self.script(self)
        super().step(duration)
        self.time += duration


class GraspAndCut:
    """The paper's estimation experiment: grasp midway, then cut; here every muscle in turn.

    A cut comes when the muscle carries tension; if it never does, it is cut all the same at the end
    of its wait, and `carried` says so.

    Attributes:
        grasp: When the weight comes into the hand [s].
        order: Muscles in the order of their cuts.
        cut: When each muscle was cut [s], order of T, shape (M,).
        carried: Whether it carried tension then, shape (M,).
    """

    def __init__(self, robot: Robot, duration: float, seed: int) -> None:
        """Plan a motion of `duration` [s] and the cuts that follow it."""
        count = robot.muscle_count
        self.grasp, self._motion = 0.5 * duration, duration
        # The second muscle first: it is the one that the paper deactivates.
        self.order = [*range(min(1, count - 1), count), *range(min(1, count - 1))]
        self.cut = np.full(count, np.nan)
        self.carried = np.zeros(count, dtype=bool)
        self._robot = robot
        self._wait = np.random.default_rng([seed, 0xC7]).uniform(0.0, EARLIEST_CUT, count)

    @property
    def duration(self) -> float:
        """Of everything [s]."""
        return self._motion + SLOT * len(self.order)

    def while_cut(self, values: Array, muscle: int) -> Array:
        """Return the rows of values (N, …) of the messages while a muscle was cut."""
        cut = float(self.cut[muscle])
        return values[message_rows(cut + FALLEN, cut + CUT_TIME)]

    def disturbed(self, count: int) -> NDArray[np.bool_]:
        """Return in which of so many messages a muscle is cut, or was until a moment ago."""
        disturbed = np.zeros(count, dtype=bool)
        for cut in self.cut:
            disturbed[message_rows(float(cut), float(cut) + CUT_TIME + RECOVERED)] = True
        return disturbed

    def __call__(self, arm: ScriptedArm) -> None:
        """Act."""
        now = arm.time + 1e-9
        if now >= self.grasp and arm.time - self.grasp < 0.011:
            arm.set_payload(PAYLOAD)
        place = int((now - self._motion) // SLOT)
        if not 0 <= place < len(self.order):
            return
        muscle, elapsed = self.order[place], now - self._motion - SLOT * place
        if np.isnan(self.cut[muscle]):
            carries = arm.tension[muscle] > self._robot.tension.bias + CARRYING
            if elapsed >= LATEST_CUT or (carries and elapsed >= self._wait[muscle]):
                arm.set_ruptured([self._robot.muscles[muscle]])
                self.cut[muscle], self.carried[muscle] = arm.time, carries
        elif abs(now - self.cut[muscle] - CUT_TIME) < 0.005:
            arm.set_ruptured([])


def grasping(arm: ScriptedArm) -> None:
    """Grasp and release every minute."""
    if abs(arm.time / 60.0 - round(arm.time / 60.0)) < 1e-5:
        arm.set_payload(PAYLOAD if round(arm.time / 60.0) % 2 else 0.0)
