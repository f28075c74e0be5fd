# SPDX-License-Identifier: Apache-2.0
"""One step of N simulated arms, preset `default`: the network's equilibrium, approached smoothly.

    l = f_decode,l(①(θ, T))                                     the learned body
    T = T_bias + max(0, K_stiff (l − l_target)),  T ≤ T_max     MSC, part of the simulated arm
    B θ̇ = −(g(θ) − JᵀF + Gᵀ T),  G = ∂l/∂θ at (θ, T)            between the joint limits

The paper descends on a sum of norms (section "Simulation"); its weights let ‖T‖ outweigh torque and
length, so that the arm settles elsewhere. Here both are equations, and what is searched is the
sheet z = ①(θ, T) of the latent space, where they have D+M unknowns for D+M equations. Their root is
the posture of rest. (Solved for z itself, with decoded θ and T instead of exact ones, the root is
no nearer to the body's and each step dearer.) The arm creeps towards it through a viscous medium B,
by linearly implicit Euler steps: Newton steps on those equations with B/h on the diagonal. B stands
for what joints and geared modules resist, so that speeds look right; it has no say in where the arm
comes to rest. A joint limit is a hard stop that gives whatever torque it takes. The network is
asked for all arms at once; the rest of a step is a loop over them, compiled by numba.
"""

from __future__ import annotations

from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from numba import njit

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.load import Weights, load, new_scratch

#: l_target of muscles without a command: paid out, so that MSC holds T_bias
PAID_OUT = np.inf  # [m]
VISCOSITY = 1.5  # [N·m·s/rad], B; motions then last as long as the emulated arm's (0.7 … 5 tried)
JOINT_SPEED = 5.0  # [rad/s] or [m/s]; bounds a step, and with it every fault of a network
MODULE_SPEED = 0.25  # [m/s] at which modules wind, chosen as in the emulator
POSTURES_PER_COEFFICIENT = 10  # of the cubic that gives slopes


class ArmState(NamedTuple):
    """N arms between two steps."""

    theta: Array  # θ_sim [rad], (N, D)
    tension: Array  # T_sim [N], (N, M)
    length: Array  # l_sim [m], (N, M)
    followed: Array  # the command as far as the modules have followed it [m], (N, M)
    holding: Array  # torque of a stop, or of whoever holds a joint, on it [N·m], (N, D)


class Muscles(NamedTuple):
    """What pulls, each (M,)."""

    stiffness: Array  # of MSC [N/m]
    bias: Array  # tensions that MSC keeps [N]
    most: Array  # and the highest ever [N]
    length_at_zero: Array  # [m]
    force: Array  # of the elastic units, as in `SeriesElastic`
    rate: Array
    wire_stretch: Array


class Slopes(NamedTuple):
    """How a network's lengths change with posture, nearly: a cubic through what it says.

        l_i(θ) ≈ Σ_n c_ni θ^n,  |n| ≤ 3      G = ∂l/∂θ,   Σ_i T_i ∂²l_i/∂θ²

    A Newton step needs these slopes in every step, but only roughly: they decide how the simulator
    approaches an equilibrium, never where it lies, which is the network's own word. The network's
    exact second derivatives would cost ten times the rest of the step.
    """

    first: Array  # of 1, θ and products of two angles to G, (Q, M·D)
    second: Array  # of T_i to the second derivatives by 1 and θ, (M, (1 + D)·D·D)
    pairs: Ints  # the two angles of each product, (2, Q − 1 − D)

    @classmethod
    def of(cls, robot: Robot, mae: Mae) -> Slopes:
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
        first = np.einsum('dqb,bm->qmd', slope, cubic)
        second = np.einsum('elq,qmd->mlde', bend, first)
        return cls(
            first.reshape(len(quadratic), -1).copy(),
            second.reshape(muscles, -1).copy(),
            np.array([term for term in quadratic if len(term) == 2]).T.copy(),
        )


class QuasiStatics:
    """The equations above for one robot and one network."""

    def __init__(self, robot: Robot, mae: Mae) -> None:
        elastic, tension = robot.series_elastic, robot.tension
        self._mae = mae
        self._body = (
            Weights.of(robot.kinematics),
            Muscles(robot.stiffness, tension.bias, tension.max, robot.routes.length_at_zero,
                    elastic.force, elastic.rate, elastic.wire_stretch),
            Slopes.of(robot, mae),
            np.stack([robot.lower, robot.upper]),
        )  # fmt: skip

    def step(
        self, state: ArmState, command: Array, h: float, wrench: Array, fixed: Array
    ) -> ArmState:
        """Return the arms h [s] later, under l_target [m] (N, M), PAID_OUT for none.

        A wrench (N, 6) [N, N·m] acts on the end effector, in axes of the root link; joints are
        forced to the angles `fixed` (N, D) [rad], nan for a free joint.
        """
        length, pullback = self._mae.lengths_with_pullback(state.theta, state.tension)
        after = ArmState(*map(np.empty_like, state))
        _creep(
            *self._body, state, length, pullback(state.tension), command, h, wrench, fixed, after
        )
        return after


@njit(cache=True, nogil=True)
def _creep(
    weights: Weights, muscles: Muscles, slopes: Slopes, limits: Array, state: ArmState,
    length: Array, pulled: Array, command: Array, h: float, wrench: Array, fixed: Array,
    after: ArmState,
) -> None:  # fmt: skip
    """Fill the state after h [s]; limits of joints are (2, D), l and Gᵀ T of the network given."""
    count, joints = pulled.shape
    scratch = new_scratch(weights)
    torque, push, turned = np.empty((3, joints))
    matrix, jacobian = np.empty((joints, joints)), np.empty((command.shape[1], joints))
    spring, desired, compliance, stretch = np.empty((4, command.shape[1]))
    for n in range(count):
        theta, tension = state.theta[n], state.tension[n]
        load(weights, scratch, theta, wrench[n], torque, matrix)
        add_slopes(slopes, theta, tension, jacobian, matrix)
        for d in range(joints):
            push[d] = -(torque[d] + pulled[n, d])
            matrix[d, d] += VISCOSITY / h
        for i in range(len(tension)):
            stiffness, bias, most = muscles.stiffness[i], muscles.bias[i], muscles.most[i]
            span = (most - bias) / stiffness
            followed = follow(
                command[n, i], state.followed[n, i], length[n, i], span, MODULE_SPEED * h
            )
            after.followed[n, i] = followed
            # MSC and the elastic unit in series: at rest posture T moves to `desired`, and with
            # the posture by `soft` K G Δθ.
            unit = 1.0 / (muscles.rate[i] * (muscles.force[i] + max(tension[i], 0.0)))
            absolute = muscles.length_at_zero[i] + length[n, i]
            compliance[i] = unit + muscles.wire_stretch[i] * absolute
            soft = 1.0 / (1.0 + stiffness * compliance[i])
            commanded = bias + stiffness * (length[n, i] - followed)
            desired[i] = tension[i] + soft * (commanded - tension[i])
            # max(0, ·) and T_max are corners: beyond them a muscle is no spring (semismooth
            # Newton).
            settled = min(max(desired[i], bias), most)
            spring[i] = stiffness * soft
            for d in range(joints):
                push[d] -= (settled - tension[i]) * jacobian[i, d]
                slope = spring[i] * jacobian[i, d] if settled == desired[i] else 0.0
                for e in range(joints):
                    matrix[d, e] += slope * jacobian[i, e]
        arrived, held = after.theta[n], after.holding[n]
        turn(limits, theta, push, matrix, JOINT_SPEED * h, fixed[n], turned, arrived, held)
        for i in range(len(tension)):
            stretch[i] = 0.0
            for d in range(joints):
                stretch[i] += jacobian[i, d] * (arrived[d] - theta[d])
            pull = desired[i] + spring[i] * stretch[i]
            pull = min(max(pull, muscles.bias[i]), muscles.most[i])
            after.tension[n, i] = pull
            after.length[n, i] = length[n, i] + stretch[i] - compliance[i] * (pull - tension[i])


@njit(cache=True, nogil=True)
def follow(command: float, followed: float, length: float, span: float, most: float) -> float:
    """Return the command as far as a module has wound that winds at most `most` [m] in a step.

    Command, how far it had `followed` it a step before, and length are in [m]; a command adds
    tension as far as `span` [m] below the length.
    """
    reached = followed + min(max(command - followed, -most), most)
    # What lies beyond changes no tension; following it would take as long to come back from.
    return min(max(reached, length - span), length + most)


@njit(cache=True, nogil=True)
def turn(
    limits: Array, theta: Array, push: Array, matrix: Array, most: float, fixed: Array,
    turned: Array, arrived: Array, holding: Array,
) -> None:  # fmt: skip
    """Fill θ after a step and what stops and holders give, (D,) each; `matrix` is used up.

    Joints at a stop stay, forced joints go where they are forced.
    """
    joints = len(theta)
    lower, upper = limits
    for d in range(joints):
        way = min(max(fixed[d], lower[d]), upper[d]) - theta[d]
        arrived[d] = min(max(way, -most), most) if np.isfinite(fixed[d]) else 0.0
    for d in range(joints):
        turned[d] = push[d]
        for e in range(joints):
            turned[d] -= matrix[d, e] * arrived[e]
    for d in range(joints):
        if np.isfinite(fixed[d]) or stopped(theta[d], push[d], lower[d], upper[d]):
            turned[d] = 0.0
            for e in range(joints):
                matrix[d, e], matrix[e, d] = 0.0, 0.0
            matrix[d, d] = 1.0
    solve(matrix, turned)
    largest = most
    for d in range(joints):
        largest = max(largest, abs(turned[d]))
    for d in range(joints):
        angle = theta[d] + turned[d] * (most / largest) + arrived[d]
        arrived[d] = min(max(angle, lower[d]), upper[d])
        held = np.isfinite(fixed[d]) or stopped(arrived[d], push[d], lower[d], upper[d])
        holding[d] = -push[d] if held else 0.0


@njit(cache=True, nogil=True)
def stopped(theta: float, push: float, lower: float, upper: float) -> bool:
    """Return whether a torque pushes a joint against a stop."""
    return (theta <= lower and push < 0.0) or (theta >= upper and push > 0.0)


@njit(cache=True, nogil=True)
def solve(matrix: Array, vector: Array) -> None:
    """Put the solution of matrix (D, D) x = vector (D,) into the vector; both are used up.

    Small and compiled: LAPACK's call takes longer than the elimination.
    """
    count = len(vector)
    for k in range(count):
        best = k
        for i in range(k + 1, count):
            best = i if abs(matrix[i, k]) > abs(matrix[best, k]) else best
        if best != k:
            for c in range(k, count):
                matrix[k, c], matrix[best, c] = matrix[best, c], matrix[k, c]
            vector[k], vector[best] = vector[best], vector[k]
        if matrix[k, k] == 0.0:
            raise FloatingPointError('the equilibrium of the network cannot be solved for')
        for i in range(k + 1, count):
            share = matrix[i, k] / matrix[k, k]
            vector[i] -= share * vector[k]
            for c in range(k + 1, count):
                matrix[i, c] -= share * matrix[k, c]
    for k in range(count - 1, -1, -1):
        for c in range(k + 1, count):
            vector[k] -= matrix[k, c] * vector[c]
        vector[k] /= matrix[k, k]


@njit(cache=True, nogil=True)
def add_slopes(
    slopes: Slopes, theta: Array, tension: Array, jacobian: Array, curvature: Array
) -> None:
    """Fill G [m/rad] (M, D) and add Σ T_i ∂²l_i/∂θ² [N·m/rad] (D, D) at θ (D,), T (M,)."""
    joints, flat, flat_curvature = len(theta), jacobian.reshape(-1), curvature.reshape(-1)
    flat[:] = slopes.first[0]
    for d in range(joints):
        add(flat, theta[d], slopes.first[1 + d])
    for p in range(slopes.pairs.shape[1]):
        product = theta[slopes.pairs[0, p]] * theta[slopes.pairs[1, p]]
        add(flat, product, slopes.first[1 + joints + p])
    pulled = np.zeros(slopes.second.shape[1])
    for i in range(len(tension)):
        add(pulled, tension[i], slopes.second[i])
    size = joints * joints
    add(flat_curvature, 1.0, pulled[:size])
    for d in range(joints):
        add(flat_curvature, theta[d], pulled[(1 + d) * size : (2 + d) * size])


@njit(cache=True, nogil=True)
def add(result: Array, scale: float, values: Array) -> None:
    """Add scale · values to a result, without an array between."""
    for i in range(len(result)):
        result[i] += scale * values[i]


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
