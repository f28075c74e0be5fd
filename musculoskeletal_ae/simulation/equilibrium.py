# SPDX-License-Identifier: Apache-2.0
"""One step of N simulated arms, preset `default`: the network's equilibrium, approached smoothly.

    l = f_decode,l(①(θ, T_end)),  T_end = T e^{−μ s}            the learned body, and its friction
    T = T_bias + max(0, K_stiff (l − l_target)),  T ≤ T_max     MSC, part of the simulated arm
    B θ̇ = −(g(θ) − JᵀF + Gᵀ T_end),  G = ∂l/∂θ at (θ, T_end)    between the joint limits

The paper descends on a sum of norms (section "Simulation"); its weights let ‖T‖ outweigh torque and
length, so that the arm settles elsewhere. Here both are equations, and what is searched is the
sheet z = ①(θ, T) of the latent space, where they have D+M unknowns for D+M equations. Their root is
the posture of rest. (Solved for z itself, with decoded θ and T instead of exact ones, the root is
no nearer to the body's and each step dearer.) The arm creeps towards it through a viscous medium B,
by linearly implicit Euler steps: Newton steps on those equations with B/h on the diagonal. B stands
for what joints and geared modules resist, so that speeds look right: more where muscles have longer
levers. It has no say in where the arm comes to rest. A joint limit is a hard stop that gives
whatever torque it takes. Friction along the wires (`friction`) has a say: the arm rests elsewhere
after winding in than after paying out.
"""

from __future__ import annotations

from itertools import combinations_with_replacement
from math import comb
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, library
from musculoskeletal_ae.friction import REVERSAL
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.groups import Group
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.load import Load

#: l_target of muscles without a command: paid out, so that MSC holds T_bias
PAID_OUT = np.inf  # [m]
#: B as a multiple of Σ_i |∂l_i/∂θ| [N·s/rad]; motions then last as long as the emulated arm's (8 to
#: 20 is as good)
VISCOSITY, LEVER_POSTURES = 12.0, 100
LEAST_VISCOSITY = 0.1  # [N·m·s/rad], of a joint that no muscle crosses
JOINT_SPEED = 5.0  # [rad/s] or [m/s]; bounds a step, and with it every fault of a network
MODULE_SPEED = 0.25  # [m/s] at which modules wind, chosen as in the emulator
ROUNDS = 3  # at most, until it is known which wires' friction turns round in a step
POSTURES_PER_COEFFICIENT = 10  # of the cubic that gives slopes


class ArmState(NamedTuple):
    """N arms between two steps."""

    theta: Array  # θ_sim [rad], (N, D)
    tension: Array  # T_sim [N], (N, M)
    length: Array  # l_sim [m], (N, M)
    followed: Array  # the command as far as the modules have followed it [m], (N, M)
    holding: Array  # torque of a stop, or of whoever holds a joint, on it [N·m], (N, D)
    slid: Array  # s: which way each wire slid last, in [−1, 1], (N, M)


class QuasiStatics:
    """The equations above for one robot, and for the network that was given to `use` last."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self._length_at_zero = robot, robot.routes.length_at_zero
        self._load, self._slopes = Load(robot.kinematics), Slopes(robot)
        self._eye = np.eye(robot.joint_count)
        postures = robot.random_postures(LEVER_POSTURES, np.random.default_rng(0))
        levers = np.abs(robot.routes.muscle_jacobian(postures)).sum(axis=1).mean(axis=0)
        self._viscosity = np.maximum(VISCOSITY * levers, LEAST_VISCOSITY) * self._eye

    def use(self, mae: Mae) -> None:
        """Take a network; a FloatingPointError says that it has no finite lengths somewhere."""
        self._slopes.fit(mae)
        self._mae = mae
        # A noisy fit may find a little less than none, which would drive the arm.
        self._friction = np.maximum(mae.friction, 0.0)

    def step(
        self,
        state: ArmState,
        command: Array,
        h: float,
        wrench: Array | None = None,
        fixed: Array | None = None,
    ) -> ArmState:
        """Return the arms h [s] later, under l_target [m] (N, M), PAID_OUT for none.

        A wrench (N, 6) [N, N·m] acts on the end effector, in axes of the root link; joints are
        forced to the angles `fixed` (N, D) [rad], nan for a free joint.
        """
        robot, theta, tension = self._robot, state.theta, state.tension
        stiffness, limits = robot.stiffness, robot.tension
        xp = library(theta)
        passed = xp.exp(-self._friction * state.slid)  # from the motor to the elastic unit
        end = passed * tension
        length, pullback = self._mae.lengths_with_pullback(theta, end)
        span = (limits.max - limits.bias) / stiffness
        followed = follow(command, state.followed, length, span, MODULE_SPEED * h)
        compliance = robot.series_elastic.compliance(self._length_at_zero + length, end)
        by_motor = passed * compliance
        command_tension = limits.bias + stiffness * (length - followed)
        jacobian, curvature = self._slopes(theta, end)
        load, load_slope = self._load(theta, wrench)
        torque = load + pullback(end)
        # Where a wire slides, friction is like a stiff spring until it has turned round: one of
        # constant stiffness, where the arm's lets go little by little.
        rubbing = self._friction * end
        turning, free = state.slid, abs(state.slid) < 1.0
        for _ in range(ROUNDS):
            rub = rubbing * free / REVERSAL
            lost = rubbing * ~free * (turning - state.slid)
            # MSC, friction and the elastic unit in series: at rest posture T moves to `desired`,
            # and with the posture by `soft` K G Δθ.
            give = 1.0 + compliance * rub
            soft = 1.0 / (give + stiffness * by_motor)
            slack = compliance * lost - by_motor * (command_tension - tension)
            desired = command_tension + stiffness * soft * slack
            # max(0, ·) and T_max are corners: beyond them a muscle is no spring (semismooth
            # Newton).
            settled = desired.clip(limits.bias, limits.max)
            moved = (compliance * lost - by_motor * (settled - tension)) / give
            change = passed * (settled - tension) + rub * moved - lost
            spring = xp.where(desired == settled, (passed * stiffness + rub) * soft, rub / give)
            push = -(torque + (change[:, None, :] @ jacobian)[:, 0])
            matrix = (jacobian * spring[..., None]).swapaxes(1, 2) @ jacobian
            matrix += curvature + load_slope + self._viscosity / h
            turned = self._turn(theta, push, matrix, JOINT_SPEED * h, fixed)
            arrived = (theta + turned).clip(robot.lower, robot.upper)
            stretch = (jacobian @ (arrived - theta)[..., None])[..., 0]
            after = (desired + stiffness * soft * stretch).clip(limits.bias, limits.max)
            moved = (stretch + compliance * lost - by_motor * (after - tension)) / give
            turning = (state.slid - moved / REVERSAL).clip(-1.0, 1.0)
            before = free
            free = abs(turning) < 1.0
            if (free == before).all() or not rubbing.any():
                break
        held = (arrived == robot.lower) & (push < 0.0) | (arrived == robot.upper) & (push > 0.0)
        if fixed is not None:
            held |= xp.isfinite(fixed)
        holding = xp.where(held, -push, 0.0)
        return ArmState(arrived, after, length + moved, followed, holding, turning)

    def _turn(
        self, theta: Array, push: Array, matrix: Array, most: float, fixed: Array | None
    ) -> Array:
        """Return Δθ of one step; joints at a stop stay, forced joints go where they are forced."""
        robot, xp = self._robot, library(theta)
        held = (theta <= robot.lower) & (push < 0.0) | (theta >= robot.upper) & (push > 0.0)
        forced = xp.zeros_like(theta)
        if fixed is not None:
            given = xp.isfinite(fixed)
            way = (fixed.clip(robot.lower, robot.upper) - theta).clip(-most, most)
            forced = xp.where(given, way, forced)
            held |= given
            push = push - (matrix @ forced[..., None])[..., 0]
        free = ~held
        matrix = matrix * (free[:, :, None] & free[:, None, :]) + held[:, :, None] * self._eye
        turned = xp.linalg.solve(matrix, (push * free)[..., None])[..., 0]
        largest = xp.amax(abs(turned), axis=1, keepdims=True)
        scaled: Array = turned * (most / largest.clip(min=most)) + forced
        return scaled


def follow(command: Array, followed: Array, length: Array, span: Array, most: float) -> Array:
    """Return the command as far as modules have wound that wind at most `most` [m] in a step.

    Command, how far they had `followed` it a step before, and length are (N, M) [m]; a command
    adds tension as far as `span` [m] (M,) below the length.
    """
    reached = followed + (command - followed).clip(-most, most)
    # What lies beyond changes no tension; following it would take as long to come back from.
    return reached.clip(length - span, length + most)


class Slopes:
    """How a network's lengths change with posture, nearly: a cubic through what it says.

        l_i(θ) ≈ Σ_n c_ni θ^n,  |n| ≤ 3      G = ∂l/∂θ,   Σ_i T_i ∂²l_i/∂θ²

    A Newton step needs these slopes in every step, but only roughly: they decide how the simulator
    approaches an equilibrium, never where it lies, which is the network's own word. The network's
    exact second derivatives would cost ten times the rest of the step. Each limb has cubics in its
    own joints: in all 17 of an upper body they would have 1140 coefficients each, instead of 120.
    """

    def __init__(self, robot: Robot) -> None:
        """Prepare to fit over the whole joint range, muscles in the middle of their tensions."""
        most = max(len(group.joints) for group in robot.groups)
        count = POSTURES_PER_COEFFICIENT * comb(most + 3, 3)
        self._postures = robot.random_postures(count, np.random.default_rng(0))
        middle = 0.5 * (robot.tension.bias + robot.tension.limit)
        self._tension = np.full((count, robot.muscle_count), middle)
        self._limbs = [Cubics(group, self._postures) for group in robot.groups]

    def fit(self, mae: Mae) -> None:
        """Fit what a network says; a FloatingPointError says that it cannot be fitted."""
        lengths = mae.lengths(self._postures, self._tension)
        if not np.isfinite(lengths).all():
            raise FloatingPointError('lengths within the joint limits that are not finite')
        for limb in self._limbs:
            limb.fit(lengths)

    def __call__(self, theta: Array, tension: Array) -> tuple[Array, Array]:
        """Return G [m/rad] (N, M, D) and Σ T_i ∂²l_i/∂θ² [N·m/rad] (N, D, D) at θ, T."""
        if len(self._limbs) == 1:
            return self._limbs[0](theta, tension)
        xp, each = library(theta), theta[:, None, :]
        jacobian = xp.zeros_like(tension[:, :, None] * each)
        curvature = xp.zeros_like(theta[:, :, None] * each)
        for limb in self._limbs:
            (pulled, turned), (down, across) = limb.of_jacobian, limb.of_curvature
            own = limb(theta[:, limb.joints], tension[:, limb.muscles])
            jacobian[:, pulled, turned], curvature[:, down, across] = own
        return jacobian, curvature


class Cubics:
    """The cubics of one limb."""

    def __init__(self, group: Group, postures: Array) -> None:
        """Prepare to fit to lengths at some postures θ of the body (N, D) [rad]."""
        self.joints, self.muscles = map(list, group)
        #: where the limb's G and Σ T_i ∂²l_i/∂θ² are in those of the body
        self.of_jacobian = np.ix_(self.muscles, self.joints)
        self.of_curvature = np.ix_(self.joints, self.joints)
        theta, joints = postures[:, self.joints], len(self.joints)
        basis = [term for n in range(4) for term in combinations_with_replacement(range(joints), n)]
        values = np.stack([theta[:, list(term)].prod(axis=1) for term in basis], axis=1)
        self._inverse = np.linalg.pinv(values)  # (basis, N)
        quadratic = [term for term in basis if len(term) <= 2]
        linear = [term for term in basis if len(term) <= 1]
        self._slope = _derivative(basis, quadratic, joints)  # (D, quadratic, basis)
        self._bend = _derivative(quadratic, linear, joints)  # (D, linear, quadratic)
        self._left, self._right = np.array([term for term in quadratic if len(term) == 2]).T

    def fit(self, lengths: Array) -> None:
        """Fit lengths of the body at those postures (N, M) [m]."""
        cubic = self._inverse @ lengths[:, self.muscles]  # (basis, M)
        first = np.einsum('dqb,bm->qmd', self._slope, cubic)
        self._first = np.ascontiguousarray(first.reshape(len(first), -1))
        second = np.einsum('elq,qmd->mlde', self._bend, first)
        self._second = np.ascontiguousarray(second.reshape(-1, len(self.joints) ** 2))

    def __call__(self, theta: Array, tension: Array) -> tuple[Array, Array]:
        """Return G [m/rad] (N, M, D) and Σ T_i ∂²l_i/∂θ² [N·m/rad] (N, D, D) at the limb's θ, T."""
        xp, (count, joints) = library(theta), theta.shape
        products = theta[:, self._left] * theta[:, self._right]
        basis = xp.concatenate((xp.ones_like(theta[:, :1]), theta, products), axis=1)
        linear, jacobian = basis[:, : 1 + joints], basis @ self._first
        weighted = (tension[:, :, None] * linear[:, None, :]).reshape(count, -1)
        curvature = weighted @ self._second
        return jacobian.reshape(count, -1, joints), curvature.reshape(count, joints, joints)


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
