# SPDX-License-Identifier: Apache-2.0
"""An update: what the network learns from the samples so far, in either preset.

Preset `default` finds out the body from the samples, then lets the network learn that:

1. Fit the calibrated body to the samples (`body`), and move the network by what lengths changed by
   everywhere: zeros, and wires that creep, need no training, and no average of weights lags behind.
2. Draw synthetic samples of it, and put real ones in the place of some: rests, and messages of the
   moving arm, of which there are many more and which say what rests do not (how wires slide, what
   the body cannot say).
3. Train the network on them for a bounded number of steps.
4. Take the residuals' statistics of healthy messages (`calibration`).

The body needs few samples because the geometric model and its tolerances are known; the network
needs many, and gets them from the body. Preset `paper` trains on the samples alone.
"""

from __future__ import annotations

import math
import re
import time
from abc import ABC, abstractmethod
from dataclasses import replace

import numpy as np
import torch

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.body import CalibratedBody
from musculoskeletal_ae.learning.body_fit import (
    LEAST_CHANGE,
    OUTLIER,
    BodyFit,
    contradicted_muscles,
)
from musculoskeletal_ae.learning.calibration import recalibrated, uncalibrated
from musculoskeletal_ae.learning.covariance import MANY, estimate_covariance, observed_theta
from musculoskeletal_ae.learning.fit import Fit
from musculoskeletal_ae.learning.network_trainer import BATCH, NetworkTrainer
from musculoskeletal_ae.learning.samples import Observations
from musculoskeletal_ae.learning.synthetic import TrainingData, synthetic_samples
from musculoskeletal_ae.learning.trainer import Job, Update
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import Network, from_mae, to_mae
from musculoskeletal_ae.mae.optimiser import Optimiser
from musculoskeletal_ae.mae.residuals import TouchStatistics
from musculoskeletal_ae.mae.training import loss, one_thread
from musculoskeletal_ae.presets import PAPER, Preset
from musculoskeletal_ae.robot.robot import Robot

#: between how the network was made and what it learned since, in `Mae.training`
LEARNED = '; learned online: '
NEWEST = 20  # samples that tell how good the estimates are


class Updater(ABC):
    """A way of learning online; keeps network and optimiser from update to update."""

    def __init__(self, robot: Robot, mae: Mae, seed: int = 0) -> None:
        """Go on from a network; `seed` draws what is random."""
        self._robot, self._origin, self._mae, self._seed = robot, mae, mae, seed

    @property
    def body(self) -> CalibratedBody | None:
        """The body as it was fitted last; None where none is."""
        return None

    def update(self, job: Job) -> Update:
        """Learn a little; bounded time for a bounded store."""
        begun, newest = time.perf_counter(), job.observed[-NEWEST:]
        mae = self._mae.without(job.isolated)
        estimate = observed_theta(mae, newest)
        observed = np.isfinite(newest.theta)
        away = np.where(observed, estimate - newest.theta, 0.0)[observed.any(axis=1)]
        error = float(np.linalg.norm(away, axis=1).mean()) if len(away) else math.nan
        update = self._learn(job)
        seconds, device = time.perf_counter() - begun, str(torch.get_default_device())
        return update._replace(error=error, seconds=seconds, device=device)

    @abstractmethod
    def _learn(self, job: Job) -> Update: ...

    def _published(
        self, network: Network, preset: str, steps: int, job: Job, fit: Fit | None = None
    ) -> Mae:
        """Return the network that runs, with its statistics, and with what it has learned."""
        origin, samples = self._origin, len(job.observed)
        history = (
            f'{origin.training.split(LEARNED)[0]}{LEARNED}'
            f'{samples} samples at rest, preset {preset}, {steps} steps'
        )
        mae = to_mae(network, origin.joints, origin.muscles, origin.preset, history)
        mae = mae.without(job.isolated)
        before = self._mae.without(job.isolated)
        before = before if job.statistics_hold else uncalibrated(before)
        if self.body is not None:
            touch = TouchStatistics(self.body.frictions(), np.ones(self._robot.joint_count))
            mae = replace(mae, touch=touch)
        mae = recalibrated(mae, before.anomaly, job.healthy, samples)
        if fit is not None and self.body is not None:
            tension, judging = job.observed.end_tension(mae.friction), job.healthy.judging
            covariance = estimate_covariance(mae, self.body, fit, tension, self._seed, judging)
            mae = replace(mae, covariance=covariance)
        self._mae = mae
        return mae


def make_updater(robot: Robot, mae: Mae, preset: Preset, seed: int = 0) -> Updater:
    """Return the preset's way of learning."""
    return (BodyUpdater if preset.corrected_body else PaperUpdater)(robot, mae, seed)


def learned_steps(mae: Mae) -> int:
    """Return how many steps of preset `default` a network has learned on a real arm, or 0."""
    said = re.search(f'{LEARNED}.*, preset default, (\\d+) steps$', mae.training)
    return int(said[1]) if said else 0


# -- preset paper ---------------------------------------------------------------------------------

BATCHES = 10  # C_batch
EPOCHS = 10  # C_epoch
DATA = 10  # C_data


class PaperUpdater(Updater):
    """The procedure as printed (section "Online Learning"), by Adam of the initial training.

        batch = {newest, (0, 0, 0), C_data random stored ones} × {①, ②, ③},   3 (C_data + 2) entries

    from C_thre samples on, with C_thre = 20, C_data = 10, number of batches 10 and epochs 10.

    "The number of batches C_batch = 10" can be read as ten such batches, each with its own random
    samples, gone through ten times: 100 steps of 36 entries. Or as mini-batches of ten within one
    batch of 36: 4 × 10 steps. The first is chosen: the text calls the 36 entries "a batch", so
    their number counts such batches; and with the second an update would see only ten stored
    samples.
    """

    def __init__(self, robot: Robot, mae: Mae, seed: int = 0) -> None:
        super().__init__(robot, mae, seed)
        self._network = from_mae(mae)
        self._optimiser = Optimiser(self._network, PAPER.training.step_size, muon=False)
        self._rng = np.random.default_rng([seed, 0x9A])
        self._steps = 0

    def _learn(self, job: Job) -> Update:
        """Learn one newest sample among stored ones; `job.steps` is the paper's own here."""
        # The print knows no changed muscle: a sample that says nothing about one is none.
        observed = job.observed.with_all_angles()
        values = observed[np.flatnonzero(observed.known.all(axis=1))].state().scaled()
        batches = []
        for _ in range(BATCHES if len(values) >= PAPER.least_samples else 0):
            stored = self._rng.choice(len(values) - 1, DATA, replace=False)
            rows = np.vstack([values[-1], np.zeros(values.shape[1]), values[stored]])
            batches.append(torch.as_tensor(np.tile(rows, (3, 1)), dtype=torch.float32))
        mask = torch.arange(3).repeat_interleave(DATA + 2)
        losses = []
        with one_thread():
            for batch in EPOCHS * batches:
                value = loss(self._network, batch, mask, PAPER.training)
                value.backward()
                self._optimiser.step(1.0)
                losses.append(value.item())
        self._steps += len(losses)
        last = float(np.mean(losses[-BATCHES:])) if losses else np.nan
        return Update(self._published(self._network, 'paper', self._steps, job), last)


# -- preset default -------------------------------------------------------------------------------

REAL_SHARE = 0.1
#: share of synthetic samples that many messages of the moving arm take the place of; half of that,
#: when there are `MANY`
MOVING_SHARE = 0.3
#: how often a synthetic sample is used before it is forgotten
USES = 3
#: a real sample that fits the body worse than this weight is not shown to the network
TRUSTED = 0.3


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
