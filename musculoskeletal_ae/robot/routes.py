# SPDX-License-Identifier: Apache-2.0
"""Muscle lengths and the muscle Jacobian of routes: straight lines, and wires that wrap.

    f_geo,abs(θ) = Σ over the route of |p_{i+1}(θ) − p_i(θ)| / divisor
    f_geo(θ)     = f_geo,abs(θ) − f_geo,abs(0)
    G(θ)         = ∂f_geo/∂θ

(paper, §III-B: start, relay and end points linearly connected.) G follows from
the velocity of the points, ∂p/∂θ_k = a_k × (p − o_k), projected on the lines d between them. Of a
segment that may wrap round a sphere or cylinder (`wrapping`) it is the velocity of the end points
as seen from that object's link, projected on the directions in which the wire leaves them. A
tendon may have several branches, which pulleys join: the length of each counts 1/divisor, and it
pulls with that share of the tension.
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

ARC = 9  # points of a wrapped wire's arc that are drawn
# Bounds the memory of one batched evaluation to a few tens of megabytes.
CHUNK = 4096
THREADED = 4  # more chunks are computed two at a time


def _in_chunks(method: Callable[[Routes, Array], Array]) -> Callable[[Routes, Array], Array]:
    """Let a method of θ (N, D) take θ (..., D), and evaluate it CHUNK rows at a time."""

    @wraps(method)
    def chunked(self: Routes, theta: Array) -> Array:
        rows = theta.reshape(-1, theta.shape[-1])
        parts = [rows[i : i + CHUNK] for i in range(0, max(len(rows), 1), CHUNK)]
        if len(parts) > THREADED:
            with ThreadPoolExecutor(2) as pool:  # numba and numpy let go of the interpreter
                values = np.concatenate(list(pool.map(partial(method, self), parts)))
        else:
            values = np.concatenate([method(self, part) for part in parts])
        return values.reshape(*theta.shape[:-1], *values.shape[1:])

    return chunked


class Routes:
    """The routes of M muscles over D joints as functions of θ: P points, S segments."""

    def __init__(self, kinematics: Kinematics, routes: Sequence[Route]) -> None:
        """Attach the routes of a description to the tree."""
        self._kinematics = kinematics
        links = ([kinematics.placement(item.link)[0] for item in route] for route in routes)
        hangs = [kinematics.tree.hangs_on[joints, 1:] for joints in links]
        # Joints of the tree: where two that turn together carry all of a route, it still changes.
        parted = np.array([some.any(axis=0) & ~some.all(axis=0) for some in hangs])
        #: joints that each muscle crosses: they or what follows them move some of it, (M, D)
        self.crossed: Bools = parted @ (kinematics.tree.moved_by > 0.0)
        pieces = [[item for item in route if isinstance(item, RoutePoint)] for route in routes]
        points = [point for points in pieces for point in points]
        attached = [kinematics.attach(point.link, point.xyz) for point in points]
        #: joint of the tree that carries each point, (P,), and the point in its frame [m], (P, 3)
        self.joint = np.array([joint for joint, _ in attached])
        self.point: Array = np.array([point for _, point in attached], dtype=float)
        owner = np.repeat(np.arange(len(pieces)), [len(points) for points in pieces])
        begins = np.array([point.divisor is not None for point in points])
        divisor = np.array([point.divisor or 1.0 for point in points])
        for p in np.flatnonzero(~begins & np.r_[False, owner[:-1] == owner[1:]]).tolist():
            divisor[p] = divisor[p - 1]
        #: points where each segment starts and ends, and its muscle, (S,)
        self.first = np.flatnonzero((owner[:-1] == owner[1:]) & ~begins[1:])
        self.second, self.muscle = self.first + 1, owner[self.first]
        #: share of its length that counts, (S,)
        self.weight: Array = 1.0 / divisor[self.first]
        self._sum: Array = self.weight * (np.arange(len(routes))[:, None] == self.muscle)
        #: segments that may wrap, and round what
        self.wrapping, self.objects = self._attach_objects(routes)
        #: pulls of wires: of each segment on both its ends, where it may wrap of either alone;
        #: points where they act, (Q,), which of the tree's joints lengthen it and which muscle's
        #: they are: (Q, J−1), (M, Q), and joints of the tree that move θ, (J−1, D)
        ends = self.first[self.wrapping], self.second[self.wrapping]
        self._pulled = np.concatenate([self.first, *ends])
        carried, moved = 1.0 * kinematics.tree.hangs_on[:, 1:], self.joint
        self._share = carried[moved[self.second]] - carried[moved[self.first]]
        if self.objects is not None:
            apart = [carried[self.objects.joint] - carried[moved[end]] for end in ends]
            self._share = np.concatenate([self._share, *apart])
        own = self._sum[:, self.wrapping]
        self._gather = np.concatenate([self._sum, own, own], axis=1)
        self.length_at_zero = self.absolute_lengths(np.zeros(len(kinematics.lower)))

    def _attach_objects(self, routes: Sequence[Route]) -> tuple[Ints, WrapObjects | None]:
        parts = [branch for route in routes for branch in branches(route)]
        steps = [step for branch in parts for step in pairwise(branch)]
        # A segment is counted where it begins, at a point.
        segment = np.cumsum([isinstance(item, RoutePoint) for item, _ in steps]) - 1
        wraps = {s: end for s, (_, end) in zip(segment, steps) if isinstance(end, Wrap)}
        if not wraps:
            return np.zeros(0, dtype=int), None
        # Only here, so that an arm of straight lines does not wait for numba.
        from musculoskeletal_ae.robot.wrapping import place_objects

        return np.array([*wraps]), place_objects(self._kinematics, [*wraps.values()])

    def _wrapped(self, poses: JointPoses, points: Array) -> tuple[Array, Array, Array]:
        """Return lengths (N, W) and pulls (N, W, 3) of the segments that may wrap."""
        from musculoskeletal_ae.robot.wrapping import wrapped_segments

        assert self.objects is not None  # asked by all callers
        start, end = points[:, self.first[self.wrapping]], points[:, self.second[self.wrapping]]
        turned, moved = (np.ascontiguousarray(part) for part in poses[:2])
        return wrapped_segments(self.objects, turned, moved, start, end)

    def drawn(self, theta: Array, points: Array | None = None) -> list[Array]:
        """Return each branch of a muscle at θ (D,) as a polyline with its arcs, (K, 3) [m].

        They stand in the order of `drawn_muscle`; see `points`.
        """
        poses = self._kinematics.tree.joint_poses(theta[None])
        points = self.placed(poses)[0] if points is None else points
        arcs = {}
        if self.objects is not None:
            from musculoskeletal_ae.robot.wrapping import touched

            at = np.ascontiguousarray(poses.rotation[0]), poses.translation[0].copy()
            for i, s in enumerate(self.wrapping.tolist()):
                ends = points[self.first[s]], points[self.second[s]]
                arcs[s] = touched(self.objects, i, ARC, *at, *ends)
        lines = []
        for own in self._branches:
            parts = [points[self.first[own[:1]]]]
            for s in own.tolist():
                parts += [arcs.get(s, points[:0]), points[self.second[s], None]]
            lines.append(np.concatenate(parts))
        return lines

    @cached_property
    def _branches(self) -> list[Ints]:
        """The segments of each branch."""
        gaps = np.flatnonzero(self.second[:-1] != self.first[1:]) + 1
        return list(np.split(np.arange(len(self.first)), gaps))

    @property
    def pieces_drawn(self) -> Ints:
        """How many straight pieces each polyline of `drawn` has at most."""
        wraps = np.isin(np.arange(len(self.first)), self.wrapping)
        return np.array([len(own) + ARC * wraps[own].sum() for own in self._branches])

    @property
    def drawn_muscle(self) -> Ints:
        """The muscle of each polyline of `drawn`."""
        return np.array([self.muscle[own[0]] for own in self._branches])

    def points(self, theta: Array) -> Array:
        """Return all route points in the root link's frame [m], shape (N, P, 3), θ (N, D)."""
        return self.placed(self._kinematics.tree.joint_poses(theta))

    def placed(self, poses: JointPoses, point: Array | None = None) -> Array:
        """Return route points, or other ones (P, 3) on the same links, for poses, (N, P, 3)."""
        rotation, translation = poses.rotation[:, self.joint], poses.translation[:, self.joint]
        point = self.point if point is None else point
        return np.einsum('npij,pj->npi', rotation, point) + translation

    def _segments(self, theta: Array) -> tuple[Array, Array]:
        """Return lengths (N, S) of the segments, and of the straight lines between their ends."""
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
        """Return f_geo,abs(θ) [m]: θ (..., D) gives (..., M)."""
        return self._segments(theta)[0] @ self._sum.T

    @_in_chunks
    def detours(self, theta: Array) -> Array:
        """Return what wrapping adds to straight lines [m]: θ (..., D) gives (..., M)."""
        return self.wound(theta) @ self._sum[:, self.wrapping].T

    @_in_chunks
    def wound(self, theta: Array) -> Array:
        """Return the same of each object, as described one after another: (..., W)."""
        if self.objects is None:
            return np.zeros((len(theta), 0))
        return np.subtract(*self._segments(theta))[:, self.wrapping]

    def relative_lengths(self, theta: Array) -> Array:
        """Return f_geo(θ) [m], zero at θ = 0: θ (..., D) gives (..., M)."""
        return self.absolute_lengths(theta) - self.length_at_zero

    @_in_chunks
    def muscle_jacobian(self, theta: Array) -> Array:
        """Return G(θ) [m/rad]: θ (..., D) gives (..., M, D)."""
        kin = self._kinematics
        poses = kin.tree.joint_poses(theta)
        points = self.placed(poses)
        line = points[:, self.second] - points[:, self.first]
        norm = np.linalg.norm(line, axis=-1, keepdims=True)
        pull = np.divide(line, norm, out=np.zeros_like(line), where=norm > 0.0)
        at = points[:, self._pulled]
        if self.objects is not None:
            _, leave, arrive = self._wrapped(poses, points)
            pull[:, self.wrapping] = 0.0
            pull = np.concatenate([pull, leave, arrive], axis=1)
        # d · (a × (p − o)) = a · (p × d) + (o × a) · d
        axis, origin = poses.axis[:, 1:], poses.translation[:, 1:]
        slides = kin.tree.prismatic[1:, None]
        turn, shift = np.where(slides, 0.0, axis), np.where(slides, axis, np.cross(origin, axis))
        screw = np.concatenate([turn, shift], axis=-1).swapaxes(-1, -2)
        longer = np.concatenate([np.cross(at, pull), pull], axis=-1) @ screw
        return kin.tree.of_theta(self._gather @ (self._share * longer), theta)
