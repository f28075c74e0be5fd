# SPDX-License-Identifier: Apache-2.0
"""Muscle lengths that bring the arm to θ_target with the least tension: the method `proposed`.

Preset `paper`, as printed (section "Control Using Musculoskeletal AutoEncoder"): descend from
z = ①(θ_target, T_current) on

    L_control = w₁‖T‖ + w₂‖θ − θ_target‖ + w₃‖τ_target + Gᵀ T‖,   l_target = l_calc + l_comp(T_calc)

Preset `default` searches the same latent space on the sheet z = ①(θ_target, T), where θ_target is
kept by construction, for

    min ‖T‖²   subject to   τ_target + Gᵀ T = 0,   T_bias ≤ T ≤ T_limit

The printed weights let ‖T‖ outweigh the torque balance (w₃ = 0.01), and then the arm sags; as
constraints, torque and limits are met first and the least tension is taken of what remains. G
depends on T, so the quadratic programme is solved a few times.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.length import first_command, msc_compensation
from musculoskeletal_ae.mae.descent import StepSearch, Term, descend
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.units import TENSION_SCALE, Mask
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import Exertion, least_tension

TENSION_WEIGHT, POSTURE_WEIGHT, TORQUE_WEIGHT = 1.0, 1.0, 0.01  # w₁, w₂, w₃
SEARCH = StepSearch(largest_step=0.5, candidates=10, epochs=10)

# Solving again with G at the tension found changes it by well under a newton after the second.
SOLVES = 2


class Solution(NamedTuple):
    """A command and what it is expected to bring.

    Attributes:
        length: l_target [m], shape (M,).
        tension: T_calc [N], shape (M,).
        missing_torque: Torque that no tension within its limits gives [N·m], shape (D,).
    """

    length: Array
    tension: Array
    missing_torque: Array


def proposed(
    robot: Robot, mae: Mae, theta: Array, torque: Array, tension: Array, limit: Array | float
) -> Solution:
    """Return the command of preset `default`.

    Args:
        robot: For limits and K_stiff.
        mae: The network.
        theta: θ_target [rad], shape (D,).
        torque: τ_target = g(θ_target) + effort [N·m], shape (D,).
        tension: T_current [N], shape (M,), where the search starts.
        limit: Highest tension planned [N], scalar or shape (M,).
    """
    bias = robot.tension.bias
    found = Exertion(np.clip(tension, bias, limit), np.zeros(robot.joint_count))
    for _ in range(SOLVES):
        found = least_tension(mae.muscle_jacobian(theta, found.tension), torque, bias, limit)
    length = first_command(robot, mae, theta, found.tension)
    return Solution(length, found.tension, found.missing_torque)


def proposed_paper(robot: Robot, mae: Mae, theta: Array, torque: Array, tension: Array) -> Solution:
    """Return the command of preset `paper`; arguments as for `proposed`.

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
