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
    cost = PathCost(robot, mae)
    direct = cost.of_edge(start, theta)
    if direct <= np.linalg.norm((theta - start) / robot.kinematics.radian):
        return theta[None]
    path = Roadmap(robot, cost, start, theta, direct).cheapest_path()
    return _shortened(path, cost)[1:]


class PathCost:
    """The cost of straight paths, by the torque that muscles and joint stops do not provide."""

    def __init__(self, robot: Robot, mae: Mae) -> None:
        self._robot, self._mae = robot, mae
        self._radian = robot.kinematics.radian
        limits = robot.tension
        self._most = limits.bias + USED * (limits.limit - limits.bias)

    def missing(self, postures: Array) -> Array:
        """Return m of postures [rad] (N, D): the largest missing torque [N·m], (N,)."""
        robot, low, high = self._robot, self._robot.tension.bias, self._most
        tensions = np.broadcast_to(low, (len(postures), robot.muscle_count))
        jacobians = self._radian * self._mae.muscle_jacobian(postures, tensions)
        torques = []
        for theta, jacobian in zip(postures, jacobians):
            # Model a stop as a muscle that pulls the joint away from it.
            stops = self._stops(theta)
            none = np.zeros(len(stops))
            ends = np.concatenate([low, none]), np.concatenate([high, none + STOP])
            torque = self._radian * robot.kinematics.holding_torque(theta)
            exertion = least_tension(np.vstack([jacobian, stops]), torque, *ends)
            torques.append(exertion.missing_torque)
        m = np.abs(torques).max(axis=1)
        return np.where(m > NOTABLE, m, 0.0)

    def _stops(self, theta: Array) -> Array:
        """Return G of the stops at which joints rest, (stops, D)."""
        robot, joints = self._robot, np.eye(self._robot.joint_count)
        at_stop = AT_STOP * self._radian
        is_low, is_high = theta < robot.lower + at_stop, theta > robot.upper - at_stop
        return np.vstack([-joints[is_low], joints[is_high]])

    def of_edge(self, one: Array, other: Array) -> float:
        """Return the cost of the straight path between two postures [rad], (D,) each."""
        length = float(np.linalg.norm((other - one) / self._radian))
        shares = np.linspace(0.0, 1.0, int(length / SPACING) + 2)[:, None]
        m = self.missing(one + shares * (other - one))
        return length * (1.0 + PRICE * float(m.mean()))

    def of_ends(self, postures: Array) -> Array:
        """Return the approximate cost between all postures [rad] (N, D), from the ends, (N, N)."""
        apart = np.linalg.norm((postures[:, None] - postures) / self._radian, axis=2)
        m = self.missing(postures)
        near = apart <= np.sort(apart, axis=1)[:, NEIGHBOURS, None]
        cost = apart * (1.0 + PRICE * 0.5 * (m[:, None] + m))
        return np.where(near | near.T, cost, 0.0)  # 0: no edge


class Roadmap:
    """Random postures between a start (number 0) and a goal (number 1), and the edges' costs."""

    def __init__(
        self, robot: Robot, cost: PathCost, start: Array, theta: Array, direct: float
    ) -> None:
        """Draw the postures; `direct` is the cost of the straight path to the goal θ."""
        self._cost = cost
        self._postures = np.vstack([start, theta, _random_postures(robot, start)])
        self._price = cost.of_ends(self._postures)
        self._evaluated = set[tuple[int, int]]()
        self._set_price(0, 1, direct)

    def cheapest_path(self) -> Array:
        """Return the postures of the cheapest path [rad], (K, D)."""
        path = [0, 1]
        for _ in range(LOOKS):
            path = self._apparently_cheapest()
            new_edges = [edge for edge in pairwise(path) if edge not in self._evaluated]
            if not new_edges:
                break
            for i, j in new_edges:
                self._set_price(i, j, self._cost.of_edge(self._postures[i], self._postures[j]))
        return self._postures[path]

    def _apparently_cheapest(self) -> list[int]:
        """Return the numbers of the postures of the cheapest path at the present costs."""
        # Import here, because an arm without isolated muscles does not need scipy.
        from scipy.sparse.csgraph import dijkstra

        before = dijkstra(self._price, indices=[0], return_predecessors=True)[1][0]
        path = [1]
        while path[-1] != 0:
            path.append(int(before[path[-1]]))
        return path[::-1]

    def _set_price(self, i: int, j: int, price: float) -> None:
        self._price[i, j] = self._price[j, i] = price
        self._evaluated |= {(i, j), (j, i)}


def _random_postures(robot: Robot, start: Array) -> Array:
    """Return random postures [rad] (POSTURES, D).

    In a part of them, joints that rest at a stop at the start stay there.
    """
    rng = np.random.default_rng(0)
    at_stop = AT_STOP * robot.kinematics.radian
    postures = robot.random_postures(POSTURES, rng)
    for joint in range(robot.joint_count):
        for stop in (robot.lower[joint], robot.upper[joint]):
            if abs(start[joint] - stop) < at_stop[joint]:
                postures[rng.random(POSTURES) < 0.3, joint] = stop
    return postures


def _shortened(path: Array, cost: PathCost) -> Array:
    """Return a path [rad] (K, D) without the postures that do not make it cheaper."""
    k = 1
    while k < len(path) - 1:
        around = cost.of_edge(path[k - 1], path[k]) + cost.of_edge(path[k], path[k + 1])
        if cost.of_edge(path[k - 1], path[k + 1]) <= around:
            path, k = np.delete(path, k, axis=0), max(k - 1, 1)
        else:
            k += 1
    return path
