# SPDX-License-Identifier: Apache-2.0
"""How good the estimates of a network have to be expected to be: their covariance."""

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import gammaincinv

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.body import CalibratedBody
from musculoskeletal_ae.learning.fit import Fit
from musculoskeletal_ae.learning.samples import Observations
from musculoskeletal_ae.learning.synthetic import UNSURE
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.training import TINY

#: messages that are enough to judge by
MANY = 200
#: bodies that the samples allow, many more than joints (of few, an ellipsoid holds what it was made
#: of, and less of others), and samples of each
BODIES, EACH = 100, 10
INSIDE = 0.95  # share of errors within the ellipsoid that the covariance says holds as many


def estimate_covariance(
    mae: Mae,
    body: CalibratedBody,
    fit: Fit,
    tension: Array,
    seed: int,
    judging: Observations | None,
) -> Array:
    """Return the covariance of θ_est − θ [rad²] (D, D) that a network has to be expected to make.

    It is that of drawn errors, with postures anywhere and tensions [N] (N, M) of the samples. How
    far drawn errors are too large or too small is told by messages that judge, if there are MANY:
    by their own errors beside those drawn in their postures, most of which are near the samples.
    """
    rng = np.random.default_rng(seed)

    def expected(theta: Array) -> Array:
        # The same bodies and errors of lengths in all postures, or chance would tell them apart.
        same = np.random.default_rng(seed)
        return _spread(_drawn_errors(mae, body, fit, theta, tension, same))

    covariance = expected(body.robot.random_postures(BODIES * EACH, rng))
    if judging is None or len(judging) < MANY:
        return covariance
    here = expected(judging.theta[rng.integers(len(judging), size=BODIES * EACH)])
    return covariance * _excess(here, observed_theta(mae, judging) - judging.theta)


def _drawn_errors(
    mae: Mae,
    body: CalibratedBody,
    fit: Fit,
    theta: Array,
    tension: Array,
    rng: np.random.Generator,
) -> Array:
    """Return θ_est − θ [rad] (BODIES · EACH, D) at as many postures.

    What the samples leave open of the body is drawn from the fit's posterior (Laplace; lengths are
    taken as linear in it), and what the network says of such bodies' lengths is compared with where
    they are.
    """
    bodies = np.repeat(np.arange(BODIES), EACH)
    tension = tension[rng.integers(len(tension), size=len(bodies))]
    direction = UNSURE * np.sin(0.5 * np.pi * rng.uniform(-1.0, 1.0, tension.shape))
    poses, length = body.poses(theta), fit.noise * rng.standard_normal(tension.shape)
    for muscles, root in fit.root:
        steps = solve_triangular(root, rng.standard_normal((len(root), BODIES))).T
        ends = np.cumsum([body.layouts[m].size for m in muscles])
        for m, step in zip(muscles.tolist(), np.split(steps, ends, axis=1)):
            smooth = body.smooth[m].at(theta)
            observed, slope = body.linearised(poses, smooth, tension[:, m], direction[:, m], m)
            length[:, m] += observed + (slope * step[bodies]).sum(axis=1)
    error: Array = mae.estimate(tension, length).theta - theta
    return error


def _spread(error: Array) -> Array:
    """Return a covariance whose ellipsoid of 95 % holds as many errors, (N, D).

    They have heavier tails than a normal distribution.
    """
    covariance = error.T @ error / len(error) + TINY * np.eye(error.shape[1])
    covariance = 0.5 * (covariance + covariance.T)
    return covariance * _excess(covariance, error)


def _excess(covariance: Array, error: Array) -> float:
    """Return by what to multiply a covariance for its ellipsoid to hold INSIDE of (N, D) errors."""
    return float(np.quantile(ellipsoids(covariance, error), INSIDE))


def ellipsoids(covariance: Array, error: Array) -> Array:
    """Return by what to multiply a covariance for each of (N, D) errors to lie on its ellipsoid.

    The ellipsoid is that of the share INSIDE of a normal distribution; (N,).
    """
    squares = np.einsum('ni,ni->n', error, np.linalg.solve(covariance, error.T).T)
    # χ² of as many degrees as joints; scipy.stats has the same, and takes 0.7 s to import.
    bounded: Array = squares / (2.0 * gammaincinv(0.5 * error.shape[1], INSIDE))
    return bounded


def observed_theta(mae: Mae, observed: Observations) -> Array:
    """Return θ [rad] (N, D) as a network estimates it from observations."""
    return mae.estimate(observed.end_tension(mae.friction), observed.length).theta
