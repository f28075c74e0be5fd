# SPDX-License-Identifier: Apache-2.0
"""The calibrated body: the geometric model with fitted parameters.

    l_i(θ, T) = f_i(θ; p + δ) − f_i(0; p + δ) − L_e(f_i, T e^{−μ s}; c e^κ) + o − r a + g_i(θ, T)

    f, L_e  length of the route through the attachment points, and elongation of the elastic element
    δ       errors of the attachment points p, a few millimetres
    κ       logarithmic errors of the elastic constants c, some per cent
    μ, s    tendon friction, and the direction of the last sliding (+1 wound in, −1 paid out);
            friction makes the motor-side tension T differ from the tension at the elastic element
    o       offset of the length sensor
    r, a    creep of the tendon per sample, and the number of samples that came after this one
    g       the remainder (`remainder`): what the parameters cannot express, such as the effect of
            tendons that wrap round bones

If all parameters and the remainder are zero, the calibrated body is the geometric model. The module
`fit` estimates the parameters. The springs of the joints do not change lengths; `springs` describes
their corrections.
"""

from __future__ import annotations

from copy import copy
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.body_model import springs
from musculoskeletal_ae.body_model.posture_regression import PostureRegression
from musculoskeletal_ae.body_model.remainder import Remainder
from musculoskeletal_ae.robot.description import RoutePoint
from musculoskeletal_ae.robot.joint_elasticity import JointElasticity
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.series_elastic import SeriesElastic
from musculoskeletal_ae.signals.friction import LARGEST_GAIN, Transmission

#: clip the constants of a motor current, |γ|, |b|/T_limit and |F|/T_limit
#: (`signals.friction.Transmission`), to these values
LARGEST_DRIVE = np.array([LARGEST_GAIN, 1.0, 1.0])
#: clip the tendon friction |μ| to this, at which friction halves or doubles the tension along the
#: route
LARGEST_FRICTION = 0.7
#: clip the logarithmic errors |κ| of the elastic constants to this, a factor of about 4.5
LARGEST_LOG = 1.5


class Layout:
    """Layout of one muscle's parameter vector: where δ, κ, μ, o and r are in it.

    The docstring of the module explains the symbols. δ has three values for each route point. If
    tensions come from motor currents, the vector also contains the constants γ, b and F of
    `Transmission`.
    """

    def __init__(self, points: Ints, weights: Array, with_drive: bool = False) -> None:
        end = 3 * len(points)
        self.points = points  # indices of the muscle's route points
        #: factor with which each line between consecutive route points counts in the length
        self.weights = weights
        self.attachment = slice(0, end)  # errors δ of the attachment points [m]
        #: κ: logarithms of force, rate and wire_stretch relative to their nominal values
        self.elastic = slice(end, end + 3)
        #: tendon friction μ, length offset o [m], and creep r per sample [m]
        self.friction, self.offset, self.creep = end + 3, end + 4, end + 5
        #: γ, b/T_limit and F/T_limit of `Transmission` where motor currents are measured
        self.drive = slice(end + 6, end + 6 + 3 * with_drive)
        self.size = self.drive.stop


class Poses(NamedTuple):
    """Poses of pinocchio's joints in the root link's frame, and the extra length from wrapping."""

    rotation: Array  # rotation matrices of the J joints, (N, J, 3, 3)
    translation: Array  # positions of the joints [m], (N, J, 3)
    detour: Array  # length that wrapping adds to the straight lines of the nominal body [m], (N, M)


class CalibratedBody:
    """Computes muscle lengths of the calibrated body, and their derivatives by its parameters."""

    def __init__(self, robot: Robot, parameters: list[Array] | None = None) -> None:
        """Create a calibrated body.

        Args:
            robot: The geometric model.
            parameters: One vector for each muscle; None for zeros.
        """
        self.robot, routes = robot, robot.routes
        self._has_drive, limit = robot.tension_source.is_current, robot.description.tension.limit
        #: units of the constants γ, b and F of motor currents: 1, T_limit and T_limit, (3, M)
        self.drive_units: Array = np.array([np.ones_like(limit), limit, limit])
        self.layouts = list[Layout]()
        for m in range(robot.muscle_count):
            segments = np.flatnonzero(routes.muscle == m)
            points = np.union1d(routes.first[segments], routes.second[segments])
            # A muscle may have several branches. Nothing connects the last point of a branch to the
            # first point of the next, so this line keeps the factor 0.
            weights = np.zeros(len(points) - 1)
            weights[routes.first[segments] - points[0]] = routes.weight[segments]
            self.layouts.append(Layout(points, weights, self._has_drive))
        self.parameters = parameters or [np.zeros(layout.size) for layout in self.layouts]
        #: what the parameters cannot express; `lengths` includes it, `linearised` does not
        self.remainder = Remainder(robot.muscle_count)
        #: regressions from lengths to joint angles, which `estimated` combines with the body
        self.regressions: tuple[PostureRegression, ...] = ()
        #: joint-sensor offsets from which the next fit starts [rad], (D,)
        self.zero = np.zeros(robot.joint_count)
        #: corrections α and β of the joints' springs, from which the next fit starts, (2, D)
        self.springs = springs.none_learned(robot.joint_count)
        #: start of the next fit for each sample, by the bytes of its lengths: fitted θ (D,) and a
        #: row of `posture_model.Bent`
        self.last_postures: dict[bytes, tuple[Array, ...]] = {}

    def limb(self, joints: Ints, muscles: Ints) -> CalibratedBody:
        """Return the part of the body with these joints and muscles only, without its remainder."""
        parameters = [self.parameters[m] for m in muscles]
        return CalibratedBody(self.robot.limb(joints, muscles), parameters)

    def with_parameters(self, parameters: list[Array]) -> CalibratedBody:
        """Return a copy of the body with other parameters, one vector for each muscle."""
        body = copy(self)
        body.parameters = parameters
        return body

    @property
    def elasticity(self) -> JointElasticity:
        """The springs and dampers of the joints, with learned corrections."""
        return springs.learned(self.robot.kinematics.elasticity, self.springs)

    def shift(self, m: int) -> Array:
        """Return the shift δ of each of the P route points of muscle `m` [m], (P, 3)."""
        return self.parameters[m][self.layouts[m].attachment].reshape(-1, 3)

    def link_shifts(self, m: int) -> list[Array]:
        """Return how far one muscle's route points are displaced in their links' frames [m]."""
        points = [p for p in self.robot.description.routes[m] if isinstance(p, RoutePoint)]
        placed = (self.robot.kinematics.placement(p.link)[1] for p in points)
        return [at.rotation.T @ shift for at, shift in zip(placed, self.shift(m), strict=True)]

    def as_robot(self) -> Robot:
        """Return a robot with the fitted route points and springs."""
        shifts = (shift for m in range(self.robot.muscle_count) for shift in self.link_shifts(m))
        return self.robot.with_moved_points(shifts).with_elasticity(self.elasticity)

    def elastic(self, m: int) -> SeriesElastic:
        """Return the fitted elastic constants of muscle `m`, as arrays of shape ()."""
        nominal = self.robot.series_elastic
        log = self.parameters[m][self.layouts[m].elastic]
        force, rate, stretch = np.exp(np.clip(log, -LARGEST_LOG, LARGEST_LOG))
        return SeriesElastic(
            nominal.force[m] * force, nominal.rate[m] * rate, nominal.wire_stretch[m] * stretch
        )

    def frictions(self) -> Array:
        """Return the tendon friction μ of each muscle, (M,)."""
        return np.array([self.friction(m) for m in range(len(self.layouts))])

    def friction(self, m: int) -> float:
        """Return the fitted tendon friction μ of muscle `m`, clipped to ±LARGEST_FRICTION."""
        value = self.parameters[m][self.layouts[m].friction]
        return float(np.clip(value, -LARGEST_FRICTION, LARGEST_FRICTION))

    @property
    def drive(self) -> Array | None:
        """Scale error γ, offset b [N] and friction F [N] of every muscle's motor current, (3, M).

        `Transmission` explains them. The value is None if the robot has tension sensors.
        """
        count = len(self.layouts)
        return np.array([*map(self._drive, range(count))]).T if self._has_drive else None

    def _drive(self, m: int) -> Array:
        """Return the constants γ, b [N] and F [N] of one muscle's motor current, (3,)."""
        own = self.parameters[m][self.layouts[m].drive]
        drive: Array = self.drive_units[:, m] * np.clip(own, -LARGEST_DRIVE, LARGEST_DRIVE)
        return drive

    @property
    def transmission(self) -> Transmission:
        """The fitted relation between tension readings and the bone-side tension T_end."""
        return Transmission(self.frictions(), self.drive)

    def end(self, m: int, tension: Array, direction: Array) -> tuple[Array, Array]:
        """Return the bone-side end tension T_end of muscle `m` [N], (N,), and its derivatives.

        The derivatives are ∂T_end/∂(μ, γ, b/T_limit, F/T_limit), (N, 4), or, if the robot has
        tension sensors, ∂T_end/∂μ alone, (N, 1).

        Args:
            m: Index of the muscle.
            tension: Tension readings T or T_read [N], (N,).
            direction: Direction of sliding s, (N,).
        """
        passed = np.exp(-self.friction(m) * direction)
        if not self._has_drive:
            end = tension * passed
            return end, -(direction * end)[:, None]
        gain, offset, drive_friction = self._drive(m)
        scaled = np.exp(gain) * tension
        motor = scaled - offset - drive_friction * direction
        pulls = passed * (motor > 0.0)
        end = motor * pulls
        slopes = -direction * end, scaled * pulls, -pulls, -direction * pulls
        return end, np.stack(slopes, axis=1) * np.append(1.0, self.drive_units[:, m])

    def crept(self, age: Array) -> Array:
        """Return how much each muscle has crept since each sample [m], (N, M).

        Args:
            age: Number of samples that came after each sample, (N,).
        """
        rates = [p[at.creep] for p, at in zip(self.parameters, self.layouts, strict=True)]
        return age[:, None] * np.array(rates)

    def poses(self, theta: Array) -> Poses:
        """Return the joint poses at each row of θ (N, D), with θ = 0 as an additional last row."""
        theta, robot = np.vstack([theta, np.zeros(theta.shape[1])]), self.robot
        at = robot.kinematics.tree.joint_poses(theta)
        return Poses(at.rotation, at.translation, robot.routes.detours(theta))

    def _world(self, poses: Poses, m: int) -> tuple[Array, Array]:
        """Return a muscle's route points in the root link's frame, and their links' rotations.

        The points [m] have the shape (N, points, 3), and the rotations (N, points, 3, 3).
        """
        layout, routes = self.layouts[m], self.robot.routes
        joint = routes.joint[layout.points]
        turn = poses.rotation[:, joint]  # (N, P, 3, 3)
        local = routes.point[layout.points] + self.shift(m)
        return (turn @ local[:, :, None])[..., 0] + poses.translation[:, joint], turn

    def lengths(self, theta: Array, tension: Array, *direction: Array) -> tuple[Array, ...]:
        """Return muscle lengths l [m], (N, M), one array for each array in `direction`.

        The lengths do not include creep (see `crept`).

        Args:
            theta: Joint angles θ [rad], (N, D).
            tension: Tension readings T or T_read [N], (N, M).
            direction: Directions s of sliding in [−1, 1], (N, M) each. 0 lies midway between
                winding in and paying out.
        """
        result = tuple(np.empty_like(tension) for _ in direction)
        poses, remainder = self.poses(theta), self.remainder.at(theta, tension)
        for m, layout in enumerate(self.layouts):
            world, _ = self._world(poses, m)
            absolute = np.linalg.norm(world[:, 1:] - world[:, :-1], axis=-1) @ layout.weights
            absolute += poses.detour[:, m]
            absolute, at_zero = absolute[:-1], absolute[-1]
            fixed = absolute - at_zero + self.parameters[m][layout.offset] + remainder[:, m]
            elastic = self.elastic(m)
            for lengths, s in zip(result, direction, strict=True):
                end, _ = self.end(m, tension[:, m], s[:, m])
                lengths[:, m] = fixed - elastic.elongation(absolute, end)
        return result

    def estimated(self, theta: Array, tension: Array, length: Array) -> Array:
        """Return the estimate of θ from T and l [rad], (N, D), where the body estimates θ.

        It is the weighted mean of body and regressions (`posture_regression`).

        Args:
            theta: Estimate of the body [rad], (N, D).
            tension: Tension readings T or T_read [N], (N, M).
            length: Measured lengths [m], (N, M).
        """
        estimate = theta.copy()
        for regression in self.regressions:
            estimate[:, regression.joints] = regression.combined(theta, tension, length)
        return estimate

    def linearised(
        self,
        poses: Poses,
        tension: Array,
        direction: Array,
        m: int,
        age: Array | float = 0.0,
    ) -> tuple[Array, Array]:
        """Return the length [m] (N,) of one muscle, and its derivatives by its parameters (N, P).

        Args:
            poses: Joint poses at the postures θ, from `poses`.
            tension: T_i or T_read,i [N], (N,).
            direction: Direction of sliding s_i, (N,).
            m: Index i of the muscle.
            age: Number of samples that came after each sample, (N,).
        """
        layout, parameters = self.layouts[m], self.parameters[m]
        world, turn = self._world(poses, m)
        line = world[:, 1:] - world[:, :-1]
        norm = np.linalg.norm(line, axis=-1)
        along = line * (layout.weights / np.maximum(norm, 1e-9))[..., None]
        by_world_point = np.zeros_like(world)
        by_world_point[:, 1:] += along
        by_world_point[:, :-1] -= along
        by_point = (by_world_point[:, :, None] @ turn).reshape(len(world), -1)
        whole = norm @ layout.weights + poses.detour[:, m]
        absolute, at_zero = whole[:-1], whole[-1]
        elastic = self.elastic(m)
        end, by_losses = self.end(m, tension, direction)
        end = np.maximum(end, 0.0)
        length = absolute - at_zero - elastic.elongation(absolute, end)
        length = length + parameters[layout.offset]
        length -= age * parameters[layout.creep]
        slope = 1.0 - elastic.length_slope(end)
        jacobian = np.empty((len(length), layout.size))
        jacobian[:, layout.attachment] = slope[:, None] * by_point[:-1] - by_point[-1]
        jacobian[:, layout.elastic] = -elastic.by_logarithms(absolute, end)
        compliance = elastic.compliance(absolute, end)
        jacobian[:, layout.friction] = compliance * end * direction
        jacobian[:, layout.drive] = -compliance[:, None] * by_losses[:, 1:]
        jacobian[:, layout.offset], jacobian[:, layout.creep] = 1.0, -np.asarray(age)
        return length, jacobian
