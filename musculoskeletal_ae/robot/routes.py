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

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.kinematics import JointPoses, Kinematics

# Bounds the memory of one batched evaluation to a few tens of megabytes.
CHUNK = 4096


class Routes:
    """The routes of M muscles over D joints as functions of θ.

    Attributes:
        joint: Joint of the tree that carries each point, shape (P,).
        point: In that joint's frame [m], shape (P, 3).
        first: Point where each straight segment starts, shape (S,).
        second: Point where it ends, shape (S,).
        muscle: Muscle it belongs to, shape (S,).
        length_at_zero: f_geo,abs(0) [m], shape (M,).
    """

    def __init__(
        self, kinematics: Kinematics, routes: Sequence[Sequence[tuple[str, Array]]]
    ) -> None:
        """Attach route points to the kinematic tree.

        Args:
            kinematics: The arm that carries the points.
            routes: For each muscle its points as (link, xyz in the link's frame [m]).
        """
        self._kinematics = kinematics
        attached = [kinematics.attach(link, xyz) for route in routes for link, xyz in route]
        self.joint = np.array([joint for joint, _ in attached])
        self.point: Array = np.array([point for _, point in attached], dtype=float)
        owner = np.repeat(np.arange(len(routes)), [len(route) for route in routes])
        self.first = np.flatnonzero(owner[:-1] == owner[1:])
        self.second, self.muscle = self.first + 1, owner[self.first]
        self._sum: Array = 1.0 * (np.arange(len(routes))[:, None] == self.muscle)
        self.length_at_zero = self.absolute_lengths(np.zeros(len(kinematics.lower)))

    def points(self, theta: Array) -> Array:
        """Return all route points in the root link's frame [m], shape (N, P, 3), θ (N, D)."""
        return self._points(self._kinematics.joint_poses(theta))

    def absolute_lengths(self, theta: Array) -> Array:
        """Return f_geo,abs(θ) [m]: θ (..., D) gives (..., M)."""
        return _in_chunks(self._absolute_lengths, theta)

    def relative_lengths(self, theta: Array) -> Array:
        """Return f_geo(θ) [m], zero at θ = 0: θ (..., D) gives (..., M)."""
        return self.absolute_lengths(theta) - self.length_at_zero

    def muscle_jacobian(self, theta: Array) -> Array:
        """Return G(θ) [m/rad]: θ (..., D) gives (..., M, D)."""
        return _in_chunks(self._muscle_jacobian, theta)

    def _points(self, poses: JointPoses) -> Array:
        rotation, translation = poses.rotation[:, self.joint], poses.translation[:, self.joint]
        points: Array = np.einsum('npij,pj->npi', rotation, self.point) + translation
        return points

    def _absolute_lengths(self, theta: Array) -> Array:
        points = self.points(theta)
        segment = np.linalg.norm(points[:, self.second] - points[:, self.first], axis=-1)
        lengths: Array = segment @ self._sum.T
        return lengths

    def _muscle_jacobian(self, theta: Array) -> Array:
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


def _in_chunks(function: Callable[[Array], Array], theta: Array) -> Array:
    """Return a function of θ (N, D) for θ of any leading shape, evaluated CHUNK rows at a time."""
    rows = theta.reshape(-1, theta.shape[-1])
    parts = [function(rows[i : i + CHUNK]) for i in range(0, max(len(rows), 1), CHUNK)]
    values = parts[0] if len(parts) == 1 else np.concatenate(parts)
    return values.reshape(*theta.shape[:-1], *values.shape[1:])
