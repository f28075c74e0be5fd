# SPDX-License-Identifier: Apache-2.0
"""Random equilibria of robots with springs at the joints and fewer muscles than joints.

An underactuated hand has fewer muscles than joints: springs return its fingers, and one tendon may
bend several joints. The lengths of its muscles do not determine its posture. At rest, however, the
posture follows from lengths and tensions, because weight g, springs K θ − b and passive tendons h
balance the tensions:

    g(θ) + K θ − b + h(θ) + G(θ)ᵀ T = 0

Where a joint lies at its limit, a stop exerts the rest of this torque. Such a robot can rest only
in these postures, so a network learns from them how θ follows from T and l.

The equilibria are found by letting the robot move from random postures. The modules either exert
constant tensions, or wind like springs of stiffness k between T_bias and T_limit:

    T = T_0 + k (l(θ) − l(θ_0))

With constant tensions, an arm settles only where it is stable without the modules, and often at its
stops. Winding modules also hold an arm in postures in which a tendon would pull itself past an
axis.
"""

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.stiffness import muscle_hessian

STEPS = 30  # move towards an equilibrium in at most this many steps
REUSED = 5  # compute the stiffness due to tensions only in every fifth of these steps
LARGEST_STEP = 0.2  # turn a joint by at most this in one of these steps [rad]
#: let the stiffness that determines a step be at least this share of the largest one
LEAST_STIFFNESS = 0.002
#: accept an equilibrium if the unbalanced torque of each joint is at most this share of the typical
#: torque of the muscles at this joint
BALANCED = 0.01
#: treat the typical torque at a joint as at least this share of the largest typical torque at any
#: joint
LEAST_TORQUE = 1e-3
SEARCHED = 200  # search for equilibria from this many random postures
#: vary the tensions of a found equilibrium by this share (standard deviation) to get another one
VARIATION = 0.1
#: vary the torques by this share of the muscles' torques (standard deviation), as joint friction
#: does
SCATTER = 0.03
SMALL = 1e-9  # divide torques by at least this [N·m]


class Equilibria(NamedTuple):
    """N postures, in equilibrium or near it, and how tensions and postures change there."""

    theta: Array  # joint angles θ [rad], (N, D)
    tension: Array  # tensions T [N], (N, M)
    jacobian: Array  # muscle Jacobian G [m/rad], (N, M, D)
    stiffness: Array  # stiffness k = ∂T/∂l of each muscle [N/m]; 0 at constant tension, (N, M)
    bend: Array  # stiffness due to tensions, Σ T ∂²l/∂θ² [N·m/rad], (N, D, D)
    by_torque: Array  # change of θ per torque, ∂θ/∂τ [rad/(N·m)]; 0 at a stop, (N, D, D)
    is_stable: Bools  # whether each posture is stable, (N,)


def has_followers(robot: Robot) -> bool:
    """Return whether a group of joints has fewer muscles than joints, and a spring at one of them.

    Without measured tensions, no equilibrium can be told from another, so the result is false.
    """
    if not robot.tension_source.is_known:
        return False
    is_sprung = robot.kinematics.elasticity.is_sprung
    return any(
        len(group.joints) > len(group.muscles) and is_sprung[list(group.joints)].any()
        for group in robot.groups
    )


def equilibrium_states(
    robot: Robot, count: int, rng: np.random.Generator, searched: int = SEARCHED
) -> tuple[Array, Array] | None:
    """Return random equilibria: θ [rad], (N, D), and T [N], (N, M).

    From half of the postures, the robot moves with winding modules, and from the others with
    constant random tensions.

    Args:
        robot: The robot.
        count: Number of equilibria N.
        rng: Random generator.
        searched: Search from this many random postures. The other equilibria lie near those found.

    Returns:
        The equilibria; None if none was found.
    """
    # Imported here, because most arms have no followers, and their nodes then load no solver.
    from musculoskeletal_ae.robot.tension import least_tension

    theta, limits = robot.random_postures(searched, rng), robot.tension
    tension = rng.uniform(limits.bias, limits.limit, (searched, robot.muscle_count))
    jacobian, torque = robot.routes.muscle_jacobian(theta), robot.kinematics.holding_torque(theta)
    for n in range(0, searched, 2):
        wanted = least_tension(jacobian[n], torque[n], limits.bias, limits.limit)
        tension[n] = wanted.tension
    stiffness = robot.muscle_stiffness(theta, tension)
    stiffness[1::2] = 0.0
    found = settled_states(robot, theta, tension, stiffness)
    if not len(found.theta):
        return None
    rows = rng.integers(len(found.theta), size=count)
    now = Equilibria._make(part[rows] for part in found)
    tension, jacobian = now.tension, now.jacobian
    muscular = np.abs(jacobian * tension[..., None]).sum(axis=1)
    wound = VARIATION * tension * rng.standard_normal(tension.shape)  # change of T at constant θ
    change = SCATTER * muscular * rng.standard_normal(muscular.shape)
    change -= np.einsum('nmd,nm->nd', jacobian, wound)
    turned = np.einsum('nij,nj->ni', now.by_torque, change)
    tension = tension + wound + now.stiffness * np.einsum('nmd,nd->nm', jacobian, turned)
    theta = np.clip(now.theta + turned, robot.lower, robot.upper)
    return theta, np.maximum(tension, 0.0)


def settled_states(
    robot: Robot, theta: Array, tension: Array, stiffness: Array | float = 0.0
) -> Equilibria:
    """Return the equilibria to which the robot moves.

    Args:
        robot: The robot.
        theta: The postures θ_0 from which it moves [rad], (N, D).
        tension: T_0 [N], (N, M).
        stiffness: k [N/m], (N, M); 0 for constant tensions.

    Returns:
        The equilibria that were found, at most N.
    """
    theta = np.clip(theta, robot.lower, robot.upper)
    start = robot.routes.absolute_lengths(theta)
    pull = np.einsum('nmd,nm->nd', robot.routes.muscle_jacobian(theta), tension)
    typical = np.abs(pull).mean(axis=0)
    enough = BALANCED * np.maximum(typical, LEAST_TORQUE * typical.max() + SMALL)
    stiffness = np.broadcast_to(np.asarray(stiffness, dtype=float), tension.shape)
    law = _Law(tension, start, stiffness)
    moving, bend = np.arange(len(theta)), np.empty((*theta.shape, theta.shape[1]))
    for step in range(STEPS):
        own = _Law(*(part[moving] for part in law))
        renew = step % REUSED == 0
        torque, now = _linearised(robot, theta[moving], own, None if renew else bend[moving])
        bend[moving] = now.bend
        is_unbalanced = (np.abs(torque) > enough).any(axis=1)
        if not is_unbalanced.any():
            break
        moving, torque = moving[is_unbalanced], torque[is_unbalanced]
        change = -np.einsum('nij,nj->ni', now.by_torque[is_unbalanced], torque)
        longest = np.maximum(np.abs(change).max(axis=1, keepdims=True), SMALL)
        change *= np.minimum(1.0, LARGEST_STEP / longest)
        theta[moving] = np.clip(theta[moving] + change, robot.lower, robot.upper)
    torque, now = _linearised(robot, theta, law, None)
    is_found = now.is_stable & (np.abs(torque) <= enough).all(axis=1)
    return Equilibria._make(part[is_found] for part in now)


class _Law(NamedTuple):
    """How the tensions of N states depend on the lengths."""

    tension: Array  # tensions T_0 at the start [N], (N, M)
    length: Array  # lengths l(θ_0) at the start [m], (N, M)
    stiffness: Array  # stiffness k of each muscle [N/m], (N, M)


def _linearised(
    robot: Robot, theta: Array, law: _Law, bend: Array | None
) -> tuple[Array, Equilibria]:
    """Return the torque that is not balanced [N·m], 0 at a stop, (N, D), and its derivatives.

    Args:
        robot: The robot.
        theta: θ [rad], (N, D).
        law: How the tensions depend on the lengths.
        bend: Σ T ∂²l/∂θ² of a posture near θ; None to compute it.
    """
    kinematics, limits = robot.kinematics, robot.tension
    jacobian = robot.routes.muscle_jacobian(theta)
    wound = law.tension + law.stiffness * (robot.routes.absolute_lengths(theta) - law.length)
    tension = np.clip(wound, limits.bias, limits.limit)
    stiffness = np.where(tension == wound, law.stiffness, 0.0)
    torque = kinematics.holding_torque(theta) + np.einsum('nmd,nm->nd', jacobian, tension)
    is_held = (theta <= robot.lower) & (torque > 0.0) | (theta >= robot.upper) & (torque < 0.0)
    if bend is None:
        hessian = muscle_hessian(robot.routes.muscle_jacobian, theta)
        bend = np.einsum('nm,nmij->nij', tension, hessian)
    whole = np.stack([kinematics.holding_gradient(row) for row in theta]) + bend
    whole = whole + jacobian.swapaxes(1, 2) @ (stiffness[..., None] * jacobian)
    # Joints at stops do not move, and do not move others.
    is_fixed = is_held[:, :, None] | is_held[:, None, :]
    whole = np.where(is_fixed, 0.0, 0.5 * (whole + whole.swapaxes(1, 2)))
    values, vectors = np.linalg.eigh(whole)
    size = np.abs(values)
    least = LEAST_STIFFNESS * size.max(axis=1, keepdims=True) + SMALL
    by_torque = vectors / np.maximum(size, least)[:, None, :] @ vectors.swapaxes(1, 2)
    by_torque = np.where(is_fixed, 0.0, by_torque)
    is_stable: Bools = (values > -least).all(axis=1)
    now = Equilibria(theta, tension, jacobian, stiffness, bend, by_torque, is_stable)
    return np.where(is_held, 0.0, torque), now
