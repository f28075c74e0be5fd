# SPDX-License-Identifier: Apache-2.0
"""Base class of all online learning methods: an updater trains a network on samples.

An updater keeps its network and optimiser between updates. Each preset chooses its own updater
(`Preset.make_updater`).
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from dataclasses import replace

import numpy as np

from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.body_model.covariance import (
    drive_covariance,
    estimate_covariance,
    length_spread,
    observed_theta,
)
from musculoskeletal_ae.body_model.postures import FittedBody
from musculoskeletal_ae.learning.detector_calibration import recalibrated, uncalibrated
from musculoskeletal_ae.learning.scheduler import Job, Update
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import Network, to_mae
from musculoskeletal_ae.mae.residuals import TouchStatistics
from musculoskeletal_ae.robot.robot import Robot

#: separate initial training and online learning by this text in `Mae.training`
LEARNED = '; learned online: '
NEWEST = 20  # compute the estimation error over this many newest samples


class Updater(ABC):
    """Base class of an online learning method; it keeps its network between updates."""

    def __init__(self, robot: Robot, mae: Mae, seed: int = 0) -> None:
        """Continue from a network; `seed` is the random seed."""
        self._robot, self._mae, self._seed = robot, mae, seed

    @property
    def body(self) -> CalibratedBody | None:
        """The most recently fitted body; None if the method fits none."""
        return None

    def update(self, job: Job) -> Update:
        """Update body and network once, and return the result.

        The duration is bounded, because the numbers of samples and training steps are bounded.
        """
        start, newest = time.perf_counter(), job.observed[-NEWEST:]
        mae = self._mae.without(job.isolated)
        estimate = observed_theta(mae, newest)
        errors = self._robot.units.mean_errors(estimate - newest.theta)
        update = self._learn(job)
        return update._replace(errors=errors, seconds=time.perf_counter() - start)

    @abstractmethod
    def _learn(self, job: Job) -> Update: ...

    def _published(
        self, network: Network, preset: str, steps: int, job: Job, fit: FittedBody | None = None
    ) -> Mae:
        """Return the trained network as an `Mae` with its statistics and its training history."""
        before, samples = self._mae, len(job.observed)
        history = (
            f'{before.training.split(LEARNED)[0]}{LEARNED}'
            f'{samples} samples at rest, preset {preset}, {steps} steps'
        )
        mae = to_mae(network, before.joints, before.muscles, before.preset, history)
        mae = mae.without(job.isolated)
        before = before.without(job.isolated)
        before = before if job.statistics_hold else uncalibrated(before)
        if self.body is not None:
            touch = TouchStatistics(
                self.body.frictions(),
                np.ones(self._robot.joint_count),
                drive=self.body.drive,
                drive_covariance=None if fit is None else drive_covariance(self.body, fit),
            )
            mae = replace(mae, touch=touch)
            if self.body.elasticity.is_present:
                mae = replace(mae, elasticity=self.body.elasticity)
        mae = recalibrated(mae, before.anomaly, job.healthy, samples)
        if fit is not None and self.body is not None:
            tension, judging = job.observed.end_tension(mae.transmission), job.healthy.judging
            covariance = estimate_covariance(mae, self.body, fit, tension, self._seed, judging)
            spread = length_spread(self.body, fit, self._seed)
            mae = replace(mae, covariance=covariance, length_spread=spread)
        self._mae = mae
        return mae
