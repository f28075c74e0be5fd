# SPDX-License-Identifier: Apache-2.0
"""The corrected body: the geometric model with other constants, plus a smooth rest.

    l_i(θ, T) = f_i(θ; p + δ) − f_i(0; p + δ) − L_e(f_i, T e^{−μ s}; c e^κ) + o + ψ(θ)ᵀ v

Attachments p are off by millimetres (δ), elastic constants c by some per cent (κ), the length
sensor by its zero (o), wires wrap round bones that the straight lines do not know (ψ, random
Fourier features over the joints that the muscle crosses), and a wire that slides reads a tension
that differs from the one at its elastic unit (μ: friction of the route, s: direction of the last
sliding, +1 wound in, −1 paid out). All parameters zero is the geometric model itself.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.robot.kinematics import JointPoses
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.series_elastic import SeriesElastic

FEATURES = 60  # of the smooth rest, per muscle
WIDTH = 0.35  # of the kernel that they approximate, as a share of the joint ranges
# More than twice the tension at the elastic unit than at the motor is no friction.
LARGEST_FRICTION = 0.5
LARGEST_LOG = 1.5


class Layout:
    """Where the parameters of one muscle are.

    Attributes:
        points: Its route points.
        attachment: δ, three per route point [m].
        elastic: κ: logarithms of force, rate, wire_stretch over the nominal ones.
        friction: μ.
        offset: o [m].
        rest: v [m].
        size: Number of parameters.
    """

    def __init__(self, points: Ints, features: int) -> None:
        """Lay out δ, κ, μ, o, v in this order."""
        end = 3 * len(points)
        self.points = points
        self.attachment, self.elastic = slice(0, end), slice(end, end + 3)
        self.friction, self.offset = end + 3, end + 4
        self.size = end + 5 + features
        self.rest = slice(end + 5, self.size)


class CorrectedBody:
    """Lengths of the corrected body, and how they change with its parameters.

    Attributes:
        robot: The geometric model that is corrected.
        layouts: Where each muscle's parameters are.
        parameters: One vector per muscle.
    """

    def __init__(self, robot: Robot, parameters: list[Array] | None = None, seed: int = 0) -> None:
        """Start from the geometric model, or from given parameters.

        Args:
            robot: The geometric model.
            parameters: One vector per muscle; zero by default.
            seed: Draws the smooth features.
        """
        self.robot = robot
        routes, kin = robot.routes, robot.kinematics
        span = robot.upper - robot.lower
        rng = np.random.default_rng([seed, 0xF0])
        self.layouts: list[Layout] = []
        self._frequency: list[Array] = []
        self._phase: list[Array] = []
        for m in range(robot.muscle_count):
            segments = np.flatnonzero(routes.muscle == m)
            points = np.append(routes.first[segments], routes.second[segments[-1]])
            moved = kin.moved_by[routes.joint[points]]
            crossed = moved.any(axis=0) & ~moved.all(axis=0)
            features = FEATURES if crossed.any() else 0
            self.layouts.append(Layout(points, features))
            frequency = rng.normal(0.0, 1.0, (features, robot.joint_count))
            self._frequency.append(frequency * crossed / (WIDTH * span))
            self._phase.append(rng.uniform(0.0, 2.0 * np.pi, features))
        self.parameters = parameters or [np.zeros(layout.size) for layout in self.layouts]

    # -- parts ----------------------------------------------------------------------------------

    def elastic(self, m: int) -> SeriesElastic:
        """Return the constants of one muscle, arrays of shape ()."""
        nominal = self.robot.series_elastic
        log = self.parameters[m][self.layouts[m].elastic]
        force, rate, stretch = np.exp(np.clip(log, -LARGEST_LOG, LARGEST_LOG))
        return SeriesElastic(
            nominal.force[m] * force, nominal.rate[m] * rate, nominal.wire_stretch[m] * stretch
        )

    def friction(self, m: int) -> float:
        """Return μ of one muscle."""
        value = self.parameters[m][self.layouts[m].friction]
        return float(np.clip(value, -LARGEST_FRICTION, LARGEST_FRICTION))

    def poses(self, theta: Array) -> JointPoses:
        """Return the joint poses of θ (N, D) and, in the last place, of θ = 0."""
        return self.robot.kinematics.joint_poses(np.vstack([theta, np.zeros(theta.shape[1])]))

    def _world(self, poses: JointPoses, m: int) -> tuple[Array, Array]:
        """Return the route's points in the root link's frame, and how their links are turned."""
        layout, routes = self.layouts[m], self.robot.routes
        joint = routes.joint[layout.points]
        shift = self.parameters[m][layout.attachment].reshape(-1, 3)
        turn = poses.rotation[:, joint]  # (N, P, 3, 3)
        local = routes.point[layout.points] + shift
        return (turn @ local[:, :, None])[..., 0] + poses.translation[:, joint], turn

    def _smooth(self, theta: Array, m: int) -> Array:
        """Return ψ(θ) − ψ(0) of one muscle, shape (N, features)."""
        scale = np.sqrt(2.0 / max(1, len(self._phase[m])))
        values = np.cos(theta @ self._frequency[m].T + self._phase[m]) - np.cos(self._phase[m])
        return scale * values

    # -- lengths --------------------------------------------------------------------------------

    def lengths(self, theta: Array, tension: Array, *direction: Array) -> tuple[Array, ...]:
        """Return l [m] (N, M) at θ [rad] (N, D) and the motors' T [N] (N, M).

        Args:
            theta: θ.
            tension: T where the modules measure it.
            direction: For each result s in [−1, 1], shape (N, M); 0 is the mean of both directions.
        """
        result = tuple(np.empty_like(tension) for _ in direction)
        poses = self.poses(theta)
        for m, layout in enumerate(self.layouts):
            world, _ = self._world(poses, m)
            absolute = np.linalg.norm(world[:, 1:] - world[:, :-1], axis=-1).sum(axis=1)
            absolute, at_zero = absolute[:-1], absolute[-1]
            fixed = absolute - at_zero + self.parameters[m][layout.offset]
            fixed += self._smooth(theta, m) @ self.parameters[m][layout.rest]
            elastic, friction = self.elastic(m), self.friction(m)
            for lengths, s in zip(result, direction, strict=True):
                end = tension[:, m] * np.exp(-friction * s[:, m])
                lengths[:, m] = fixed - elastic.elongation(absolute, end)
        return result

    def linearised(
        self, poses: JointPoses, theta: Array, tension: Array, direction: Array, m: int
    ) -> tuple[Array, Array]:
        """Return l_i [m] (N,) of one muscle and ∂l_i/∂parameters (N, P).

        Args:
            poses: Of θ, from `poses`.
            theta: θ [rad], shape (N, D).
            tension: T_i at the motor [N], shape (N,).
            direction: s_i in [−1, 1], shape (N,).
            m: The muscle.
        """
        layout, parameters = self.layouts[m], self.parameters[m]
        world, turn = self._world(poses, m)
        line = world[:, 1:] - world[:, :-1]
        norm = np.linalg.norm(line, axis=-1)
        along = line / np.maximum(norm, 1e-9)[..., None]
        pull = np.zeros_like(world)
        pull[:, 1:] += along
        pull[:, :-1] -= along
        by_point = (pull[:, :, None] @ turn).reshape(len(world), -1)
        absolute, at_zero = norm[:-1].sum(axis=1), norm[-1].sum()
        elastic = self.elastic(m)
        end = np.maximum(tension * np.exp(-self.friction(m) * direction), 0.0)
        smooth = self._smooth(theta, m)
        length = absolute - at_zero - elastic.elongation(absolute, end)
        length = length + parameters[layout.offset] + smooth @ parameters[layout.rest]
        slope = 1.0 - elastic.length_slope(end)
        jacobian = np.empty((len(theta), layout.size))
        jacobian[:, layout.attachment] = slope[:, None] * by_point[:-1] - by_point[-1]
        jacobian[:, layout.elastic] = np.stack(
            [
                end / (elastic.force + end) / elastic.rate,
                np.log1p(end / elastic.force) / elastic.rate,
                -elastic.wire_stretch * absolute * end,
            ],
            axis=1,
        )
        jacobian[:, layout.friction] = elastic.compliance(absolute, end) * end * direction
        jacobian[:, layout.offset] = 1.0
        jacobian[:, layout.rest] = smooth
        return length, jacobian
