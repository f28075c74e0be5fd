# SPDX-License-Identifier: Apache-2.0
"""The calibrated body of one arm, from update to update.

Every update fits the body to all samples, from where the last fit ended. The prior is the geometric
model, or what a network knows that has learned a real arm (`fit_to_network`), unless the first
samples show that the network is of another arm.
"""

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.body import CalibratedBody
from musculoskeletal_ae.learning.fit import Fit, fit_body, fit_to_network
from musculoskeletal_ae.learning.samples import Observations
from musculoskeletal_ae.learning.synthetic import held_tensions
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

PROBES = 200  # postures that the mean of a body's lengths is taken over
#: so many newest samples in a row that contradict the body mean that a muscle has changed …
IN_A_ROW = 4
#: … by more than this [m] and this many σ, provided that there were so many samples before
LEAST_CHANGE, OUTLIER, LEAST_BEFORE = 0.004, 6.0, 8


class BodyFit:
    """Keeps the calibrated body of one arm, and fits it.

    Attributes:
        body: The body as it was fitted last.
    """

    def __init__(self, robot: Robot, mae: Mae | None, seed: int = 0) -> None:
        """Begin with the body that a network has learned, if one is given; `seed` draws it."""
        self.body = CalibratedBody(robot, seed=seed)
        #: what the network knew of the body, in the place of the geometric model
        self._prior_mean: list[Array] | None = None
        if mae is not None:
            fit_to_network(self.body, mae, seed)
            self._prior_mean = list(self.body.parameters)
        self._is_prior_confirmed = False
        rng = np.random.default_rng([seed, 0x3E])
        self._probe = robot.random_postures(PROBES, rng), held_tensions(robot, PROBES, rng)
        self._mean_length = self._probe_lengths()  # of the body that the network knows [m], (M,)

    def is_of_another_arm(self, observed: Observations) -> bool:
        """Whether samples contradict what the network knew of the body.

        That shows once there are a few samples; it is looked at once.
        """
        observed = observed.with_all_angles()
        if self._prior_mean is None or self._is_prior_confirmed or len(observed) < IN_A_ROW:
            return False
        self._is_prior_confirmed = True
        body = CalibratedBody(self.body.robot, self._prior_mean, smooth=self.body.smooth)
        (length,) = body.lengths(observed.theta, observed.tension, observed.direction)
        return bool(np.median(np.abs(observed.length - length)[observed.known]) > LEAST_CHANGE)

    def start_anew(self) -> None:
        """Begin with the geometric model: a wrong prior is worse than none."""
        self._prior_mean = None
        self.body = CalibratedBody(self.body.robot, smooth=self.body.smooth)

    def fit(self, observed: Observations, guess: Array) -> Fit:
        """Fit the body to samples; θ that was not read is looked for from `guess` [rad] (N, D)."""
        return fit_body(self.body, observed, self._prior_mean, guess)

    def lengthened(self) -> Array:
        """Return by how much all lengths have grown since this was last asked [m], (M,)."""
        before, self._mean_length = self._mean_length, self._probe_lengths()
        return self._mean_length - before

    def _probe_lengths(self) -> Array:
        """Return l [m] (M,), averaged over always the same postures and tensions."""
        (length,) = self.body.lengths(*self._probe, np.zeros_like(self._probe[1]))
        return length.mean(axis=0)


def contradicted_muscles(observed: Observations, fit: Fit) -> tuple[tuple[int, int], ...]:
    """Return muscles whose newest samples contradict the body in one direction, and how many."""
    muscles = []
    for m, noise in enumerate(fit.noise):
        residual = fit.residual[observed.known[:, m], m]
        odd = np.abs(residual) > max(OUTLIER * noise, LEAST_CHANGE)
        same = odd & (np.sign(residual) == np.sign(residual[-1])) if len(residual) else odd
        fits = np.flatnonzero(~same)
        run = len(same) - 1 - fits[-1] if len(fits) else 0
        if run >= IN_A_ROW and len(same) - run >= LEAST_BEFORE:
            muscles.append((m, int(run)))
    return tuple(muscles)
