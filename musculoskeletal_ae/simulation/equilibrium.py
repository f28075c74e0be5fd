# SPDX-License-Identifier: Apache-2.0
"""One step of N simulated arms, preset `default`: a viscous approach to the network's equilibrium.

    l = f_decode,l(①(θ, T_end)),  T_end = T e^{−μ s}            learned body and tendon friction
    T = T_bias + max(0, K_stiff (l − l_target)),  T ≤ T_max     muscle stiffness control (MSC)
    l = l_target,  0 ≤ T ≤ T_max                                position-controlled modules
    B θ̇ = −(g(θ) + K θ − b − JᵀF + Gᵀ T_end),  G = ∂l/∂θ at (θ, T_end)    between the joint limits

Here ① encodes θ and T (paper, §III-A). The paper minimises a sum of norms (§III-F, eq. 13). With
its weights, ‖T‖ outweighs torque and length, so the arm does not settle at the balance of torques.
This module therefore solves the equations of lengths and torques above. On the surface z = ①(θ, T)
of the latent space, they are D+M equations for D+M unknowns, and their root is the rest posture.
(One could also solve for z itself, with decoded θ and T. That root is no closer to the rest posture
of the body, and each step costs more.)

The arm approaches the root against a viscous resistance B, by linearly implicit Euler steps. These
are Newton steps on the equations with B/h on the diagonal. B models the resistance of joints and
geared muscle modules, which makes speeds realistic. It includes the dampers in the robot
description, and is larger where muscles have larger moment arms. B does not affect the rest
posture. K and b describe the springs of the joints (`JointElasticity`): the values that the network
has learned, or else those of the robot description. A joint limit is a hard stop that exerts any
torque needed. Tendon friction (`friction`) does affect the rest posture: the arm rests in different
postures after tendons have been wound in and after they have been paid out.

These steps follow a motion and are compiled, so they do not use the solver `gauss_newton`.
"""

import math
from itertools import combinations_with_replacement
from math import comb
from typing import NamedTuple

import numpy as np
from numba import njit

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.handle import Handle
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.groups import Group
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.friction import REVERSAL
from musculoskeletal_ae.simulation.load import LoadTree, hold

#: value of l_target for muscles without a command [m]; MSC then holds T_bias, and modules that
#: follow positions hold their length
PAID_OUT = np.inf
#: represent a position-controlled module by this K_stiff [N/m]; 400 N move such a module by 1 mm
RIGID = 4e5
#: The viscous resistance B of a joint is this times Σ_i |∂l_i/∂θ| [N·s/rad], plus the damping that
#: the robot description states. Motions then take as long as on the emulated arm; values from 8 to
#: 20 do equally well.
VISCOSITY = 12.0
#: average |∂l_i/∂θ| over this many random postures to get the viscous resistance B
JACOBIAN_POSTURES = 100
LEAST_VISCOSITY = 0.1  # use at least this B, such as at a joint that no muscle crosses [N·m·s/rad]
#: move no joint faster than this [rad/s] or [m/s]; this limits each step, and so the effect of
#: network errors
JOINT_SPEED = 5.0
MODULE_SPEED = 0.25  # let muscle modules wind no faster than this, as in the emulator [m/s]
ROUNDS = 3  # search in at most this many rounds for the tendons whose friction reverses in a step
FARTHEST = 0.05  # let a position command run ahead of the module by at most this distance [m]
POSTURES_PER_COEFFICIENT = 10  # fit a cubic to this many postures per coefficient


class ArmState(NamedTuple):
    """State of N arms after a step."""

    theta: Array  # simulated joint angles [rad], (N, D)
    tension: Array  # simulated motor-side tensions [N], (N, M)
    length: Array  # simulated muscle lengths [m], (N, M)
    followed: Array  # command that the muscle modules have reached [m], (N, M)
    holding: Array  # torque of a stop or an external hold on each joint [N·m], (N, D)
    slid: Array  # s, direction in which each tendon slid last, in [−1, 1], (N, M)


class Body(NamedTuple):
    """Constants of muscles (M,) and joints (D,) for the compiled code."""

    stiffness: Array  # control stiffness K_stiff of the module [N/m]
    bias: Array  # T at l = l_target [N]: T_bias, or 0 for position-controlled modules
    most: Array  # tension maximum T_max [N]
    span: Array  # distance of l_target below l at which T reaches T_max [m]
    loose: Array  # distance of l_target above l beyond which T no longer changes [m]
    friction: Array  # friction coefficient μ of the tendon
    speed: Array  # largest speed of the module [m/s]; infinite if it is not stated
    # constants of the series elastic elements, as in `SeriesElastic`
    force: Array
    rate: Array
    wire_stretch: Array
    length_at_zero: Array  # length of each tendon at θ = 0 [m]
    lower: Array  # lower joint limits [rad]
    upper: Array  # upper joint limits [rad]
    viscosity: Array  # viscous resistance B of each joint [N·m·s/rad]


class Limbs(NamedTuple):
    """Fitted cubic polynomials of the muscle lengths of all limbs, concatenated for `add_slopes`.

    A limb is an independent group of joints and muscles. The arrays are flat, so that the same
    compiled code serves any number of limbs.
    """

    counts: Ints  # number of joints D and muscles M of each limb, (limbs, 2)
    joints: Ints  # indices in θ of the joints, limb after limb
    muscles: Ints  # indices in T and l of the muscles, limb after limb
    #: for each muscle, first and last + 1 index into `joints` of the joints of its limb, (M, 2)
    crossed: Ints
    #: for each limb, coefficients of G (M, D) in the basis 1, θ_j, θ_j θ_k with j ≤ k
    first: Array
    #: for each limb and muscle, coefficients of the lower half of ∂²l_i/∂θ² in the basis 1, θ_j
    second: Array


@njit(cache=True)
def handed(body: Body, tree: LoadTree, limbs: Limbs) -> Handle:
    """Return a handle with the constants of the robot, which `advance` takes as an argument."""
    return Handle((body, tree, limbs))


@njit(cache=True)
def clip(value: float, low: float, high: float) -> float:
    """Return the number in [low, high] that is closest to a value."""
    return min(max(value, low), high)


@njit(cache=True)
def follow(
    command: float, followed: float, length: float, span: float, loose: float, most: float
) -> float:
    """Follow a command: return the length [m] that a muscle module has reached on the way.

    Args:
        command: Length command l_target [m].
        followed: The length that the module had reached before this step [m].
        length: Muscle length [m].
        span: Distance of the command below `length` at which the tension reaches T_max [m].
        loose: Distance of the command above `length` beyond which the tension does not change [m].
        most: Largest distance that the module winds in a step [m].
    """
    reached = followed + clip(command - followed, -most, most)
    # Stop the module where the tension no longer changes: winding further would delay its way back.
    return clip(reached, length - span, length + max(loose, most))


@njit(cache=True)
def combine(shares: Array, rows: Array, total: Array) -> None:
    """Combine rows (K, W) with shares (K, N): fill `total` (W, N) with rowsᵀ @ shares."""
    terms, width = rows.shape
    total[:] = 0.0
    # Make the innermost loop long, because a core computes several numbers at once.
    if total.shape[1] == 1:
        row = total.reshape(width)
        for k in range(terms):
            for w in range(width):
                row[w] += shares[k, 0] * rows[k, w]
        return
    for w in range(width):
        for k in range(terms):
            for n in range(total.shape[1]):
                total[w, n] += rows[k, w] * shares[k, n]


@njit(cache=True)
def add_slopes(
    limbs: Limbs, theta: Array, tension: Array, jacobian: Array, curvature: Array
) -> None:
    """Write G, and add Σ T_i ∂²l_i/∂θ² to `curvature`, from the cubics of all limbs (see `Slopes`).

    Args:
        limbs: The fitted cubics of all limbs.
        theta: Joint angles θ [rad], (D, N).
        tension: Tensions T [N], (M, N).
        jacobian: Output, overwritten with G [m/rad], (M, D, N).
        curvature: Input and output, (D, D, N). Σ T_i ∂²l_i/∂θ² [N·m/rad] is added to the lower
            triangle; the upper triangle is not changed.
    """
    arms = theta.shape[1]
    jacobian[:] = 0.0
    joints, muscles, first, second = limbs.joints, limbs.muscles, limbs.first, limbs.second
    for limb in range(len(limbs.counts)):
        count, lines = limbs.counts[limb, 0], limbs.counts[limb, 1]
        pairs = count * (count + 1) // 2
        terms, bends = 1 + count + pairs, (1 + count) * pairs
        basis, pull = np.ones((terms, arms)), np.empty((lines, arms))
        slope, bend = np.empty((lines * count, arms)), np.empty((bends, arms))
        term = 1 + count
        for j in range(count):
            for n in range(arms):
                basis[1 + j, n] = theta[joints[j], n]
        for j in range(count):
            for k in range(j, count):
                for n in range(arms):
                    basis[term, n] = basis[1 + j, n] * basis[1 + k, n]
                term += 1
        for m in range(lines):
            for n in range(arms):
                pull[m, n] = tension[muscles[m], n]
        combine(basis, first[: terms * len(slope)].reshape(terms, len(slope)), slope)
        combine(pull, second[: lines * bends].reshape(lines, bends), bend)
        for m in range(lines):
            for j in range(count):
                for n in range(arms):
                    jacobian[muscles[m], joints[j], n] = slope[m * count + j, n]
        pair = 0
        for j in range(count):
            for k in range(j + 1):
                for b in range(1 + count):
                    for n in range(arms):
                        part = basis[b, n] * bend[b * pairs + pair, n]
                        curvature[joints[j], joints[k], n] += part
                pair += 1
        joints, muscles = joints[count:], muscles[lines:]
        first, second = first[terms * len(slope) :], second[lines * bends :]


@njit(cache=True, error_model='numpy')
def turn(
    body: Body, theta: Array, push: Array, matrix: Array, most: float, fixed: Array, arrived: Array
) -> None:
    """Turn the joints by the Newton step of matrix · Δθ = push; fill `arrived` with θ (D, N).

    Δθ is scaled down so that no joint moves by more than `most` [rad]. A joint that `push` presses
    against its stop stays there, and forced joints move towards their angles in `fixed`. Only the
    lower triangle of the symmetric `matrix` (D, D, N) is read, and it is overwritten.
    """
    joints, arms = theta.shape
    way, turned, held = np.zeros((joints, arms)), push.copy(), np.empty((joints, arms), np.bool_)
    largest, factor = np.full(arms, most), np.empty(arms)
    for d in range(joints):
        low, high = body.lower[d], body.upper[d]
        for n in range(arms):
            at, pushed, forced = theta[d, n], push[d, n], math.isfinite(fixed[d, n])
            stopped = (at <= low and pushed < 0.0) or (at >= high and pushed > 0.0)
            held[d, n] = forced or stopped
            if forced:
                way[d, n] = clip(clip(fixed[d, n], low, high) - at, -most, most)
    for d in range(joints):
        for e in range(joints):
            for n in range(arms):
                turned[d, n] -= matrix[max(d, e), min(d, e), n] * way[e, n]
    for d in range(joints):
        for e in range(d + 1):
            for n in range(arms):
                if held[d, n] or held[e, n]:
                    matrix[d, e, n] = 1.0 if d == e else 0.0
        for n in range(arms):
            if held[d, n]:
                turned[d, n] = 0.0
    # Eliminate (Gauss); the viscosity on the diagonal makes pivoting unnecessary.
    for d in range(joints):
        for e in range(d + 1, joints):
            for n in range(arms):
                factor[n] = matrix[e, d, n] / matrix[d, d, n]
                turned[e, n] -= factor[n] * turned[d, n]
            for k in range(d + 1, e + 1):
                for n in range(arms):
                    matrix[e, k, n] -= factor[n] * matrix[k, d, n]
    for d in range(joints - 1, -1, -1):
        for k in range(d + 1, joints):
            for n in range(arms):
                turned[d, n] -= matrix[k, d, n] * turned[k, n]
        for n in range(arms):
            turned[d, n] /= matrix[d, d, n]
            largest[n] = max(largest[n], abs(turned[d, n]))
    for d in range(joints):
        low, high = body.lower[d], body.upper[d]
        for n in range(arms):
            reached = theta[d, n] + turned[d, n] * (most / largest[n]) + way[d, n]
            arrived[d, n] = clip(reached, low, high)


@njit(cache=True, nogil=True, error_model='numpy')
def advance(
    robot: Handle, state: ArmState, after: ArmState, h: float, passed: Array, pulled: Array,
    command: Array, wrench: Array, fixed: Array,
) -> None:  # fmt: skip
    """Advance N arms by a step of h [s], and write their states into `after`.

    The last axis of all arrays is that of the arms.

    Args:
        robot: Handle of Body, Tree and Limbs.
        state: The present state; its lengths are those of the network at (θ, T_end), (M, N).
        after: Output: the state after the step.
        h: Duration of the step [s].
        passed: Fraction of the tension that reaches the bone despite friction, T_end / T, (M, N).
        pulled: The network's Gᵀ T_end [N·m], (D, N).
        command: Length commands l_target [m], (M, N).
        wrench: Wrench on the end effectors [N, N·m], (6, N).
        fixed: Angles that joints are forced to [rad], (D, N); NaN for a free joint.
    """
    body, tree, limbs = robot.held
    theta, tension, length, slid = state.theta, state.tension, state.length, state.slid
    (muscles, arms), joints = tension.shape, len(theta)
    load, slope = np.empty((joints, arms)), np.empty((joints, joints, arms))
    push, matrix = np.empty_like(load), np.empty_like(slope)
    jacobian, end = np.empty((muscles, joints, arms)), passed * tension
    compliance, wanted, give = np.empty_like(end), np.empty_like(end), np.empty_like(end)
    soft, lost, turning = np.empty_like(end), np.empty_like(end), slid.copy()
    change, spring, stiff = np.empty(arms), np.empty(arms), np.empty(arms)
    arrived, way = np.empty_like(load), np.empty(arms)
    done, rough = np.zeros(arms, np.bool_), body.friction.any()
    hold(tree, theta, wrench, load, slope)
    add_slopes(limbs, theta, end, jacobian, slope)
    for m in range(muscles):
        stiffness, bias, most = body.stiffness[m], body.bias[m], body.most[m]
        speed = min(MODULE_SPEED, body.speed[m])
        for n in range(arms):
            after.followed[m, n] = follow(
                command[m, n],
                state.followed[m, n],
                length[m, n],
                body.span[m],
                body.loose[m],
                speed * h,
            )
            stretch = body.wire_stretch[m] * (body.length_at_zero[m] + length[m, n])
            unit = body.rate[m] * (body.force[m] + max(end[m, n], 0.0))
            compliance[m, n] = 1.0 / unit + stretch
    for _ in range(ROUNDS):
        for d in range(joints):
            for n in range(arms):
                push[d, n] = -(load[d, n] + pulled[d, n])
            for e in range(d + 1):
                for n in range(arms):
                    matrix[d, e, n] = slope[d, e, n]
            for n in range(arms):
                matrix[d, d, n] += body.viscosity[d] / h
        for m in range(muscles):
            stiffness, bias, most = body.stiffness[m], body.bias[m], body.most[m]
            friction = body.friction[m]
            for n in range(arms):
                # While the friction of a tendon reverses, it acts like a stiff spring. On the real
                # arm, its stiffness decreases gradually; here it is constant until the friction has
                # reversed.
                rubbed, turns = friction * end[m, n], abs(turning[m, n]) < 1.0
                rub = rubbed / REVERSAL if turns else 0.0
                lost[m, n] = 0.0 if turns else rubbed * (turning[m, n] - slid[m, n])
                # MSC, friction and elastic element act in series. T moves to `wanted` if the
                # posture stays the same, and a change of posture adds `soft` · G Δθ.
                wound = stiffness * (length[m, n] - after.followed[m, n])
                by_motor, aim = passed[m, n] * compliance[m, n], bias + wound
                give[m, n] = 1.0 + compliance[m, n] * rub
                soft[m, n] = stiffness / (give[m, n] + stiffness * by_motor)
                slack = compliance[m, n] * lost[m, n] - by_motor * (aim - tension[m, n])
                wanted[m, n] = aim + soft[m, n] * slack
                # Leave the stiffness of a muscle out of the Newton matrix where T is clipped to
                # T_bias or T_max, and does not depend on the length (semismooth Newton).
                settled = clip(wanted[m, n], bias, most)
                rise = settled - tension[m, n]
                moved = (compliance[m, n] * lost[m, n] - by_motor * rise) / give[m, n]
                change[n] = passed[m, n] * rise + rub * moved - lost[m, n]
                wholly = (passed[m, n] + rub / stiffness) * soft[m, n]
                spring[n] = wholly if settled == wanted[m, n] else rub / give[m, n]
            start, stop = limbs.crossed[m]
            for i in range(start, stop):
                d = limbs.joints[i]
                for n in range(arms):
                    push[d, n] -= change[n] * jacobian[m, d, n]
                    stiff[n] = spring[n] * jacobian[m, d, n]
                for j in range(start, i + 1):
                    e = limbs.joints[j]
                    for n in range(arms):
                        matrix[d, e, n] += stiff[n] * jacobian[m, e, n]
        turn(body, theta, push, matrix, JOINT_SPEED * h, fixed, arrived)
        again = np.zeros(arms, np.bool_)
        for d in range(joints):
            for n in range(arms):
                stopped = arrived[d, n] == body.lower[d] and push[d, n] < 0.0
                stopped |= arrived[d, n] == body.upper[d] and push[d, n] > 0.0
                held = -push[d, n] if stopped or math.isfinite(fixed[d, n]) else 0.0
                if not done[n]:
                    after.theta[d, n], after.holding[d, n] = arrived[d, n], held
        for m in range(muscles):
            stiffness, bias, most = body.stiffness[m], body.bias[m], body.most[m]
            way[:] = 0.0
            start, stop = limbs.crossed[m]
            for i in range(start, stop):
                d = limbs.joints[i]
                for n in range(arms):
                    way[n] += jacobian[m, d, n] * (arrived[d, n] - theta[d, n])
            for n in range(arms):
                pull = clip(wanted[m, n] + soft[m, n] * way[n], bias, most)
                rise = passed[m, n] * compliance[m, n] * (pull - tension[m, n])
                moved = (way[n] + compliance[m, n] * lost[m, n] - rise) / give[m, n]
                before, now = turning[m, n], clip(slid[m, n] - moved / REVERSAL, -1.0, 1.0)
                again[n] |= (abs(before) < 1.0) != (abs(now) < 1.0)
                if not done[n]:
                    turning[m, n], after.slid[m, n] = now, now
                    after.tension[m, n], after.length[m, n] = pull, length[m, n] + moved
        done |= ~again
        if not rough or done.all():
            break


class QuasiStatics:
    """Simulates arms of one robot by the equations of this module; `use` sets the network."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self.slopes = robot, Slopes(robot)
        postures = robot.random_postures(JACOBIAN_POSTURES, np.random.default_rng(0))
        moment_arms = np.abs(robot.routes.muscle_jacobian(postures)).sum(axis=1).mean(axis=0)
        viscosity = np.maximum(VISCOSITY * moment_arms, LEAST_VISCOSITY)
        self._viscosity = viscosity + robot.kinematics.elasticity.damping

    def use(self, mae: Mae, robot: Robot) -> None:
        """Use a network, and the robot with the currently isolated muscles.

        Raises:
            FloatingPointError: If the network's lengths are not finite at some posture.
        """
        self.slopes.fit(mae)
        robot = robot.with_elasticity(mae.elasticity)
        self._robot, elastic, self._mae = robot, robot.series_elastic, mae
        self.tree = LoadTree.of(robot.kinematics)
        # A noisy fit may return a slightly negative friction, which would drive the arm: use 0.
        friction = np.maximum(mae.friction, 0.0)
        bias, most = robot.tension.bias, robot.tension.max
        farthest = np.full_like(most, FARTHEST)
        stiffness, span, loose = robot.actuation.choose(
            (robot.stiffness, (most - bias) / robot.stiffness, 0.0 * most),
            (np.full_like(most, RIGID), farthest, farthest),
        )
        kept, speed = robot.actuation.kept_tension, robot.description.speed
        muscles = stiffness, kept, most, span, loose, friction, speed
        units = elastic.force, elastic.rate, elastic.wire_stretch, robot.routes.length_at_zero
        joints = robot.lower, robot.upper, self._viscosity
        self.body = Body(*map(np.array, (*muscles, *units, *joints)))
        self._handle = handed(self.body, self.tree, self.slopes.limbs)

    def step(
        self, state: ArmState, command: Array, h: float, wrench: Array, fixed: Array
    ) -> ArmState:
        """Return the state of the arms after a step.

        `SimulatedBody.step` describes the arguments.
        """
        # Without a command, position-controlled modules hold their last position.
        held = self._robot.actuation.choose(command, state.followed)
        command = np.where(np.isfinite(command), command, held)
        passed = np.exp(-self.body.friction * state.slid)
        end = passed * state.tension
        length, pullback = self._mae.lengths_with_pullback(state.theta, end)
        before = ArmState(*map(arms_last, state._replace(length=length)))
        others = map(arms_last, (passed, pullback(end), command, wrench, fixed))
        after = ArmState(*map(np.empty_like, before))
        advance(self._handle, before, after, h, *others)
        return ArmState(*[part.T for part in after])


def arms_last(part: Array) -> Array:
    """Return an array (N, …) transposed to (…, N), contiguous in memory."""
    return np.ascontiguousarray(part.T)


class Slopes:
    """Approximate derivatives of a network's lengths with respect to θ, from fitted cubics.

        l_i(θ) ≈ Σ_n c_ni θ^n,  |n| ≤ 3      G = ∂l/∂θ,   Σ_i T_i ∂²l_i/∂θ²

    Each Newton step needs these derivatives, but only roughly. They affect how the simulator
    approaches an equilibrium, whereas the network itself determines where the equilibrium lies. The
    network's exact second derivatives would cost ten times the rest of the step. The cubics of a
    limb depend on its own joints only. A cubic in all 17 joints of an upper body would have 1140
    coefficients, whereas one in the 7 joints of an arm has 120.
    """

    def __init__(self, robot: Robot) -> None:
        """Draw the postures, over all joint ranges, at which `fit` fits the cubics."""
        most = max(len(group.joints) for group in robot.groups)
        count = POSTURES_PER_COEFFICIENT * comb(most + 3, 3)
        self._postures = robot.random_postures(count, np.random.default_rng(0))
        middle = 0.5 * (robot.tension.bias + robot.tension.limit)
        self._tension = np.full((count, robot.muscle_count), middle)
        self._cubics = [Cubics(group, self._postures) for group in robot.groups]
        joints, muscles = map(np.concatenate, zip(*robot.groups, strict=True))
        counts = np.array([[*map(len, group)] for group in robot.groups])
        crossed = np.empty((len(muscles), 2), int)
        ends = np.cumsum([0, *counts[:, 0]])
        for group, *span in zip(robot.groups, ends, ends[1:]):
            crossed[list(group.muscles)] = span
        self._places = counts, joints, muscles, crossed

    def fit(self, mae: Mae) -> None:
        """Fit the cubics to a network's lengths.

        Raises:
            FloatingPointError: If a length is not finite.
        """
        lengths = mae.lengths(self._postures, self._tension)
        if not np.isfinite(lengths).all():
            raise FloatingPointError(
                "some of the network's lengths within the joint limits are not finite"
            )
        fitted = zip(*(limb.fit(lengths) for limb in self._cubics), strict=True)
        self.limbs = Limbs(*self._places, *map(np.concatenate, fitted))


class Cubics:
    """Fits a cubic in θ to the length of each muscle of one limb."""

    def __init__(self, group: Group, postures: Array) -> None:
        """Prepare fits to lengths at postures θ [rad] (N, D) of the whole body."""
        self._muscles = np.array(group.muscles)
        theta, joints = postures[:, np.array(group.joints)], len(group.joints)
        basis = [term for n in range(4) for term in combinations_with_replacement(range(joints), n)]
        values = np.stack([theta[:, list(term)].prod(axis=1) for term in basis], axis=1)
        self._inverse = np.linalg.pinv(values)  # (basis, N)
        quadratic = [term for term in basis if len(term) <= 2]
        linear = [term for term in basis if len(term) <= 1]
        self._slope = _derivative(basis, quadratic, joints)  # (D, quadratic, basis)
        self._bend = _derivative(quadratic, linear, joints)  # (D, linear, quadratic)

    def fit(self, lengths: Array) -> tuple[Array, Array]:
        """Fit cubics to lengths [m] (N, M) at the N postures of the constructor.

        Returns:
            The entries of this limb in `Limbs.first` and `Limbs.second`.
        """
        cubic = self._inverse @ lengths[:, self._muscles]  # (basis, M)
        first = np.einsum('dqb,bm->qmd', self._slope, cubic)
        bend = np.einsum('elq,qmd->mlde', self._bend, first)
        rows, columns = np.tril_indices(first.shape[-1])
        return first.ravel(), bend[..., rows, columns].ravel()


def _derivative(basis: list[tuple[int, ...]], target: list[tuple[int, ...]], joints: int) -> Array:
    """Return the matrices (D, target, basis) that differentiate a polynomial by each θ_d.

    Matrix d maps the polynomial's coefficients in `basis` to the coefficients of its derivative
    ∂/∂θ_d in `target`.
    """
    place = {term: i for i, term in enumerate(target)}
    matrices = np.zeros((joints, len(target), len(basis)))
    for column, term in enumerate(basis):
        for d in set(term):
            rest = list(term)
            rest.remove(d)
            matrices[d, place[tuple(rest)], column] = term.count(d)
    return matrices
