# SPDX-License-Identifier: Apache-2.0
"""How lengths change with posture, nearly: a cubic through what the network says.

    l_i(θ) ≈ Σ_n c_ni θ^n,  |n| ≤ 3      G = ∂l/∂θ,   Σ_i T_i ∂²l_i/∂θ²

A Newton step needs these slopes in every step, but only roughly: they decide how the simulator
approaches an equilibrium, never where it lies (that is the network's own word, `sim_step`). The
network's exact second derivatives would cost ten times the rest of the step.
"""

from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

POSTURES_PER_COEFFICIENT = 10


class Slopes:
    """First and second derivatives of a network's lengths by θ, for N arms at once."""

    def __init__(self, robot: Robot, mae: Mae) -> None:
        """Fit the cubic over the whole joint range, muscles in the middle of their tensions."""
        joints, muscles = robot.joint_count, robot.muscle_count
        basis = [term for n in range(4) for term in combinations_with_replacement(range(joints), n)]
        count = POSTURES_PER_COEFFICIENT * len(basis)
        theta = robot.random_postures(count, np.random.default_rng(0))
        middle = 0.5 * (robot.tension.bias + robot.tension.limit)
        lengths = mae.lengths(theta, np.full((count, muscles), middle))
        values = np.stack([theta[:, list(term)].prod(axis=1) for term in basis], axis=1)
        cubic = np.linalg.lstsq(values, lengths, rcond=None)[0]  # (basis, M)
        quadratic = [term for term in basis if len(term) <= 2]
        linear = [term for term in basis if len(term) <= 1]
        slope = _derivative(basis, quadratic, joints)  # (D, quadratic, basis)
        bend = _derivative(quadratic, linear, joints)  # (D, linear, quadratic)
        pairs = [term for term in quadratic if len(term) == 2]
        self._left, self._right = np.array(pairs).T
        first = np.einsum('dqb,bm->qmd', slope, cubic)
        self._shape = (muscles, joints)
        self._first = np.ascontiguousarray(first.reshape(len(quadratic), -1))
        second = np.einsum('elq,qmd->mlde', bend, first)
        self._second = np.ascontiguousarray(second.reshape(muscles * len(linear), -1))

    def __call__(self, theta: Array, tension: Array) -> tuple[Array, Array]:
        """Return G [m/rad] (N, M, D) and Σ T_i ∂²l_i/∂θ² [N·m/rad] (N, D, D).

        Args:
            theta: θ [rad], shape (N, D).
            tension: T [N], shape (N, M).
        """
        count, joints = theta.shape
        linear = np.ones((count, 1 + joints))
        linear[:, 1:] = theta
        products = theta[:, self._left] * theta[:, self._right]
        jacobian = np.concatenate((linear, products), axis=1) @ self._first
        weighted = (tension[:, :, None] * linear[:, None, :]).reshape(count, -1)
        curvature = weighted @ self._second
        return jacobian.reshape(count, *self._shape), curvature.reshape(count, joints, joints)


def _derivative(basis: list[tuple[int, ...]], target: list[tuple[int, ...]], joints: int) -> Array:
    """Return the matrices that take coefficients of monomials to those of their ∂/∂θ_d."""
    place = {term: i for i, term in enumerate(target)}
    matrices = np.zeros((joints, len(target), len(basis)))
    for column, term in enumerate(basis):
        for d in set(term):
            rest = list(term)
            rest.remove(d)
            matrices[d, place[tuple(rest)], column] = term.count(d)
    return matrices
