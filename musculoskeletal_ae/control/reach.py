# SPDX-License-Identifier: Apache-2.0
"""What the muscles can hold: whether a posture, what is nearest to one, and a way that is held.

All with the learned G, by the least tension within the limits. An arm that lacks a muscle falls
where the rest cannot hold it, to a joint's stop, which then bears what they lack, and cannot simply
go straight to where they can. `way` is the cheapest path through a roadmap of random postures,

    cost of an edge = ∫ 1 + PRICE m(θ) ds,   m = max_j |τ_missing,j|

with what slides as if a pinion of radius RACK turned it, and tensions up to
T_bias + USED (T_limit − T_bias), so that it leads through what is held with something to spare, if
there is such a way, and else where the least is missing. Some of the roadmap lies where joints that
the arm leans on stay at their stops. Edges are looked at only if the cheapest path leads along them
(lazy roadmap, Bohlin and Kavraki 2000); until then the postures at their ends say what they cost.
"""

from itertools import pairwise

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension

# Where a joint slides, [rad] below are times RACK [m], [N·m] over RACK [N].
NOTABLE = 0.05  # [N·m] of missing torque at which a posture is not held
HALVINGS = 6  # of the way to a posture that cannot be held

PRICE, USED = 20.0, 0.85  # [rad/(N·m)]; of what muscles can pull above T_bias
POSTURES, NEIGHBOURS, LOOKS = 300, 12, 40  # of the roadmap; paths that are looked at
SPACING = 0.15  # [rad] between the postures of an edge that are looked at
AT_STOP, STOP = 0.05, 100.0  # [rad] from a joint's limit; [N·m] that its stop bears


def lacking(robot: Robot, mae: Mae, theta: Array) -> str:
    """Return which joint lacks how much torque to hold θ [rad] (D,), or ''."""
    limits, radian = robot.tension, robot.kinematics.radian
    torque = radian * robot.kinematics.holding_torque(theta)
    jacobian = radian * mae.muscle_jacobian(theta, limits.bias)
    lacks = np.abs(least_tension(jacobian, torque, limits.bias, limits.limit).missing_torque)
    joint = int(lacks.argmax())
    if lacks[joint] <= NOTABLE:
        return ''
    return (
        f'{lacks[joint] / radian[joint]:.2f} {robot.units[joint].torque} at {robot.joints[joint]}'
    )


def nearest_held(robot: Robot, mae: Mae, start: Array, theta: Array) -> tuple[Array, str]:
    """Return the posture nearest to θ on the way from `start` [rad] (D,) that can be held.

    And what θ itself lacks, or ''.
    """
    missing = lacking(robot, mae, theta)
    if not missing:
        return theta, ''
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        share = 0.5 * (low + high)
        held = not lacking(robot, mae, start + share * (theta - start))
        low, high = (share, high) if held else (low, share)
    return start + low * (theta - start), f'the muscles lack {missing} there'


def way(robot: Robot, mae: Mae, start: Array, theta: Array) -> Array:
    """Return postures that lead from `start` to θ [rad] (D,), the last of them θ, (K, D)."""
    if robot.used.all():
        return theta[None]
    # Only here, so that an arm with all its muscles does without scipy.
    from scipy.sparse.csgraph import dijkstra

    limits, joints = robot.tension, np.eye(robot.joint_count)
    radian = robot.kinematics.radian
    at_stop = AT_STOP * radian
    most = limits.bias + USED * (limits.limit - limits.bias)

    def missing(postures: Array) -> Array:
        pulls = np.broadcast_to(limits.bias, (len(postures), robot.muscle_count))
        found = []
        for at, jacobian in zip(postures, radian * mae.muscle_jacobian(postures, pulls)):
            # A stop is a muscle that pulls away from it.
            low, high = at < robot.lower + at_stop, at > robot.upper - at_stop
            stops = np.vstack([-joints[low], joints[high]])
            none = np.zeros(len(stops))
            ends = np.concatenate([limits.bias, none]), np.concatenate([most, none + STOP])
            torque = radian * robot.kinematics.holding_torque(at)
            found.append(least_tension(np.vstack([jacobian, stops]), torque, *ends).missing_torque)
        m = np.abs(found).max(axis=1)
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
    # Where the arm leans on a stop, a part of the roadmap does as well.
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
    looked = {(0, 1), (1, 0)}
    path = [0, 1]
    for _ in range(LOOKS):
        before = dijkstra(price, indices=[0], return_predecessors=True)[1][0]
        path = [1]
        while path[-1] != 0:
            path.append(int(before[path[-1]]))
        path.reverse()
        fresh = [edge for edge in pairwise(path) if edge not in looked]
        if not fresh:
            break
        for i, j in fresh:
            price[i, j] = price[j, i] = cost(postures[i], postures[j])
            looked |= {(i, j), (j, i)}
    points = postures[path]
    # What is not needed is left out.
    k = 1
    while k < len(points) - 1:
        around = cost(points[k - 1], points[k]) + cost(points[k], points[k + 1])
        if cost(points[k - 1], points[k + 1]) <= around:
            points, k = np.delete(points, k, axis=0), max(k - 1, 1)
        else:
            k += 1
    return points[1:]
