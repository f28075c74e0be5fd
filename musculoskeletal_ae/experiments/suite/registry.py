# SPDX-License-Identifier: Apache-2.0
"""Names of the experiments, what measures them and how long that takes."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from musculoskeletal_ae.experiments.suite import (
    body_change,
    control,
    estimation,
    loss_change,
    simulation,
)
from musculoskeletal_ae.experiments.suite.study import Measured, Progress, Study


class Experiment(NamedTuple):
    """One experiment on one individual.

    Attributes:
        measure: Returns numbers and traces.
        weight: How long it takes, beside the others; for order and progress bar only.
    """

    measure: Callable[[Study, int, Progress], Measured]
    weight: float


LEARNING = 'online_learning'  # is measured where the networks are learnt, see suite.learning
LEARNING_WEIGHT = 12.0

AFTERWARDS = {
    'estimation': Experiment(estimation.measure, 6.0),
    'control': Experiment(control.measure, 10.0),
    'simulation': Experiment(simulation.measure, 3.0),
    'loss_change': Experiment(loss_change.measure, 0.5),
    'body_change': Experiment(body_change.measure, 0.2),
}
NAMES = (LEARNING, *AFTERWARDS)
