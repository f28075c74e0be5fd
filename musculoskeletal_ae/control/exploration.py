# SPDX-License-Identifier: Apache-2.0
"""Random motion that collects data: the paper's three steps, repeated.

1. 5 s: `first` with a random θ_target and T_const = T_bias,
2. 2 s: `second`, the same θ_target with the tension of the moment,
3. 3 s: `first` again with a random T_const in [T_bias, T_limit]

(paper, section "Online Learning of Musculoskeletal AutoEncoder"). Each step ramps the command and
then rests, since the body is learned at rest. Targets are drawn among the postures that the arm can
hold with tensions in [T_bias, T_limit].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import InfeasibleError, RobotDescriptionError
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension

DURATIONS = (5.0, 2.0, 3.0)  # [s]
# Share of a step in which the command moves; the arm settles and is sampled in the rest.
RAMP_SHARE = 0.6
TRIES = 1000


class Step(NamedTuple):
    """One step of the exploration.

    Attributes:
        method: 'first' or 'second'.
        theta: θ_target [rad], shape (D,).
        tension: T_const [N] of `first`, shape (M,); `second` takes the tension of the moment, and
            this is what the geometric model expects it to be.
        duration: [s].
    """

    method: str
    theta: Array
    tension: Array
    duration: float


class Exploration:
    """An endless, reproducible stream of exploration steps."""

    def __init__(self, robot: Robot, seed: int) -> None:
        """Explore `robot`; the stream is the seed's."""
        self._robot = robot
        self._rng = np.random.default_rng([seed, 0xE8])
        self._pending: list[Step] = []

    def begin_cycle(self) -> None:
        """Go on with a new posture, as after a pause; the stream itself goes on."""
        self._pending = []

    def next_step(self) -> Step:
        """Return the next of the three steps; a new random posture starts each cycle."""
        if not self._pending:
            self._pending = self._cycle()
        return self._pending.pop(0)

    def _cycle(self) -> list[Step]:
        robot, tension = self._robot, self._robot.tension
        theta, holding = self._holdable_posture()
        bias = np.full(robot.muscle_count, tension.bias)
        constant = self._rng.uniform(tension.bias, tension.limit, robot.muscle_count)
        return [
            Step('first', theta, bias, DURATIONS[0]),
            Step('second', theta, holding, DURATIONS[1]),
            Step('first', theta, constant, DURATIONS[2]),
        ]

    def _holdable_posture(self) -> tuple[Array, Array]:
        """Return a random posture and the least tension that holds it."""
        robot, tension = self._robot, self._robot.tension
        for _ in range(TRIES):
            theta = robot.random_postures(1, self._rng)[0]
            jacobian = robot.routes.muscle_jacobian(theta)
            torque = robot.kinematics.holding_torque(theta)
            try:
                return theta, holding_tension(jacobian, torque, tension.bias, tension.limit, 0.0)
            except InfeasibleError:
                continue
        raise RobotDescriptionError(
            f'{robot.description.directory}: none of {TRIES} random postures can be held with '
            f'tensions in [{tension.bias:g}, {tension.limit:g}] N; run check_robot'
        )
