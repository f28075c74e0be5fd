# SPDX-License-Identifier: Apache-2.0
"""The tree of joints, and the poses of all joints for many postures in one call.

The pose of a revolute joint in its parent is its fixed placement times (Rodrigues' formula)

    exp([a]ₓ θ) = 1 + sin θ [a]ₓ + (1 − cos θ) [a]ₓ²

where a is the joint axis. The pose of a prismatic joint is its fixed placement times the
translation θ a. Both are sums of constant matrices with scalar factors, so that all joints are
computed by the same operation.

q are the positions of all joints of the tree [rad or m], and θ [rad] those of the joints that are
not coupled to another one. The position q of a coupled joint is a polynomial of the position of its
master, which is usually linear. A prismatic joint moves by RACK per radian of θ (`JointUnits`). The
position of every joint is therefore a polynomial of one entry of θ, Σ terms_k θᵏ. With
A(θ) = ∂q/∂θ, pinocchio's gravity g, inertia M and Jacobian J with respect to q become Aᵀ g, Aᵀ M A
and J A with respect to θ.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.joint_units import PRISMATIC, JointUnits

REVOLUTE = ('JointModelRX', 'JointModelRY', 'JointModelRZ', 'JointModelRevoluteUnaligned')


class JointPoses(NamedTuple):
    """Poses of pinocchio's J joints in the root link's frame, in N postures.

    Joint 0 is the root link itself.
    """

    rotation: Array  # rotation matrices, (N, J, 3, 3)
    translation: Array  # joint origins [m], (N, J, 3)
    axis: Array  # joint axes, (N, J, 3); zero at index 0


#: refuse a coupling whose polynomial has more coefficients than this; two chained couplings of
#: degree 4 have degree 16
MOST_TERMS = 17


class Coupling(NamedTuple):
    """A joint that follows another: q = Σ terms_k · θ_masterᵏ."""

    master: str  # after `resolved`, a joint that is not coupled itself
    terms: tuple[float, ...]  # coefficients of all powers, at least two, the constant first

    @classmethod
    def of_terms(cls, master: str, terms: Sequence[float]) -> Coupling:
        """Return the coupling whose polynomial has these coefficients, the constant first."""
        offset, ratio, *higher = [*map(float, terms), 0.0, 0.0][: max(2, len(terms))]
        while higher and higher[-1] == 0.0:
            higher.pop()
        return cls(master, (offset, ratio, *higher))

    def value(self, master: Array | float) -> Array:
        """Return the position q of the joint [rad] or [m] for the position of its master."""
        return polyval(np.asarray(master), np.array(self.terms))

    def __str__(self) -> str:
        """Return the right side of the equation, such as '0.5 · elbow +0.1'."""
        offset, ratio, *higher = self.terms
        powers = [f'{c:+g} · {self.master}^{k}' for k, c in enumerate(higher, 2) if c]
        constant = [f'{offset:+g}'] if offset else []
        return ' '.join([f'{ratio:g} · {self.master}', *powers, *constant])


def resolved(couplings: Mapping[str, Coupling]) -> dict[str, Coupling]:
    """Replace chained couplings by direct couplings, whose masters are not coupled themselves.

    Raises:
        ValueError: If a joint follows itself, or if a polynomial has too many terms.
    """
    result = {}
    for slave, coupling in couplings.items():
        chain, terms, master = {slave}, np.polynomial.Polynomial(coupling.terms), coupling.master
        while master in couplings:
            if master in chain:
                joints = ', '.join(sorted(chain))
                raise ValueError(f'joint {slave!r} follows itself; joints of the loop: {joints}')
            chain.add(master)
            terms = terms(np.polynomial.Polynomial(couplings[master].terms))
            master = couplings[master].master
        if len(terms.coef) > MOST_TERMS:
            message = f'joint {slave!r} follows {master!r} by a polynomial of degree'
            raise ValueError(f'{message} {len(terms.coef) - 1}; legal: at most {MOST_TERMS - 1}')
        result[slave] = Coupling.of_terms(master, terms.coef.tolist())
    return result


def polyval(x: Array, terms: Array) -> Array:
    """Evaluate polynomials at x by Horner's rule.

    The last axis of `terms` holds the coefficients of each polynomial, the constant first.
    """
    result = np.broadcast_to(terms[..., -1], x.shape)
    for k in range(terms.shape[-1] - 2, -1, -1):
        result = result * x + terms[..., k]
    return result


def derivative(terms: Array) -> Array:
    """Return the coefficients of the derivatives of polynomials, the constant first, (..., K).

    There are as many coefficients as in `terms`, so the last coefficient is 0.
    """
    result = np.zeros_like(terms)
    result[..., :-1] = terms[..., 1:] * np.arange(1, terms.shape[-1])
    return result


def joint_axis(joint: pin.JointModel) -> Array:
    """Return the axis (3,) of a revolute or prismatic joint."""
    data = joint.createData()
    joint.calc(data, np.zeros(joint.idx_q + 1))
    return np.ravel(data.S).reshape(2, 3)[0 if joint.shortname() in PRISMATIC else 1]


class JointTree:
    """The joints of a pinocchio model, indexed as in pinocchio; index 0 is the root link.

    Attributes:
        order: Index in pinocchio's q and v of each entry of θ, (D,).
        parent: Index of each joint's parent, (J,).
        placement_rotation: Rotation of the fixed placement in the parent, (J, 3, 3).
        placement_translation: Translation of the fixed placement [m], (J, 3).
        prismatic: Whether each joint is prismatic, (J,).
        local_axis: Axis in the joint's own frame, (J, 3).
        placements: Fixed placement in the parent, homogeneous, (J, 4, 4).
        first: The pose in the parent is placement + a · first + b · second, with a = sin θ and
            b = 1 − cos θ for revolute joints, a = θ and b = 0 for prismatic ones, (J, 4, 4).
        second: See `first`, (J, 4, 4).
        theta_index: Index in θ of the entry that moves each joint, -1 for the root link, (J,).
        terms: Coefficients of q = Σ terms_k θᵏ, the constant first, (J, K).
        is_geared: Whether there are coupled or prismatic joints, so that ∂q/∂θ is not 1.
        is_nonlinear: Whether a coupling is not linear.
        moved_by: 1 where an entry of θ moves a joint of the tree, else 0, (J−1, D).
        descends_from: Entry [i, j] is true if joint i is joint j or a descendant of it, (J, J).
    """

    def __init__(
        self, model: pin.Model, units: JointUnits, couplings: Mapping[str, Coupling]
    ) -> None:
        """Read the tree of a model.

        Args:
            model: The model, which has only the joints of θ and the joints coupled to them.
            units: Names and units of the D joints of θ, in order.
            couplings: Coupling of each coupled joint, whose terms refer to positions.
        """
        joints = units.names
        count, ids = model.njoints, [model.getJointId(name) for name in joints]

        self.order = np.array([model.joints[i].idx_q for i in ids])
        self.parent = np.array(model.parents)
        #: pairs (joint, parent) of the joints whose parent is not the root link
        self._with_parent = [(i, up) for i, up in enumerate(self.parent.tolist()) if up > 0]
        self.placement_rotation = np.stack([m.rotation for m in model.jointPlacements])
        self.placement_translation = np.stack([m.translation for m in model.jointPlacements])
        self.prismatic = np.array([joint.shortname() in PRISMATIC for joint in model.joints])
        self.local_axis = np.zeros((count, 3))
        self.placements = np.stack([m.homogeneous for m in model.jointPlacements])
        self.first, self.second = np.zeros((2, count, 4, 4))
        for i, turn in enumerate(self.placement_rotation[1:], 1):
            axis = joint_axis(model.joints[i])
            self.local_axis[i], cross = axis, pin.skew(axis)
            if self.prismatic[i]:
                self.first[i, :3, 3] = turn @ axis
            else:
                self.first[i, :3, :3], self.second[i, :3, :3] = turn @ cross, turn @ cross @ cross
        self.theta_index = np.full(count, -1)
        self.theta_index[ids] = np.arange(len(ids))
        most = max([2, *(len(coupling.terms) for coupling in couplings.values())])
        self.terms = np.zeros((count, most))
        self.terms[ids, 1] = units.radian
        for name, coupling in couplings.items():
            i = model.getJointId(name)
            self.theta_index[i] = k = joints.index(coupling.master)
            powers = np.arange(len(coupling.terms))
            self.terms[i, powers] = np.array(coupling.terms) * units.radian[k] ** powers
        self.is_geared, self.is_nonlinear = bool(couplings) or bool(units.slides.any()), most > 2
        self.moved_by: Array = 1.0 * np.eye(len(ids))[self.theta_index[1:]]
        self.descends_from = np.eye(count, dtype=bool)
        for i in range(1, count):
            self.descends_from[i] |= self.descends_from[self.parent[i]]

    def in_parents(self, theta: Array) -> Array:
        """Return homogeneous poses (N, J, 4, 4) of all joints in their parents at θ (N, D)."""
        angle = theta[:, self.theta_index]
        if self.is_geared:
            angle = polyval(angle, self.terms)
        angle = angle[..., None, None]
        first, second = np.sin(angle), 1.0 - np.cos(angle)
        if self.prismatic.any():
            slides = self.prismatic[:, None, None]
            first, second = np.where(slides, angle, first), np.where(slides, 0.0, second)
        return self.placements + first * self.first + second * self.second

    def transforms(self, theta: Array) -> Array:
        """Return homogeneous poses (N, J, 4, 4) of all joints in the root's frame at θ (N, D)."""
        poses = self.in_parents(theta)
        for i, parent in self._with_parent:
            poses[:, i] = poses[:, parent] @ poses[:, i]
        return poses

    def joint_poses(self, theta: Array) -> JointPoses:
        """Return the poses of all joints in the root link's frame, for θ of shape (N, D)."""
        poses = self.transforms(theta)
        rotation = poses[..., :3, :3]
        axis = np.einsum('njab,jb->nja', rotation, self.local_axis)
        return JointPoses(rotation, poses[..., :3, 3], axis)

    def angles(self, theta: Array) -> Array:
        """Return the positions of all joints of the tree, including coupled joints, (..., J−1).

        Args:
            theta: Joint angles θ [rad], (..., D).

        Returns:
            The positions [rad] or [m] in pinocchio's order, without the root link.
        """
        q: Array = theta[..., self.theta_index[1:]]
        return polyval(q, self.terms[1:]) if self.is_geared else q

    def ratios(self, theta: Array) -> Array:
        """Return the speed of each joint of the tree relative to its entry of θ, (..., J−1).

        For a revolute joint that is not coupled, the ratio is 1. `theta` is θ [rad], (..., D).
        """
        return polyval(theta[..., self.theta_index[1:]], derivative(self.terms[1:]))

    def curvatures(self, theta: Array) -> Array:
        """Return the second derivative of each joint's position with respect to its entry of θ.

        Args:
            theta: Joint angles θ [rad], (..., D).

        Returns:
            One value for each joint of the tree, (..., J−1); 0 unless its coupling is nonlinear.
        """
        terms = derivative(derivative(self.terms[1:]))
        return polyval(theta[..., self.theta_index[1:]], terms)

    def transmission(self, theta: Array) -> Array:
        """Return the derivative of all joint positions q of the tree with respect to θ, (J−1, D).

        `theta` is θ [rad], (D,).
        """
        return self.ratios(theta)[:, None] * self.moved_by

    def of_theta(self, values: Array, theta: Array) -> Array:
        """Convert values for all joints of the tree into values for the joints of θ.

        The values are torques, or derivatives with respect to the joint positions q of the tree.
        They are multiplied by the transpose of ∂q/∂θ. The result for a joint of θ thus includes the
        values of the joints that are coupled to it.

        Args:
            values: One value for each joint of the tree, (*N, ..., J−1).
            theta: Joint angles θ [rad], (*N, D).

        Returns:
            Torques or derivatives with respect to θ, (*N, ..., D).
        """
        if not self.is_geared:
            of_joints: Array = values[..., self.order]
            return of_joints
        ratios = self.ratios(theta)
        between = (1,) * (values.ndim - ratios.ndim)
        ratios = ratios.reshape(*ratios.shape[:-1], *between, ratios.shape[-1])
        return (values * ratios) @ self.moved_by

    def of_both(self, matrix: Array, theta: Array) -> Array:
        """Convert a matrix of the tree's joints, such as an inertia, to the joints of θ, (D, D).

        The result is Aᵀ B A with A = ∂q/∂θ.

        Args:
            matrix: The matrix B, (J−1, J−1).
            theta: Joint angles θ [rad], (D,).
        """
        if not self.is_geared:
            return self.of_theta(self.of_theta(matrix, theta).T, theta).T
        transmission = self.transmission(theta)
        return transmission.T @ matrix @ transmission
