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

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import InfeasibleError, RobotDescriptionError
from musculoskeletal_ae.robot.description import shown
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension

DURATIONS = (5.0, 2.0, 3.0)  # [s]
# Share of a step in which the command moves; the arm settles and is sampled in the rest.
RAMP_SHARE = 0.6
TRIES = 1000


class Step(NamedTuple):
    """One step of the exploration."""

    method: str  # 'first' or 'second'
    theta: Array  # θ_target [rad], (D,)
    # T_const [N] of `first`, (M,); of `second`, which takes the tension of the moment, what the
    # geometric model expects that to be
    tension: Array
    duration: float  # [s]


class Exploration:
    """A reproducible stream of steps; iterating again goes on with it at a new posture."""

    def __init__(self, robot: Robot, seed: int) -> None:
        self._robot, self._rng = robot, np.random.default_rng([seed, 0xE8])

    def __iter__(self) -> Iterator[Step]:
        robot, rng, limits = self._robot, self._rng, self._robot.tension
        bias = np.full(robot.muscle_count, limits.bias)
        while True:
            postures = (robot.random_postures(1, rng)[0] for _ in range(TRIES))
            ((theta, holding),) = holdable_postures(robot, postures, 1)
            constant = rng.uniform(limits.bias, limits.limit, robot.muscle_count)
            yield Step('first', theta, bias, DURATIONS[0])
            yield Step('second', theta, holding, DURATIONS[1])
            yield Step('first', theta, constant, DURATIONS[2])


def holdable_postures(
    robot: Robot, postures: Iterable[Array], count: int, *others: Callable[[Array], Array]
) -> list[tuple[Array, Array]]:
    """Return the first of random θ (D,) that can be held, each with the least T [N] (M,).

    They can be held with the nominal G and with every other, given as for `muscle_hessian`; T is
    that of the last one. A RobotDescriptionError says that there are not so many.
    """
    held: list[tuple[Array, Array]] = []
    for theta in postures:
        with suppress(InfeasibleError):
            for muscle_jacobian in (robot.routes.muscle_jacobian, *others):
                tension = holding_tension(robot, theta, jacobian=muscle_jacobian(theta[None])[0])
            held.append((theta, tension))
        if len(held) == count:
            return held
    raise RobotDescriptionError(
        f'{robot.description.directory}: only {len(held)} of {TRIES} random postures can be held '
        f'with tensions in [{shown(robot.tension.bias)}, {shown(robot.tension.limit)}] N; '
        'run check_robot'
    )
