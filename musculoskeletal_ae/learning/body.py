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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.series_elastic import SeriesElastic

Array = NDArray[np.float64]

FEATURES = 80  # of the smooth rest, per muscle
WIDTH = 0.35  # of the kernel that they approximate, as a share of the joint ranges
# More than twice the tension at the elastic unit than at the motor is no friction.
LARGEST_FRICTION = 0.5
LARGEST_LOG = 1.5


@dataclass(frozen=True)
class Layout:
    """Where the parameters of one muscle are: points, elastic, friction, offset, smooth rest."""

    points: NDArray[np.int_]
    smooth: int

    @property
    def size(self) -> int:
        """Number of parameters."""
        return 3 * len(self.points) + 5 + self.smooth

    @property
    def attachment(self) -> slice:
        """δ, three per route point [m]."""
        return slice(0, 3 * len(self.points))

    @property
    def elastic(self) -> slice:
        """κ: logarithms of force, rate, wire_stretch over the nominal ones."""
        start = 3 * len(self.points)
        return slice(start, start + 3)

    @property
    def friction(self) -> int:
        """μ."""
        return 3 * len(self.points) + 3

    @property
    def offset(self) -> int:
        """o [m]."""
        return 3 * len(self.points) + 4

    @property
    def rest(self) -> slice:
        """v [m]."""
        return slice(3 * len(self.points) + 5, self.size)


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
            self.layouts.append(Layout(points, FEATURES if crossed.any() else 0))
            frequency = rng.normal(0.0, 1.0, (self.layouts[m].smooth, robot.joint_count))
            self._frequency.append(frequency * crossed / (WIDTH * span))
            self._phase.append(rng.uniform(0.0, 2.0 * np.pi, self.layouts[m].smooth))
        self.parameters = parameters or [np.zeros(layout.size) for layout in self.layouts]

    # -- parts ----------------------------------------------------------------------------------

    def _smooth(self, theta: Array, m: int) -> Array:
        """Return ψ(θ) − ψ(0) of one muscle, shape (N, features)."""
        scale = np.sqrt(2.0 / max(1, len(self._phase[m])))
        values = np.cos(theta @ self._frequency[m].T + self._phase[m]) - np.cos(self._phase[m])
        return scale * values

    def _route(
        self, rotation: Array, translation: Array, m: int, gradient: bool
    ) -> tuple[Array, Array]:
        """Return f_i [m] (N,) and ∂f_i/∂δ (N, 3 points), the latter empty if not asked for."""
        routes, layout = self.robot.routes, self.layouts[m]
        joint = routes.joint[layout.points]
        shift = self.parameters[m][layout.attachment].reshape(-1, 3)
        local = routes.point[layout.points] + shift
        turn = rotation[:, joint]  # (N, P, 3, 3)
        world = np.einsum('npij,pj->npi', turn, local) + translation[:, joint]
        line = world[:, 1:] - world[:, :-1]
        norm = np.linalg.norm(line, axis=-1)
        if not gradient:
            return norm.sum(axis=1), np.empty(0)
        direction = line / np.maximum(norm, 1e-9)[..., None]
        pull = np.zeros_like(world)
        pull[:, 1:] += direction
        pull[:, :-1] -= direction
        return norm.sum(axis=1), np.einsum('npij,npi->npj', turn, pull).reshape(len(world), -1)

    def elastic(self, m: int) -> SeriesElastic:
        """Return the constants of one muscle, arrays of shape ()."""
        nominal = self.robot.series_elastic
        log = self.parameters[m][self.layouts[m].elastic]
        force, rate, stretch = np.exp(np.clip(log, -LARGEST_LOG, LARGEST_LOG))
        return SeriesElastic(
            nominal.force[m] * force, nominal.rate[m] * rate, nominal.wire_stretch[m] * stretch
        )

    def friction(self) -> Array:
        """Return μ of every muscle, shape (M,)."""
        values = [p[lay.friction] for p, lay in zip(self.parameters, self.layouts, strict=True)]
        return np.clip(np.array(values), 0.0, LARGEST_FRICTION)

    # -- lengths --------------------------------------------------------------------------------

    def lengths(self, theta: Array, tension: Array, sliding: Array | None = None) -> Array:
        """Return l [m] (N, M) at θ [rad] (N, D) and the motor's T [N] (N, M).

        Args:
            theta: θ.
            tension: T where the module measures it.
            sliding: s in [−1, 1], shape (N, M); 0 by default, the mean of both directions.
        """
        columns = [
            self._muscle(theta, tension[:, m], None if sliding is None else sliding[:, m], m)
            for m in range(self.robot.muscle_count)
        ]
        return np.stack(columns, axis=1)

    def _muscle(self, theta: Array, tension: Array, sliding: Array | None, m: int) -> Array:
        return self.linearised(theta, tension, sliding, m, gradient=False)[0]

    def linearised(
        self, theta: Array, tension: Array, sliding: Array | None, m: int, gradient: bool = True
    ) -> tuple[Array, Array]:
        """Return l_i [m] (N,) of one muscle and ∂l_i/∂parameters (N, P)."""
        layout, parameters = self.layouts[m], self.parameters[m]
        poses = self.robot.kinematics.joint_poses(np.vstack([theta, np.zeros(theta.shape[1])]))
        absolute, by_point = self._route(poses.rotation, poses.translation, m, gradient)
        absolute, at_zero = absolute[:-1], absolute[-1]
        friction = np.clip(parameters[layout.friction], -LARGEST_FRICTION, LARGEST_FRICTION)
        slid = np.zeros(len(theta)) if sliding is None else sliding
        end = tension * np.exp(-friction * slid)
        elastic = self.elastic(m)
        smooth = self._smooth(theta, m)
        elongation = elastic.elongation(absolute, end)
        length = absolute - at_zero - elongation + parameters[layout.offset]
        length = length + smooth @ parameters[layout.rest]
        if not gradient:
            return length, np.empty(0)
        slope = 1.0 - elastic.length_slope(end)
        jacobian = np.empty((len(theta), layout.size))
        jacobian[:, layout.attachment] = slope[:, None] * by_point[:-1] - by_point[-1]
        pull = np.maximum(end, 0.0)
        unit = np.log1p(pull / elastic.force) / elastic.rate
        jacobian[:, layout.elastic] = np.stack(
            [
                pull / (elastic.force + pull) / elastic.rate,
                unit,
                -elastic.wire_stretch * absolute * pull,
            ],
            axis=1,
        )
        jacobian[:, layout.friction] = elastic.compliance(absolute, end) * end * slid
        jacobian[:, layout.offset] = 1.0
        jacobian[:, layout.rest] = smooth
        return length, jacobian
