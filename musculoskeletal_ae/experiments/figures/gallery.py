# SPDX-License-Identifier: Apache-2.0
"""Which plots belong to which experiment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from musculoskeletal_ae.experiments.figures import (
    body_change,
    control,
    estimation,
    loss_change,
    online_learning,
    simulation,
)
from musculoskeletal_ae.experiments.figures.style import Plot
from musculoskeletal_ae.experiments.suite.study import Measured, Study
from musculoskeletal_ae.robot.robot import Robot

Plotter = Callable[[Study, Robot, Mapping[int, Measured], Path], list[Plot]]

PLOTTERS: dict[str, Plotter] = {
    'online_learning': online_learning.plot,
    'estimation': estimation.plot,
    'control': control.plot,
    'simulation': simulation.plot,
    'loss_change': loss_change.plot,
    'body_change': body_change.plot,
}
