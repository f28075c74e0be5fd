# SPDX-License-Identifier: Apache-2.0
"""Residuals of rest samples against the calibrated body, and their derivatives.

    length    l_nm − l_m(θ_n, T_n; w)
    torque    τ_nj = −(g(θ_n) + K θ_n − b + Gᵀ T_end)_j, which is 0 at rest
    angle     y_nj − θ_nj − z_j
    gravity   u_ni − R_iᵀ(θ_n) ĝ

Here w are the parameters of the body, θ_n the postures of the samples and z the joint-sensor
offsets (`postures`). g(θ) are the torques that hold the weight, G is the muscle Jacobian, and T_end
are the bone-side tensions. K and b describe the joints' springs (`springs`). y_nj are measured
angles and u_ni measured directions of gravity in the frame of joint i. R_i is the rotation of this
frame, and ĝ is the direction of gravity in the frame of the root link.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.body_model import springs
from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.body_model.observations import Observations
from musculoskeletal_ae.robot.stiffness import muscle_hessian

DIFFERENCE = 1e-6  # differentiate numerically with this step [rad]
#: Compute the joint stiffness Σ T ∂²l/∂θ² due to muscle tensions again only after a joint has moved
#: by more than this [rad], because it is costly and changes little.
REUSED_MOTION = 0.05
SMALL = 1e-6  # divide the vector of gravity by at least this norm


class Unknowns(NamedTuple):
    """Values of all unknowns of one group of D joints and M muscles."""

    theta: Array  # angles θ of all joints of the body [rad], (N, all joints)
    zero: Array  # joint-sensor offsets z [rad], (D,)
    parameters: list[Array]  # parameters w of each muscle
    springs: Array  # α and β of all joints of the body, as in the module `springs`, (2, all joints)


class Residuals(NamedTuple):
    """Residuals of lengths, torques, angles and gravity, and their derivatives, at one point."""

    length: Array  # residuals of the lengths [m], (N, M)
    muscle_jacobian: Array  # muscle Jacobian G [m/rad], (N, M, D)
    by_body: list[Array]  # derivatives of each muscle's length by its parameters, (N, parameters)
    torque: Array  # residuals of the torques τ [N·m], (N, D)
    torque_by_body: Array  # negative derivatives of τ by the W parameters of all muscles, (N, D, W)
    #: negative derivatives of τ by α and β of the S joints with springs, (N, D, 2S)
    torque_by_springs: Array
    #: median over the samples of the sum of the muscles' absolute torques at each joint [N·m], (D,)
    load: Array
    angle: Array  # residuals of the angles [rad], (N, D); 0 where no angle was measured
    gravity: Array  # residuals of the directions of gravity, (N, 3J)
    #: derivative of the directions of gravity with respect to θ, (N, 3J, D)
    gravity_by_posture: Array


class Bent(NamedTuple):
    """Cache of the joint stiffness Σ T ∂²l/∂θ² that muscle tensions cause.

    It belongs to the geometric model. Between two fits it hardly changes, because the postures of
    the samples hardly change.
    """

    theta: Array  # postures of the last evaluation [rad], (N, D)
    stiffness: Array  # joint stiffness Σ T ∂²l/∂θ² at these postures [N·m/rad], (N, D, D)

    @classmethod
    def unknown(cls, count: int, joint_count: int) -> Bent:
        """Return an empty cache for `count` postures."""
        nowhere = np.full((count, joint_count), np.nan)
        return cls(nowhere, np.zeros((count, joint_count, joint_count)))


class PostureModel:
    """Computes the residuals of N rest samples of one group of joints and muscles.

    The derivatives of the residuals are computed as well.
    """

    def __init__(
        self, body: CalibratedBody, observed: Observations, joints: Ints, muscles: Ints, bent: Bent
    ) -> None:
        """Create the model of one group.

        Args:
            body: The whole body.
            observed: All samples.
            joints: Joints of the group.
            muscles: Muscles of the group.
            bent: Cache of the whole body, which is updated in place.
        """
        self.body, self.observed = body.limb(joints, muscles), observed.limb(joints, muscles)
        self.joints = joints
        self._kinematics = body.robot.kinematics  # kinematics of the whole body
        #: joints of the group with a spring, indices in θ of the whole body, (S,)
        self.sprung: Ints = joints[self._kinematics.elasticity.is_sprung[joints]]
        ends = np.cumsum([0, *(layout.size for layout in self.body.layouts)])
        #: positions of each muscle's parameters in w
        self.columns = [slice(*pair) for pair in pairwise(ends.tolist())]
        #: prior spread of α and β of the joints in `sprung`, (2, S)
        self.spring_spread = springs.prior_spread(self._kinematics.elasticity)[:, self.sprung]
        self._crossed = self.body.robot.routes.crossed
        of_muscle = np.repeat(self._crossed, np.diff(ends), axis=0).T
        #: the parameters of the muscles that cross each joint
        self.acting = [np.flatnonzero(own) for own in of_muscle]
        self.is_read = np.isfinite(self.observed.theta)
        self.by_sensor = self.is_read & (self.observed.spread == 0.0)  # measured by a joint sensor
        self.is_tilt_known = np.isfinite(self.observed.gravity)
        self._tilt = np.where(self.is_tilt_known, self.observed.gravity, 0.0)
        self._bent = bent

    @property
    def parameter_count(self) -> int:
        """Number of parameters of all muscles of the group, which is the size of w."""
        return self.columns[-1].stop

    def residuals(self, at: Unknowns) -> Residuals:
        """Return the residuals and their derivatives at given values of the unknowns."""
        body, observed, columns = (
            self.body.with_parameters(at.parameters),
            self.observed,
            self.columns,
        )
        own = at.theta[:, self.joints]
        count, places = own.shape
        # The postures, followed by D copies of them. In each copy, one joint is moved by
        # DIFFERENCE.
        flat = np.concatenate([own[None], own + DIFFERENCE * np.eye(places)[:, None]])
        poses = body.poses(flat.reshape(-1, places))
        length, end = np.empty_like(observed.length), np.empty_like(observed.length)
        slope = np.zeros((*length.shape, places))
        by_body = []
        torque_by_body = np.zeros((count, places, self.parameter_count))
        for m in range(length.shape[1]):
            tension, direction = observed.tension[:, m], observed.direction[:, m]
            turns = np.flatnonzero(self._crossed[m])  # skip joints that do not change the length
            parts = np.append(0, 1 + turns)
            rows = (count * parts[:, None] + np.arange(count)).ravel()
            placed = type(poses)(*(part[np.append(rows, -1)] for part in poses))
            tensions, directions, age = (
                np.tile(part, len(parts)) for part in (tension, direction, observed.age)
            )
            l_m, j_m = body.linearised(placed, tensions, directions, m, age)
            l_m, j_m = l_m.reshape(len(parts), count), j_m.reshape(len(parts), count, -1)
            length[:, m] = observed.length[:, m] - l_m[0]
            by_body.append(j_m[0])
            slope[:, m, turns] = (l_m[1:] - l_m[0]).T / DIFFERENCE
            end[:, m], by_losses = body.end(m, tension, direction)
            block = (j_m[1:] - j_m[0]) * (end[:, m, None] / DIFFERENCE)
            layout, arms = body.layouts[m], slope[:, m, turns].T
            block[:, :, layout.friction] += by_losses[:, 0] * arms
            block[:, :, layout.drive] += arms[:, :, None] * by_losses[:, 1:]
            torque_by_body[:, turns, columns[m]] = block.swapaxes(0, 1)
        muscular = end[:, :, None] * slope
        nominal = self._kinematics.elasticity
        held = self._kinematics.weight_torque(at.theta)
        if nominal.is_present:
            held = held + springs.learned(nominal, at.springs).holding_torque(at.theta)
        by_springs = springs.slope(nominal, at.springs, at.theta, self.sprung)
        down = self._down(at.theta)
        return Residuals(
            length,
            slope,
            by_body,
            -held[:, self.joints] - muscular.sum(axis=1),
            torque_by_body,
            by_springs[:, self.joints],
            np.median(np.abs(muscular).sum(axis=1), axis=0),
            np.where(self.is_read, observed.theta - own - self.by_sensor * at.zero, 0.0),
            self.is_tilt_known * (self._tilt - down[0]),
            np.moveaxis(down[1:] - down[0], 0, -1) / DIFFERENCE,
        )

    def _down(self, theta: Array) -> Array:
        """Return the direction of gravity in the frames of the tree's joints, (1+D, N, 3J).

        The first entry is the direction at θ (N, all joints). For each of the D others, one joint
        of the group is moved by `DIFFERENCE`. Without an IMU, the result has 0 columns.
        """
        if not self._tilt.size:
            return np.zeros((1 + len(self.joints), len(theta), 0))
        gravity = self._kinematics.model.gravity.linear
        turned = theta + DIFFERENCE * np.eye(theta.shape[1])[self.joints, None]
        flat = np.concatenate([theta[None], turned]).reshape(-1, theta.shape[1])
        rotation = self._kinematics.tree.joint_poses(flat).rotation
        down = np.einsum('njba,b->nja', rotation, gravity / max(np.linalg.norm(gravity), SMALL))
        return down.reshape(-1, *self._tilt.shape)

    def stiffness(self, at: Unknowns) -> Array:
        """Return the joint stiffness −∂τ/∂θ [N·m/rad], (N, D, D).

        The part that the bone-side tensions cause comes from the geometric model.
        """
        within, theta = (self.joints[:, None], self.joints), at.theta
        kinematics = self._kinematics
        if kinematics.elasticity.is_present:
            now = springs.learned(kinematics.elasticity, at.springs)
            kinematics = kinematics.with_elasticity(now)
        held = np.stack([kinematics.holding_gradient(row) for row in theta])
        stiffness: Array = held[:, within[0], within[1]]
        return stiffness + self._muscle_stiffness(theta[:, self.joints])

    def _muscle_stiffness(self, own: Array) -> Array:
        """Return the joint stiffness Σ T ∂²l/∂θ² [N·m/rad] that muscle tensions cause, (N, D, D).

        The geometric model gives it at θ (N, D), or the cache for a posture near θ.
        """
        joints = self.joints
        at = self._bent.theta[:, joints]
        moved = np.flatnonzero(~(np.abs(own - at) < REUSED_MOTION).all(axis=1))
        hessian = muscle_hessian(self.body.robot.routes.muscle_jacobian, own[moved])
        self._bent.theta[np.ix_(moved, joints)] = own[moved]
        read, direction = self.observed.tension[moved], self.observed.direction[moved]
        tension = self.body.transmission.end(read, direction)
        self._bent.stiffness[np.ix_(moved, joints, joints)] = np.einsum(
            'nm,nmij->nij', tension, hessian
        )
        return self._bent.stiffness[:, joints[:, None], joints]
