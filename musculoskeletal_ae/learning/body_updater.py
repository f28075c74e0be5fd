# SPDX-License-Identifier: Apache-2.0
"""An update of preset `default`: fits the calibrated body, then trains the network on it.

1. Fit the calibrated body to the samples (`body_model/`). Shift the network's lengths by the mean
   change of each muscle's length, so that length offsets and creep need no training.
2. Draw synthetic samples of the body, and replace some of them by real ones: rest samples and the
   far more numerous motion samples. Motion samples show effects that rest samples and the body
   model lack, such as tendon sliding.
3. Train the network on these samples for a bounded number of steps.
4. Compute the statistics of the residuals on healthy messages (`detector_calibration`), and the
   expected covariance of the estimation errors (`covariance`).

The body can be fitted to few samples, because the geometric model and its tolerances are known. The
network needs many samples, which are drawn from the body.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.body_model.body_fit import (
    LEAST_CHANGE,
    OUTLIER,
    BodyFit,
    contradicted_muscles,
)
from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.body_model.covariance import MANY_MESSAGES, observed_theta
from musculoskeletal_ae.body_model.observations import Observations
from musculoskeletal_ae.body_model.postures import FittedBody
from musculoskeletal_ae.body_model.synthetic import TrainingData, synthetic_samples
from musculoskeletal_ae.learning.network_trainer import BATCH, NetworkTrainer
from musculoskeletal_ae.learning.scheduler import Job, Update
from musculoskeletal_ae.learning.updater import LEARNED, Updater
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import from_mae
from musculoskeletal_ae.robot.robot import Robot

REAL_SHARE = 0.1  # replace this share of the training samples by rest samples
#: replace at most this share of the training samples by motion samples; fewer if there are few, and
#: half of this share if there are MANY_MESSAGES of them
MOVING_SHARE = 0.3
USES = 3  # use each drawn training sample this many times on average in one update
LEAST_WEIGHT = 0.3  # train only with rest samples whose robust weight in the fit is at least this


def learned_steps(mae: Mae) -> int:
    """Return how many online training steps of preset `default` a network has had.

    The number comes from the description of its training. It is 0 if the network has not learned
    online with this preset.
    """
    match = re.search(f'{LEARNED}.*, preset default, (\\d+) steps$', mae.training)
    return int(match[1]) if match else 0


class BodyUpdater(Updater):
    """Updater of preset `default`: fits the calibrated body, and trains the network on it."""

    def __init__(self, robot: Robot, mae: Mae, seed: int = 0) -> None:
        """Continue from a network, and from a body fitted to it if it has learned a real arm."""
        super().__init__(robot, mae, seed)
        steps = learned_steps(mae)
        self.body_fit = BodyFit(robot, mae if steps else None, seed)
        self._trainer = NetworkTrainer(from_mae(mae), seed, steps)
        self._rng = np.random.default_rng([seed, 0xD2])
        self._statistics_held = True

    @property
    def body(self) -> CalibratedBody:
        """The most recently fitted body."""
        return self.body_fit.body

    def _learn(self, job: Job) -> Update:
        observed = job.observed
        if self.body_fit.is_of_another_arm(observed):
            self.body_fit.start_anew()
            self._trainer.restart()
        fit = self.body_fit.fit(observed, observed_theta(self._mae, observed))
        learned, judging = map(self._at_angles, (job.healthy.learned, job.healthy.judging))
        job = job._replace(healthy=job.healthy._replace(learned=learned, judging=judging))
        self._trainer.move(self.body_fit.lengthened())
        contradicted = contradicted_muscles(observed, fit)
        # If several muscles are contradicted, the cause is probably contact and not replaced
        # muscles. The robust weights then exclude the newest samples, until they are the majority.
        if self._statistics_held and not job.statistics_hold:
            self._trainer.restart()
        self._statistics_held = job.statistics_hold
        count = max(BATCH, job.steps * BATCH // USES)
        data = synthetic_samples(self.body, fit.noise, count, self._rng)
        self._mix_in_real(data, replace(observed, theta=fit.theta), fit)
        if job.healthy.learned is not None:
            self._mix_in_moving(data, job.healthy.learned, fit.noise)
        loss_now = self._trainer.train(data, job.steps)
        remainder = self.body.remainder.at(fit.theta, observed.tension)
        return Update(
            self._published(self._trainer.network, 'default', self._trainer.steps, job, fit),
            loss_now,
            fit.noise,
            contradicted if len(contradicted) == 1 else (),
            remainder=np.sqrt(np.square(remainder).mean(axis=0)),
            sensor_offset=self.body.zero.copy(),
        )

    def _at_angles(self, read: Observations | None) -> Observations | None:
        """Return messages with θ corrected for the estimated joint-sensor offsets.

        Without messages, return None.
        """
        return read and replace(read, theta=read.theta - self.body.zero)

    def _mix_in_real(self, data: TrainingData, observed: Observations, fit: FittedBody) -> None:
        """Replace some training samples by rest samples that fit the body."""
        trusted = np.flatnonzero((fit.weight > LEAST_WEIGHT).all(axis=1))
        self._put(data, observed[trusted], slice(int(REAL_SHARE * len(data.entered))))

    def _mix_in_moving(self, data: TrainingData, observed: Observations, noise: Array) -> None:
        """Replace some training samples by motion samples that do not contradict the body."""
        (length,) = self.body.lengths(observed.theta, observed.tension, observed.direction)
        error = np.abs(observed.length + self.body.crept(observed.age) - length)
        sound = np.flatnonzero((error <= np.maximum(OUTLIER * noise, LEAST_CHANGE)).all(axis=1))
        share = MOVING_SHARE * len(sound) / (len(sound) + MANY_MESSAGES)
        self._put(
            data, observed[sound], slice(len(data.entered) - int(share * len(data.entered)), None)
        )

    def _put(self, data: TrainingData, real: Observations, places: slice) -> None:
        """Put random real samples into the training data at `places`.

        The tensions of real samples are converted to bone-side tensions, and their target lengths
        are corrected for the creep since the samples were taken.
        """
        if len(real) == 0:
            return
        real = real[self._rng.integers(len(real), size=len(data.entered[places]))]
        state = real.state()._replace(tension=real.end_tension(self.body.transmission))
        data.entered[places] = state.scaled()
        length = real.length + self.body.crept(real.age)
        data.true[places] = state._replace(length=length).scaled()
