# SPDX-License-Identifier: Apache-2.0
"""One emulated individual: how its true body differs from the geometric model.

The seed selects the individual, and `Spread` lists the differences. Masses and link lengths equal
those of the model (paper, §I: assumed correct).
"""

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.design.route_jumps import MOST_DRAWS, newly_jumping
from musculoskeletal_ae.emulator.kin.wrapping import Placed, Tree, WrappedRoutes, wrapped_lengths
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.series_elastic import SeriesElastic
from musculoskeletal_ae.robot.wrapping import WrapObjects

THICKEST_BONE = 0.04  # limit the radius of a bone's head to this [m]


@dataclass(frozen=True)
class Spread:
    """Sizes of the differences between individuals, calibrated once (`bench/calibration.py`)."""

    attachment: float = 0.0085  # standard deviation of each coordinate of each route point [m]
    #: The radius of a bone's head is this quantile, over the joint range, of the distance between
    #: the straight tendon and the joint centre; 0 for no wrapping.
    wrap: float = 0.4
    elastic: float = 0.15  # standard deviation of the logarithm of each elastic constant
    tendon_friction: float = 0.095  # mean relative tension loss along the route (capstan exponent)
    #: mean Coulomb torque of a joint, as a share of its load (`Robot.joint_load`): the largest
    #: holding torque, plus the torques of all muscles at T_bias
    joint_friction: float = 0.0133
    length_bias: float = 0.0005  # standard deviation of each length sensor's offset [m]
    tension_bias: float = 1.0  # standard deviation of each tension sensor's offset [N]
    tension_gain: float = 0.01  # standard deviation of each tension sensor's relative gain error
    springs: float = 0.2  # standard deviation of the logarithm of each joint's spring stiffness
    #: standard deviation of the angle at which each spring is at rest [rad]
    spring_rest: float = 0.05


#: sizes with which an individual equals the geometric model and has no friction
NOMINAL = Spread(**{field.name: 0.0 for field in fields(Spread)})


class Individual:
    """True routes, elastic constants, friction and sensor errors of one arm."""

    def __init__(self, robot: Robot, seed: int, spread: Spread | None = None) -> None:
        """Draw an individual.

        Args:
            robot: The geometric model, from which the individual differs.
            seed: Selects the individual.
            spread: Sizes of the differences; by default the calibrated ones.
        """
        spread = spread or Spread()
        rng = np.random.default_rng([seed, 0xB0D1])
        muscles, kin, nominal = robot.muscle_count, robot.kinematics, robot.routes
        self._kinematics, self._muscles = kin, muscles
        # Numba compiles separate code for each memory order, so use a single one.
        placements = (
            np.ascontiguousarray(kin.tree.placement_rotation),
            kin.tree.placement_translation,
        )
        tree = Tree(
            kin.tree.parent.astype(np.int64), *placements, kin.tree.local_axis, kin.tree.prismatic
        )
        off = rng.normal(0.0, spread.attachment, nominal.point.shape)
        thickness = rng.uniform(0.8, 1.2, len(nominal.first))

        def routes(off: Array) -> WrappedRoutes:
            """Return the true routes for deviations of the route points [m], (P, 3)."""
            point = nominal.point + off
            objects = _objects(robot, point, spread.wrap, seed, thickness)
            segments = nominal.first, nominal.second, nominal.muscle, nominal.weight
            return WrappedRoutes(tree, nominal.joint, point, *segments, objects)

        self.routes = routes(off)
        if nominal.objects is not None:
            again = np.random.default_rng([seed, 0x1A7])
            redrawn = again.normal(0.0, spread.attachment, (MOST_DRAWS, *off.shape))
            self._redraw_jumping_routes(robot, off, redrawn, routes)
        factor = np.exp(rng.normal(0.0, spread.elastic, (3, muscles)))
        constants = zip(vars(robot.series_elastic).values(), factor, strict=True)
        self.elastic = SeriesElastic(*(each * scale for each, scale in constants))
        #: capstan exponent of each muscle, (M,)
        self.tendon_friction: Array = spread.tendon_friction * rng.uniform(0.5, 1.5, muscles)
        theta = robot.random_postures(200, rng)
        #: load of each joint by weight and muscles at T_bias [N·m], (D,)
        self.joint_load = robot.joint_load(
            kin.holding_torque(theta), nominal.muscle_jacobian(theta)
        )
        relative_friction = rng.uniform(0.5, 1.5, len(self.joint_load))
        #: Coulomb torque of each joint [N·m], (D,)
        self.joint_friction: Array = spread.joint_friction * self.joint_load * relative_friction
        #: errors of the length sensors: offsets [m], (M,)
        self.length_bias: Array = rng.normal(0.0, spread.length_bias, muscles)
        #: errors of the tension sensors: offsets [N], (M,)
        self.tension_bias: Array = rng.normal(0.0, spread.tension_bias, muscles)
        #: errors of the tension sensors: factors of the tension, (M,)
        self.tension_gain: Array = 1.0 + rng.normal(0.0, spread.tension_gain, muscles)
        self.length_at_zero: Array = self.absolute_lengths(np.zeros((1, robot.joint_count)))[0]
        drawn = np.random.default_rng([seed, 0x5B]).normal(size=(2, robot.joint_count))
        #: springs and dampers of the joints
        self.joint_elasticity = kin.elasticity.deviating(
            np.exp(spread.springs * drawn[0]), spread.spring_rest * drawn[1]
        )

    def _redraw_jumping_routes(
        self, robot: Robot, off: Array, again: Array, routes: Callable[[Array], WrappedRoutes]
    ) -> None:
        """Redraw the route points of tendons whose length jumps.

        If a tendon slips over the end of an object that it wraps around, its length jumps by
        centimetres. No one would route a tendon there. Tendons that also jump in the geometric
        model are not redrawn. If all deviations in `again` are used up, some tendons may still
        jump.

        Args:
            robot: The geometric model.
            off: Deviations of the route points [m], (P, 3), changed in place.
            again: Deviations to try one after another [m], (..., P, 3).
            routes: Function that returns the true routes for deviations.
        """
        nominal = robot.routes
        for drawn in again:
            wrong = newly_jumping(self.absolute_lengths, nominal.absolute_lengths, robot)
            if not wrong.any():
                return
            places = wrong[nominal.muscle]
            for ends in (nominal.first[places], nominal.second[places]):
                off[ends] = drawn[ends]
            self.routes = routes(off)

    def _evaluate(self, theta: Array) -> tuple[Array, Array]:
        q = np.ascontiguousarray(self._kinematics.tree.angles(theta))
        return wrapped_lengths(self.routes, q, Placed.empty(self.routes, self._muscles))

    def absolute_lengths(self, theta: Array) -> Array:
        """Return the true route lengths [m], (N, M), for joint angles θ [rad], (N, D)."""
        return self._evaluate(theta)[0]

    def muscle_jacobian(self, theta: Array) -> Array:
        """Return the true muscle Jacobian ∂l/∂θ [m/rad], (N, M, D), for joint angles (N, D)."""
        return self._kinematics.tree.of_theta(self._evaluate(theta)[1], theta)

    def muscle_lengths(self, theta: Array, tension: Array) -> Array:
        """Return the true muscle lengths [m], (N, M), without friction and sensor errors.

        Args:
            theta: Joint angles [rad], (N, D).
            tension: Tensions [N], (N, M).
        """
        absolute = self.absolute_lengths(theta)
        return absolute - self.length_at_zero - self.elastic.elongation(absolute, tension)


def _objects(
    robot: Robot, point: Array, quantile: float, seed: int, thickness: Array
) -> WrapObjects:
    """Return the object that each segment of the routes wraps around.

    A segment wraps around the object that the robot description states, or else around the head of
    a bone. The radius of a described object differs slightly from the description, and is small
    enough that the object does not enclose the true route points.

    A bone's head is centred at the revolute joint nearest to the tendon. The head is smaller than
    `quantile` demands if the tendon could otherwise slip over to the other side, or if the head
    would enclose the described route points.

    Args:
        robot: The geometric model.
        point: True route points in the frames of their joints [m], (P, 3).
        quantile: Approximate share of the postures in which a tendon touches a bone's head. With 0,
            bones have no heads, and described objects are unchanged.
        seed: Selects the individual.
        thickness: Factor of the radius of the bone's head for each segment.
    """
    kin, routes = robot.kinematics, robot.routes
    count = len(routes.first)
    nothing, nowhere = np.zeros((count, 3)), np.full((count, 3), np.nan)
    objects = WrapObjects(
        np.zeros(count, np.int64), nothing, 1.0 * nothing, nowhere, np.zeros(count, np.int64),
        np.zeros(count), np.zeros(count, dtype=bool),
    )  # fmt: skip
    if routes.objects is not None:
        for whole, part in zip(objects, routes.objects, strict=True):
            whole[routes.wrapping] = part
    if quantile <= 0.0:
        return objects
    poses = kin.tree.joint_poses(robot.random_postures(300, np.random.default_rng(0)))
    points, true = routes.placed(poses), routes.placed(poses, point)
    described = np.random.default_rng([seed, 0x3AB]).uniform(0.9, 1.1, count)
    for s, ends in enumerate(zip(routes.first, routes.second, strict=True)):
        if objects.swivels[s]:
            continue  # keep the radius of a pulley, because its tendon enters it at the centre
        if objects.radius[s] > 0.0:
            turn, origin = (part[:, objects.joint[s]] for part in poses[:2])
            away = true[:, ends] - (origin + turn @ objects.centre[s])[:, None]
            axis = (turn @ objects.axis[s])[:, None]
            away -= (away * axis).sum(axis=-1, keepdims=True) * axis
            least = np.linalg.norm(away, axis=-1).min()
            scale = min(described[s], 0.95 * least / objects.radius[s])
            objects.radius[s] *= scale
            if objects.side_joint[s] == objects.joint[s]:
                # A side point inside the object, which makes it a ring, stays inside.
                objects.side[s] *= scale
            continue
        between = (
            kin.tree.descends_from[routes.joint[ends[0]]]
            ^ kin.tree.descends_from[routes.joint[ends[1]]]
        )
        best = np.inf
        for joint in np.flatnonzero(between & ~kin.tree.prismatic):
            start, end = (points[:, e] - poses.translation[:, joint] for e in ends)
            line = end - start
            share = -np.sum(start * line, axis=1) / np.sum(line * line, axis=1)
            nearest = start + np.clip(share, 0.0, 1.0)[:, None] * line
            distance = np.linalg.norm(nearest, axis=1)
            if np.median(distance) < best:
                best = float(np.median(distance))
                least = min(np.linalg.norm(e, axis=1).min() for e in (start, end))
                touching = thickness[s] * np.quantile(distance, quantile)
                objects.joint[s] = joint
                objects.radius[s] = min(touching, 2.0 * distance.min(), 0.8 * least, THICKEST_BONE)
    return objects
