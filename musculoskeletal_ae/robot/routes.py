# SPDX-License-Identifier: Apache-2.0
"""Muscle lengths and the muscle Jacobian of straight-line routes.

    f_geo,abs(θ) = Σ over the route of |p_{i+1}(θ) − p_i(θ)|
    f_geo(θ)     = f_geo,abs(θ) − f_geo,abs(0)
    G(θ)         = ∂f_geo/∂θ

(paper, section "Initial Training": start, relay and end points linearly connected.) G follows from
the velocity of the points, ∂p/∂θ_k = a_k × (p − o_k), projected on the lines between them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.kinematics import JointPoses, Kinematics

# Bounds the memory of one batched evaluation to a few tens of megabytes.
CHUNK = 4096


def _in_chunks(method: Callable[[Routes, Array], Array]) -> Callable[[Routes, Array], Array]:
    """Let a method of θ (N, D) take θ (..., D), and evaluate it CHUNK rows at a time."""

    @wraps(method)
    def chunked(self: Routes, theta: Array) -> Array:
        rows = theta.reshape(-1, theta.shape[-1])
        starts = range(0, max(len(rows), 1), CHUNK)
        values = np.concatenate([method(self, rows[i : i + CHUNK]) for i in starts])
        return values.reshape(*theta.shape[:-1], *values.shape[1:])

    return chunked


class Routes:
    """The routes of M muscles over D joints as functions of θ: P points, S straight segments."""

    def __init__(
        self, kinematics: Kinematics, routes: Sequence[Sequence[tuple[str, Array]]]
    ) -> None:
        """Attach routes to the tree, for each muscle its points (link, xyz in its frame [m])."""
        self._kinematics = kinematics
        attached = [kinematics.attach(link, xyz) for route in routes for link, xyz in route]
        #: joint of the tree that carries each point, (P,), and the point in its frame [m], (P, 3)
        self.joint = np.array([joint for joint, _ in attached])
        self.point: Array = np.array([point for _, point in attached], dtype=float)
        owner = np.repeat(np.arange(len(routes)), [len(route) for route in routes])
        #: points where each segment starts and ends, and its muscle, (S,)
        self.first = np.flatnonzero(owner[:-1] == owner[1:])
        self.second, self.muscle = self.first + 1, owner[self.first]
        self._sum: Array = 1.0 * (np.arange(len(routes))[:, None] == self.muscle)
        self.length_at_zero = self.absolute_lengths(np.zeros(len(kinematics.lower)))

    def points(self, theta: Array) -> Array:
        """Return all route points in the root link's frame [m], shape (N, P, 3), θ (N, D)."""
        return self._points(self._kinematics.joint_poses(theta))

    def _points(self, poses: JointPoses) -> Array:
        rotation, translation = poses.rotation[:, self.joint], poses.translation[:, self.joint]
        return np.einsum('npij,pj->npi', rotation, self.point) + translation

    @_in_chunks
    def absolute_lengths(self, theta: Array) -> Array:
        """Return f_geo,abs(θ) [m]: θ (..., D) gives (..., M)."""
        points = self.points(theta)
        segment = np.linalg.norm(points[:, self.second] - points[:, self.first], axis=-1)
        return segment @ self._sum.T

    def relative_lengths(self, theta: Array) -> Array:
        """Return f_geo(θ) [m], zero at θ = 0: θ (..., D) gives (..., M)."""
        return self.absolute_lengths(theta) - self.length_at_zero

    @_in_chunks
    def muscle_jacobian(self, theta: Array) -> Array:
        """Return G(θ) [m/rad]: θ (..., D) gives (..., M, D)."""
        kin = self._kinematics
        poses = kin.joint_poses(theta)
        points = self._points(poses)
        line = points[:, self.second] - points[:, self.first]
        norm = np.linalg.norm(line, axis=-1, keepdims=True)
        direction = np.divide(line, norm, out=np.zeros_like(line), where=norm > 0.0)
        jacobian = np.empty((len(theta), len(self._sum), theta.shape[1]))
        for i in range(1, len(kin.parent)):
            k = kin.theta_index[i]
            axis, origin = poses.axis[:, i, None], poses.translation[:, i, None]
            motion = axis if kin.prismatic[i] else np.cross(axis, points - origin)
            velocity = motion * kin.moved_by[self.joint, k][:, None]
            rate = velocity[:, self.second] - velocity[:, self.first]
            jacobian[:, :, k] = np.einsum('nsi,nsi->ns', direction, rate) @ self._sum.T
        return jacobian
