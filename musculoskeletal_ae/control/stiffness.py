# SPDX-License-Identifier: Apache-2.0
"""A posture with a chosen joint stiffness: the method `stiffness`.

    min Σ_j (K_jj(T) − wish_j)²   subject to   −Gᵀ T = τ_target,   T_low ≤ T ≤ T_limit

Tensions in the null space of Gᵀ leave the posture as it is and stiffen the elastic units
(`stiffness_model`). T_low lies above T_bias, because a muscle that MSC holds at T_bias is stiff in
one direction only. K is nearly linear in T, so that a few quadratic programmes around the last
solution find the optimum.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import quadprog

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.length import first_command
from musculoskeletal_ae.control.proposed import SOLVES, Solution
from musculoskeletal_ae.control.stiffness_model import StiffnessModel, stiffness_model
from musculoskeletal_ae.exceptions import InfeasibleError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension, least_tension

# [N] above T_bias that a push may take from a muscle before it gives way; the widest that is held.
MARGINS = (40.0, 30.0, 20.0, 10.0, 0.0)
ITERATIONS = 6
# Of the least tension against the wish; a reachable wish is missed by about this share.
LEAST_TENSION_SHARE = 1e-3
SHARES = (1.0, 0.5, 0.25, 0.125)  # of the way to a corner; K bends down in every tension
FAR = 1e5  # [N²] turns a quadratic programme into a linear one: its gradient outweighs distance


class StiffnessSolution(NamedTuple):
    """A command and the stiffness it is expected to bring.

    Attributes:
        command: Lengths, tensions and missing torque.
        stiffness: Expected K_θ [N·m/rad], shape (D, D).
        lowest: Least K_jj that the posture allows, each joint alone, shape (D,).
        highest: Greatest ones, shape (D,).
    """

    command: Solution
    stiffness: Array
    lowest: Array
    highest: Array


class _Polytope(NamedTuple):
    """Tensions that produce the torque within their limits."""

    jacobian: Array
    torque: Array
    low: Array
    high: Array

    def nearest(self, tension: Array) -> Array:
        return holding_tension(self.jacobian, self.torque, self.low, self.high, tension)

    def minimum(self, quadratic: Array, linear: Array) -> Array:
        """Return argmin ½ Tᵀ Q T − aᵀ T."""
        eye = np.eye(len(linear))
        constraints = np.hstack([-self.jacobian, eye, -eye])
        bounds = np.concatenate([self.torque, self.low, -self.high])
        try:
            solution = quadprog.solve_qp(quadratic, linear, constraints, bounds, len(self.torque))
        except ValueError as error:
            raise InfeasibleError('no tension within its limits produces the torque') from error
        tension: Array = solution[0]
        return tension


def stiffness_command(
    robot: Robot, mae: Mae, theta: Array, torque: Array, wish: Array, limit: Array | float
) -> StiffnessSolution:
    """Return the command whose joint stiffness is as near as possible to the wish.

    Args:
        robot: For limits and K_stiff.
        mae: The network.
        theta: θ_target [rad], shape (D,).
        torque: τ_target = g(θ_target) + effort [N·m], shape (D,).
        wish: Diagonal entries [N·m/rad], shape (D,); 0 for as it comes. A wish beyond the
            reachable range of its joint is taken as the end of that range.
        limit: Highest tension planned [N], scalar or shape (M,).
    """
    high = np.array(np.broadcast_to(limit, robot.muscle_count), dtype=float)
    jacobian = mae.muscle_jacobian(theta, np.minimum(robot.tension.bias + MARGINS[0], high))
    for margin in MARGINS:
        low = np.minimum(robot.tension.bias + margin, high)
        tension, missing = least_tension(jacobian, torque, low, high)
        if not missing.any():
            break
    model = stiffness_model(robot, mae, theta, tension)
    # Where every muscle is needed for the torque nothing is left to choose.
    lowest = highest = np.diag(model.joint_stiffness(tension))
    for _ in range(SOLVES):
        tensions = _Polytope(model.jacobian, torque, low, high)
        try:
            start = tensions.nearest(tension)
        except InfeasibleError:
            break
        lowest, highest = _reachable(model, tensions, start)
        wished = np.where(wish > 0.0, np.clip(wish, lowest, highest), 0.0)
        tension = _approach(model, tensions, start, wished)
        model = stiffness_model(robot, mae, theta, tension)
        missing = torque + model.jacobian.T @ tension if missing.any() else missing
    command = Solution(first_command(robot, mae, theta, tension), tension, missing)
    return StiffnessSolution(command, model.joint_stiffness(tension), lowest, highest)


def _approach(model: StiffnessModel, tensions: _Polytope, start: Array, wish: Array) -> Array:
    """Gauss–Newton on the wished entries; the others are as they come."""
    chosen = wish > 0.0
    tension = start
    for _ in range(ITERATIONS if chosen.any() else 0):
        slope = model.slope(tension)[chosen]
        short = (wish - np.diag(model.joint_stiffness(tension)))[chosen]
        small = LEAST_TENSION_SHARE * np.square(slope).sum(axis=1).mean()
        quadratic = slope.T @ slope + small * np.eye(len(tension))
        linear = slope.T @ (short + slope @ tension) + small * start
        tension = tensions.minimum(quadratic, linear)
    return tension


def _reachable(model: StiffnessModel, tensions: _Polytope, start: Array) -> tuple[Array, Array]:
    """Return the least and the greatest diagonal entries, each joint alone."""
    joints = range(model.jacobian.shape[1])
    lowest = [_extreme(model, tensions, start, joint, -1.0) for joint in joints]
    highest = [_extreme(model, tensions, start, joint, 1.0) for joint in joints]
    return np.array(lowest), np.array(highest)


def _extreme(
    model: StiffnessModel, tensions: _Polytope, start: Array, joint: int, sign: float
) -> float:
    """Climb to the corner that the slope points to, as far as it improves (Frank and Wolfe)."""

    def value(tension: Array) -> float:
        return sign * float(model.joint_stiffness(tension)[joint, joint])

    best, tension, eye = value(start), start, np.eye(len(start))
    for _ in range(ITERATIONS):
        slope = sign * model.slope(tension)[joint]
        pull = FAR / max(float(np.abs(slope).max()), 1e-12) * slope
        corner = tensions.minimum(eye, tension + pull)
        steps = [tension + share * (corner - tension) for share in SHARES]
        values = [value(step) for step in steps]
        k = int(np.argmax(values))
        if values[k] <= best + 1e-3 * abs(best):
            break
        best, tension = values[k], steps[k]
    return sign * best
