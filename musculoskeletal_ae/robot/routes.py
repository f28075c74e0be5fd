# SPDX-License-Identifier: Apache-2.0
"""Muscle lengths and the muscle Jacobian of straight-line routes.

    f_geo,abs(θ) = Σ over the route of |p_{i+1}(θ) − p_i(θ)|
    f_geo(θ)     = f_geo,abs(θ) − f_geo,abs(0)
    G(θ)         = ∂f_geo/∂θ

(paper, section "Initial Training": start, relay and end points linearly connected.) G follows from
the velocity of the points, ∂p/∂θ_k = a_k × (p − o_k), projected on the lines between them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.kinematics import JointPoses, Kinematics

# Bounds the memory of one batched evaluation to a few tens of megabytes.
CHUNK = 4096


class Routes:
    """The routes of M muscles over D joints as functions of θ."""

    def __init__(
        self, kinematics: Kinematics, routes: Sequence[Sequence[tuple[str, Array]]]
    ) -> None:
        """Attach route points to the kinematic tree.

        Args:
            kinematics: The arm that carries the points.
            routes: For each muscle its points as (link, xyz in the link's frame [m]).
        """
        self._kinematics = kinematics
        joint: list[int] = []
        point: list[Array] = []
        first: list[int] = []
        second: list[int] = []
        muscle: list[int] = []
        for m, route in enumerate(routes):
            for i, (link, xyz) in enumerate(route):
                tree_joint, rotation, translation = kinematics.link_attachment(link)
                if i > 0:
                    first.append(len(point) - 1)
                    second.append(len(point))
                    muscle.append(m)
                joint.append(tree_joint)
                point.append(rotation @ xyz + translation)
        self.joint = np.array(joint)
        self.point: Array = np.array(point, dtype=float)
        self.first, self.second = np.array(first), np.array(second)
        self.muscle = np.array(muscle)
        self._sum = np.zeros((len(routes), len(first)))
        self._sum[self.muscle, np.arange(len(first))] = 1.0
        self.length_at_zero = self.absolute_lengths(np.zeros(len(kinematics.lower)))

    def points(self, theta: Array) -> Array:
        """Return all route points in the root link's frame [m], shape (N, P, 3), θ (N, D)."""
        return self._points(self._kinematics.joint_poses(theta))

    def _points(self, poses: JointPoses) -> Array:
        rotation, translation = poses.rotation[:, self.joint], poses.translation[:, self.joint]
        points: Array = np.einsum('npij,pj->npi', rotation, self.point) + translation
        return points

    def absolute_lengths(self, theta: Array) -> Array:
        """Return f_geo,abs(θ) [m]: θ (..., D) gives (..., M)."""
        if theta.ndim != 2:
            rows = self.absolute_lengths(theta.reshape(-1, theta.shape[-1]))
            return rows.reshape(*theta.shape[:-1], len(self._sum))
        if len(theta) > CHUNK:
            parts = range(0, len(theta), CHUNK)
            return np.concatenate([self.absolute_lengths(theta[i : i + CHUNK]) for i in parts])
        points = self.points(theta)
        segment = np.linalg.norm(points[:, self.second] - points[:, self.first], axis=-1)
        lengths: Array = segment @ self._sum.T
        return lengths

    def relative_lengths(self, theta: Array) -> Array:
        """Return f_geo(θ) [m], zero at θ = 0: θ (..., D) gives (..., M)."""
        return self.absolute_lengths(theta) - self.length_at_zero

    def muscle_jacobian(self, theta: Array) -> Array:
        """Return G(θ) [m/rad]: θ (..., D) gives (..., M, D)."""
        if theta.ndim != 2:
            rows = self.muscle_jacobian(theta.reshape(-1, theta.shape[-1]))
            return rows.reshape(*theta.shape[:-1], *rows.shape[1:])
        if len(theta) > CHUNK:
            parts = range(0, len(theta), CHUNK)
            return np.concatenate([self.muscle_jacobian(theta[i : i + CHUNK]) for i in parts])
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

    def muscle_hessian(self, theta: Array, step: float = 1e-5) -> Array:
        """Return ∂²l/∂θ² [m/rad²], θ (D,) gives (M, D, D), by central differences of G."""
        offsets = step * np.eye(len(theta))
        forward = self.muscle_jacobian(theta + offsets)
        backward = self.muscle_jacobian(theta - offsets)
        raw = (forward - backward).transpose(1, 2, 0) / (2.0 * step)
        hessian: Array = 0.5 * (raw + raw.transpose(0, 2, 1))
        return hessian
