# SPDX-License-Identifier: Apache-2.0
"""Trains the initial network of a robot on its geometric model, as a preset specifies."""

from dataclasses import replace

import numpy as np

from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import Network, to_mae
from musculoskeletal_ae.mae.residuals import NORM, AnomalyStatistics, anomaly, residuals
from musculoskeletal_ae.mae.training import Progress, rest_states
from musculoskeletal_ae.presets.registry import preset_named
from musculoskeletal_ae.robot.robot import Robot

#: compute the first mean and covariance of the residuals from this many held-out states
HELD_OUT_STATES = 5000


def initial_mae(
    robot: Robot,
    preset: str = 'default',
    seed: int = 0,
    progress: Progress | None = None,
    steps: int | None = None,
) -> Mae:
    """Train a network on the geometric model, and add anomaly statistics of the model.

    Args:
        robot: The geometric model.
        preset: Name of the preset.
        seed: Random seed; on the same machine, the same seed gives the same network.
        progress: Function that is called after every mini-batch; see `Progress`.
        steps: Number of mini-batches; None for the preset's number.
    """
    chosen = preset_named(preset)
    steps = chosen.initial_steps(robot) if steps is None else steps
    network = chosen.train_initial(robot, seed, steps, progress)
    return completed(robot, network, preset, seed, steps)


def completed(robot: Robot, network: Network, preset: str, seed: int, steps: int) -> Mae:
    """Complete a trained network to a `Mae` with its history and anomaly statistics.

    The statistics are those of held-out states of the geometric model.

    Args:
        robot: The geometric model.
        network: The network of the initial training.
        preset: Name of the preset that trained it.
        seed: Random seed of the training.
        steps: Number of mini-batches.
    """
    history = (
        f'initial training on the geometric model of {robot.description.directory.name}: '
        f'preset {preset}, seed {seed}, {steps} mini-batches'
    )
    mae = to_mae(network, robot.joints, robot.muscles, preset, history)
    rng = np.random.default_rng([seed, 1])
    _, tension, length = rest_states(robot, HELD_OUT_STATES, rng)
    error = residuals(mae.estimate(tension, length), tension, length)
    statistics = AnomalyStatistics.of(error, calibrated=False)
    statistics = replace(statistics, thresholds={NORM: float(anomaly(error).max())})
    return replace(mae, anomaly=statistics)
