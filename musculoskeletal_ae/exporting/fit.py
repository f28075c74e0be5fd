# SPDX-License-Identifier: Apache-2.0
"""Fit a parametric body to a learned network.

    min over δ, κ, o   Σ_n (l_net(θ_n, T_n) − l(θ_n, T_n; δ, κ, o))² / σ²
                       + Σ (δ/s_δ)² + Σ (κ/s_κ)² + (o/s_o)²

    l(θ, T; δ, κ, o) = f(θ; p + δ) − f(0; p + δ) − L_e(f, T; c e^κ) + o

f is the length of the route with displaced points p + δ, wrapping included; κ are logarithmic
changes of the elastic constants c, and o is a length offset. Each muscle is fitted separately, by
the Levenberg–Marquardt method of SciPy. The residual is the part of the network's lengths that this
parametric body cannot represent.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.joint_tree import JointPoses
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.routes import Routes
from musculoskeletal_ae.robot.series_elastic import SeriesElastic

STATES = 1000  # number of random states in the fit
#: σ [m]. The lengths of the network have errors of about 0.5 mm. Some forty neighbouring states
#: share an error, so they count as one state: σ ≈ 0.5 mm · √40.
NOISE = 3e-3
ATTACHMENT, ELASTIC, OFFSET = 0.01, 0.5, 0.05  # s_δ [m], s_κ, s_o [m]
LARGEST_LOG = 1.5  # bound on |κ|
ENOUGH = 1e-4  # relative improvement of the sum below which the search ends


@dataclass(frozen=True)
class FittedBody:
    """The fitted body and its residual."""

    shift: Array  # displacement of each route point in the frame of its joint [m], (P, 3)
    elastic: SeriesElastic  # elastic constants of the muscles
    residual: Array  # root mean square residual of each muscle's length [m], (M,)


class _States(NamedTuple):
    """N states of one muscle, and the lengths that the fit should reproduce."""

    poses: JointPoses  # poses of the joints at θ, with θ = 0 as an additional last row
    tension: Array  # T [N], (N,)
    length: Array  # l of the network [m], (N,)


def fit(robot: Robot, mae: Mae, seed: int = 0) -> FittedBody:
    """Return the parametric body that is fitted to a network's lengths over the workspace."""
    rng = np.random.default_rng([seed, 0xE2])
    theta = robot.random_postures(STATES, rng)
    tension = rng.uniform(robot.tension.bias, robot.tension.limit, (STATES, robot.muscle_count))
    length = mae.lengths(theta, tension)
    at_zero = np.zeros((1, robot.joint_count))
    poses = robot.kinematics.tree.joint_poses(np.concatenate([theta, at_zero]))
    shifts, constants, residual = [], [], []
    for m, route in enumerate(robot.description.routes):
        states = _States(poses, tension[:, m], length[:, m])
        muscle = _Muscle(Routes(robot.kinematics, [route]), robot.series_elastic.of(m))
        parameters, error = muscle.fitted(states)
        shifts.append(muscle.shift(parameters))
        constants.append(muscle.elastic(parameters))
        residual.append(float(np.sqrt(np.mean(error**2))))
    values = zip(*(vars(each).values() for each in constants), strict=True)
    elastic = SeriesElastic(*(np.array(value) for value in values))
    return FittedBody(np.concatenate(shifts), elastic, np.array(residual))


class _Muscle:
    """One muscle with the vector of its parameters.

    The vector contains the displacement δ of each route point (three numbers), the logarithmic
    changes κ of the three elastic constants, and the length offset o.
    """

    def __init__(self, routes: Routes, elastic: SeriesElastic) -> None:
        self._routes, self._elastic = routes, elastic
        sizes = 3 * len(routes.point), 3, 1
        self._spread = np.repeat([ATTACHMENT, ELASTIC, OFFSET], sizes)

    def shift(self, parameters: Array) -> Array:
        """Return δ, the displacements of the P route points [m], (P, 3)."""
        return parameters[:-4].reshape(-1, 3)

    def elastic(self, parameters: Array) -> SeriesElastic:
        """Return the elastic constants of this muscle as scalars, changed by the factors e^κ."""
        factors = np.exp(np.clip(parameters[-4:-1], -LARGEST_LOG, LARGEST_LOG))
        nominal = vars(self._elastic).values()
        return SeriesElastic(*(value * f for value, f in zip(nominal, factors, strict=True)))

    def fitted(self, states: _States) -> tuple[Array, Array]:
        """Fit the parameters of the muscle to N states.

        Returns:
            The parameters, and the remaining errors of l [m], (N,).
        """

        def residuals(parameters: Array) -> Array:
            length, _ = self._linearised(parameters, states)
            return np.concatenate([(length - states.length) / NOISE, parameters / self._spread])

        def jacobian(parameters: Array) -> Array:
            _, by_parameters = self._linearised(parameters, states)
            return np.concatenate([by_parameters / NOISE, np.diag(1.0 / self._spread)])

        solution = least_squares(
            residuals,
            np.zeros(len(self._spread)),
            jacobian,
            x_scale='jac',
            ftol=ENOUGH,
            method='lm',
        )
        return solution.x, NOISE * solution.fun[: len(states.length)]

    def _linearised(self, parameters: Array, states: _States) -> tuple[Array, Array]:
        """Return the muscle's lengths [m], (N,), and their derivatives, (N, K).

        The derivatives are those with respect to the K parameters.
        """
        point = self._routes.point + self.shift(parameters)
        whole, by_point = self._routes.moved(states.poses, point)
        absolute, by_shift = whole[:, 0], by_point.reshape(len(whole), -1)
        elastic, tension, offset = self.elastic(parameters), states.tension, parameters[-1]
        elongation = elastic.elongation(absolute[:-1], tension)
        length = absolute[:-1] - absolute[-1] - elongation + offset
        stretch = 1.0 - elastic.length_slope(tension)
        by_elastic = [
            tension / (elastic.force + tension) / elastic.rate,
            np.log1p(tension / elastic.force) / elastic.rate,
            -elastic.wire_stretch * absolute[:-1] * tension,
        ]
        by_shift = stretch[:, None] * by_shift[:-1] - by_shift[-1]
        columns = [by_shift, np.stack(by_elastic, axis=1), np.ones((len(tension), 1))]
        return length, np.concatenate(columns, axis=1)
