# SPDX-License-Identifier: Apache-2.0
"""An update of preset `default`: it finds out the body, then lets the network learn that.

1. Fit the calibrated body to the samples (`body`), and move the network by what lengths changed by
   everywhere: zeros, and wires that creep, need no training, and no average of weights lags behind.
2. Draw synthetic samples of it, and put real ones in the place of some: rests, and messages of the
   moving arm, of which there are many more and which say what rests do not (how wires slide, what
   the body cannot say).
3. Train the network on them for a bounded number of steps.
4. Take the residuals' statistics of healthy messages (`calibration`).

The body needs few samples because the geometric model and its tolerances are known; the network
needs many, and gets them from the body.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.body import CalibratedBody
from musculoskeletal_ae.learning.body_fit import (
    LEAST_CHANGE,
    OUTLIER,
    BodyFit,
    contradicted_muscles,
)
from musculoskeletal_ae.learning.covariance import MANY, observed_theta
from musculoskeletal_ae.learning.fit import Fit
from musculoskeletal_ae.learning.network_trainer import BATCH, NetworkTrainer
from musculoskeletal_ae.learning.samples import Observations
from musculoskeletal_ae.learning.synthetic import TrainingData, synthetic_samples
from musculoskeletal_ae.learning.trainer import Job, Update
from musculoskeletal_ae.learning.updater import LEARNED, Updater
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import from_mae
from musculoskeletal_ae.robot.robot import Robot

REAL_SHARE = 0.1
#: share of synthetic samples that many messages of the moving arm take the place of; half of that,
#: when there are `MANY`
MOVING_SHARE = 0.3
#: how often a synthetic sample is used before it is forgotten
USES = 3
#: a real sample that fits the body worse than this weight is not shown to the network
TRUSTED = 0.3


def learned_steps(mae: Mae) -> int:
    """Return how many steps of preset `default` a network has learned on a real arm, or 0."""
    said = re.search(f'{LEARNED}.*, preset default, (\\d+) steps$', mae.training)
    return int(said[1]) if said else 0


class BodyUpdater(Updater):
    """Learns by the calibrated body."""

    def __init__(self, robot: Robot, mae: Mae, seed: int = 0) -> None:
        """Go on from a network, and from the body that it knows if it has learned one."""
        super().__init__(robot, mae, seed)
        steps = learned_steps(mae)
        self.body_fit = BodyFit(robot, mae if steps else None, seed)
        self._trainer = NetworkTrainer(from_mae(mae), seed, steps)
        self._rng = np.random.default_rng([seed, 0xD2])
        self._statistics_held = True

    @property
    def body(self) -> CalibratedBody:
        """The body as it was fitted last."""
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
        # Several at once are no replaced muscles but a joint sensor that slipped or a touched arm:
        # the robust weights leave such samples out until they are the rule.
        alone = len(contradicted) == 1
        if self._statistics_held and not job.statistics_hold:
            self._trainer.restart()
        self._statistics_held = job.statistics_hold
        count = max(BATCH, job.steps * BATCH // USES)
        data = synthetic_samples(self.body, fit.noise, count, self._rng)
        self._mix_in_real(data, replace(observed, theta=fit.theta), fit)
        if job.healthy.learned is not None:
            self._mix_in_moving(data, job.healthy.learned, fit.noise)
        loss_now = self._trainer.train(data, job.steps)
        return Update(
            self._published(self._trainer.network, 'default', self._trainer.steps, job, fit),
            loss_now,
            fit.noise,
            contradicted if alone else (),
            () if alone else tuple(muscle for muscle, _ in contradicted),
        )

    def _at_angles(self, read: Observations | None) -> Observations | None:
        """Return messages with θ less what the joint sensors' zeros were found to be."""
        return read and replace(read, theta=read.theta - self.body.zero)

    def _mix_in_real(self, data: TrainingData, observed: Observations, fit: Fit) -> None:
        """Put real samples in the place of some."""
        trusted = np.flatnonzero((fit.weight > TRUSTED).all(axis=1))
        self._put(data, observed[trusted], slice(int(REAL_SHARE * len(data.entered))))

    def _mix_in_moving(self, data: TrainingData, observed: Observations, noise: Array) -> None:
        """Put messages in the place of some, but none that contradict the body."""
        (length,) = self.body.lengths(observed.theta, observed.tension, observed.direction)
        off = np.abs(observed.length + self.body.crept(observed.age) - length)
        sound = np.flatnonzero((off <= np.maximum(OUTLIER * noise, LEAST_CHANGE)).all(axis=1))
        share = MOVING_SHARE * len(sound) / (len(sound) + MANY)
        self._put(
            data, observed[sound], slice(len(data.entered) - int(share * len(data.entered)), None)
        )

    def _put(self, data: TrainingData, real: Observations, places: slice) -> None:
        """Put some of what was measured there, with T as the elastic units have it."""
        if len(real) == 0:
            return
        real = real[self._rng.integers(len(real), size=len(data.entered[places]))]
        state = real.state()._replace(tension=real.end_tension(self.body.frictions()))
        data.entered[places] = state.scaled()
        length = real.length + self.body.crept(real.age)
        data.true[places] = state._replace(length=length).scaled()
