# SPDX-License-Identifier: Apache-2.0
"""How a target posture becomes muscle lengths, method by method.

    l_comp(T)  = −(T − T_bias)/K_stiff
    geometric  l_target = f_geo(θ_target) − L_e(f_geo,abs(θ_target), T_bias)
    first      l_target = ①(θ_target, T) + l_comp(T),  T = T_const
    second     the same after `first`, T = T_current
    proposed   the same, T = argmin ‖T‖²  subject to  τ_target + Gᵀ T = 0,  T_bias ≤ T ≤ T_limit

(paper, section "Control"). MSC holds T = T_bias + max(0, K_stiff (l − l_target)), so l_comp is how
far the command must lie below the length for the muscle to carry T there. `stiffness` chooses T for
a joint stiffness (`stiffness.py`), `tension` commands tensions instead of lengths (`torque.py`).

`proposed` of preset `paper` is as printed: descend from z = ①(θ_target, T_current) on

    L_control = w₁‖T‖ + w₂‖θ − θ_target‖ + w₃‖τ_target + Gᵀ T‖,   l_target = l_calc + l_comp(T_calc)

Preset `default` searches the same latent space on the sheet z = ①(θ_target, T), where θ_target is
kept by construction. The printed weights let ‖T‖ outweigh the torque balance (w₃ = 0.01), and then
the arm sags; as constraints, torque and limits are met first and the least tension is taken of what
remains. G depends on T, so the quadratic programme is solved a few times.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.descent import StepSearch, Term, descend
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.units import TENSION_SCALE, Mask
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import Exertion, least_tension

TENSION_WEIGHT, POSTURE_WEIGHT, TORQUE_WEIGHT = 1.0, 1.0, 0.01  # w₁, w₂, w₃
SEARCH = StepSearch(largest_step=0.5, candidates=10, epochs=10)

# Solving again with G at the new tension changes it by well under a newton after the second.
SOLVES = 2


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


def msc_compensation(robot: Robot, tension: Array) -> Array:
    """Return l_comp(T) [m], shape (..., M); zero at T_bias, negative above it."""
    return -(tension - robot.tension.bias) / robot.stiffness


def geometric_command(robot: Robot, theta: Array) -> Array:
    """Return l_target [m] (..., M) of `geometric` for θ_target [rad] (..., D)."""
    bias = np.full((*theta.shape[:-1], robot.muscle_count), robot.tension.bias)
    return robot.muscle_lengths(theta, bias)


def first_command(robot: Robot, mae: Mae, theta: Array, tension: Array) -> Array:
    """Return l_target [m] (..., M) of `first` for θ_target [rad] (..., D), T_const [N] (..., M)."""
    return mae.lengths(theta, tension) + msc_compensation(robot, tension)


def proposed(
    robot: Robot, mae: Mae, theta: Array, torque: Array, tension: Array, limit: Array | float
) -> Solution:
    """Return the command of `proposed`, preset `default`.

    For θ_target [rad] (D,) and τ_target = g(θ_target) + effort [N·m] (D,); the search starts at
    T_current [N] (M,) and plans no tension above the limit [N], scalar or (M,).
    """
    bias = robot.tension.bias
    exertion = Exertion(np.clip(tension, bias, limit), np.zeros(robot.joint_count))
    for _ in range(SOLVES):
        jacobian = mae.muscle_jacobian(theta, exertion.tension)
        exertion = least_tension(jacobian, torque, bias, limit)
    return Solution(first_command(robot, mae, theta, exertion.tension), *exertion)


def proposed_paper(robot: Robot, mae: Mae, theta: Array, torque: Array, tension: Array) -> Solution:
    """Return the command of `proposed`, preset `paper`; arguments as for `proposed`.

    It knows no limits; what it leaves of the torque is its own choice and not reported as missing.
    """
    terms = paper_terms(robot, mae, theta, torque, tension)
    z = descend(mae, mae.encode(Mask.THETA_TENSION, theta, tension), terms, SEARCH)
    state = mae.decode(z)
    length = state.length + msc_compensation(robot, state.tension)
    return Solution(length, state.tension, np.zeros(robot.joint_count))


def paper_terms(
    robot: Robot, mae: Mae, theta: Array, torque: Array, tension: Array
) -> tuple[Term, ...]:
    """Return the three terms of L_control, with G at (θ_target, T_current)."""
    joints, muscles = robot.joint_count, robot.muscle_count
    jacobian = mae.muscle_jacobian_difference(theta, tension)
    rows = np.eye(joints + 2 * muscles)
    pull = rows[joints : joints + muscles]
    return (
        Term(TENSION_WEIGHT, pull, np.zeros(muscles)),
        Term(POSTURE_WEIGHT, rows[:joints], theta),
        Term(TORQUE_WEIGHT, jacobian.T @ pull / TENSION_SCALE, -torque),
    )
