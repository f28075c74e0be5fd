# SPDX-License-Identifier: Apache-2.0
"""One step of N simulated arms, preset `default`: the network's equilibrium, approached smoothly.

    l = f_decode,l(①(θ, T_end)),  T_end = T e^{−μ s}            the learned body, and its friction
    T = T_bias + max(0, K_stiff (l − l_target)),  T ≤ T_max     MSC, part of the simulated arm
    B θ̇ = −(g(θ) − JᵀF + Gᵀ T_end),  G = ∂l/∂θ at (θ, T_end)    between the joint limits

The paper descends on a sum of norms (§III-F, eq. 13); its weights let ‖T‖ outweigh torque and
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
from musculoskeletal_ae.simulation.load import Load, Tree, hold

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


class Body(NamedTuple):
    """What a step reads of muscles (M,) and joints (D,), as the compiled code wants it."""

    stiffness: Array  # K_stiff [N/m]
    bias: Array
    most: Array  # T_max [N]
    friction: Array  # μ
    force: Array  # of the elastic units, as in `SeriesElastic`
    rate: Array
    wire_stretch: Array
    length_at_zero: Array
    lower: Array
    upper: Array
    viscosity: Array  # B


class Limbs(NamedTuple):
    """The cubics of all limbs, one after the other: what `add_slopes` reads.

    They are numbers in a row, so that the compiled code is the same for any number of limbs.
    """

    counts: Ints  # D joints and M muscles of each, (limbs, 2)
    joints: Ints  # places in θ
    muscles: Ints  # places in T and l
    crossed: Ints  # of each place in T and l, from and to which of `joints` its limb's are, (M, 2)
    first: Array  # of each, G (M, D) by each member of the basis 1, θ_j, θ_j θ_k with j ≤ k
    second: Array  # of each, and each muscle, the lower half of ∂²l_i/∂θ² by 1 and each θ_j


@njit(cache=True)
def handed(body: Body, tree: Tree, limbs: Limbs) -> Handle:
    """Return the robot that a step takes."""
    return Handle((body, tree, limbs))


@njit(cache=True)
def clip(value: float, low: float, high: float) -> float:
    """Return what is nearest to a value between two others."""
    return min(max(value, low), high)


@njit(cache=True)
def follow(command: float, followed: float, length: float, span: float, most: float) -> float:
    """Return the command [m] as far as a module has wound that winds `most` [m] in a step.

    `followed` is how far it had a step before; a command adds tension as far as `span` [m] below
    the length.
    """
    reached = followed + clip(command - followed, -most, most)
    # What lies beyond changes no tension; following it would take as long to come back from.
    return clip(reached, length - span, length + most)


@njit(cache=True)
def combine(shares: Array, rows: Array, total: Array) -> None:
    """Fill the sums (W, N) of rows (K, W), each times its share (K, N)."""
    terms, width = rows.shape
    total[:] = 0.0
    if total.shape[1] == 1:  # a core computes several numbers at once: of one arm those of a row
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
    """Fill G [m/rad] (M, D, N); add Σ T_i ∂²l_i/∂θ² [N·m/rad] to the lower half of (D, D, N)."""
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
    """Fill θ (D, N) after a step of at most `most` [rad] each.

    Joints at a stop stay, forced joints go where they are forced. Of the matrix (D, D, N), which is
    symmetric, the lower half is read, and used up.
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
    # Gauss; no pivoting where viscosity is on the diagonal.
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
    """Fill the arms h [s] after a state, of a robot: Body, Tree and Limbs.

    Arms stand last, as in `load`. Of the network: the lengths at θ
    and T_end, which are the state's (M, N), and Gᵀ T_end there (D, N). `passed` is what friction
    lets through from the motor to the elastic unit, T_end / T (M, N).
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
        span = (most - bias) / stiffness
        for n in range(arms):
            after.followed[m, n] = follow(
                command[m, n], state.followed[m, n], length[m, n], span, MODULE_SPEED * h
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
                # Where a wire slides, friction is like a stiff spring until it has turned round:
                # one of constant stiffness, where the arm's lets go little by little.
                rubbed, turns = friction * end[m, n], abs(turning[m, n]) < 1.0
                rub = rubbed / REVERSAL if turns else 0.0
                lost[m, n] = 0.0 if turns else rubbed * (turning[m, n] - slid[m, n])
                # MSC, friction and the elastic unit in series: at rest posture T moves to `wanted`,
                # and with the posture by `soft` K G Δθ.
                wound = stiffness * (length[m, n] - after.followed[m, n])
                by_motor, aim = passed[m, n] * compliance[m, n], bias + wound
                give[m, n] = 1.0 + compliance[m, n] * rub
                soft[m, n] = stiffness / (give[m, n] + stiffness * by_motor)
                slack = compliance[m, n] * lost[m, n] - by_motor * (aim - tension[m, n])
                wanted[m, n] = aim + soft[m, n] * slack
                # max(0, ·) and T_max are corners: beyond them a muscle is no spring (semismooth
                # Newton).
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
    """The equations above for one robot, and for the network that was given to `use` last."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self.tree, self.slopes = robot, Load(robot.kinematics).tree, Slopes(robot)
        postures = robot.random_postures(LEVER_POSTURES, np.random.default_rng(0))
        levers = np.abs(robot.routes.muscle_jacobian(postures)).sum(axis=1).mean(axis=0)
        self._viscosity = np.maximum(VISCOSITY * levers, LEAST_VISCOSITY)

    def use(self, mae: Mae, robot: Robot) -> None:
        """Take a network, and the robot with the muscles that are isolated now.

        A FloatingPointError says that the network has no finite lengths somewhere.
        """
        self.slopes.fit(mae)
        self._robot, elastic, self._mae = robot, robot.series_elastic, mae
        # A noisy fit may find a little less than none, which would drive the arm.
        friction = np.maximum(mae.friction, 0.0)
        muscles = robot.stiffness, robot.tension.bias, robot.tension.max, friction
        units = elastic.force, elastic.rate, elastic.wire_stretch, robot.routes.length_at_zero
        joints = robot.lower, robot.upper, self._viscosity
        self.body = Body(*map(np.array, (*muscles, *units, *joints)))
        self._handle = handed(self.body, self.tree, self.slopes.limbs)

    def step(
        self, state: ArmState, command: Array, h: float, wrench: Array, fixed: Array
    ) -> ArmState:
        """Return the arms h [s] later, under l_target [m] (N, M), PAID_OUT for none.

        A wrench (N, 6) [N, N·m] acts on the end effector, in axes of the root link; joints are
        forced to the angles `fixed` (N, D) [rad], nan for a free joint.
        """
        passed = np.exp(-self.body.friction * state.slid)
        end = passed * state.tension
        length, pullback = self._mae.lengths_with_pullback(state.theta, end)
        before = ArmState(*map(arms_last, state._replace(length=length)))
        others = map(arms_last, (passed, pullback(end), command, wrench, fixed))
        after = ArmState(*map(np.empty_like, before))
        advance(self._handle, before, after, h, *others)
        return ArmState(*[part.T for part in after])


def arms_last(part: Array) -> Array:
    """Return what is given by arm, (N, …), with arms last, in one piece."""
    return np.ascontiguousarray(part.T)


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
        self._cubics = [Cubics(group, self._postures) for group in robot.groups]
        joints, muscles = map(np.concatenate, zip(*robot.groups, strict=True))
        counts = np.array([[*map(len, group)] for group in robot.groups])
        crossed = np.empty((len(muscles), 2), int)
        ends = np.cumsum([0, *counts[:, 0]])
        for group, *span in zip(robot.groups, ends, ends[1:]):
            crossed[list(group.muscles)] = span
        self._places = counts, joints, muscles, crossed

    def fit(self, mae: Mae) -> None:
        """Fit what a network says; a FloatingPointError says that it cannot be fitted."""
        lengths = mae.lengths(self._postures, self._tension)
        if not np.isfinite(lengths).all():
            raise FloatingPointError('lengths within the joint limits that are not finite')
        fitted = zip(*(limb.fit(lengths) for limb in self._cubics), strict=True)
        self.limbs = Limbs(*self._places, *map(np.concatenate, fitted))


class Cubics:
    """The cubics of one limb."""

    def __init__(self, group: Group, postures: Array) -> None:
        """Prepare to fit to lengths at some postures θ of the body (N, D) [rad]."""
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
        """Fit lengths of the body at those postures (N, M) [m]; return its part of `Limbs`."""
        cubic = self._inverse @ lengths[:, self._muscles]  # (basis, M)
        first = np.einsum('dqb,bm->qmd', self._slope, cubic)
        bend = np.einsum('elq,qmd->mlde', self._bend, first)
        rows, columns = np.tril_indices(first.shape[-1])
        return first.ravel(), bend[..., rows, columns].ravel()


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
