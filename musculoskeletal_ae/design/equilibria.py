# SPDX-License-Identifier: Apache-2.0
"""Finds postures of a suspended robot, whose muscles cannot hold every posture.

A robot with fewer muscles than joints, such as a platform that hangs on four tendons, can only be
held where its weight and springs balance the muscles:

    τ(θ, T) = g(θ) + K θ − b + G(θ)ᵀ T = 0,   T in [T_bias, T_limit]

From a random posture θ₀, `equilibria` moves to a posture near it that satisfies this equation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.gauss_newton import minimise_each
from musculoskeletal_ae.robot.actuation import DESIRED_SHARE
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.stiffness import muscle_hessian

NEAR = 1.0  # expect an equilibrium about this far from the random posture θ₀ [rad]
#: expect tensions to differ from the desired one by about this share of T_limit
SHARE = 0.5
#: weigh the unbalanced torque τ in the search as an error with this standard deviation, relative to
#: the typical torque of weight and muscles
BALANCE = 1e-4
DIFFERENCE = 1e-5  # differentiate the torque of weight and springs over ± this angle [rad]
ROUNDS = 60  # end the search after this many steps
#: accept a posture as an equilibrium if the unbalanced torque of each joint is at most this share
#: of the typical torque
BALANCED = 0.01


class Equilibria(NamedTuple):
    """Postures and tensions of N equilibria."""

    theta: Array  # joint angles [rad], (N, D)
    tension: Array  # tensions [N], (N, M); NaN where no equilibrium was found
    missing: Array  # torque that is not balanced [N·m], (N, D); 0 where an equilibrium was found
    gradient: Array  # derivative of the torque of weight and springs by θ [N·m/rad], (N, D, D)


def is_suspended(robot: Robot) -> bool:
    """Return whether a robot is suspended: its muscles cannot hold it without weight or springs.

    Robots with as many muscles as joints are judged like others if a joint has a spring, because
    one muscle and a spring hold a joint.
    """
    free = robot.joint_count - robot.muscle_count
    return free > 0 or (free == 0 and not robot.kinematics.elasticity.is_sprung.any())


def equilibria(robot: Robot, theta: Array) -> Equilibria:
    """Return an equilibrium near each posture θ₀ [rad], (N, D)."""
    count, low, high = robot.joint_count, robot.tension.bias, robot.tension.limit

    def load(at: Array) -> Array:
        springs = robot.kinematics.elasticity.holding_torque(at)
        return np.array(robot.kinematics.weight_torque(at) + springs)

    def load_gradient(at: Array) -> Array:
        steps = DIFFERENCE * np.eye(count)
        columns = [(load(at + step) - load(at - step)) / (2.0 * DIFFERENCE) for step in steps]
        return np.stack(columns, axis=-1)

    jacobian = robot.routes.muscle_jacobian
    typical = np.abs(load(theta)).mean(axis=0) + np.abs(
        jacobian(theta).swapaxes(-1, -2) @ (DESIRED_SHARE * high)
    ).mean(axis=0)
    scale = np.maximum(typical, 1e-3 * typical.max())

    def residuals(state: Array) -> tuple[Array, Array]:
        at, tension = state[:, :count], high * state[:, count:]
        slope = jacobian(at)  # (N, M, D)
        torque = load(at) + np.einsum('nmd,nm->nd', slope, tension)
        curved = np.einsum('nm,nmij->nij', tension, muscle_hessian(jacobian, at))
        by_theta = load_gradient(at) + curved
        by_share = (slope * high[:, None]).swapaxes(-1, -2)  # (N, D, M)
        balance = np.concatenate([by_theta, by_share], axis=-1) / (BALANCE * scale[:, None])
        priors = np.concatenate([np.full(count, 1.0 / NEAR), np.full(len(high), 1.0 / SHARE)])
        values = np.concatenate([torque / (BALANCE * scale), priors * (state - start)], axis=-1)
        prior_slope = np.broadcast_to(np.diag(priors), (len(at), *np.diag(priors).shape))
        return values, np.concatenate([balance, prior_slope], axis=-2)

    start = np.hstack([theta, np.full((len(theta), len(high)), DESIRED_SHARE)])
    bounds = np.append(robot.lower, low / high), np.append(robot.upper, np.ones(len(high)))
    state = minimise_each(residuals, start, 1.0, ROUNDS, bounds=bounds)
    at, tension = state[:, :count], high * state[:, count:]
    torque = load(at) + np.einsum('nmd,nm->nd', jacobian(at), tension)
    is_balanced = (np.abs(torque) <= BALANCED * scale).all(axis=1)
    tension[~is_balanced] = np.nan
    missing = np.where(is_balanced[:, None], 0.0, torque)
    return Equilibria(at, tension, missing, load_gradient(at))
