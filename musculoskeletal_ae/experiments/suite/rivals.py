# SPDX-License-Identifier: Apache-2.0
"""Estimators from before the autoencoder on the held-out motion, before and after learning.

They learn from the very samples at rest that the autoencoder learnt from. Table search, whose table
cannot be filled from so few postures, is also given the whole stream at 10 Hz.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.experiments.baselines.estimator import Baseline
from musculoskeletal_ae.experiments.baselines.geometric import GeometricLeastSquares
from musculoskeletal_ae.experiments.baselines.mapping import PolynomialFilter
from musculoskeletal_ae.experiments.baselines.table import TableSearch
from musculoskeletal_ae.experiments.least_squares import mean_error
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, Recording
from musculoskeletal_ae.experiments.suite.learning import EXPLORING, rest_samples
from musculoskeletal_ae.experiments.suite.study import Study

STREAM_STRIDE = 10


def rivals(study: Study, seed: int, held_out: Recording) -> dict[str, dict[str, float]]:
    """Return for each estimator its error before and after learning [rad]."""
    robot = study.body()
    samples = rest_samples(study, seed)
    stream = study.stream(seed, EXPLORING)
    part = slice(None, None, STREAM_STRIDE)
    moving = stream.theta_sensor[part], stream.tension[part], stream.length[part]
    table: dict[str, dict[str, float]] = {}
    for kind in (GeometricLeastSquares, PolynomialFilter, TableSearch):
        untaught: Baseline = kind(robot)
        before = error(untaught, held_out)
        if isinstance(untaught, GeometricLeastSquares):  # has nothing to learn
            table[untaught.name] = {'before_rad': before, 'after_rad': before}
            continue
        taught: dict[str, Baseline] = {'': kind(robot), ', whole stream': kind(robot)}
        for (suffix, baseline), data in zip(taught.items(), (samples, moving), strict=True):
            if len(data[0]):
                baseline.learn(*data)
            name = baseline.name + suffix
            table[name] = {'before_rad': before, 'after_rad': error(baseline, held_out)}
    return table


def error(baseline: Baseline, recording: Recording) -> float:
    """Return the mean of ‖θ_est − θ_true‖₂ [rad] over the messages a baseline is given."""
    part = slice(None, None, baseline.stride)
    estimate = baseline.estimate(
        recording.tension[part], recording.length[part], baseline.stride * SAMPLE_TIME
    )
    if not np.isfinite(estimate).all():
        raise FloatingPointError(f'{baseline.name} diverged')
    return mean_error(estimate, recording.theta[part])
