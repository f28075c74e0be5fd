# SPDX-License-Identifier: Apache-2.0
"""Fit a parametric body to a learned network.

    min over δ, κ, o   Σ_n (l_net(θ_n, T_n) − l(θ_n, T_n; δ, κ, o))² / σ²
                       + Σ (δ/s_δ)² + Σ (κ/s_κ)² + (o/s_o)²

l is the length of the calibrated body of `learning/body.py` without its residual model. Its
parameters are displacements δ of the route points, factors e^κ of the elastic constants, and a
length offset o. Each muscle is fitted separately, by the Gauss–Newton method with decreasing
damping. The residual is the part of the network that such a body cannot represent.
"""

from dataclasses import dataclass

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.body import CalibratedBody
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

STATES = 1500  # number of random states in the fit
NOISE = 3e-4  # σ of the network's lengths [m]
ATTACHMENT, ELASTIC, OFFSET = 0.02, 0.5, 0.05  # s_δ [m], s_κ, s_o [m]
DAMPING = (
    10.0,
    1.0,
    0.1,
    0.01,
    0.0,
    0.0,
    0.0,
    0.0,
)  # damping of each round, relative to the diagonal


@dataclass(frozen=True)
class FittedBody:
    """The fitted body and its residual."""

    body: CalibratedBody
    residual: Array  # root mean square residual of each muscle's length [m], (M,)

    @property
    def shift(self) -> Array:
        """Displacement of each route point in the frame of its joint [m], (P, 3)."""
        shift = np.zeros((len(self.body.robot.routes.point), 3))
        for layout, parameters in zip(self.body.layouts, self.body.parameters, strict=True):
            shift[layout.points] = parameters[layout.attachment].reshape(-1, 3)
        return shift


def fit(robot: Robot, mae: Mae, seed: int = 0) -> FittedBody:
    """Fit the parametric body to the lengths of a network over the workspace."""
    rng = np.random.default_rng([seed, 0xE2])
    theta = robot.random_postures(STATES, rng)
    tension = rng.uniform(robot.tension.bias, robot.tension.limit, (STATES, robot.muscle_count))
    wanted = mae.lengths(theta, tension)
    body = CalibratedBody(robot, seed=seed)
    poses = body.poses(theta)
    parameters, residual = [], np.zeros(robot.muscle_count)
    for m, layout in enumerate(body.layouts):
        fitted = np.r_[layout.attachment, layout.elastic, layout.offset]
        spread = np.full(layout.size, np.inf)
        spread[layout.attachment], spread[layout.elastic] = ATTACHMENT, ELASTIC
        spread[layout.offset] = OFFSET
        prior = NOISE**2 / spread[fitted] ** 2
        smooth, direction = np.zeros((STATES, layout.size - layout.rest.start)), np.zeros(STATES)
        for damping in DAMPING:
            length, jacobian = body.linearised(poses, smooth, tension[:, m], direction, m)
            part = jacobian[:, fitted]
            error, own = wanted[:, m] - length, body.parameters[m]
            normal = part.T @ part + np.diag(prior)
            normal += damping * np.diag(np.diag(normal))
            own = own.copy()
            own[fitted] += np.linalg.solve(normal, part.T @ error - prior * own[fitted])
            body = body.with_parameters(
                [own if k == m else old for k, old in enumerate(body.parameters)]
            )
        length, _ = body.linearised(poses, smooth, tension[:, m], direction, m)
        residual[m] = float(np.sqrt(np.mean((wanted[:, m] - length) ** 2)))
        parameters.append(body.parameters[m])
    return FittedBody(body.with_parameters(parameters), residual)
