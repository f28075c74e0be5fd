# SPDX-License-Identifier: Apache-2.0
"""One step of N simulated arms, preset `default`: the network's equilibrium, approached smoothly.

    l = f_decode,l(①(θ, T))                                     the learnt body
    T = T_bias + max(0, K_stiff (l − l_target)),  T ≤ T_max     MSC, part of the simulated arm
    B θ̇ = −(g(θ) − JᵀF + Gᵀ T),  G = ∂l/∂θ at (θ, T)            between the joint limits

The paper descends on a sum of norms (section "Simulation"); its weights let ‖T‖ outweigh torque and
length, so that the arm settles elsewhere. Here both are equations, and what is searched is the
sheet z = ①(θ, T) of the latent space, where they have D+M unknowns for D+M equations. Their root is
the posture of rest. (Solved for z itself, with decoded θ and T instead of exact ones, the root is
no nearer to the body's and each step dearer.) The arm creeps towards it through a viscous medium B,
by linearly implicit Euler steps: Newton steps on those equations with B/h on the diagonal. B stands
for what joints and geared modules resist, so that speeds look right; it has no say in where the arm
comes to rest. A joint limit is a hard stop that gives whatever torque it takes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.load import Load
from musculoskeletal_ae.simulation.slopes import Slopes

#: l_target of muscles without a command: paid out, so that MSC holds T_bias
PAID_OUT = np.inf  # [m]
VISCOSITY = 1.5  # [N·m·s/rad], B; motions then last as long as the emulated arm's (0.7 … 5 tried)
JOINT_SPEED = 5.0  # [rad/s] or [m/s]; bounds a step, and with it every fault of a network
MODULE_SPEED = 0.25  # [m/s] at which modules wind, chosen as in the emulator


class ArmState(NamedTuple):
    """N arms between two steps.

    Attributes:
        theta: θ_sim [rad], shape (N, D).
        tension: T_sim [N], shape (N, M).
        length: l_sim [m], shape (N, M).
        followed: The command as far as the modules have followed it [m], shape (N, M).
        holding: Torque by which a stop, or whoever holds a joint, keeps it [N·m], shape (N, D).
    """

    theta: Array
    tension: Array
    length: Array
    followed: Array
    holding: Array


class QuasiStatics:
    """The equations above for one robot and one network."""

    def __init__(self, robot: Robot, mae: Mae) -> None:
        """Read the robot's constants and fit the network's slopes."""
        self._robot, self._mae = robot, mae
        self._load, self._slopes = Load(robot.kinematics), Slopes(robot, mae)
        self._eye = np.eye(robot.joint_count)

    def step(
        self,
        state: ArmState,
        command: Array,
        h: float,
        wrench: Array | None = None,
        fixed: Array | None = None,
    ) -> ArmState:
        """Return the arms h later.

        Args:
            state: N arms.
            command: l_target [m], shape (N, M); PAID_OUT for none.
            h: Time step [s].
            wrench: On the end effector, axes of the root link [N, N·m], shape (N, 6).
            fixed: Angles joints are forced to [rad], shape (N, D); nan for a free joint.
        """
        robot, theta, tension = self._robot, state.theta, state.tension
        stiffness, limits = robot.stiffness, robot.tension
        length, pullback = self._mae.lengths_with_pullback(theta, tension)
        span = (limits.max - limits.bias) / stiffness
        followed = follow(command, state.followed, length, span, MODULE_SPEED * h)
        # MSC and the elastic unit in series: at rest posture T moves to `wished`, and with the
        # posture by `soft` K G Δθ.
        absolute = robot.routes.length_at_zero + length
        compliance = robot.series_elastic.compliance(absolute, tension)
        soft = 1.0 / (1.0 + stiffness * compliance)
        command_tension = limits.bias + stiffness * (length - followed)
        wished = tension + soft * (command_tension - tension)
        # max(0, ·) and T_max are corners: beyond them a muscle is no spring (semismooth Newton).
        settled = np.minimum(np.maximum(wished, limits.bias), limits.max)
        spring = stiffness * soft * (wished == settled)
        jacobian, curvature = self._slopes(theta, tension)
        load, load_slope = self._load(theta, wrench)
        pull = ((settled - tension)[:, None, :] @ jacobian)[:, 0]
        push = -(load + pullback(tension) + pull)
        matrix = (jacobian * spring[..., None]).swapaxes(1, 2) @ jacobian
        matrix += curvature + load_slope + (VISCOSITY / h) * self._eye
        turned = self._turn(theta, push, matrix, JOINT_SPEED * h, fixed)
        arrived = np.minimum(np.maximum(theta + turned, robot.lower), robot.upper)
        stretch = (jacobian @ (arrived - theta)[..., None])[..., 0]
        after = wished + stiffness * soft * stretch
        after = np.minimum(np.maximum(after, limits.bias), limits.max)
        held = (arrived == robot.lower) & (push < 0.0) | (arrived == robot.upper) & (push > 0.0)
        if fixed is not None:
            held |= np.isfinite(fixed)
        return ArmState(
            arrived,
            after,
            length + stretch - compliance * (after - tension),
            followed,
            np.where(held, -push, 0.0),
        )

    def _turn(
        self, theta: Array, push: Array, matrix: Array, most: float, fixed: Array | None
    ) -> Array:
        """Return Δθ of one step; joints at a stop stay, forced joints go where they are forced."""
        robot = self._robot
        held = (theta <= robot.lower) & (push < 0.0) | (theta >= robot.upper) & (push > 0.0)
        forced = np.zeros_like(theta)
        if fixed is not None:
            given = np.isfinite(fixed)
            wished = np.minimum(np.maximum(fixed, robot.lower), robot.upper) - theta
            forced[given] = np.minimum(np.maximum(wished, -most), most)[given]
            held |= given
            push = push - (matrix @ forced[..., None])[..., 0]
        free = ~held
        matrix = matrix * (free[:, :, None] & free[:, None, :]) + held[:, :, None] * self._eye
        turned = np.linalg.solve(matrix, (push * free)[..., None])[..., 0]
        largest = np.abs(turned).max(axis=1, keepdims=True)
        scaled: Array = turned * (most / np.maximum(largest, most)) + forced
        return scaled


def follow(command: Array, followed: Array, length: Array, span: float, most: float) -> Array:
    """Return the command as far as modules of limited speed have wound.

    Args:
        command: l_target [m], shape (N, M).
        followed: How far they had wound a step before [m], shape (N, M).
        length: l [m], shape (N, M).
        span: How far below l a command still adds tension [m].
        most: What a module winds in a step [m].
    """
    reached = followed + np.minimum(np.maximum(command - followed, -most), most)
    # What lies beyond changes no tension; following it would take as long to come back from.
    within: Array = np.minimum(np.maximum(reached, length - span), length + most)
    return within
