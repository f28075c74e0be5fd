# SPDX-License-Identifier: Apache-2.0
"""How well a network restores a body: the nine (mask, output) pairs, in rad, N and mm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.anomaly_statistics import AnomalyStatistics
from musculoskeletal_ae.mae.mae import Mae, State
from musculoskeletal_ae.mae.samples import geometric_samples
from musculoskeletal_ae.mae.units import LENGTH_SCALE, TENSION_SCALE, Mask, scale_vector
from musculoskeletal_ae.robot.robot import Robot

#: outputs with the unit and the factor from SI that errors are shown in
OUTPUTS = (('theta', 'rad', 1.0), ('tension', 'N', 1.0), ('length', 'mm', 1e3))


@dataclass(frozen=True)
class PairError:
    """Error of one output entered by one mask.

    Attributes:
        mask: How the network was entered.
        output: 'theta', 'tension' or 'length'.
        unit: Unit of the numbers.
        norm: Mean over samples of the L2 norm of the error.
        elements: Mean absolute error of each joint or muscle, shape (D,) or (M,).
    """

    mask: Mask
    output: str
    unit: str
    norm: float
    elements: Array


def unseen_states(
    robot: Robot, count: int, rng: np.random.Generator, lowest: float, highest: float
) -> State:
    """Return random states in SI units with every T uniform in [lowest, highest] [N]."""
    theta = robot.random_postures(count, rng)
    tension = rng.uniform(lowest, highest, (count, robot.muscle_count))
    return State(theta, tension, robot.muscle_lengths(theta, tension))


def pair_errors(mae: Mae, states: State) -> list[PairError]:
    """Return the error of each of the nine (mask, output) pairs over given states."""
    result = []
    for mask in Mask:
        restored = mae.decode(mae.encode(mask, *states))
        for (output, unit, factor), got, true in zip(OUTPUTS, restored, states, strict=True):
            error = factor * (got - true)
            norm = float(np.linalg.norm(error, axis=1).mean())
            result.append(PairError(mask, output, unit, norm, np.abs(error).mean(axis=0)))
    return result


def jacobian_error(mae: Mae, robot: Robot, states: State) -> tuple[float, float]:
    """Return the mean absolute error of G through ① and the mean size of G itself [mm/rad]."""
    true = robot.routes.muscle_jacobian(states.theta)
    slope = robot.series_elastic.length_slope(states.tension)[..., None]
    true = true * (1.0 - slope)  # l = f_geo − L_e(l_abs, T), and L_e grows with l_abs
    error = mae.muscle_jacobian(states.theta, states.tension) - true
    return float(1e3 * np.abs(error).mean()), float(1e3 * np.abs(true).mean())


def residuals(mae: Mae, tension: Array, length: Array) -> Array:
    """Return e = (T_est − T, l_est − l) of ② in scaled units, shape (..., 2M)."""
    restored = mae.estimate(tension, length)
    return np.concatenate(
        [
            TENSION_SCALE * (restored.tension - tension),
            LENGTH_SCALE * (restored.length - length),
        ],
        axis=-1,
    )


def geometric_anomaly(mae: Mae, robot: Robot, seed: int, count: int = 5000) -> AnomalyStatistics:
    """Return the residuals' statistics on unseen data of the geometric model: not calibrated."""
    rng = np.random.default_rng([seed, 1])
    scale = scale_vector(robot.joint_count, robot.muscle_count)
    values = geometric_samples(robot, count, rng, robot.tension.limit) / scale
    tension, length = np.split(values[:, robot.joint_count :], 2, axis=1)
    error = residuals(mae, tension, length)
    halves = error.reshape(count, 2, -1)
    anomaly = np.linalg.norm(halves, axis=2).sum(axis=1)  # A of the paper
    return AnomalyStatistics.of(error, calibrated=False, thresholds={'norm': float(anomaly.max())})
