# SPDX-License-Identifier: Apache-2.0
"""Fits the calibrated body of one arm again in every update.

Every update fits the body to all samples and starts from the last fit. The prior is the geometric
model, or, if a network has already learned a real arm, a body fitted to this network
(`fit_to_network`). If the first samples show that the network learned another arm, the geometric
model becomes the prior again.
"""

import numpy as np
from scipy.optimize import lsq_linear

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.body_model.fit import fit_body, fit_to_network
from musculoskeletal_ae.body_model.observations import Observations
from musculoskeletal_ae.body_model.postures import FittedBody
from musculoskeletal_ae.body_model.remainder import Remainder
from musculoskeletal_ae.body_model.sensor_offsets import LARGEST_OFFSET
from musculoskeletal_ae.body_model.synthetic import held_tensions
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

#: compare the body fitted to a network with at most this many of the newest samples
NEWEST = 20
#: measure by how much an update lengthens each muscle as the mean over this many random postures
PROBES = 200
#: report a muscle as changed if at least this many of its newest samples contradict the fitted
#: body, all with length residuals of the same sign
LEAST_NEWEST = 4
#: report a muscle as changed only if at least this many samples came before the contradicting ones
LEAST_BEFORE = 8
#: conclude that a sample contradicts the body only if its length residual exceeds this [m]
LEAST_CHANGE = 0.004
#: conclude that a sample contradicts the body only if its length residual exceeds this many
#: standard deviations
OUTLIER = 6.0


class BodyFit:
    """Fits the calibrated body of one arm and stores the result.

    Attributes:
        body: The most recently fitted body.
    """

    def __init__(self, robot: Robot, mae: Mae | None, seed: int = 0) -> None:
        """Begin with a body that is fitted to `mae`, or with the geometric model if it is None."""
        if mae is not None:
            robot = robot.with_elasticity(mae.elasticity)
        self.body = CalibratedBody(robot)
        #: parameters fitted to the network; if not None, they replace the geometric model as prior
        #: mean
        self._prior_mean: list[Array] | None = None
        if mae is not None:
            fit_to_network(self.body, mae, seed)
            self._prior_mean = list(self.body.parameters)
            self.body.remainder = Remainder(robot.muscle_count, before=self.body.remainder)
        self._is_prior_confirmed = False
        rng = np.random.default_rng([seed, 0x3E])
        self._probe = robot.random_postures(PROBES, rng), held_tensions(robot, PROBES, rng)
        self._mean_length = self._probe_lengths()  # mean length of each muscle [m], (M,)

    def is_of_another_arm(self, observed: Observations) -> bool:
        """Return whether samples contradict the body that was fitted to the network.

        The check runs once, as soon as there are enough samples. All other calls return False. Only
        the NEWEST samples count, because tendons creep. Length differences that offsets of the
        joint sensors explain do not count either: learning accepts offsets up to LARGEST_OFFSET,
        and a network does not contain them.
        """
        observed = observed.with_all_angles()[-NEWEST:]
        if self._prior_mean is None or self._is_prior_confirmed:
            return False
        if len(observed) < LEAST_NEWEST or not observed.known.any():
            return False
        self._is_prior_confirmed = True
        body = CalibratedBody(self.body.robot, self._prior_mean)
        body.remainder = self.body.remainder.before or body.remainder
        (length,) = body.lengths(observed.theta, observed.tension, observed.direction)
        residual = (observed.length - length)[observed.known]
        # An offset z of the sensors changes the lengths of a posture by −G z.
        slope = -self.body.robot.routes.muscle_jacobian(observed.theta)[observed.known]
        zero = lsq_linear(slope, residual, (-LARGEST_OFFSET, LARGEST_OFFSET)).x
        return bool(np.median(np.abs(residual - slope @ zero)) > LEAST_CHANGE)

    def start_anew(self) -> None:
        """Discard the fit, which was that of another arm; start from the geometric model."""
        self._prior_mean = None
        self.body = CalibratedBody(self.body.robot.with_elasticity(None))

    def fit(self, observed: Observations, guess: Array) -> FittedBody:
        """Fit the body to samples.

        Args:
            observed: The samples.
            guess: Initial values for joint angles that were not measured [rad], (N, D).
        """
        return fit_body(self.body, observed, self._prior_mean, guess)

    def lengthened(self) -> Array:
        """Return by how much each muscle has lengthened since the previous call [m], (M,).

        Its length is the mean over a fixed set of postures and tensions.
        """
        before, self._mean_length = self._mean_length, self._probe_lengths()
        return self._mean_length - before

    def _probe_lengths(self) -> Array:
        """Return the mean lengths [m] (M,) over a fixed set of postures and tensions."""
        (length,) = self.body.lengths(*self._probe, np.zeros_like(self._probe[1]))
        return length.mean(axis=0)


def contradicted_muscles(observed: Observations, fit: FittedBody) -> tuple[tuple[int, int], ...]:
    """Return the muscles that seem to have changed, because their newest samples misfit the body.

    The newest samples of such a muscle all have large length residuals of the same sign, while
    enough earlier samples exist.

    Returns:
        The index of each such muscle, and the number of the first sample from which on all its
        samples have such residuals (`Observations.number`).
    """
    muscles = []
    for m, noise in enumerate(fit.noise):
        known = observed.known[:, m]
        residual = fit.residual[known, m]
        odd = np.abs(residual) > max(OUTLIER * noise, LEAST_CHANGE)
        same = odd & (np.sign(residual) == np.sign(residual[-1])) if len(residual) else odd
        fits = np.flatnonzero(~same)
        run = len(same) - 1 - fits[-1] if len(fits) else 0
        if run >= LEAST_NEWEST and len(same) - run >= LEAST_BEFORE:
            muscles.append((m, int(observed.number[known][-run])))
    return tuple(muscles)
