# SPDX-License-Identifier: Apache-2.0
"""How learning changes the body: l against the shoulder's angle and against tension.

l(θ) at T = 0 over −120…30° of the shoulder, and l(T) over 0…T_max at θ = 0, through ① of the
network before and after learning, beside the true body. All other joints are at θ = 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.experiments.suite.learning import rest_samples
from musculoskeletal_ae.experiments.suite.roles import shoulder
from musculoskeletal_ae.experiments.suite.study import Measured, Progress, Study
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

SWEEP = np.radians(np.linspace(-120.0, 30.0, 151))  # [rad]
POINTS = 101  # of tension


def measure(study: Study, seed: int, progress: Progress) -> Measured:
    """Return the numbers and traces of one individual."""
    robot = study.body()
    individual = Individual(robot, seed)
    joint = shoulder(robot)
    theta, tension = (
        np.zeros((len(SWEEP), robot.joint_count)),
        np.linspace(0.0, robot.tension.max, POINTS),
    )
    theta[:, joint] = SWEEP
    by_angle = theta, np.zeros((len(SWEEP), robot.muscle_count))
    by_tension = (
        np.zeros((POINTS, robot.joint_count)),
        np.repeat(tension[:, None], robot.muscle_count, axis=1),
    )
    networks = {'before': study.initial(robot), 'after': study.learnt(robot, seed)}
    traces: dict[str, Any] = {
        'joint': robot.joints[joint],
        'angle': SWEEP,
        'tension': tension,
        'angle_trained': (robot.lower[joint] <= SWEEP) & (robot.upper[joint] >= SWEEP),
        'tension_trained': _explored(study, seed, robot, tension),
    }
    numbers: dict[str, Any] = {'joint': robot.joints[joint]}
    for name, points in (('angle', by_angle), ('tension', by_tension)):
        true = individual.muscle_lengths(*points)
        curves = {when: _lengths(mae, points) for when, mae in networks.items()}
        traces[f'by_{name}'] = {**curves, 'true': true}
        trained = traces[f'{name}_trained']
        numbers[f'{name}_change_mm'] = _by_muscle(
            robot, 1e3 * np.abs(curves['after'] - curves['before'])[trained].max(axis=0)
        )
        for when, length in curves.items():
            # Beside the zero that each curve has its own: only their shapes are compared.
            off = (length - true)[trained]
            shape = 1e3 * (off - off.mean(axis=0)).std(axis=0)
            numbers[f'{name}_{when}_shape_mm'] = float(shape.mean())
    progress(1.0)
    return Measured(numbers, traces)


def _lengths(mae: Mae, points: tuple[Array, Array]) -> Array:
    return mae.lengths(*points)


def _explored(study: Study, seed: int, robot: Robot, tension: Array) -> NDArray[np.bool_]:
    """Return which tensions the learner's samples reached in any muscle."""
    samples = rest_samples(study, seed)[1]
    if not samples.size:
        return tension <= robot.tension.limit
    explored: NDArray[np.bool_] = (tension >= samples.min()) & (tension <= samples.max())
    return explored


def _by_muscle(robot: Robot, values: Array) -> dict[str, float]:
    return dict(zip(robot.muscles, values.tolist(), strict=True))
