# SPDX-License-Identifier: Apache-2.0
"""An update of preset `default`: find out the body from the samples, then let the network learn it.

1. Fit the corrected body to the samples (`body_fit`).
2. Draw synthetic samples of it, and put real ones in the place of a tenth of them.
3. Train the network on them for a bounded number of steps.
4. Take the residuals' statistics of healthy messages (`calibration`).

The body needs few samples because the geometric model and its tolerances are known; the network
needs many, and gets them from the body.
"""

from __future__ import annotations

import copy
import re
from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.body import CorrectedBody
from musculoskeletal_ae.learning.body_fit import OUTLIER, Fit, fit_body, fit_to_network
from musculoskeletal_ae.learning.calibration import recalibrated, uncalibrated
from musculoskeletal_ae.learning.samples import Observations
from musculoskeletal_ae.learning.training import Job, Update
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import Network, from_mae, to_mae
from musculoskeletal_ae.mae.optimiser import Optimiser
from musculoskeletal_ae.mae.training import OVERLOAD_SHARE, TINY, one_thread
from musculoskeletal_ae.mae.units import scale_vector
from musculoskeletal_ae.robot.robot import Robot

REAL_SHARE = 0.1
#: how often a synthetic sample is used before it is forgotten
USES = 3
#: a real sample that fits the body worse than this weight is not shown to the network
TRUSTED = 0.3
#: so many newest samples in a row that contradict the body mean that a muscle has changed …
IN_A_ROW = 4
#: … by more than this [m], provided that there were this many before
LEAST_CHANGE, LEAST_BEFORE = 0.004, 8


#: between how the network was made and what it learned since, in `Mae.training`
LEARNED = '; learned online: '
NEWEST = 20  # samples that tell how good the estimates are


class Updater(ABC):
    """A way of learning online; keeps network and optimiser from update to update.

    Attributes:
        body: The corrected body as it was fitted last; None where none is.
    """

    body: CorrectedBody | None = None

    def __init__(self, robot: Robot, mae: Mae) -> None:
        """Go on from a network."""
        self._robot, self._origin, self._mae = robot, mae, mae

    @abstractmethod
    def update(self, job: Job) -> Update:
        """Learn a little; bounded time for a bounded store."""

    def _newest_error(self, seen: Observations) -> float:
        """Return the mean of ‖θ_est − θ‖₂ over the newest samples [rad]."""
        newest = slice(-NEWEST, None)
        estimate = self._mae.estimate(seen.tension[newest], seen.length[newest]).theta
        return float(np.linalg.norm(estimate - seen.theta[newest], axis=1).mean())

    def _published(self, network: Network, preset: str, steps: int, job: Job) -> Mae:
        """Return the network that runs, with its statistics, and with what it has learned."""
        origin, samples = self._origin, len(job.seen)
        history = (
            f'{origin.training.split(LEARNED)[0]}{LEARNED}'
            f'{samples} samples at rest, preset {preset}, {steps} steps'
        )
        mae = to_mae(network, origin.joints, origin.muscles, origin.preset, history)
        before = self._mae if job.statistics_hold else uncalibrated(self._mae)
        self._mae = recalibrated(mae, before.anomaly, job.healthy, samples)
        return self._mae


def learned_steps(mae: Mae) -> int:
    """Return how many steps of preset `default` a network has learned on a real arm, or 0."""
    said = re.search(f'{LEARNED}.*, preset default, (\\d+) steps$', mae.training)
    return int(said[1]) if said else 0


class BodyUpdater(Updater):
    """Learns by the corrected body."""

    body: CorrectedBody

    def __init__(self, robot: Robot, mae: Mae, seed: int = 0) -> None:
        """Go on from a network, and from the body that it knows if it has learned one."""
        super().__init__(robot, mae)
        self.body = CorrectedBody(robot, seed=seed)
        self._seed = seed
        #: what the network knew of the body, in the place of the geometric model
        self._prior_mean: list[Array] | None = None
        if learned_steps(mae):
            fit_to_network(self.body, mae, seed)
            self._prior_mean = list(self.body.parameters)
        self._prior_mean_confirmed = False
        self._trainer = Trainer(from_mae(mae), seed, learned_steps(mae))
        self._rng = np.random.default_rng([seed, 0xD2])
        self._statistics_held = True

    def update(self, job: Job) -> Update:
        """Learn a little."""
        seen, error = job.seen, self._newest_error(job.seen)
        body = self.body = self._body_to_go_on_from(seen)
        fit = fit_body(body, seen, prior_mean=self._prior_mean)
        contradicted = contradicted_muscles(seen, fit)
        # Several at once are no replaced muscles but a joint sensor that slipped or a touched arm:
        # the robust weights leave such samples out until they are the rule.
        alone = len(contradicted) == 1
        if self._statistics_held and not job.statistics_hold:
            self._trainer.restart()
        self._statistics_held = job.statistics_hold
        count = max(BATCH, job.steps * BATCH // USES)
        data = synthetic_samples(body, fit.noise, count, self._rng)
        self._mix_in_real(data, body, seen, fit)
        loss = self._trainer.train(data, job.steps)
        return Update(
            self._published(self._trainer.network, 'default', self._trainer.steps, job),
            loss,
            error,
            fit.noise,
            contradicted if alone else (),
            () if alone else tuple(muscle for muscle, _ in contradicted),
        )

    def _body_to_go_on_from(self, seen: Observations) -> CorrectedBody:
        """Return the body so far, unless the network's turns out to be that of another arm.

        That shows once there are a few samples, and is worse than no body at all.
        """
        if self._prior_mean is None or self._prior_mean_confirmed or len(seen) < IN_A_ROW:
            return self.body
        self._prior_mean_confirmed = True
        body = CorrectedBody(self._robot, self._prior_mean, self._seed)
        (length,) = body.lengths(seen.theta, seen.tension, seen.direction)
        if np.median(np.abs(seen.length - length)[seen.known]) <= LEAST_CHANGE:
            return self.body
        self._prior_mean = None
        self._trainer.restart()
        return CorrectedBody(self._robot, seed=self._seed)

    def _mix_in_real(
        self, data: TrainingData, body: CorrectedBody, seen: Observations, fit: Fit
    ) -> None:
        """Put real samples, freed of friction as the body knows it, in the place of some."""
        trusted = np.flatnonzero((fit.weight > TRUSTED).all(axis=1))
        if len(trusted) == 0:
            return
        rows = trusted[self._rng.integers(len(trusted), size=int(REAL_SHARE * len(data.seen)))]
        theta, tension, direction = seen.theta[rows], seen.tension[rows], seen.direction[rows]
        with_friction, without = body.lengths(theta, tension, direction, np.zeros_like(direction))
        for values, length in (
            (data.seen, seen.length[rows]),
            (data.true, seen.length[rows] + without - with_friction),
        ):
            values[: len(rows)] = _scaled(theta, tension, length)


def contradicted_muscles(seen: Observations, fit: Fit) -> tuple[tuple[int, int], ...]:
    """Return muscles whose newest samples contradict the body in one direction, and how many."""
    muscles = []
    for m, noise in enumerate(fit.noise):
        residual = fit.residual[seen.known[:, m], m]
        odd = np.abs(residual) > max(OUTLIER * noise, LEAST_CHANGE)
        same = odd & (np.sign(residual) == np.sign(residual[-1])) if len(residual) else odd
        fits = np.flatnonzero(~same)
        run = len(same) - 1 - fits[-1] if len(fits) else 0
        if run >= IN_A_ROW and len(same) - run >= LEAST_BEFORE:
            muscles.append((m, int(run)))
    return tuple(muscles)


# -- synthetic samples ----------------------------------------------------------------------------

#: share with most muscles near T_bias, as muscle stiffness control holds them
HELD_SHARE = 0.5
# The arm reaches its limits, and friction or a push carries it a little beyond.
MARGIN = 0.02


class TrainingData(NamedTuple):
    """N samples in scaled units, shape (N, D+2M) each.

    Attributes:
        seen: With scattered lengths.
        true: What the network is to restore.
    """

    seen: Array
    true: Array


def synthetic_samples(
    body: CorrectedBody, noise: Array, count: int, rng: np.random.Generator
) -> TrainingData:
    """Draw samples of a body.

        (θ, T, l) = (θ_r, T_r, l(θ_r, T_r; s = 0)),   seen as (θ_r, T_r, l(θ_r, T_r; s_r) + ε)

    Which way each wire slid last, s_r, is not known to an estimator, so that the network sees
    lengths with the friction's and the sensors' scatter and is asked for those without: ② then
    learns to weigh muscles by how far their lengths can be trusted, as weighted least squares do.

    Args:
        body: The corrected body.
        noise: Standard deviation of each muscle's length beside friction [m], shape (M,).
        count: N.
        rng: Source of randomness.
    """
    robot = body.robot
    shape = count, robot.muscle_count
    theta = robot.random_postures(count, rng, MARGIN)
    tension = _tensions(robot, count, rng)
    # Mostly at either end of [−1, 1], where sliding leaves it.
    direction = np.sin(0.5 * np.pi * rng.uniform(-1.0, 1.0, shape))
    length, scattered = body.lengths(theta, tension, np.zeros(shape), direction)
    scattered = scattered + noise * rng.standard_normal(shape)
    return TrainingData(_scaled(theta, tension, scattered), _scaled(theta, tension, length))


def _tensions(robot: Robot, count: int, rng: np.random.Generator) -> Array:
    tension = robot.tension
    shape = count, robot.muscle_count
    overloaded = rng.uniform(size=(count, 1)) < OVERLOAD_SHARE
    highest = np.where(
        overloaded, rng.uniform(tension.limit, tension.max, (count, 1)), tension.limit
    )
    anywhere = rng.uniform(0.0, 1.0, shape) * highest
    lowest = tension.bias * rng.uniform(0.7, 1.0, shape)
    held = lowest + rng.uniform(0.0, 1.0, shape) ** 3 * (highest - lowest)
    return np.where(rng.uniform(size=(count, 1)) < HELD_SHARE, held, anywhere)


def _scaled(theta: Array, tension: Array, length: Array) -> Array:
    values = np.concatenate([theta, tension, length], axis=1)
    scaled: Array = values * scale_vector(theta.shape[1], tension.shape[1])
    return scaled


# -- the network ----------------------------------------------------------------------------------

STEP_SIZE = 2e-3
BATCH = 128
#: averaged over this share of the steps so far, but at least and at most so many steps
AVERAGED_SHARE, LEAST_AVERAGED, MOST_AVERAGED = 0.1, 20.0, 2000.0
#: the step size falls to a half after so many steps, and at last to this share of itself, below
#: which the average no longer wanders but a slowly changing body is still followed
CALMING, LEAST_CALM = 2000.0, 0.1


class Trainer:
    """Trains the network a few steps at a time, for as long as the robot lives.

    What is published is the average of the weights over about the last tenth of all steps, and the
    step size falls as steps add up, so that the network follows a body that is still being found
    out and becomes calm when it is known. (At a constant step size even the average wanders: ±10 %
    of the error of an arm over hours.)

    Attributes:
        network: The average: what is published.
        steps: Steps taken so far, in former lives too.
    """

    def __init__(self, network: Network, seed: int = 0, steps: int = 0) -> None:
        """Go on from a network's weights, as calmly as after so many `steps`."""
        self.network = network
        self._restless = copy.deepcopy(network)
        self._optimiser = Optimiser(self._restless, STEP_SIZE, muon=True)
        self._rng = np.random.default_rng([seed, 0x7A])
        self.steps = steps

    def train(self, data: TrainingData, steps: int) -> float:
        """Take steps on batches of the data; returns the mean loss of the last half of them."""
        seen = torch.as_tensor(data.seen, dtype=torch.float32)
        true = torch.as_tensor(data.true, dtype=torch.float32)
        mask = torch.arange(3).repeat_interleave(BATCH)
        losses = []
        with one_thread():
            for _ in range(steps):
                rows = torch.as_tensor(self._rng.integers(len(seen), size=BATCH))
                value = _loss(self._restless, seen[rows], true[rows], mask)
                value.backward()
                self._optimiser.step(max(LEAST_CALM, 1.0 / (1.0 + self.steps / CALMING)))
                self.steps += 1
                self._average()
                losses.append(value.item())
        return float(np.mean(losses[len(losses) // 2 :]))

    def restart(self) -> None:
        """Take large steps again and average few: the body has changed."""
        self.steps = min(self.steps, int(LEAST_AVERAGED / AVERAGED_SHARE))

    def _average(self) -> None:
        span = min(max(AVERAGED_SHARE * self.steps, LEAST_AVERAGED), MOST_AVERAGED)
        with torch.no_grad():
            for mean, now in zip(self.network.parameters(), self._restless.parameters()):
                mean.lerp_(now, 1.0 / span)


def _loss(network: Network, seen: Tensor, true: Tensor, mask: Tensor) -> Tensor:
    """Return the three norms, each in units of the spread of the data, all three masks entered."""
    error = network.decoder(network.encode(seen.repeat(3, 1), mask))
    error = error - ((true - network.mean) / network.std).repeat(3, 1)  # (3N, D+2M)
    parts = error.square().split([network.joints, network.muscles, network.muscles], dim=1)
    return torch.stack([(part.sum(dim=1) + TINY).sqrt().mean() for part in parts]).sum()
