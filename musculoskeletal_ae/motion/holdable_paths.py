# SPDX-License-Identifier: Apache-2.0
"""Finds out whether a posture is holdable, and finds holdable postures and paths.

All functions use the learned G and the least tensions within the limits. A posture is holdable if
the muscles hold it together with the stops of joints at their limits (`supporting_stops`). An arm
with isolated muscles falls where the remaining muscles cannot hold it, until a joint's stop
supports it. From there, the straight path to a target may lead through postures that are not
holdable. `way` returns the cheapest path through a roadmap of random postures, with

    cost of an edge = ∫ 1 + PRICE m(θ) ds,   m = max_j |τ_missing,j|

where τ_missing,j is the torque of joint j that muscles and joint stops do not provide. Tensions
are limited to T_bias + USED (T_limit − T_bias), so that the path keeps a reserve of tension. On an
edge, tendon friction opposes the motion (`PathLimits`), and the path keeps a reserve of torque:

    τ_reserve = SUPPORT σ d/‖d‖

d is the direction of the edge, and SUPPORT σ the torque by which the feedback supports its largest
shift (`feedback`). A path without this reserve can lead where friction and the errors of the
learned body, which the residual torque σ contains, stop the arm. If no path can keep the reserves,
the cost favours postures in which little torque is missing.

A joint that is at a stop at the start is also at this stop in some postures of the roadmap. An edge
is evaluated only if the cheapest path contains it (lazy roadmap, Bohlin and Kavraki 2000). Until
then, its cost is approximated from the postures at its ends.

If the muscles cannot move the arm along the path found, the motion is refused (`passable`).

`slowness` slows the motion along the path until the muscles can accelerate the arm.
"""

from itertools import pairwise

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion.feedback import largest_support
from musculoskeletal_ae.motion.trajectory import Setpoint
from musculoskeletal_ae.robot.joint_stops import AT_STOP, supporting_stops
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension

#: Refuse a path of an arm with isolated muscles if the others cannot exert more torque in the
#: direction of the motion than it needs, by this multiple of SUPPORT σ. SUPPORT is 2, so they need
#: σ more: the residual torque of the healthy arm.
RESERVE = 0.5
NOTABLE = 0.05  # treat a posture as not holdable if it lacks more torque than this [N·m]
HALVINGS = 6  # search for the last holdable posture of a path with this many bisection steps

#: charge one radian of a path that lacks 1 N·m like this many additional radians [1/(N·m)]
PRICE = 20.0
USED = 0.85  # let a path use this fraction of the tension range above T_bias, and keep the rest
POSTURES = 300  # draw this many random postures for the roadmap
NEIGHBOURS = 12  # connect each posture of the roadmap with this many neighbours
LOOKS = 40  # evaluate all edges of at most this many paths, then use the cheapest path found so far
SPACING = 0.15  # evaluate postures of an edge that are at most this far apart [rad]
#: assume full tendon friction for muscles whose length changes by much more than this with the
#: angle [m/rad]; less friction for other muscles, because their sliding direction is uncertain
CERTAIN = 0.005
#: assume this tendon friction μ if a network has learned none: typical of hand-built arms
FRICTION = 0.05


def lacking(robot: Robot, mae: Mae, theta: Array) -> str:
    """Return a text on the largest missing torque at θ [rad], (D,), or '' if θ is holdable."""
    limits, torque = robot.tension, robot.kinematics.holding_torque(theta)
    jacobian = mae.muscle_jacobian(theta, limits.bias)
    stops = supporting_stops(robot, theta)
    exertion = least_tension(jacobian, torque, limits.bias, limits.limit, stops=stops)
    return _torque_text(robot, np.abs(exertion.missing_torque))


def _torque_text(robot: Robot, missing: Array) -> str:
    """Return a text on the largest of the missing torques [N·m], (D,), or '' if it is small."""
    joint = int(missing.argmax())
    if missing[joint] <= NOTABLE:
        return ''
    return f'{robot.units[joint].torque_text(missing[joint])} at joint {robot.joints[joint]}'


def passable(robot: Robot, mae: Mae, path: Array) -> tuple[Array, str]:
    """Return the part of a path along which the muscles can move the arm, and what they then lack.

    The arm moves slowly. The muscles may use all their tensions, but the torque RESERVE · SUPPORT σ
    in the direction of the motion stays in reserve. Postures before the first holdable one do not
    count: an arm that has fallen has to leave its posture.

    Args:
        robot: The robot; isolated muscles have no tension.
        mae: The network in use.
        path: Postures [rad], (K, D), that straight lines connect.

    Returns:
        The path, or its first part, which may have the length 0; a text on the largest missing
        torque, or ''.
    """
    travelled = np.insert(np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum(), 0, 0.0)
    marks = np.linspace(0.0, travelled[-1], int(travelled[-1] / SPACING) + 2)
    postures = np.stack([np.interp(marks, travelled, angle) for angle in path.T], axis=1)
    begin = 0
    while begin < len(postures) - 2 and lacking(robot, mae, postures[begin]):
        begin += 1
    cost = PathCost(robot, mae, 1.0, RESERVE)
    missing = np.concatenate(
        [
            cost.missing_torques(theta[None], theta - before)
            for before, theta in pairwise(postures[begin:])
        ]
    )
    worst = missing[missing.max(axis=1).argmax()]
    if not (problem := _torque_text(robot, worst)):
        return path, ''
    last = begin + int((missing.max(axis=1) > NOTABLE).argmax())
    inner = path[1:][travelled[1:] < marks[last]]
    return np.vstack([path[:1], inner, postures[last]]), problem


def nearest_held(robot: Robot, mae: Mae, start: Array, theta: Array) -> tuple[Array, str]:
    """Return a holdable posture on the straight path from `start` to θ [rad], (D,).

    If θ is not holdable, a bisection between `start` and θ looks for the last holdable posture
    before θ, to which the muscles can also move an arm with isolated muscles. The bisection does
    not check `start` itself, and returns it if it finds no such posture.

    Returns:
        The posture, and a text on the missing torque at θ, or '' if θ is holdable.
    """
    missing = lacking(robot, mae, theta)
    if not missing:
        return theta, ''
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        share = 0.5 * (low + high)
        posture = start + share * (theta - start)
        is_holdable = not lacking(robot, mae, posture)
        if is_holdable and not robot.used.all():
            is_holdable = not passable(robot, mae, np.stack([start, posture]))[1]
        low, high = (share, high) if is_holdable else (low, share)
    return start + low * (theta - start), f'at the target, the muscles lack {missing}'


def way(robot: Robot, mae: Mae, start: Array, theta: Array) -> Array:
    """Return the way from `start` to θ on which the muscles hold the arm as well as possible.

    The path is straight if no muscle is isolated, or if the whole straight path is holdable.

    Returns:
        The postures [rad], (K, D), that straight lines connect, without `start` itself.
    """
    if robot.used.all():
        return theta[None]
    cost = PathCost(robot, mae)
    direct = cost.of_edge(start, theta)
    if direct <= np.linalg.norm(theta - start):
        return theta[None]
    path = Roadmap(robot, cost, start, theta, direct).cheapest_path()
    return _shortened(path, cost)[1:]


def tendon_friction(robot: Robot, mae: Mae) -> Array:
    """Return the tendon friction μ that plans assume, (M,): the learned one, or `FRICTION`."""
    return np.full(robot.muscle_count, FRICTION) if mae.touch is None else mae.touch.friction


class PathLimits:
    """The bone-side tensions that a moving arm may use.

        T_bias/loss ≤ T_end ≤ (T_bias + used (T_limit − T_bias))/loss,   loss = e^{μ s}

    Here `used` is USED, unless a caller needs no reserve. Tendon friction opposes the motion: it
    weakens a tendon that is wound in (s = 1), and a tendon that is drawn out (s = −1) resists with
    more than T_bias.
    """

    def __init__(self, robot: Robot, mae: Mae, used: float = USED) -> None:
        """Describe the limits; `used` is the usable fraction of the tension range above T_bias."""
        limits = robot.tension
        self._robot = robot
        self._low = limits.bias
        self._high = limits.bias + used * (limits.limit - limits.bias)
        self._friction = tendon_friction(robot, mae)

    def of(
        self, jacobian: Array, direction: Array, resistance: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Return the lowest and the highest bone-side tension [N] that may be used, (M,) each.

        Args:
            jacobian: Muscle Jacobian G [m/rad], (M, D).
            direction: Direction in which the joints move, (D,); 0 at rest. The length of this
                vector has no effect.
            resistance: Tension by which the lowest tension is raised [N], (M,).
        """
        length = max(float(np.linalg.norm(direction)), 1e-9)
        loss = np.exp(-self._friction * np.tanh(jacobian @ direction / (length * CERTAIN)))
        return np.minimum(self._low + resistance, self._high) / loss, self._high / loss

    def missing_in_motion(self, jacobian: Array, at: Setpoint, lag: float, slower: float) -> float:
        """Return the largest missing torque [N·m] at one instant of a motion.

        Args:
            jacobian: Muscle Jacobian G [m/rad], (M, D).
            at: The setpoint at this instant.
            lag: Time λ by which the muscle modules lag behind their commands [s].
            slower: Factor by which the motion is slowed; ∞ for a very slow motion.
        """
        robot = self._robot
        velocity, acceleration = at.velocity / slower, at.acceleration / slower**2
        paid_out = np.maximum(jacobian @ velocity, 0.0)
        ends = self.of(jacobian, at.velocity, robot.actuation.tension_of_lag(lag, paid_out))
        torque = robot.kinematics.inverse_dynamics(at.theta, velocity, acceleration)
        stops = supporting_stops(robot, at.theta, at.velocity)
        exertion = least_tension(jacobian, torque, *ends, stops=stops)
        return float(np.abs(exertion.missing_torque).max())


class PathCost:
    """Computes the cost of straight paths between postures.

    The cost of a path grows with its length, and with the missing torque, which neither the muscles
    nor the joint stops provide.
    """

    def __init__(self, robot: Robot, mae: Mae, used: float = USED, reserve: float = 1.0) -> None:
        """Describe how much the arm keeps in reserve along paths.

        Args:
            robot: The robot; isolated muscles have no tension.
            mae: The network in use.
            used: Usable fraction of the tension range above T_bias.
            reserve: Torque in reserve, as a multiple of SUPPORT σ.
        """
        self._robot, self._mae = robot, mae
        self._limits = PathLimits(robot, mae, used)
        #: torque of each joint that is kept in reserve if only this joint moves [N·m], (D,)
        self._reserve = reserve * largest_support(mae)

    def missing(self, postures: Array, direction: Array | None = None) -> Array:
        """Return the largest of `missing_torques` in each posture, m [N·m], (N,).

        Missing torques up to NOTABLE count as 0.
        """
        m = self.missing_torques(postures, direction).max(axis=1)
        return np.where(m > NOTABLE, m, 0.0)

    def missing_torques(self, postures: Array, direction: Array | None = None) -> Array:
        """Return the size of the missing torque of each joint in each posture [N·m], (N, D).

        Args:
            postures: Postures θ [rad], (N, D).
            direction: Direction in which the joints move slowly, (D,), of any length; None if they
                rest.
        """
        robot, bias = self._robot, self._robot.tension.bias
        moved = np.zeros(robot.joint_count) if direction is None else direction
        moved = moved / max(float(np.linalg.norm(moved)), 1e-9)
        reserve = self._reserve * moved
        tensions = np.broadcast_to(bias, (len(postures), robot.muscle_count))
        jacobians = self._mae.muscle_jacobian(postures, tensions)
        torques = []
        for theta, jacobian in zip(postures, jacobians):
            ends, stops = self._limits.of(jacobian, moved), supporting_stops(robot, theta, moved)
            torque = robot.kinematics.holding_torque(theta) + reserve
            exertion = least_tension(jacobian, torque, *ends, stops=stops)
            torques.append(exertion.missing_torque)
        return np.abs(torques)

    def of_edge(self, one: Array, other: Array) -> float:
        """Return the cost of the straight path between two postures θ [rad], (D,) each."""
        length = float(np.linalg.norm(other - one))
        shares = np.linspace(0.0, 1.0, int(length / SPACING) + 2)[:, None]
        m = self.missing(one + shares * (other - one), other - one)
        return length * (1.0 + PRICE * float(m.mean()))

    def of_ends(self, postures: Array) -> Array:
        """Return the cost of the edges between postures [rad], (N, D), as a matrix (N, N).

        The cost is approximated from the missing torque at both ends of an edge. It is 0 for
        postures between which the roadmap has no edge.
        """
        apart = np.linalg.norm(postures[:, None] - postures, axis=2)
        m = self.missing(postures)
        near = apart <= np.sort(apart, axis=1)[:, NEIGHBOURS, None]
        cost = apart * (1.0 + PRICE * 0.5 * (m[:, None] + m))
        return np.where(near | near.T, cost, 0.0)


class Roadmap:
    """Random postures with the costs of the edges between them.

    Posture 0 is the start of the path, and posture 1 its goal.
    """

    def __init__(
        self, robot: Robot, cost: PathCost, start: Array, theta: Array, direct: float
    ) -> None:
        """Draw the random postures, and approximate the costs of the edges between them.

        Args:
            robot: The robot.
            cost: Computes the costs.
            start: Start of the path [rad], (D,).
            theta: Goal of the path [rad], (D,).
            direct: Cost of the straight path from start to goal.
        """
        self._cost = cost
        self._postures = np.vstack([start, theta, _random_postures(robot, start)])
        self._price = cost.of_ends(self._postures)
        self._evaluated = set[tuple[int, int]]()
        self._set_price(0, 1, direct)

    def cheapest_path(self) -> Array:
        """Return the cheapest path as postures θ [rad], (K, D)."""
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
        """Return the indices of the postures on the path that is cheapest at the present costs."""
        # Import here, because scipy loads slowly, and an arm with all muscles does not need it.
        from scipy.sparse.csgraph import dijkstra

        before = dijkstra(self._price, indices=[0], return_predecessors=True)[1][0]
        path = [1]
        while path[-1] != 0:
            path.append(int(before[path[-1]]))
        return path[::-1]

    def _set_price(self, i: int, j: int, price: float) -> None:
        self._price[i, j] = price
        self._evaluated.add((i, j))


def _random_postures(robot: Robot, start: Array) -> Array:
    """Return random postures [rad], (POSTURES, D).

    A joint that is at a stop in `start` is placed at that stop in 30 % of the postures.
    """
    rng = np.random.default_rng(0)
    postures = robot.random_postures(POSTURES, rng)
    for joint in range(robot.joint_count):
        for stop in (robot.lower[joint], robot.upper[joint]):
            if abs(start[joint] - stop) < AT_STOP:
                postures[rng.random(POSTURES) < 0.3, joint] = stop
    return postures


def _shortened(path: Array, cost: PathCost) -> Array:
    """Remove postures from a path [rad], (K, D), as long as its cost does not increase."""
    k = 1
    while k < len(path) - 1:
        around = cost.of_edge(path[k - 1], path[k]) + cost.of_edge(path[k], path[k + 1])
        if cost.of_edge(path[k - 1], path[k + 1]) <= around:
            path, k = np.delete(path, k, axis=0), max(k - 1, 1)
        else:
            k += 1
    return path
