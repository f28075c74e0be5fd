# SPDX-License-Identifier: Apache-2.0
"""The calibrated body: the geometric model with other constants, plus a residual model.

    l_i(θ, T) = f_i(θ; p + δ) − f_i(0; p + δ) − L_e(f_i, T e^{−μ s}; c e^κ) + o − r a + ψ(θ)ᵀ v

Attachments p are off by millimetres (δ), elastic constants c by some per cent (κ), and the length
sensor by an offset (o). Tendons wrap round bones that the straight lines do not know: that is the
residual model (ψ, random Fourier features over the joints that the muscle crosses). A tendon that
slides has another tension at the motor than at its elastic element (μ: tendon friction, s:
direction of the last sliding, +1 wound in, −1 paid out). Tendons creep, by r from one sample to the
next: a sample after which a others came says what the length was then. All parameters zero is the
geometric model.

`fit` finds the parameters.
"""

from __future__ import annotations

import math
from copy import copy
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints, Singles
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.series_elastic import SeriesElastic
from musculoskeletal_ae.signals.friction import end_tension

FEATURES = 60  # of the residual model that are drawn, per muscle
WIDTH = 0.35  # of the kernel that they approximate, as a share of the joint ranges
#: share of their variance that is left out with the directions that vary least, about half of them
#: (less than 0.1 mm at the prior's spread), and the postures that it is taken over
LEFT_OUT, POSTURES = 1e-3, 500
# More than twice the tension at the elastic unit than at the motor is no friction.
LARGEST_FRICTION = 0.7
LARGEST_LOG = 1.5


class Layout:
    """Where the parameters of one muscle are: δ (three per route point), κ, μ, o, r, v."""

    def __init__(self, points: Ints, weights: Array, features: int) -> None:
        end = 3 * len(points)
        self.points = points  # its route points
        #: of the lines between each two of them: the share of the length that counts
        self.weights = weights
        self.attachment = slice(0, end)  # δ [m]
        self.elastic = slice(end, end + 3)  # κ: log of force, rate, wire_stretch over nominal ones
        self.friction, self.offset, self.creep = end + 3, end + 4, end + 5  # μ; o, r [m]
        self.size = end + 6 + features
        self.rest = slice(end + 6, self.size)  # v [m]


class ResidualModel(NamedTuple):
    """ψ of one muscle: K random Fourier features, in the F directions in which they vary.

    In single precision, in which cosines take a seventh of the time.
    """

    frequency: Singles  # [1/rad or 1/m], (K, D); 0 for joints that the muscle does not cross
    phase: Singles  # (K,)
    basis: Singles  # (K, F)

    @classmethod
    def drawn(
        cls, robot: Robot, crossed: Bools, theta: Array, rng: np.random.Generator
    ) -> ResidualModel:
        """Draw those of a muscle which crosses some joints (D,); they vary over θ (N, D)."""
        count = FEATURES if crossed.any() else 0
        frequency = rng.normal(0.0, 1.0, (count, robot.joint_count))
        frequency = frequency * crossed / (WIDTH * (robot.upper - robot.lower))
        phase = rng.uniform(0.0, 2.0 * np.pi, count)
        every = cls(*(part.astype(np.float32) for part in (frequency, phase, np.eye(count))))
        values = every.at(theta)
        power, basis = np.linalg.eigh(values.T @ values)
        kept = basis[:, power.cumsum() > LEFT_OUT * power.sum()]
        return every._replace(basis=kept.astype(np.float32))

    def at(self, theta: Array) -> Array:
        """Return ψ(θ) − ψ(0), shape (N, F)."""
        angles = theta @ self.frequency.T + self.phase
        values = np.cos(angles.astype(self.phase.dtype)) - np.cos(self.phase)
        return (values @ self._scaled).astype(float)

    def slope(self, theta: Array, joints: Ints) -> Singles:
        """Return ∂ψ/∂θ of some joints [1/rad or 1/m], shape (joints, N, F)."""
        angles = theta @ self.frequency.T + self.phase
        values = -np.sin(angles.astype(self.phase.dtype)) * self.frequency.T[joints, None]
        return values @ self._scaled

    @property
    def _scaled(self) -> Singles:
        return math.sqrt(2.0 / max(1, len(self.phase))) * self.basis


class Poses(NamedTuple):
    """Of pinocchio's joints in the root link's frame, and what wrapping adds to straight lines."""

    rotation: Array  # (N, J, 3, 3)
    translation: Array  # [m], (N, J, 3)
    detour: Array  # of the nominal body [m], (N, M)


class CalibratedBody:
    """Lengths of the calibrated body, and how they change with its `parameters`."""

    def __init__(
        self,
        robot: Robot,
        parameters: list[Array] | None = None,
        seed: int = 0,
        smooth: list[ResidualModel] | None = None,
    ) -> None:
        """Correct `robot` by one vector per muscle (zero); `seed` draws `smooth` if not given."""
        self.robot, routes = robot, robot.routes
        if smooth is None:
            rng = np.random.default_rng([seed, 0xF0])
            theta = robot.random_postures(POSTURES, np.random.default_rng([seed, 0xF1]))
            smooth = [ResidualModel.drawn(robot, crossed, theta, rng) for crossed in routes.crossed]
        self.smooth, self.layouts = smooth, list[Layout]()
        for m, own in enumerate(smooth):
            segments = np.flatnonzero(routes.muscle == m)
            points = np.union1d(routes.first[segments], routes.second[segments])
            weights = np.zeros(len(points) - 1)  # 0 from one branch to the next
            weights[routes.first[segments] - points[0]] = routes.weight[segments]
            self.layouts.append(Layout(points, weights, own.basis.shape[1]))
        self.parameters = parameters or [np.zeros(layout.size) for layout in self.layouts]
        # Where the next fit starts:
        #: offsets of the joint sensors [rad], (D,)
        self.zero = np.zeros(robot.joint_count)
        #: θ (D,) of samples, with a row of `posture_model.Bent`, by the bytes of their lengths
        self.last_postures: dict[bytes, tuple[Array, ...]] = {}

    def limb(self, joints: Ints, muscles: Ints) -> CalibratedBody:
        """Return the body of one group, with the parameters of its muscles."""
        of_group = [self.smooth[m] for m in muscles]
        smooth = [own._replace(frequency=own.frequency[:, joints]) for own in of_group]
        parameters = [self.parameters[m] for m in muscles]
        return CalibratedBody(self.robot.limb(joints, muscles), parameters, smooth=smooth)

    def with_parameters(self, parameters: list[Array]) -> CalibratedBody:
        """Return the body with other parameters, one vector per muscle."""
        body = copy(self)
        body.parameters = parameters
        return body

    def elastic(self, m: int) -> SeriesElastic:
        """Return the constants of one muscle, arrays of shape ()."""
        nominal = self.robot.series_elastic
        log = self.parameters[m][self.layouts[m].elastic]
        force, rate, stretch = np.exp(np.clip(log, -LARGEST_LOG, LARGEST_LOG))
        return SeriesElastic(
            nominal.force[m] * force, nominal.rate[m] * rate, nominal.wire_stretch[m] * stretch
        )

    def frictions(self) -> Array:
        """Return μ of each wire (M,)."""
        return np.array([self.friction(m) for m in range(len(self.layouts))])

    def friction(self, m: int) -> float:
        """Return μ of one muscle."""
        value = self.parameters[m][self.layouts[m].friction]
        return float(np.clip(value, -LARGEST_FRICTION, LARGEST_FRICTION))

    def crept(self, age: Array) -> Array:
        """Return by how much lengths have grown since samples of an age (N,) [m], (N, M)."""
        rates = [p[at.creep] for p, at in zip(self.parameters, self.layouts, strict=True)]
        return age[:, None] * np.array(rates)

    def poses(self, theta: Array) -> Poses:
        """Return the joint poses of θ (N, D) and, in the last place, of θ = 0."""
        theta, robot = np.vstack([theta, np.zeros(theta.shape[1])]), self.robot
        at = robot.kinematics.tree.joint_poses(theta)
        return Poses(at.rotation, at.translation, robot.routes.detours(theta))

    def _world(self, poses: Poses, m: int) -> tuple[Array, Array]:
        """Return the route's points in the root link's frame, and how their links are turned."""
        layout, routes = self.layouts[m], self.robot.routes
        joint = routes.joint[layout.points]
        shift = self.parameters[m][layout.attachment].reshape(-1, 3)
        turn = poses.rotation[:, joint]  # (N, P, 3, 3)
        local = routes.point[layout.points] + shift
        return (turn @ local[:, :, None])[..., 0] + poses.translation[:, joint], turn

    def lengths(self, theta: Array, tension: Array, *direction: Array) -> tuple[Array, ...]:
        """Return l [m] (N, M) at θ [rad] (N, D) and the motors' T [N] (N, M).

        One result for each direction s in [−1, 1], shape (N, M); 0 is the mean of both directions.
        """
        result = tuple(np.empty_like(tension) for _ in direction)
        poses = self.poses(theta)
        for m, layout in enumerate(self.layouts):
            world, _ = self._world(poses, m)
            absolute = np.linalg.norm(world[:, 1:] - world[:, :-1], axis=-1) @ layout.weights
            absolute += poses.detour[:, m]
            absolute, at_zero = absolute[:-1], absolute[-1]
            fixed = absolute - at_zero + self.parameters[m][layout.offset]
            fixed += self.smooth[m].at(theta) @ self.parameters[m][layout.rest]
            elastic, friction = self.elastic(m), self.friction(m)
            for lengths, s in zip(result, direction, strict=True):
                end = end_tension(friction, tension[:, m], s[:, m])
                lengths[:, m] = fixed - elastic.elongation(absolute, end)
        return result

    def linearised(
        self, poses: Poses, smooth: Array, tension: Array, direction: Array, m: int,
        age: Array | float = 0.0,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Return l_i [m] (N,) of one muscle and ∂l_i/∂parameters (N, P).

        Of θ come the `poses` and ψ (N, F), `smooth`; T_i [N] and s_i are the muscle's own, (N,).
        """
        layout, parameters = self.layouts[m], self.parameters[m]
        world, turn = self._world(poses, m)
        line = world[:, 1:] - world[:, :-1]
        norm = np.linalg.norm(line, axis=-1)
        along = line * (layout.weights / np.maximum(norm, 1e-9))[..., None]
        pull = np.zeros_like(world)
        pull[:, 1:] += along
        pull[:, :-1] -= along
        by_point = (pull[:, :, None] @ turn).reshape(len(world), -1)
        whole = norm @ layout.weights + poses.detour[:, m]
        absolute, at_zero = whole[:-1], whole[-1]
        elastic = self.elastic(m)
        end = np.maximum(end_tension(self.friction(m), tension, direction), 0.0)
        length = absolute - at_zero - elastic.elongation(absolute, end)
        length = length + parameters[layout.offset] + smooth @ parameters[layout.rest]
        length -= age * parameters[layout.creep]
        slope = 1.0 - elastic.length_slope(end)
        jacobian = np.empty((len(smooth), layout.size))
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
        jacobian[:, layout.offset], jacobian[:, layout.creep] = 1.0, -np.asarray(age)
        jacobian[:, layout.rest] = smooth
        return length, jacobian
