# SPDX-License-Identifier: Apache-2.0
"""From a robot description to a network that can run: training, residuals, history in one call."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from musculoskeletal_ae.mae.evaluation import geometric_anomaly
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import to_mae
from musculoskeletal_ae.mae.training import Progress, initial_training
from musculoskeletal_ae.presets import PRESETS
from musculoskeletal_ae.robot.robot import Robot


class Trained(NamedTuple):
    """A network ready for a checkpoint, and the loss of every mini-batch on the way."""

    mae: Mae
    losses: list[float]


def initial_mae(
    robot: Robot,
    preset: str = 'default',
    seed: int = 0,
    progress: Progress | None = None,
    steps: int | None = None,
) -> Trained:
    """Train on the geometric model, with anomaly statistics of it that are not calibrated.

    Args:
        robot: The nominal body.
        preset: 'paper' or 'default'.
        seed: Same seed, same network (on the same machine).
        progress: Told (step, loss) after every mini-batch.
        steps: Fewer or more mini-batches than the preset's.
    """
    network, losses = initial_training(robot, preset, seed, progress, steps)
    settings = PRESETS[preset].training
    history = (
        f'initial training on the geometric model of {robot.description.directory.name}: '
        f'preset {preset}, seed {seed}, {len(losses)} mini-batches of {settings.batch} '
        f'by {settings.optimiser}'
    )
    mae = to_mae(network, robot.joints, robot.muscles, preset, history)
    return Trained(replace(mae, anomaly=geometric_anomaly(mae, robot, seed)), losses)
