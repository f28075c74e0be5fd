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

import math
from itertools import combinations_with_replacement
from math import comb
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.compiler import njit
from musculoskeletal_ae.friction import REVERSAL
from musculoskeletal_ae.handle import Handle
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.groups import Group
from musculoskeletal_ae.robot.robot import Robot
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
    first: Array  # of each, G (M, D) by each member of the basis 1, θ_j, θ_j θ_k with j ≤ k
    second: Array  # of each, and each muscle, ∂²l_i/∂θ² (D, D) by 1 and each θ_j


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
def add(share: float, row: Array, total: Array) -> None:
    """Add a multiple of the beginning of a row."""
    for i in range(len(total)):
        total[i] += share * row[i]


@njit(cache=True)
def add_slopes(
    limbs: Limbs, theta: Array, tension: Array, jacobian: Array, curvature: Array
) -> None:
    """Add G [m/rad] to (M, D), and Σ T_i ∂²l_i/∂θ² [N·m/rad] to (D, D)."""
    joints, muscles, first, second = limbs.joints, limbs.muscles, limbs.first, limbs.second
    for count, lines in limbs.counts:
        slope, bend = np.zeros(lines * count), np.zeros((1 + count) * count * count)
        add(1.0, first, slope)
        first = first[len(slope) :]
        for j in range(count):
            add(theta[joints[j]], first, slope)
            first = first[len(slope) :]
        for j in range(count):
            for k in range(j, count):
                add(theta[joints[j]] * theta[joints[k]], first, slope)
                first = first[len(slope) :]
        for m in range(lines):
            add(tension[muscles[m]], second, bend)
            second = second[len(bend) :]
        for j in range(count):
            for m in range(lines):
                jacobian[muscles[m], joints[j]] += slope[m * count + j]
            for k in range(count):
                value = bend[j * count + k]
                for b in range(count):
                    value += theta[joints[b]] * bend[((b + 1) * count + j) * count + k]
                curvature[joints[j], joints[k]] += value
        joints, muscles = joints[count:], muscles[lines:]


@njit(cache=True, error_model='numpy')
def turn(
    body: Body, theta: Array, push: Array, matrix: Array, most: float, fixed: Array, arrived: Array
) -> None:
    """Fill θ after a step of at most `most` [rad] each; the matrix (D, D) is used up.

    Joints at a stop stay, forced joints go where they are forced.
    """
    joints = len(theta)
    way, turned, held = np.zeros(joints), np.zeros(joints), np.empty(joints, np.bool_)
    for d in range(joints):
        held[d] = theta[d] <= body.lower[d] and push[d] < 0.0
        held[d] |= theta[d] >= body.upper[d] and push[d] > 0.0
        if math.isfinite(fixed[d]):
            held[d] = True
            way[d] = clip(clip(fixed[d], body.lower[d], body.upper[d]) - theta[d], -most, most)
    for d in range(joints):
        if not held[d]:
            turned[d] = push[d]
            for e in range(joints):
                turned[d] -= matrix[d, e] * way[e]
    for d in range(joints):
        if held[d]:
            for e in range(joints):
                matrix[d, e] = matrix[e, d] = 0.0
            matrix[d, d] = 1.0
    # Gauss; no pivoting where viscosity is on the diagonal.
    for d in range(joints):
        for e in range(d + 1, joints):
            factor = matrix[e, d] / matrix[d, d]
            turned[e] -= factor * turned[d]
            for k in range(d + 1, joints):
                matrix[e, k] -= factor * matrix[d, k]
    largest = most
    for d in range(joints - 1, -1, -1):
        for k in range(d + 1, joints):
            turned[d] -= matrix[d, k] * turned[k]
        turned[d] /= matrix[d, d]
        largest = max(largest, abs(turned[d]))
    for d in range(joints):
        reached = theta[d] + turned[d] * (most / largest) + way[d]
        arrived[d] = clip(reached, body.lower[d], body.upper[d])


@njit(cache=True, nogil=True, error_model='numpy')
def advance(
    robot: Handle, state: ArmState, after: ArmState, h: float, passed: Array, length: Array,
    pulled: Array, command: Array, wrench: Array, fixed: Array,
) -> None:  # fmt: skip
    """Fill the arms h [s] after a state, of a robot: Body, Tree and Limbs.

    Of the network: the lengths at θ and T_end (N, M), and Gᵀ T_end there (N, D). `passed` is what
    friction lets through from the motor to the elastic unit, T_end / T (N, M).
    """
    body, tree, limbs = robot.held
    muscles, joints = len(body.stiffness), len(body.lower)
    load, push = np.empty(joints), np.empty(joints)
    slope, matrix = np.empty((joints, joints)), np.empty((joints, joints))
    jacobian, end = np.empty((muscles, joints)), np.empty(muscles)
    compliance, wanted = np.empty(muscles), np.empty(muscles)
    give, soft, lost = np.empty(muscles), np.empty(muscles), np.empty(muscles)
    for n in range(len(length)):
        theta, tension, slid, arrived = (
            state.theta[n],
            state.tension[n],
            state.slid[n],
            after.theta[n],
        )
        passing, turning = passed[n], after.slid[n]
        hold(tree, theta, wrench[n], load, slope)
        jacobian[:] = 0.0
        rough = False
        for m in range(muscles):
            end[m], turning[m] = passing[m] * tension[m], slid[m]
            rough |= body.friction[m] * end[m] != 0.0
            span = (body.most[m] - body.bias[m]) / body.stiffness[m]
            after.followed[n, m] = follow(
                command[n, m], state.followed[n, m], length[n, m], span, MODULE_SPEED * h
            )
            stretch = body.wire_stretch[m] * (body.length_at_zero[m] + length[n, m])
            unit = body.rate[m] * (body.force[m] + max(end[m], 0.0))
            compliance[m] = 1.0 / unit + stretch
        add_slopes(limbs, theta, end, jacobian, slope)
        for _ in range(ROUNDS):
            for d in range(joints):
                push[d] = -(load[d] + pulled[n, d])
                for e in range(joints):
                    matrix[d, e] = slope[d, e]
                matrix[d, d] += body.viscosity[d] / h
            for m in range(muscles):
                # Where a wire slides, friction is like a stiff spring until it has turned round:
                # one of constant stiffness, where the arm's lets go little by little.
                rub, lost[m] = 0.0, 0.0
                if abs(turning[m]) < 1.0:
                    rub = body.friction[m] * end[m] / REVERSAL
                else:
                    lost[m] = body.friction[m] * end[m] * (turning[m] - slid[m])
                # MSC, friction and the elastic unit in series: at rest posture T moves to `wanted`,
                # and with the posture by `soft` K G Δθ.
                wound = body.stiffness[m] * (length[n, m] - after.followed[n, m])
                by_motor, aim = passing[m] * compliance[m], body.bias[m] + wound
                give[m] = 1.0 + compliance[m] * rub
                soft[m] = body.stiffness[m] / (give[m] + body.stiffness[m] * by_motor)
                slack = compliance[m] * lost[m] - by_motor * (aim - tension[m])
                wanted[m] = aim + soft[m] * slack
                # max(0, ·) and T_max are corners: beyond them a muscle is no spring (semismooth
                # Newton).
                settled = clip(wanted[m], body.bias[m], body.most[m])
                rise = settled - tension[m]
                moved = (compliance[m] * lost[m] - by_motor * rise) / give[m]
                change = passing[m] * rise + rub * moved - lost[m]
                spring = rub / give[m]
                if settled == wanted[m]:
                    spring = (passing[m] + rub / body.stiffness[m]) * soft[m]
                for d in range(joints):
                    push[d] -= change * jacobian[m, d]
                    stiff = spring * jacobian[m, d]
                    for e in range(joints):
                        matrix[d, e] += stiff * jacobian[m, e]
            turn(body, theta, push, matrix, JOINT_SPEED * h, fixed[n], arrived)
            settled_now = True
            for m in range(muscles):
                stretch = 0.0
                for d in range(joints):
                    stretch += jacobian[m, d] * (arrived[d] - theta[d])
                pull = clip(wanted[m] + soft[m] * stretch, body.bias[m], body.most[m])
                rise = passing[m] * compliance[m] * (pull - tension[m])
                moved = (stretch + compliance[m] * lost[m] - rise) / give[m]
                before, turning[m] = turning[m], clip(slid[m] - moved / REVERSAL, -1.0, 1.0)
                settled_now &= (abs(before) < 1.0) == (abs(turning[m]) < 1.0)
                after.tension[n, m], after.length[n, m] = pull, length[n, m] + moved
            if settled_now or not rough:
                break
        for d in range(joints):
            stopped = arrived[d] == body.lower[d] and push[d] < 0.0
            stopped |= arrived[d] == body.upper[d] and push[d] > 0.0
            after.holding[n, d] = -push[d] if stopped or math.isfinite(fixed[n, d]) else 0.0


class QuasiStatics:
    """The equations above for one robot, and for the network that was given to `use` last."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self.tree, self.slopes = robot, Load(robot.kinematics).tree, Slopes(robot)
        postures = robot.random_postures(LEVER_POSTURES, np.random.default_rng(0))
        levers = np.abs(robot.routes.muscle_jacobian(postures)).sum(axis=1).mean(axis=0)
        self._viscosity = np.maximum(VISCOSITY * levers, LEAST_VISCOSITY)

    def use(self, mae: Mae) -> None:
        """Take a network, and the muscles that are isolated now.

        A FloatingPointError says that the network has no finite lengths somewhere.
        """
        self.slopes.fit(mae)
        robot, elastic, self._mae = self._robot, self._robot.series_elastic, mae
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
        pulled = np.ascontiguousarray(pullback(end))  # as of one arm, of many: compiled once
        after = ArmState(*map(np.empty_like, state))
        advance(self._handle, state, after, h, passed, length, pulled, command, wrench, fixed)
        return after


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
        places = map(np.concatenate, zip(*robot.groups, strict=True))
        self._places = np.array([[*map(len, group)] for group in robot.groups]), *places

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
        return first.ravel(), np.einsum('elq,qmd->mlde', self._bend, first).ravel()


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
