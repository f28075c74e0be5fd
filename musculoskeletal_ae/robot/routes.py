# SPDX-License-Identifier: Apache-2.0
"""Muscle lengths and the muscle Jacobian of tendon routes, straight or wrapped around objects.

    f_geo,abs(θ) = Σ over the route of |p_{i+1}(θ) − p_i(θ)| / divisor
    f_geo(θ)     = f_geo,abs(θ) − f_geo,abs(0)
    G(θ)         = ∂f_geo/∂θ

(paper, §III-B: start, relay and end points linearly connected.) f_geo,abs is the length of a route
with the points p_i, and f_geo the same relative to θ = 0. If joint k turns about the axis a_k
through the point o_k, a point p of the route moves by ∂p/∂θ_k = a_k × (p − o_k). For a straight
segment, G is the difference of the motions of its two end points, projected onto the line between
them. For a segment that may wrap around a sphere or cylinder (`wrapping`), G is the motion of the
end points relative to the link of that object. This motion is projected onto the directions in
which the tendon leaves the end points.

A tendon may have several branches, joined by pulleys. The length of each branch counts 1/divisor,
and the branch carries 1/divisor of the tension.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, partial, wraps
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.robot.description import Route, RoutePoint, Wrap, branches
from musculoskeletal_ae.robot.joint_tree import JointPoses
from musculoskeletal_ae.robot.kinematics import Kinematics

if TYPE_CHECKING:
    from musculoskeletal_ae.robot.wrapping import WrapObjects

ARC = 9  # number of points that draw the arc of a wrapped tendon
#: evaluate this many postures at once, which limits the memory to a few tens of megabytes
CHUNK = 4096
TYPICAL = 200  # average moment arms over this many postures
MOST_SERIAL_CHUNKS = 4  # let two threads share the evaluation if there are more chunks than this


def _in_chunks(method: Callable[[Routes, Array], Array]) -> Callable[[Routes, Array], Array]:
    """Make a method that takes θ of shape (N, D) accept the shape (..., D).

    The method is evaluated for at most 4096 postures at a time, which limits its memory.
    """

    @wraps(method)
    def chunked(self: Routes, theta: Array) -> Array:
        rows = theta.reshape(-1, theta.shape[-1])
        parts = [rows[i : i + CHUNK] for i in range(0, max(len(rows), 1), CHUNK)]
        if len(parts) > MOST_SERIAL_CHUNKS:
            with ThreadPoolExecutor(2) as pool:  # numba and numpy release the GIL
                values = np.concatenate(list(pool.map(partial(method, self), parts)))
        else:
            values = np.concatenate([method(self, part) for part in parts])
        return values.reshape(*theta.shape[:-1], *values.shape[1:])

    return chunked


class Routes:
    """Lengths and muscle Jacobian of M muscles over D joints as functions of θ.

    The routes consist of P points and S segments, of which W may wrap around an object.
    """

    def __init__(self, kinematics: Kinematics, routes: Sequence[Route]) -> None:
        """Attach the routes of a description to the joints of the tree."""
        self._kinematics = kinematics
        links = ([kinematics.placement(item.link)[0] for item in route] for route in routes)
        carried_by = [kinematics.tree.descends_from[joints, 1:] for joints in links]
        # A joint of the tree changes the length of a route only if the joint carries some, but not
        # all, of the route's points. Coupled joints are considered one by one: two of them may
        # carry a whole route together and still change its length.
        crossed = np.array([some.any(axis=0) & ~some.all(axis=0) for some in carried_by])
        #: whether each muscle crosses each joint of θ or a joint coupled to it, (M, D)
        self.crossed: Bools = crossed @ (kinematics.tree.moved_by > 0.0)
        pieces = [[item for item in route if isinstance(item, RoutePoint)] for route in routes]
        points = [point for points in pieces for point in points]
        attached = [kinematics.attach(point.link, point.xyz) for point in points]
        #: joint of the tree that carries each point, (P,)
        self.joint = np.array([joint for joint, _ in attached])
        #: each point in the frame of that joint [m], (P, 3)
        self.point: Array = np.array([point for _, point in attached], dtype=float)
        owner = np.repeat(np.arange(len(pieces)), [len(points) for points in pieces])
        begins = np.array([point.divisor is not None for point in points])
        divisor = np.array([point.divisor or 1.0 for point in points])
        for p in np.flatnonzero(~begins & np.r_[False, owner[:-1] == owner[1:]]).tolist():
            divisor[p] = divisor[p - 1]
        #: start point, end point and muscle of each segment, (S,)
        self.first = np.flatnonzero((owner[:-1] == owner[1:]) & ~begins[1:])
        self.second, self.muscle = self.first + 1, owner[self.first]
        #: factor with which the length of each segment counts in that of its muscle, (S,)
        self.weight: Array = 1.0 / divisor[self.first]
        self._sum: Array = self.weight * (np.arange(len(routes))[:, None] == self.muscle)
        #: segments that may wrap, and the objects around which they wrap
        self.wrapping, self.objects = self._attach_objects(routes)
        # Tendon forces, Q = S + 2 W. Each acts between two bodies, and counts once. Every segment
        # has one force, between its end points. A segment that may wrap has two more, one between
        # each end point and the object.
        ends = self.first[self.wrapping], self.second[self.wrapping]
        #: point at which each force acts, (Q,)
        self._force_point = np.concatenate([self.first, *ends])
        #: ±1 where a joint of the tree moves only one of the two bodies between which a force acts,
        #: else 0, (Q, J−1)
        carried, moved = 1.0 * kinematics.tree.descends_from[:, 1:], self.joint
        self._share = carried[moved[self.second]] - carried[moved[self.first]]
        if self.objects is not None:
            apart = [carried[self.objects.joint] - carried[moved[end]] for end in ends]
            self._share = np.concatenate([self._share, *apart])
        #: weight of each force in the sum of each muscle, (M, Q)
        own = self._sum[:, self.wrapping]
        self._gather = np.concatenate([self._sum, own, own], axis=1)
        self.length_at_zero = self.absolute_lengths(np.zeros(len(kinematics.lower)))

    def _attach_objects(self, routes: Sequence[Route]) -> tuple[Ints, WrapObjects | None]:
        parts = [branch for route in routes for branch in branches(route)]
        steps = [step for branch in parts for step in pairwise(branch)]
        # Number the segments by their start points, because a wrap lies within a segment.
        segment = np.cumsum([isinstance(item, RoutePoint) for item, _ in steps]) - 1
        wraps = {s: end for s, (_, end) in zip(segment, steps) if isinstance(end, Wrap)}
        if not wraps:
            return np.zeros(0, dtype=int), None
        # Imported here so that arms without wraps do not wait for numba.
        from musculoskeletal_ae.robot.wrapping import place_objects

        return np.array([*wraps]), place_objects(self._kinematics, [*wraps.values()])

    def _wrapped(self, poses: JointPoses, points: Array) -> tuple[Array, Array, Array]:
        """Return lengths (N, W) of the segments that may wrap, and unit vectors at both ends.

        The unit vectors (N, W, 3) point along the tendon, away from the start and from the end.
        """
        from musculoskeletal_ae.robot.wrapping import wrapped_segments

        assert self.objects is not None  # callers check this
        start, end = points[:, self.first[self.wrapping]], points[:, self.second[self.wrapping]]
        turned, moved = (np.ascontiguousarray(part) for part in poses[:2])
        return wrapped_segments(self.objects, turned, moved, start, end)

    def drawn(self, theta: Array, points: Array | None = None) -> list[Array]:
        """Return the routes of all muscles in a posture as polylines, for drawing.

        An arc around an object consists of several points.

        Args:
            theta: Joint angles [rad], (D,).
            points: Route points in the root link's frame [m], (P, 3); by default those at `theta`.

        Returns:
            For each branch of a route, its points in the root link's frame [m], (K, 3).
            `drawn_muscle` states to which muscle each branch belongs.
        """
        poses = self._kinematics.tree.joint_poses(theta[None])
        points = self.placed(poses)[0] if points is None else points
        arcs = {}
        if self.objects is not None:
            from musculoskeletal_ae.robot.wrapping import arc_points

            at = np.ascontiguousarray(poses.rotation[0]), poses.translation[0].copy()
            for i, s in enumerate(self.wrapping.tolist()):
                ends = points[self.first[s]], points[self.second[s]]
                arcs[s] = arc_points(self.objects, i, ARC, *at, *ends)
        lines = []
        for own in self._branches:
            parts = [points[self.first[own[:1]]]]
            for s in own.tolist():
                parts += [arcs.get(s, points[:0]), points[self.second[s], None]]
            lines.append(np.concatenate(parts))
        return lines

    @cached_property
    def _branches(self) -> list[Ints]:
        """Indices of the segments of each branch."""
        gaps = np.flatnonzero(self.second[:-1] != self.first[1:]) + 1
        return list(np.split(np.arange(len(self.first)), gaps))

    @cached_property
    def typical_arms(self) -> Array:
        """Root mean square moment arm of each muscle over the joint ranges [m], (M,).

        The mean is taken over the joints that the muscle crosses.
        """
        low, high = self._kinematics.lower, self._kinematics.upper
        theta = np.random.default_rng(0).uniform(low, high, (TYPICAL, len(low)))
        crossed = np.maximum(self.crossed.sum(axis=1), 1)
        squares = np.square(self.muscle_jacobian(theta)).sum(axis=2)
        result: Array = np.sqrt(squares.mean(axis=0) / crossed)
        return result

    @property
    def pieces_drawn(self) -> Ints:
        """Largest number of straight pieces that each polyline of `drawn` can have."""
        wraps = np.isin(np.arange(len(self.first)), self.wrapping)
        return np.array([len(own) + ARC * wraps[own].sum() for own in self._branches])

    @property
    def drawn_muscle(self) -> Ints:
        """Index of the muscle of each polyline of `drawn`."""
        return np.array([self.muscle[own[0]] for own in self._branches])

    def points(self, theta: Array) -> Array:
        """Return all route points in the root link's frame [m] (N, P, 3) at θ (N, D)."""
        return self.placed(self._kinematics.tree.joint_poses(theta))

    def placed(self, poses: JointPoses, point: Array | None = None) -> Array:
        """Return route points in the root link's frame [m], (N, P, 3).

        Args:
            poses: Poses of the joints in N postures.
            point: Points in the frames of their joints [m], (P, 3); by default those of the routes.
        """
        rotation, translation = poses.rotation[:, self.joint], poses.translation[:, self.joint]
        point = self.point if point is None else point
        return np.einsum('npij,pj->npi', rotation, point) + translation

    def _segments(self, theta: Array) -> tuple[Array, Array]:
        """Return the lengths of all segments, with wrapping and as straight lines.

        Args:
            theta: Joint angles in N postures [rad], (N, D).

        Returns:
            The lengths, and the distances between the end points [m], (N, S) each.
        """
        poses = self._kinematics.tree.joint_poses(theta)
        points = self.placed(poses)
        straight = np.linalg.norm(points[:, self.second] - points[:, self.first], axis=-1)
        if self.objects is None:
            return straight, straight
        lengths = straight.copy()
        lengths[:, self.wrapping] = self._wrapped(poses, points)[0]
        return lengths, straight

    @_in_chunks
    def absolute_lengths(self, theta: Array) -> Array:
        """Return the length of each muscle's route [m], (..., M), at θ [rad], (..., D)."""
        return self._segments(theta)[0] @ self._sum.T

    def moved(self, poses: JointPoses, point: Array) -> tuple[Array, Array]:
        """Return the lengths of routes with other points, and the gradients of these lengths.

        Args:
            poses: Poses of the joints in N postures.
            point: Points in the frames of their joints [m], (P, 3).

        Returns:
            Lengths [m], (N, M), and for each point the derivative of its muscle's length with
            respect to the point's position in the frame of its joint, (N, P, 3).
        """
        points = self.placed(poses, point)
        line = points[:, self.second] - points[:, self.first]
        lengths = np.linalg.norm(line, axis=-1)
        leave = line / np.maximum(lengths, 1e-9)[..., None]
        arrive = -leave
        if self.objects is not None:
            own = self.wrapping
            lengths[:, own], leave[:, own], arrive[:, own] = self._wrapped(poses, points)
        # A point begins at most one segment, and ends at most one.
        by_point, weight = np.zeros_like(points), self.weight[:, None]
        by_point[:, self.first] -= weight * leave
        by_point[:, self.second] -= weight * arrive
        return lengths @ self._sum.T, np.einsum(
            'npi,npij->npj', by_point, poses.rotation[:, self.joint]
        )

    @_in_chunks
    def detours(self, theta: Array) -> Array:
        """Return the length that wrapping adds to each muscle [m] (..., M) at θ (..., D)."""
        return self.wound(theta) @ self._sum[:, self.wrapping].T

    @_in_chunks
    def wound(self, theta: Array) -> Array:
        """Return the length that wrapping around each object adds [m] (..., W) at θ (..., D)."""
        if self.objects is None:
            return np.zeros((len(theta), 0))
        return np.subtract(*self._segments(theta))[:, self.wrapping]

    def relative_lengths(self, theta: Array) -> Array:
        """Return the route lengths relative to those at θ = 0 [m], (..., M), at θ (..., D)."""
        return self.absolute_lengths(theta) - self.length_at_zero

    @_in_chunks
    def muscle_jacobian(self, theta: Array) -> Array:
        """Return the muscle Jacobian G = ∂l/∂θ [m/rad], (..., M, D), at θ [rad], (..., D)."""
        kin = self._kinematics
        poses = kin.tree.joint_poses(theta)
        points = self.placed(poses)
        line = points[:, self.second] - points[:, self.first]
        norm = np.linalg.norm(line, axis=-1, keepdims=True)
        pull = np.divide(line, norm, out=np.zeros_like(line), where=norm > 0.0)
        at = points[:, self._force_point]
        if self.objects is not None:
            _, leave, arrive = self._wrapped(poses, points)
            pull[:, self.wrapping] = 0.0
            pull = np.concatenate([pull, leave, arrive], axis=1)
        # A turn about the axis a through o moves a point p along the direction d of the tendon by
        #     d · (a × (p − o)) = a · (p × d) + (o × a) · d
        # where d is `pull`, p is `at`, a is `axis` and o is `origin`.
        axis, origin = poses.axis[:, 1:], poses.translation[:, 1:]
        slides = kin.tree.prismatic[1:, None]
        turn, shift = np.where(slides, 0.0, axis), np.where(slides, axis, np.cross(origin, axis))
        screw = np.concatenate([turn, shift], axis=-1).swapaxes(-1, -2)
        longer = np.concatenate([np.cross(at, pull), pull], axis=-1) @ screw
        return kin.tree.of_theta(self._gather @ (self._share * longer), theta)
