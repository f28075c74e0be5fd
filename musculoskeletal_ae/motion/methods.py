# SPDX-License-Identifier: Apache-2.0
"""Control methods that convert a target posture into muscle lengths, and joint stiffness.

Muscle stiffness control exerts T = T_bias + max(0, K_stiff (l − l_target)). A muscle that should
exert the tension T at the posture θ therefore gets the length command

    l_target = ①(θ, T) + l_comp(T)

①(θ, T) is the network's prediction of the muscle lengths, and l_target lies below it by |l_comp|.
`stiffness` chooses T for a joint stiffness (`stiffness_command`). `proposed` chooses the least
tensions (`tension_plan`), and `tension` commands tensions instead of lengths (`torque`). The preset
provides the methods `geometric`, `first` and `second` (`Preset.length_methods`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import InfeasibleError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion.activities import msc_compensation
from musculoskeletal_ae.robot import stiffness as robot_stiffness
from musculoskeletal_ae.robot.joint_stops import supporting_stops
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import TensionProgramme, least_tension

FIRST = 'first'  # name of the length method that uses the given tension T_const
SECOND = 'second'  # name of the length method that uses the measured tension T

#: solve this many quadratic programmes for one posture, each with G at the tension that the
#: previous one found; a third would change the tension by well under a newton
SOLVES = 2

# The following constants are those of the method `stiffness`.

# Raise T_low above T_bias by the largest of these margins that is feasible [N]. An external force
# can reduce a muscle's tension by this margin before it falls to T_bias, where the muscle is stiff
# in one direction only.
MARGINS = (40.0, 30.0, 20.0, 10.0, 0.0)
ITERATIONS = 6  # end the search for tensions of a desired stiffness after this many iterations
# Weigh the distance from the initial tensions (at first the least tensions) by this, relative to
# the stiffness error. A reachable stiffness is missed by about this share.
LEAST_TENSION_SHARE = 1e-3
# Try these step lengths in the line search towards a corner of the feasible tensions. The full step
# need not be the best, because K is concave in each tension.
SHARES = (1.0, 0.5, 0.25, 0.125)
# Project a point at this distance from the present tensions along the gradient of K [N]. At so
# large a distance, the feasible tensions nearest to the point are those at which a linear
# approximation of K is extreme.
FAR = 1e5
LEVELS = 8  # evaluate the elongation at this many tensions from T_bias to T_limit
# Compute finite differences of G with this step [rad]. A larger step would average over the
# curvature of the routes, and a smaller step would amplify the errors of the network.
STEP = 0.05


class JointStiffness(NamedTuple):
    """Expected joint stiffness of a command, and the range that the posture allows [N·m/rad]."""

    expected: Array  # joint stiffness K_θ that the command produces, (D, D)
    lowest: Array  # smallest stiffness that tensions can give to each joint alone, (D,)
    highest: Array  # largest stiffness that tensions can give to each joint alone, (D,)


class Solution(NamedTuple):
    """A command with its expected tension, missing torque and stiffness."""

    length: Array  # length command l_target [m], (M,)
    tension: Array  # tension T that the command should produce [N], (M,)
    missing_torque: Array  # torque that no tensions within their limits provide [N·m], (D,)
    #: planned joint stiffness; None except with the method `stiffness`
    stiffness: JointStiffness | None = None


#: Function that computes the length command for a target, and the tension that it should produce.
#: Its arguments are the body, in which isolated muscles have no tension, the network, the target
#: posture θ_target [rad], (D,), the torque that the muscles should exert there, τ_target [N·m],
#: (D,), and T_const, or the measured T at the start of the movement [N], (M,).
LengthCommand = Callable[[Robot, Mae, Array, Array, Array], Solution]


class LengthMethod(NamedTuple):
    """A control method that ramps to one length command and holds it.

    Attributes:
        command: Function that computes l_target.
        takes_tension: Whether the tensions that are passed to `command` are those that the muscles
            should exert. If so, the caller limits them before it calls `command`.
        follows_first: Whether the arm first moves to the target by the method `first`.
    """

    command: LengthCommand
    takes_tension: bool = False
    follows_first: bool = False


class Goal(NamedTuple):
    """A posture, and the method that converts it into lengths.

    Attributes:
        method: One of the preset's length methods.
        theta: Target posture θ_target [rad], (D,).
        effort: Torque in addition to gravity compensation [N·m], (D,).
        duration: Duration of the movement [s].
        tension: T_const of the method `first` [N], (M,); None to use T_current at the start of the
            goal. The exploration also states a tension for `second`, which recordings of
            experiments use: the one that the geometric model expects.
    """

    method: str
    theta: Array
    effort: Array
    duration: float
    tension: Array | None = None


def first_command(robot: Robot, mae: Mae, theta: Array, tension: Array) -> Array:
    """Return length commands [m], (..., M), for target postures and tensions.

    Args:
        robot: Provides T_bias and K_stiff of the muscle modules.
        mae: The network that predicts the muscle lengths.
        theta: Target postures θ_target [rad], (..., D).
        tension: Tensions T that the commands should produce [N], (..., M).
    """
    return mae.lengths(theta, tension) + msc_compensation(robot, tension)


class StiffnessModel(NamedTuple):
    """How the joint stiffness around one posture depends on the tensions, by the network."""

    jacobian: Array  # muscle Jacobian G [m/rad], (M, D)
    hessian: Array  # second derivatives ∂²l/∂θ² of the lengths [m/rad²], (M, D, D)
    compliance: Array  # ∂L_e/∂T [m/N] as polynomials of T, highest power first, (3, M)
    module: Array  # stiffness K_stiff of the modules [N/m], (M,)
    springs: Array  # stiffness of springs and passive tendons [N·m/rad], (D, D)

    @classmethod
    def read(cls, robot: Robot, mae: Mae, theta: Array, tension: Array) -> StiffnessModel:
        """Read the model from the lengths that the network computes near one state of the arm.

        The state is that of the joint angles θ [rad], (D,), and the tensions T [N], (M,).
        """

        def jacobian(postures: Array) -> Array:
            return mae.muscle_jacobian(postures, np.tile(tension, (len(postures), 1)))

        ranges = np.stack([robot.tension.bias, robot.tension.limit])
        tensions: Array = np.linspace(ranges[0], ranges[1], LEVELS)
        lengths = mae.lengths(np.tile(theta, (LEVELS, 1)), tensions)
        cubic = np.empty((4, robot.muscle_count))
        for low, high in np.unique(ranges, axis=1).T:
            own = (ranges[0] == low) & (ranges[1] == high)
            # The tension range of an isolated muscle is empty, which `polyfit` does not allow.
            levels = np.linspace(low, max(high, low + 1.0), LEVELS)
            cubic[:, own] = np.polyfit(levels, -lengths[:, own], 3)
        slope = mae.muscle_jacobian(theta, tension)
        bend = robot_stiffness.muscle_hessian(jacobian, theta, STEP)
        slope[list(robot.isolated)] = bend[list(robot.isolated)] = 0.0
        return cls(
            jacobian=slope,
            hessian=bend,
            compliance=cubic[:3] * np.array([3.0, 2.0, 1.0])[:, None],
            module=robot.stiffness,
            springs=robot.kinematics.elasticity.stiffness_at(theta),
        )

    def muscle_stiffness(self, tension: Array) -> tuple[Array, Array]:
        """Return the stiffness k [N/m] of every muscle, and dk/dT [1/m], at T [N], (M,) each."""
        square, linear, constant = self.compliance
        compliance = (square * tension + linear) * tension + constant
        # Treat a tendon as rigid if the network wrongly predicts that it shortens under tension.
        slope = np.where(compliance > 0.0, 2.0 * square * tension + linear, 0.0)
        k = robot_stiffness.muscle_stiffness(self.module, np.maximum(compliance, 0.0))
        return k, -k * k * slope

    def joint_stiffness(self, tension: Array) -> Array:
        """Return the joint stiffness K_θ [N·m/rad], (D, D), at the tensions T [N], (M,)."""
        k, _ = self.muscle_stiffness(tension)
        muscular = robot_stiffness.joint_stiffness(self.jacobian, self.hessian, k, tension)
        return self.springs + muscular

    def slope(self, tension: Array) -> Array:
        """Return by how much each joint's stiffness K_jj changes with each tension T_i.

        The result is ∂K_jj/∂T_i [N·m/rad/N], (D, M), at the tensions `tension` [N], (M,).
        """
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
    velocity: Array | float = 0.0,
    effort: Array | float = 0.0,
) -> Solution:
    """Return the command whose joint stiffness is nearest to the desired one (method `stiffness`).

        min Σ_j (K_jj(T) − K_desired,j)²   subject to   −Gᵀ T = τ_target,   T_low ≤ T ≤ T_limit

    K_θ, with the diagonal entries K_jj, is defined in `robot/stiffness.py` and here includes the
    springs of the joints. It depends on G, ∂²l/∂θ² and the elongation L_e(T) = −l(θ, T) + const.
    These three come from the network's prediction l(θ, T) of the muscle lengths (paper, §III-E,
    variable stiffness control).

    Tensions in the null space of Gᵀ keep the posture and stiffen the elastic elements. A muscle
    that muscle stiffness control (MSC) holds at T_bias is stiff in one direction only. Therefore
    T_low lies above T_bias, by the largest of MARGINS with which the torque is possible. K is
    nearly linear in T, so a few quadratic programmes around the last solution suffice.

    Args:
        robot: The body, in which isolated muscles have no tension.
        mae: The network.
        theta: Target posture θ_target [rad], (D,).
        torque: Target torque τ_target [N·m], (D,).
        desired: Desired diagonal entries of K_θ [N·m/rad], (D,). 0 leaves an entry unconstrained;
            values beyond the reachable range of a joint are clipped to it.
        limit: Highest tension that may be planned [N], scalar or (M,).
        near: Tension of a nearby solution [N], (M,); the search then starts there and needs only
            one round. None if no such solution is known.
        velocity: Velocity θ̇ of the joints [rad/s], (D,).
        effort: Torque beyond gravity and inertia, which `torque` contains [N·m], (D,). It decides
            together with the velocity which joint stops support the joints.
    """
    stops = supporting_stops(robot, theta, velocity, effort)
    high = np.array(np.broadcast_to(limit, robot.muscle_count), dtype=float)
    jacobian = mae.muscle_jacobian(theta, np.minimum(robot.tension.bias + MARGINS[0], high))
    for margin in MARGINS:
        low = np.minimum(robot.tension.bias + margin, high)
        tension, missing = least_tension(jacobian, torque, low, high, stops=stops)
        if not missing.any():
            break
    rounds = SOLVES if near is None else 1
    tension = tension if near is None else near
    model = StiffnessModel.read(robot, mae, theta, tension)
    # If no tensions within their limits exert the torque, the stiffness cannot be chosen.
    lowest = highest = np.diag(model.joint_stiffness(tension))
    for _ in range(rounds):
        programme = TensionProgramme(model.jacobian, torque, low, high, stops)
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
        missing = np.zeros_like(missing)
    stiffness = JointStiffness(model.joint_stiffness(tension), lowest, highest)
    return Solution(first_command(robot, mae, theta, tension), tension, missing, stiffness)


def _approach(
    model: StiffnessModel, programme: TensionProgramme, tension: Array, desired: Array
) -> Array:
    """Return tensions whose joint stiffness is close to `desired`, by Gauss–Newton iterations.

    Joints with `desired` = 0 are unconstrained. Each iteration is a quadratic programme, because
    the tensions have to balance the torque within their limits. The module `gauss_newton` solves
    problems without such constraints only.
    """
    chosen, start = desired > 0.0, tension
    for _ in range(ITERATIONS if chosen.any() else 0):
        slope = model.slope(tension)[chosen]
        error = (desired - np.diag(model.joint_stiffness(tension)))[chosen]
        small = LEAST_TENSION_SHARE * np.square(slope).sum(axis=1).mean()
        quadratic = slope.T @ slope + small * np.eye(len(tension))
        tension = programme.minimum(quadratic, slope.T @ (error + slope @ tension) + small * start)
    return tension


def _extreme(
    model: StiffnessModel, programme: TensionProgramme, tension: Array, joint: int, sign: float
) -> float:
    """Return the largest or smallest stiffness of a joint [N·m/rad] that is possible.

    It is found by the Frank–Wolfe method with a line search. `sign` is 1 for the largest and −1 for
    the smallest stiffness.
    """

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
