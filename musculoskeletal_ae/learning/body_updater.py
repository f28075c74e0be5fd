# SPDX-License-Identifier: Apache-2.0
"""Preset `default`: find out the body from the samples, then dream of it.

1. Fit the corrected body to the samples (`body_fit`).
2. Draw synthetic samples of it (`dream`), a tenth of them in the place of real ones.
3. Train the network on them for a bounded number of steps (`trainer`).
4. Take the residuals' statistics of healthy messages (`healthy`).

The body needs few samples because the geometric model and its tolerances are known; the network
needs many, and gets them from the body.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.body import CorrectedBody
from musculoskeletal_ae.learning.body_fit import OUTLIER, Fit, Observations, Prior, fit_body
from musculoskeletal_ae.learning.dream import Dream, dream
from musculoskeletal_ae.learning.inherit import inherit
from musculoskeletal_ae.learning.trainer import BATCH, Trainer
from musculoskeletal_ae.learning.update import (
    Job,
    Update,
    history,
    learned_steps,
    newest_error,
    with_statistics,
)
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import from_mae, to_mae
from musculoskeletal_ae.mae.units import scale_vector
from musculoskeletal_ae.robot.robot import Robot

REAL_SHARE = 0.1
#: how often a dream is used before it is forgotten
USES = 3
#: a real sample that fits the body worse than this weight is not shown to the network
TRUSTED = 0.3
#: so many newest samples in a row that contradict the body mean that a muscle has changed …
IN_A_ROW = 4
#: … by more than this [m], provided that there were this many before
LEAST_CHANGE, LEAST_BEFORE = 0.004, 8


class BodyUpdater:
    """Learns by the corrected body.

    Attributes:
        body: As it was fitted last.
    """

    least_samples = 2

    def __init__(self, robot: Robot, mae: Mae, seed: int = 0, prior: Prior | None = None) -> None:
        """Go on from a network, and from the body that it knows if it has learned one."""
        self._robot, self._origin, self._mae = robot, mae, mae
        self._prior = prior or Prior()
        self.body = CorrectedBody(robot, seed=seed)
        self._seed, self._confirmed = seed, False
        self._inherited: list[Array] | None = None
        if learned_steps(mae):
            inherit(self.body, mae, self._prior, seed)
            self._inherited = list(self.body.parameters)
        self._trainer = Trainer(from_mae(mae), seed, learned_steps(mae))
        self._rng = np.random.default_rng([seed, 0xD2])
        self._statistics_held = True

    def update(self, job: Job) -> Update:
        """Learn a little; bounded time for a bounded store."""
        seen, robot = job.seen, self._robot
        error = newest_error(self._mae, seen)
        self._doubt_inheritance(seen)
        fit = fit_body(self.body, seen, self._prior, self._inherited)
        contradicted = _contradicted(seen, fit)
        # Several at once are no replaced muscles but a joint sensor that slipped or a touched arm:
        # the robust weights leave such samples out until they are the rule.
        alone = len(contradicted) == 1
        if self._statistics_held and not job.statistics_hold:
            self._trainer.hurry()
        self._statistics_held = job.statistics_hold
        data = dream(self.body, fit.noise, max(BATCH, job.steps * BATCH // USES), self._rng)
        loss = self._trainer.train(self._with_real(data, seen, fit), job.steps)
        mae = to_mae(
            self._trainer.network,
            robot.joints,
            robot.muscles,
            self._origin.preset,
            history(self._origin, len(seen), 'default', self._trainer.steps),
            job.version,
        )
        self._mae = with_statistics(mae, self._mae, job)
        doubtful = () if alone else tuple(m for m, _ in contradicted)
        return Update(self._mae, loss, error, fit.noise, contradicted if alone else (), doubtful)

    def _doubt_inheritance(self, seen: Observations) -> None:
        """Once there are a few samples: a body learned on another arm is worse than none."""
        if self._inherited is None or self._confirmed or len(seen) < IN_A_ROW:
            return
        self._confirmed = True
        body = CorrectedBody(self._robot, self._inherited, self._seed)
        (length,) = body.lengths(seen.theta, seen.tension, seen.sliding)
        if np.median(np.abs(seen.length - length)[seen.known]) > LEAST_CHANGE:
            self._inherited = None
            self.body = CorrectedBody(self._robot, seed=self._seed)
            self._trainer.hurry()

    def _with_real(self, data: Dream, seen: Observations, fit: Fit) -> Dream:
        """Put real samples, freed of friction as the body knows it, in the place of some dreams."""
        trusted = np.flatnonzero((fit.weight > TRUSTED).all(axis=1))
        if len(trusted) == 0:
            return data
        rows = trusted[self._rng.integers(len(trusted), size=int(REAL_SHARE * len(data.seen)))]
        theta, tension, sliding = seen.theta[rows], seen.tension[rows], seen.sliding[rows]
        slid, free = self.body.lengths(theta, tension, sliding, np.zeros_like(sliding))
        scale = scale_vector(self._robot.joint_count, self._robot.muscle_count)
        for values, length in (
            (data.seen, seen.length[rows]),
            (data.true, seen.length[rows] + free - slid),
        ):
            values[: len(rows)] = np.concatenate([theta, tension, length], axis=1) * scale
        return data


def _contradicted(seen: Observations, fit: Fit) -> tuple[tuple[int, int], ...]:
    """Return muscles whose newest samples contradict the body in one direction, and how many."""
    found = []
    for m, noise in enumerate(fit.noise):
        residual = fit.residual[seen.known[:, m], m]
        odd = np.abs(residual) > max(OUTLIER * noise, LEAST_CHANGE)
        same = odd & (np.sign(residual) == np.sign(residual[-1])) if len(residual) else odd
        fits = np.flatnonzero(~same)
        run = len(same) - 1 - fits[-1] if len(fits) else 0
        if run >= IN_A_ROW and len(same) - run >= LEAST_BEFORE:
            found.append((m, int(run)))
    return tuple(found)
