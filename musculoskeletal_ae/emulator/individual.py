# SPDX-License-Identifier: Apache-2.0
"""One individual arm: how the true body that `seed` picks differs from its geometric model.

Attachments are off by millimetres, wires wrap round bone heads that the straight-line model does
not know, elastic units and wires have their own constants, cables and joints rub, sensors have
bias. Masses and link lengths are the model's (paper, Introduction: assumed correct).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.emulator.wrapping import Tree, WrappedRoutes, wrapped_lengths
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.series_elastic import SeriesElastic
from musculoskeletal_ae.robot.wrapping import WrapObjects

THICKEST_BONE = 0.04  # [m] radius of a bone's head


@dataclass(frozen=True)
class Spread:
    """How much individuals differ, calibrated once (`bench/calibration.py`).

    Attributes:
        attachment: Standard deviation of each coordinate of each route point [m].
        wrap: Quantile, over the joint range, of the straight line's distance from the joint
            centre that the bone's head reaches; 0 for no wrapping.
        elastic: Standard deviation of the logarithm of each elastic constant.
        cable_friction: Mean of the relative tension loss along the route (capstan exponent).
        joint_friction: Mean Coulomb torque of a joint, as a share of the largest torque that
            the arm's weight puts on any joint.
        length_bias: Standard deviation of each length sensor's zero error [m].
        tension_bias: Standard deviation of each tension sensor's zero error [N].
        tension_gain: Standard deviation of each tension sensor's relative gain error.
    """

    attachment: float = 0.0085
    wrap: float = 0.4
    elastic: float = 0.15
    cable_friction: float = 0.095
    joint_friction: float = 0.02
    length_bias: float = 0.0005
    tension_bias: float = 1.0
    tension_gain: float = 0.01


#: No difference at all: the geometric model itself as a body, without friction.
NOMINAL = Spread(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Individual:
    """True routes, elastic constants, friction and sensor errors of one arm.

    Attributes:
        elastic: True elastic constants of the M muscles.
        cable_friction: Capstan exponent of each muscle's route, shape (M,).
        joint_friction: Coulomb torque of each joint [N·m], shape (D,), order of θ.
        length_bias: Zero error of the length sensors [m], shape (M,).
        tension_bias: Zero error of the tension sensors [N], shape (M,).
        tension_gain: Gain of the tension sensors, shape (M,).
    """

    def __init__(self, robot: Robot, seed: int, spread: Spread | None = None) -> None:
        """Draw the individual.

        Args:
            robot: Geometric model that it differs from.
            seed: Which individual.
            spread: How much individuals differ; the calibrated one by default.
        """
        spread = spread or Spread()
        rng = np.random.default_rng([seed, 0xB0D1])
        muscles = robot.muscle_count
        kin = robot.kinematics
        self._kinematics = kin
        self.tree = Tree(
            kin.parent.astype(np.int64),
            kin.placement_rotation,
            kin.placement_translation,
            kin.local_axis,
            kin.prismatic,
        )
        nominal = robot.routes
        shift = rng.normal(0.0, spread.attachment, nominal.point.shape)
        sphere_joint, radius = _bone_heads(robot, spread.wrap, rng)
        self.routes = WrappedRoutes(
            nominal.joint.astype(np.int64),
            nominal.point + shift,
            nominal.first.astype(np.int64),
            nominal.second.astype(np.int64),
            nominal.muscle.astype(np.int64),
            sphere_joint,
            radius,
            _objects(robot, nominal.point + shift, spread.wrap > 0.0, seed),
        )
        factor = np.exp(rng.normal(0.0, spread.elastic, (3, muscles)))
        nominal_elastic = robot.series_elastic
        self.elastic = SeriesElastic(
            nominal_elastic.force * factor[0],
            nominal_elastic.rate * factor[1],
            nominal_elastic.wire_stretch * factor[2],
        )
        self.cable_friction: Array = spread.cable_friction * rng.uniform(0.5, 1.5, muscles)
        largest = np.abs(kin.holding_torque(robot.random_postures(200, rng))).max()
        self.joint_friction: Array = (
            spread.joint_friction * largest * rng.uniform(0.5, 1.5, robot.joint_count)
        )
        self.length_bias: Array = rng.normal(0.0, spread.length_bias, muscles)
        self.tension_bias: Array = rng.normal(0.0, spread.tension_bias, muscles)
        self.tension_gain: Array = 1.0 + rng.normal(0.0, spread.tension_gain, muscles)
        self.length_at_zero: Array = self.absolute_lengths(np.zeros((1, robot.joint_count)))[0]

    def _evaluate(self, theta: Array) -> tuple[Array, Array]:
        q = self._kinematics.tree_angles(theta)
        return wrapped_lengths(self.tree, self.routes, len(self.cable_friction), q)

    def absolute_lengths(self, theta: Array) -> Array:
        """Return the true route lengths [m], θ (N, D) gives (N, M)."""
        return self._evaluate(theta)[0]

    def muscle_jacobian(self, theta: Array) -> Array:
        """Return the true G [m/rad], θ (N, D) gives (N, M, D)."""
        return self._kinematics.of_theta(self._evaluate(theta)[1])

    def muscle_lengths(self, theta: Array, tension: Array) -> Array:
        """Return the true l [m] without friction and sensor error, θ (N, D), T (N, M)."""
        absolute = self.absolute_lengths(theta)
        return absolute - self.length_at_zero - self.elastic.elongation(absolute, tension)


def _objects(robot: Robot, point: Array, differs: bool, seed: int) -> WrapObjects:
    """Return what the description wraps each segment round, a little thicker or thinner.

    Never so thick that the true route's points come to lie inside it.
    """
    kin, routes = robot.kinematics, robot.routes
    count = len(routes.first)
    centre, axis, side = np.zeros((3, count, 3))
    objects = WrapObjects(np.zeros(count, np.int64), centre, axis, side, np.zeros(count))
    if routes.objects is None:
        return objects
    for whole, part in zip(objects, routes.objects, strict=True):
        whole[routes.wrapping] = part
    if differs:
        poses = kin.joint_poses(robot.random_postures(300, np.random.default_rng(0)))
        thickness = np.random.default_rng([seed, 0x3AB]).uniform(0.9, 1.1, count)
        for s in routes.wrapping:
            turn = poses.rotation[:, objects.joint[s]]
            centre = poses.translation[:, objects.joint[s]] + turn @ objects.centre[s]
            least = np.inf
            for end in (routes.first[s], routes.second[s]):
                joint = routes.joint[end]
                at = poses.translation[:, joint] + poses.rotation[:, joint] @ point[end]
                away, axis = at - centre, turn @ objects.axis[s]
                away = away - (away * axis).sum(axis=1, keepdims=True) * axis
                least = min(least, float(np.linalg.norm(away, axis=1).min()))
            objects.radius[s] = min(objects.radius[s] * thickness[s], 0.95 * least)
    return objects


def _bone_heads(robot: Robot, quantile: float, rng: np.random.Generator) -> tuple[Ints, Array]:
    """Return for each segment the joint whose head it may wrap round, and the head's radius.

    The head sits at the joint centre nearest to the line. It is thick enough to touch the line in
    a share `quantile` of the postures, but never so thick that the wire could slip over to its
    other side, and never reaches an attachment.
    """
    kin, routes = robot.kinematics, robot.routes
    sphere_joint = np.zeros(len(routes.first), dtype=np.int64)
    radius = np.zeros(len(routes.first))
    if quantile <= 0.0:
        return sphere_joint, radius
    postures = robot.random_postures(300, np.random.default_rng(0))
    poses, points = kin.joint_poses(postures), routes.points(postures)
    # The description says of some segments what they wrap round.
    described = set(routes.wrapping.tolist())
    thickness = rng.uniform(0.8, 1.2, len(routes.first))
    for s, (first, second) in enumerate(zip(routes.first, routes.second, strict=True)):
        moved = kin.moved_by[routes.joint[first]] ^ kin.moved_by[routes.joint[second]]
        crossed = [i for i in range(1, len(kin.parent)) if moved[kin.theta_index[i]]]
        crossed = [i for i in crossed if not kin.prismatic[i]]
        best = np.inf
        for joint in crossed if s not in described else ():
            centre = poses.translation[:, joint]
            start, end = points[:, first] - centre, points[:, second] - centre
            line = end - start
            share = -np.sum(start * line, axis=1) / np.sum(line * line, axis=1)
            share = np.clip(share, 0.0, 1.0)
            distance = np.linalg.norm(start + share[:, None] * line, axis=1)
            if np.median(distance) < best:
                best = float(np.median(distance))
                ends = np.minimum(np.linalg.norm(start, axis=1), np.linalg.norm(end, axis=1))
                sphere_joint[s] = joint
                radius[s] = min(
                    thickness[s] * np.quantile(distance, quantile),
                    2.0 * distance.min(),
                    0.8 * ends.min(),
                    THICKEST_BONE,
                )
    return sphere_joint, radius
