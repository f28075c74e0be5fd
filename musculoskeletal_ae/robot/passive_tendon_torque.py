# SPDX-License-Identifier: Apache-2.0
"""Computes, in compiled code, torques that hold joints against passive tendons."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from musculoskeletal_ae.arrays import Array

if TYPE_CHECKING:
    from musculoskeletal_ae.robot.passive_tendons import Passive


@njit(cache=True)
def monomial(passive: Passive, term: int, theta: Array, a: int, b: int) -> float:
    """Return a term of a length at θ (D,), differentiated by θ_a and θ_b unless these are −1."""
    value = passive.coefficient[term]
    for j in range(len(theta)):
        power, order = passive.power[term, j], int(j == a) + int(j == b)
        if order > power:
            return 0.0
        for i in range(order):
            value *= power - i
        value *= (theta[j] - passive.centre[j]) ** (power - order)
    return value


@njit(cache=True)
def add_passive(passive: Passive, theta: Array, torque: Array, gradient: Array) -> None:
    """Add the torques that hold joints at θ (D,) against passive tendons to `torque` [N·m].

    Add their derivatives with respect to θ to `gradient` [N·m/rad], (D, D). `torque` has the shape
    (D,).
    """
    joints = len(theta)
    slope = np.empty(joints)
    for t in range(len(passive.law)):
        terms = range(passive.first[t], passive.first[t + 1])
        stiffness, low, high = passive.law[t]
        length = 0.0
        for r in terms:
            length += monomial(passive, r, theta, -1, -1)
        if low <= length <= high:
            continue
        force = stiffness * (length - (high if length > high else low))
        slope[:] = 0.0
        for j in range(joints):
            for r in terms:
                if passive.power[r, j]:
                    slope[j] += monomial(passive, r, theta, j, -1)
        for j in range(joints):
            torque[j] += force * slope[j]
            for i in range(joints):
                gradient[j, i] += stiffness * slope[j] * slope[i]
                for r in terms:
                    if passive.power[r, j] and passive.power[r, i]:
                        gradient[j, i] += force * monomial(passive, r, theta, j, i)


@njit(cache=True)
def hold_postures(passive: Passive, theta: Array, torque: Array, gradient: Array) -> None:
    """Call `add_passive` for N postures: θ (N, D), `torque` (N, D) and `gradient` (N, D, D)."""
    for n in range(len(theta)):
        add_passive(passive, theta[n], torque[n], gradient[n])
