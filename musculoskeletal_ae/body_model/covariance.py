# SPDX-License-Identifier: Apache-2.0
"""How far learned angles, lengths and constants of motor currents may be wrong."""

import math
from collections.abc import Iterator

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import gammaincinv

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.body_model.observations import Observations
from musculoskeletal_ae.body_model.postures import FittedBody
from musculoskeletal_ae.body_model.priors import INDEPENDENT_SAMPLES, PRIOR
from musculoskeletal_ae.body_model.synthetic import UNKNOWN_FRICTION
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.training import TINY

#: scale the covariance to the network's actual errors on validation messages only if there are at
#: least this many of them
MANY_MESSAGES = 200
#: Draw this many bodies from the posterior: many more than joints, because a covariance from few
#: draws underestimates the errors of other draws.
BODIES = 100
POSTURES_PER_BODY = 10  # draw estimation errors of each drawn body at this many postures
WORKSPACE = 100  # average possible errors of lengths over this many random postures
#: Multiply the covariance by this factor if there are fewer than MANY_MESSAGES validation messages.
#: It stands for errors that all samples share and no prior describes, for example where tendons
#: wrap round bones. With this factor, the ellipsoids contain 95 % of the true angles on emulator
#: model `foreign`, and on `kin` if no joint reaches its limits; if joints do, they are too large on
#: `kin` (doc/limitations.md, `python -m bench covariance`).
UNVALIDATED_FACTOR = 1.7
#: scale a covariance so that its ellipsoid contains this share of the estimation errors
CONTAINED_SHARE = 0.95


def estimate_covariance(
    mae: Mae,
    body: CalibratedBody,
    fit: FittedBody,
    tension: Array,
    seed: int,
    judging: Observations | None,
) -> Array:
    """Estimate the covariance of a network's errors θ_est − θ [rad²], (D, D).

    The covariance is computed from errors that are drawn at random postures with tensions of the
    samples. An error has two parts. The first part is the error of the joint-sensor offset.
    Validation messages do not show it, because they contain the same offset. The second part is
    everything else. With at least MANY_MESSAGES validation messages, it is multiplied by the ratio
    of the network's actual errors on these messages to errors drawn at the same postures. The
    postures must be the same: validation messages lie mostly near samples, where errors are smaller
    than at random postures. With fewer validation messages, the covariance is multiplied by
    UNVALIDATED_FACTOR instead.

    Args:
        mae: The network.
        body: The calibrated body.
        fit: The fit of that body.
        tension: Tensions at the elastic elements in the samples [N], (N, M).
        seed: Seed of the draws.
        judging: Validation messages, or None.
    """
    rng = np.random.default_rng(seed)

    def draw(theta: Array) -> tuple[Array, Array]:
        # Draw the same bodies and length errors in both calls, so that only the postures differ.
        return _drawn_errors(mae, body, fit, theta, tension, np.random.default_rng(seed))

    error, offset = draw(body.robot.random_postures(BODIES * POSTURES_PER_BODY, rng))
    if judging is None or len(judging) < MANY_MESSAGES:
        return UNVALIDATED_FACTOR * _spread(error)
    rows = rng.integers(len(judging), size=BODIES * POSTURES_PER_BODY)
    here, offset_here = draw(judging.theta[rows])
    actual = observed_theta(mae, judging) - judging.theta
    ratio = math.sqrt(_excess(_spread(here - offset_here), actual))
    return _spread(offset + ratio * (error - offset))


def drive_covariance(body: CalibratedBody, fit: FittedBody) -> Array | None:
    """Return the posterior covariances of each motor current's scale, offset and friction.

    `Transmission` explains the constants. All samples together have the weight of at most
    INDEPENDENT_SAMPLES samples, because errors of the body model are common to all of them.

    Returns:
        The covariance of γ, b [N] and F [N] for each muscle, (M, 3, 3), or None if the robot has
        tension sensors.
    """
    if body.drive is None:
        return None
    covariance = np.empty((len(body.layouts), 3, 3))
    share = min(1.0, INDEPENDENT_SAMPLES / len(fit.theta))
    for m, of_muscle in _muscle_covariances(body, fit):
        drive = body.layouts[m].drive
        prior = np.diag(1.0 / np.square(PRIOR.drive))
        observed = np.linalg.inv(of_muscle[drive, drive]) - prior
        widened = np.linalg.inv(prior + share * observed)
        scale = body.drive_units[:, m]
        covariance[m] = scale[:, None] * (0.5 * (widened + widened.T)) * scale
    return covariance


def length_spread(body: CalibratedBody, fit: FittedBody, seed: int) -> Array:
    """Return how far the learned lengths may be wrong over the workspace [m], (M,).

        s_m² = mean over θ of Var(e_m(θ) − mean over θ of e_m)

    e_m(θ) is the error of the length of muscle m that the samples leave open: the error of its
    route points in the posterior of the fit. The mean over the workspace does not count, because
    it is an offset. Errors of elastic constants and of the remainder are left out.
    """
    robot = body.robot
    theta = robot.random_postures(WORKSPACE, np.random.default_rng([seed, 0x1E]))
    poses, still = body.poses(theta), np.zeros(WORKSPACE)
    spread = np.empty(robot.muscle_count)
    for m, of_muscle in _muscle_covariances(body, fit):
        points, tension = body.layouts[m].attachment, np.full(WORKSPACE, robot.tension.bias[m])
        slope = body.linearised(poses, tension, still, m)[1][:, points]
        slope -= slope.mean(axis=0)
        variance = np.einsum('ni,ij,nj->n', slope, of_muscle[points, points], slope)
        spread[m] = math.sqrt(variance.mean())
    return spread


def _muscle_covariances(body: CalibratedBody, fit: FittedBody) -> Iterator[tuple[int, Array]]:
    """Yield each muscle and the posterior covariance of its parameters w, (P, P)."""
    for muscles, root in fit.root:
        end = 0
        for m in muscles.tolist():
            size = body.layouts[m].size
            half = solve_triangular(root, np.eye(len(root), size, -end), trans='T')
            yield m, half.T @ half
            end += size


def _drawn_errors(
    mae: Mae,
    body: CalibratedBody,
    fit: FittedBody,
    theta: Array,
    tension: Array,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Draw one estimation error for each posture, and the error of the joint-sensor offsets in it.

    Bodies and joint-sensor offsets are drawn from the posterior of the fit. The posterior is a
    Laplace approximation, in which lengths are linear in the parameters. The network estimates θ
    from the lengths of each drawn body.

    Returns:
        The errors θ_est − θ [rad], and the errors of the joint-sensor offsets [rad], both of shape
        (BODIES · POSTURES_PER_BODY, D).
    """
    bodies = np.repeat(np.arange(BODIES), POSTURES_PER_BODY)
    tension = tension[rng.integers(len(tension), size=len(bodies))]
    direction = UNKNOWN_FRICTION * np.sin(0.5 * np.pi * rng.uniform(-1.0, 1.0, tension.shape))
    # The network gets bone-side tensions, and the body computes lengths from readings.
    read = body.transmission.reading(tension, np.zeros_like(tension))
    poses, length = body.poses(theta), fit.noise * rng.standard_normal(tension.shape)
    length += body.remainder.at(theta, read) + body.remainder.drawn_error(theta, read, rng)
    offset = np.zeros((BODIES, theta.shape[1]))
    for group, (muscles, root) in zip(body.robot.groups, fit.root, strict=True):
        steps = solve_triangular(root, rng.standard_normal((len(root), BODIES))).T
        ends = np.cumsum([body.layouts[m].size for m in muscles])
        for m, step in zip(muscles.tolist(), np.split(steps, ends, axis=1)):
            observed, slope = body.linearised(poses, read[:, m], direction[:, m], m)
            length[:, m] += observed + (slope * step[bodies]).sum(axis=1)
        joints = list(group.joints)
        offset[:, joints] = steps[:, ends[-1] : ends[-1] + len(joints)]
    return mae.estimate(tension, length).theta - theta, offset[bodies]


def _spread(error: Array) -> Array:
    """Return a covariance (D, D) whose 95 % ellipsoid contains 95 % of the errors (N, D).

    The ellipsoid of the plain covariance would contain less than 95 % of the errors, because they
    have heavier tails than a normal distribution.
    """
    covariance = error.T @ error / len(error) + TINY * np.eye(error.shape[1])
    covariance = 0.5 * (covariance + covariance.T)
    return covariance * _excess(covariance, error)


def _excess(covariance: Array, error: Array) -> float:
    """Return the factor by which a covariance must grow for its ellipsoid to hold 95 % of errors.

    `covariance` [rad²] has the shape (D, D), and `error` [rad] the shape (N, D).
    """
    return float(np.quantile(ellipsoids(covariance, error), CONTAINED_SHARE))


def ellipsoids(covariance: Array, error: Array) -> Array:
    """Return the factor by which the ellipsoid of a covariance must grow to reach each error, (N,).

    The factor multiplies the covariance. The ellipsoid contains the share CONTAINED_SHARE of the
    normal distribution with this covariance.

    Args:
        covariance: A covariance [rad²], (D, D).
        error: Errors [rad], (N, D).
    """
    squares = np.einsum('ni,ni->n', error, np.linalg.solve(covariance, error.T).T)
    # Compute the quantile of χ² with D degrees of freedom here: importing scipy.stats takes 0.7 s.
    bounded: Array = squares / (2.0 * gammaincinv(0.5 * error.shape[1], CONTAINED_SHARE))
    return bounded


def observed_theta(mae: Mae, observed: Observations) -> Array:
    """Return the joint angles θ [rad] (N, D) that a network estimates from observations."""
    return mae.estimate(observed.end_tension(mae.transmission), observed.length).theta
