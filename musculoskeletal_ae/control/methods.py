# SPDX-License-Identifier: Apache-2.0
"""How a target posture becomes muscle lengths: the methods `proposed` and `stiffness`.

    proposed   l_target = ①(θ_target, T) + l_comp(T)
               T = argmin ‖T‖²  subject to  τ_target + Gᵀ T = 0,  T_bias ≤ T ≤ T_limit

This searches the latent space of the network on the sheet z = ①(θ_target, T), where θ_target is
kept by construction. As constraints, torque and limits are met first, and the least tension is
taken of what remains. (As terms of a sum of norms, ‖T‖ can outweigh the torque balance, and then
the arm sags.) G depends on T, so the quadratic programme is solved a few times.

Muscle stiffness control holds T = T_bias + max(0, K_stiff (l − l_target)), so l_comp is how far the
command must lie below the length for the muscle to carry T there. `stiffness` chooses T for a joint
stiffness (`stiffness_command`). `tension` commands tensions, no lengths (`torque`). The methods
`geometric`, `first` and `second` are those that the preset lists (`Preset.length_methods`).
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.command import msc_compensation
from musculoskeletal_ae.exceptions import InfeasibleError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot import stiffness as robot_stiffness
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import Exertion, TensionProgramme, least_tension

# Solving again with G at the new tension changes it by well under a newton after the second.
SOLVES = 2

# `stiffness`
# [N] above T_bias that a push may take from a muscle before it gives way; the widest that is held.
MARGINS = (40.0, 30.0, 20.0, 10.0, 0.0)
ITERATIONS = 6
# Of the least tension against the stiffness; one within reach is missed by about this share.
LEAST_TENSION_SHARE = 1e-3
SHARES = (1.0, 0.5, 0.25, 0.125)  # of the way to a corner; K bends down in every tension
FAR = 1e5  # [N²] turns a quadratic programme into a linear one: its gradient outweighs distance
LEVELS = 8  # tensions between T_bias and limit at which the elongation is read
# [rad] for the slope of G; small against the bends of a route, large against errors of the MAE.
STEP = 0.05


class JointStiffness(NamedTuple):
    """Stiffness that a command is expected to bring, and what the posture allows [N·m/rad]."""

    expected: Array  # K_θ, (D, D)
    lowest: Array  # least K_jj, each joint alone, (D,)
    highest: Array  # greatest ones, (D,)


class Solution(NamedTuple):
    """A command and what it is expected to bring."""

    length: Array  # l_target [m], (M,)
    tension: Array  # T [N], (M,)
    missing_torque: Array  # torque that no tension within its limits gives [N·m], (D,)
    stiffness: JointStiffness | None = None  # of the method `stiffness` alone


class LengthCommand(Protocol):
    """Makes one command of a target."""

    def __call__(
        self, robot: Robot, mae: Mae, theta: Array, torque: Array, tension: Array, /
    ) -> Solution:
        """Return the command.

        Args:
            robot: The body, whose isolated muscles pull nothing.
            mae: The network.
            theta: θ_target [rad], (D,).
            torque: τ_target [N·m], (D,).
            tension: T_const, or T as the muscles pull when the method begins [N], (M,).
        """


class LengthMethod(NamedTuple):
    """A control method that ramps to one length command and holds it.

    Attributes:
        command: Makes the command.
        takes_tension: Whether the muscles are to carry the tension that is given; it is then kept
            below the limit.
        follows_first: Whether the method `first` runs before it.
    """

    command: LengthCommand
    takes_tension: bool = False
    follows_first: bool = False


def first_command(robot: Robot, mae: Mae, theta: Array, tension: Array) -> Array:
    """Return the l_target [m] (..., M) by which T [N] (..., M) holds θ_target [rad] (..., D)."""
    return mae.lengths(theta, tension) + msc_compensation(robot, tension)


def proposed(
    robot: Robot, mae: Mae, theta: Array, torque: Array, tension: Array, limit: Array | float
) -> Solution:
    """Return the command of `proposed`.

    For θ_target [rad] (D,) and τ_target = g(θ_target) + effort [N·m] (D,); the search starts at
    T_current [N] (M,) and plans no tension above the limit [N], scalar or (M,).
    """
    bias = robot.tension.bias
    exertion = Exertion(np.clip(tension, bias, limit), np.zeros(robot.joint_count))
    for _ in range(SOLVES):
        jacobian = mae.muscle_jacobian(theta, exertion.tension)
        exertion = least_tension(jacobian, torque, bias, limit)
    return Solution(first_command(robot, mae, theta, exertion.tension), *exertion)


class StiffnessModel(NamedTuple):
    """Joint stiffness around one posture, as the MAE sees it."""

    jacobian: Array  # G [m/rad], (M, D)
    hessian: Array  # ∂²l/∂θ² [m/rad²], (M, D, D)
    compliance: Array  # ∂L_e/∂T [m/N] as polynomials of T, highest power first, (3, M)
    module: Array  # K_stiff [N/m], (M,)

    @classmethod
    def read(cls, robot: Robot, mae: Mae, theta: Array, tension: Array) -> StiffnessModel:
        """Read the model off the MAE at θ (D,) and T (M,)."""

        def jacobian(postures: Array) -> Array:
            return mae.muscle_jacobian(postures, np.tile(tension, (len(postures), 1)))

        ranges = np.stack([robot.tension.bias, robot.tension.limit])
        tensions: Array = np.linspace(ranges[0], ranges[1], LEVELS)
        lengths = mae.lengths(np.tile(theta, (LEVELS, 1)), tensions)
        cubic = np.empty((4, robot.muscle_count))
        for low, high in np.unique(ranges, axis=1).T:
            own = (ranges[0] == low) & (ranges[1] == high)
            levels = np.linspace(low, max(high, low + 1.0), LEVELS)  # isolated: all 0
            cubic[:, own] = np.polyfit(levels, -lengths[:, own], 3)
        slope = mae.muscle_jacobian(theta, tension)
        step = STEP * robot.kinematics.radian
        bend = robot_stiffness.muscle_hessian(jacobian, theta, step)
        slope[list(robot.isolated)] = bend[list(robot.isolated)] = 0.0
        return cls(
            jacobian=slope,
            hessian=bend,
            compliance=cubic[:3] * np.array([3.0, 2.0, 1.0])[:, None],
            module=robot.stiffness,
        )

    def muscle_stiffness(self, tension: Array) -> tuple[Array, Array]:
        """Return k [N/m] and dk/dT [1/m] of every muscle, each of shape (M,)."""
        square, linear, constant = self.compliance
        compliance = (square * tension + linear) * tension + constant
        # A network may err so far that a wire seems to shorten under tension; call it rigid.
        slope = np.where(compliance > 0.0, 2.0 * square * tension + linear, 0.0)
        k = robot_stiffness.muscle_stiffness(self.module, np.maximum(compliance, 0.0))
        return k, -k * k * slope

    def joint_stiffness(self, tension: Array) -> Array:
        """Return K_θ [N·m/rad] at T (M,), shape (D, D)."""
        k, _ = self.muscle_stiffness(tension)
        return robot_stiffness.joint_stiffness(self.jacobian, self.hessian, k, tension)

    def slope(self, tension: Array) -> Array:
        """Return ∂K_jj/∂T_i [N·m/rad/N] at T (M,), shape (D, M)."""
        _, bend = self.muscle_stiffness(tension)
        return (self.jacobian**2 * bend[:, None]).T + np.einsum('mjj->jm', self.hessian)


def stiffness_command(
    robot: Robot,
    mae: Mae,
    theta: Array,
    torque: Array,
    desired: Array,
    limit: Array | float,
    near: Array | None = None,
) -> Solution:
    """Return the command of `stiffness`: joint stiffness as near as possible to the desired one.

        min Σ_j (K_jj(T) − K_desired,j)²   subject to   −Gᵀ T = τ_target,   T_low ≤ T ≤ T_limit

    with K_θ of `robot/stiffness.py`, whose G, ∂²l/∂θ² and L_e(T), which is −l(θ, T) up to a
    constant, are read by entering the MAE with ① (paper, §III-E, third: variable
    stiffness). Tensions in the null space of Gᵀ leave the posture and stiffen the elastic units.
    T_low lies above T_bias, because a muscle that MSC holds at T_bias is stiff in one direction
    only. K is nearly linear in T: a few quadratic programmes around the last solution suffice.

    Desired are diagonal entries [N·m/rad] (D,); 0 for as it comes, and what lies beyond the
    reachable range of its joint is taken as the end of that range. Others as for `proposed`. Near
    the T [N] (M,) of a moment ago a single round does.
    """
    high = np.array(np.broadcast_to(limit, robot.muscle_count), dtype=float)
    jacobian = mae.muscle_jacobian(theta, np.minimum(robot.tension.bias + MARGINS[0], high))
    for margin in MARGINS:
        low = np.minimum(robot.tension.bias + margin, high)
        tension, missing = least_tension(jacobian, torque, low, high)
        if not missing.any():
            break
    rounds = SOLVES if near is None else 1
    tension = tension if near is None else near
    model = StiffnessModel.read(robot, mae, theta, tension)
    # Where every muscle is needed for the torque nothing is left to choose.
    lowest = highest = np.diag(model.joint_stiffness(tension))
    for _ in range(rounds):
        programme = TensionProgramme(model.jacobian, torque, low, high)
        try:
            start = programme.nearest(tension)
        except InfeasibleError:
            break
        lowest, highest = (
            np.array([_extreme(model, programme, start, j, sign) for j in range(len(theta))])
            for sign in (-1.0, 1.0)
        )
        within = np.where(desired > 0.0, np.clip(desired, lowest, highest), 0.0)
        tension = _approach(model, programme, start, within)
        model = StiffnessModel.read(robot, mae, theta, tension)
        missing = torque + model.jacobian.T @ tension if missing.any() else missing
    stiffness = JointStiffness(model.joint_stiffness(tension), lowest, highest)
    return Solution(first_command(robot, mae, theta, tension), tension, missing, stiffness)


def _approach(
    model: StiffnessModel, programme: TensionProgramme, tension: Array, desired: Array
) -> Array:
    """Gauss–Newton on the desired entries; the others are as they come."""
    chosen, start = desired > 0.0, tension
    for _ in range(ITERATIONS if chosen.any() else 0):
        slope = model.slope(tension)[chosen]
        short = (desired - np.diag(model.joint_stiffness(tension)))[chosen]
        small = LEAST_TENSION_SHARE * np.square(slope).sum(axis=1).mean()
        quadratic = slope.T @ slope + small * np.eye(len(tension))
        tension = programme.minimum(quadratic, slope.T @ (short + slope @ tension) + small * start)
    return tension


def _extreme(
    model: StiffnessModel, programme: TensionProgramme, tension: Array, joint: int, sign: float
) -> float:
    """Climb to the corner that the slope points to, as far as it improves (Frank and Wolfe)."""

    def value(tension: Array) -> float:
        return sign * float(model.joint_stiffness(tension)[joint, joint])

    best = value(tension)
    for _ in range(ITERATIONS):
        slope = sign * model.slope(tension)[joint]
        corner = programme.nearest(tension + FAR / max(float(np.abs(slope).max()), 1e-12) * slope)
        steps = [tension + share * (corner - tension) for share in SHARES]
        values = [value(step) for step in steps]
        k = int(np.argmax(values))
        if values[k] <= best + 1e-3 * abs(best):
            break
        best, tension = values[k], steps[k]
    return sign * best
