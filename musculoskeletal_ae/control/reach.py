# SPDX-License-Identifier: Apache-2.0
"""Holdability: whether a posture is holdable, the nearest holdable one, and a holdable path.

All functions use the learned G and the least tensions within the limits. Where the remaining
muscles cannot hold an arm with isolated muscles, it falls until a joint's stop supports it. From
there a straight path to a holdable posture may not exist. `way` returns the cheapest path through a
roadmap of random postures,

    cost of an edge = ∫ 1 + PRICE m(θ) ds,   m = max_j |τ_missing,j|

Prismatic joints count as if a pinion of radius RACK turned them. Tensions are limited to
T_bias + USED (T_limit − T_bias), so that the path keeps a reserve if possible; otherwise it
minimises the missing torque. In some postures of the roadmap, joints that rest at their stops stay
there. An edge is evaluated only if the cheapest path contains it (lazy roadmap, Bohlin and Kavraki
2000); until then its cost is approximated from the postures at its ends.
"""

from itertools import pairwise

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension

# Constants in rad and N·m are for revolute joints. For a prismatic joint, angles are multiplied by
# RACK and become [m], and torques are divided by RACK and become [N].
NOTABLE = 0.05  # missing torque above which a posture is not holdable [N·m]
HALVINGS = 6  # bisection steps on the way to a posture that is not holdable

PRICE = 20.0  # cost of missing torque [rad/(N·m)]
USED = 0.85  # fraction of the tension range above T_bias that a path may use
POSTURES = 300  # number of random postures of the roadmap
NEIGHBOURS = 12  # number of neighbours of each posture to which the roadmap has edges
LOOKS = 40  # largest number of paths of which all edges are evaluated
SPACING = 0.15  # distance between the evaluated postures of an edge [rad]
AT_STOP = 0.05  # distance from a stop below which a joint rests at it [rad]
STOP = 100.0  # largest torque with which a stop supports a joint [N·m]


def lacking(robot: Robot, mae: Mae, theta: Array) -> str:
    """Return a text on the largest missing torque at θ [rad] (D,), or '' if θ is holdable."""
    limits, radian = robot.tension, robot.kinematics.radian
    torque = radian * robot.kinematics.holding_torque(theta)
    jacobian = radian * mae.muscle_jacobian(theta, limits.bias)
    lacks = np.abs(least_tension(jacobian, torque, limits.bias, limits.limit).missing_torque)
    joint = int(lacks.argmax())
    if lacks[joint] <= NOTABLE:
        return ''
    torque_text = f'{lacks[joint] / radian[joint]:.2f} {robot.units[joint].torque}'
    return f'{torque_text} at joint {robot.joints[joint]}'


def nearest_held(robot: Robot, mae: Mae, start: Array, theta: Array) -> tuple[Array, str]:
    """Return the last holdable posture on the straight path from `start` to θ [rad], (D,).

    Returns:
        The posture, and a text on the missing torque at θ, or '' if θ is holdable.
    """
    missing = lacking(robot, mae, theta)
    if not missing:
        return theta, ''
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        share = 0.5 * (low + high)
        is_holdable = not lacking(robot, mae, start + share * (theta - start))
        low, high = (share, high) if is_holdable else (low, share)
    return start + low * (theta - start), f'at the target, the muscles lack {missing}'


def way(robot: Robot, mae: Mae, start: Array, theta: Array) -> Array:
    """Return the postures of a path from `start` to θ [rad], (K, D); the last one is θ."""
    if robot.used.all():
        return theta[None]
    # Import here, because an arm without isolated muscles does not need scipy.
    from scipy.sparse.csgraph import dijkstra

    limits, joints = robot.tension, np.eye(robot.joint_count)
    radian = robot.kinematics.radian
    at_stop = AT_STOP * radian
    most = limits.bias + USED * (limits.limit - limits.bias)

    def missing(postures: Array) -> Array:
        tensions = np.broadcast_to(limits.bias, (len(postures), robot.muscle_count))
        torques = []
        for at, jacobian in zip(postures, radian * mae.muscle_jacobian(postures, tensions)):
            # Model a stop as a muscle that pulls the joint away from it.
            low, high = at < robot.lower + at_stop, at > robot.upper - at_stop
            stops = np.vstack([-joints[low], joints[high]])
            none = np.zeros(len(stops))
            ends = np.concatenate([limits.bias, none]), np.concatenate([most, none + STOP])
            torque = radian * robot.kinematics.holding_torque(at)
            exertion = least_tension(np.vstack([jacobian, stops]), torque, *ends)
            torques.append(exertion.missing_torque)
        m = np.abs(torques).max(axis=1)
        return np.where(m > NOTABLE, m, 0.0)

    def cost(one: Array, other: Array) -> float:
        length = float(np.linalg.norm((other - one) / radian))
        shares = np.linspace(0.0, 1.0, int(length / SPACING) + 2)[:, None]
        m = missing(one + shares * (other - one))
        return length * (1.0 + PRICE * float(m.mean()))

    direct = cost(start, theta)
    if direct <= np.linalg.norm((theta - start) / radian):
        return theta[None]
    rng = np.random.default_rng(0)
    postures = robot.random_postures(POSTURES, rng)
    # Keep joints that rest at a stop there in a part of the roadmap.
    for joint in range(robot.joint_count):
        for stop in (robot.lower[joint], robot.upper[joint]):
            if abs(start[joint] - stop) < at_stop[joint]:
                postures[rng.random(POSTURES) < 0.3, joint] = stop
    postures = np.vstack([start, theta, postures])
    apart = np.linalg.norm((postures[:, None] - postures) / radian, axis=2)
    m = missing(postures)
    price = apart * (1.0 + PRICE * 0.5 * (m[:, None] + m))
    near = apart <= np.sort(apart, axis=1)[:, NEIGHBOURS, None]
    price = np.where(near | near.T, price, 0.0)
    price[0, 1] = price[1, 0] = direct
    evaluated = {(0, 1), (1, 0)}
    path = [0, 1]
    for _ in range(LOOKS):
        before = dijkstra(price, indices=[0], return_predecessors=True)[1][0]
        path = [1]
        while path[-1] != 0:
            path.append(int(before[path[-1]]))
        path.reverse()
        new_edges = [edge for edge in pairwise(path) if edge not in evaluated]
        if not new_edges:
            break
        for i, j in new_edges:
            price[i, j] = price[j, i] = cost(postures[i], postures[j])
            evaluated |= {(i, j), (j, i)}
    points = postures[path]
    # Remove postures that do not make the path cheaper.
    k = 1
    while k < len(points) - 1:
        around = cost(points[k - 1], points[k]) + cost(points[k], points[k + 1])
        if cost(points[k - 1], points[k + 1]) <= around:
            points, k = np.delete(points, k, axis=0), max(k - 1, 1)
        else:
            k += 1
    return points[1:]
