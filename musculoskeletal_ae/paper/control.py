# SPDX-License-Identifier: Apache-2.0
"""The control methods that command muscle lengths (§III-E).

    muscle stiffness control   T_target = T_bias + max(0, K_stiff (l − l_target))            (5)
                               l_comp(T) = −(T − T_bias)/K_stiff                             (6)

    geometric   l_target = f_geo(θ_target) − L_e(f_geo,abs(θ_target), T_bias)
    first       l_target = f_dec,l(f_enc,1(θ_target, T_const)) + l_comp(T_const)             (7)
    second      l_target = f_dec,l(f_enc,1(θ_target, T_current)) + l_comp(T_current)         (8)

    proposed    z = f_enc,1(θ_target, T_current), then descend (`latent_descent`) on
                L_control = w₁‖T‖₂ + w₂‖θ − θ_target‖₂
                            + w₃‖τ_target + Gᵀ(θ_target, T_current) T‖₂                      (9)
                l_target = l_calc + l_comp(T_calc)                                           (12)

The muscle modules compute (5). The paper does not state the following, which we chose: T_current is
read once, when a method starts, and is limited to the highest permitted tension. τ in (9) is in
N·mm and T in the network's units. G is a forward difference with Δθ = 0.01 rad.

Every method maps (robot, mae, θ_target [rad] (D,), τ_target [N·m] (D,), T [N] (M,)) to a command.
Its argument T is T_const or T_current, whichever the equation of the method contains.
"""

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.units import TENSION_SCALE, Mask
from musculoskeletal_ae.motion.activities import msc_compensation
from musculoskeletal_ae.motion.methods import LengthMethod, Solution
from musculoskeletal_ae.paper.constants import (
    CONTROL_CANDIDATES,
    CONTROL_EPOCHS,
    CONTROL_LARGEST_STEP,
    CONTROL_WEIGHTS,
    JOINT_STEP,
    TORQUE_UNITS,
)
from musculoskeletal_ae.paper.latent_descent import Term, descend
from musculoskeletal_ae.robot.robot import Robot

#: search for step sizes in the descent of method `proposed` with these constants
SEARCH = CONTROL_LARGEST_STEP, CONTROL_CANDIDATES, CONTROL_EPOCHS  # of `descend`


def geometric(robot: Robot, mae: Mae, theta: Array, torque: Array, tension: Array) -> Solution:  # noqa: ARG001
    """Return the length command of the geometric model; the network is not used."""
    bias = np.full(robot.muscle_count, robot.tension.bias)
    return Solution(robot.muscle_lengths(theta, bias), bias, np.zeros(robot.joint_count))


def first(robot: Robot, mae: Mae, theta: Array, torque: Array, tension: Array) -> Solution:  # noqa: ARG001
    """Return the length command of method `first`, equation (7) of the paper.

    `tension` is T_const [N], (M,).
    """
    length = mae.lengths(theta, tension) + msc_compensation(robot, tension)
    return Solution(length, tension, np.zeros(robot.joint_count))


def second(robot: Robot, mae: Mae, theta: Array, torque: Array, tension: Array) -> Solution:
    """Return the length command of method `second`, equation (8) of the paper.

    `tension` is T_current [N], (M,). This method runs after `first`.
    """
    return first(robot, mae, theta, torque, tension)


def proposed(robot: Robot, mae: Mae, theta: Array, torque: Array, tension: Array) -> Solution:
    """Return the length command of method `proposed`, equation (12) of the paper.

    `tension` is T_current [N], (M,). The method does not enforce tension limits. The solution
    states a missing torque of 0 even if the planned tensions do not produce τ_target.
    """
    terms = control_loss(robot, mae, theta, torque, tension)
    z = descend(mae, mae.encode(Mask.THETA_TENSION, theta, tension), terms, *SEARCH)
    calculated = mae.decode(z)
    length = calculated.length + msc_compensation(robot, calculated.tension)
    return Solution(length, calculated.tension, np.zeros(robot.joint_count))


def control_loss(
    robot: Robot, mae: Mae, theta: Array, torque: Array, tension: Array
) -> tuple[Term, ...]:
    """Return the three terms of the control loss L_control, equation (9) of the paper."""
    joints, muscles = robot.joint_count, robot.muscle_count
    jacobian = muscle_jacobian(mae, theta, tension)
    jacobian[list(robot.isolated)] = 0.0
    rows = np.eye(joints + 2 * muscles)
    tension_rows = rows[joints : joints + muscles]
    tension_weight, posture_weight, torque_weight = CONTROL_WEIGHTS
    return (
        Term(tension_weight, tension_rows, np.zeros(muscles)),
        Term(posture_weight, rows[:joints], theta),
        torque_term(torque_weight, jacobian, tension_rows, torque),
    )


def torque_term(weight: float, jacobian: Array, tension_rows: Array, torque: Array) -> Term:
    """Return the term w ‖τ_target + Gᵀ T‖₂ of the losses (9) and (13), with τ in N·mm.

    Args:
        weight: w₃ or w₆.
        jacobian: G [m/rad], (M, D).
        tension_rows: Rows that select scaled T from scaled (θ, T, l), (M, D+2M).
        torque: τ_target [N·m], (D,).
    """
    matrix = TORQUE_UNITS * jacobian.T @ tension_rows / TENSION_SCALE
    return Term(weight, matrix, -TORQUE_UNITS * torque)


def muscle_jacobian(mae: Mae, theta: Array, tension: Array, step: float = JOINT_STEP) -> Array:
    """Return the muscle Jacobian G(θ, T) [m/rad], (..., M, D), by forward differences.

    The lengths are those that the network reconstructs from θ and T.
    """
    joints = theta.shape[-1]
    offsets = np.vstack([np.zeros(joints), step * np.eye(joints)])
    postures = theta[..., None, :] + offsets  # (..., D+1, D)
    shape = (*postures.shape[:-1], tension.shape[-1])
    lengths = mae.lengths(postures, np.broadcast_to(tension[..., None, :], shape))
    difference: Array = (lengths[..., 1:, :] - lengths[..., :1, :]) / step
    return difference.swapaxes(-1, -2)


#: the paper's control methods by the name of the parameter `method`
METHODS = {
    'geometric': LengthMethod(geometric),
    'first': LengthMethod(first, takes_tension=True),
    'second': LengthMethod(second, takes_tension=True, follows_first=True),
    'proposed': LengthMethod(proposed),
}
