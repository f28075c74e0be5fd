# SPDX-License-Identifier: Apache-2.0
"""A wire between two points that a sphere or a cylinder may stand in the way of.

In the plane of the end points and the centre (sphere) or across the axis (cylinder), the wire goes
straight, or along a tangent, round by an arc, and off along the other tangent:

    length = √(a² − r²) + √(b² − r²) + r · arc        a, b: distances of the ends from the centre

On a cylinder the wire also advances evenly along the axis: √(length² + Δz²). Without a `side` it
wraps where the straight line would cut the object, the short way round. With one it passes the
object on that side; a side *inside* the object makes it a ring that the wire runs through. Which
tangents, and when, is MuJoCo's choice (its `mju_wrap`), so that its models keep their lengths. At
the points where the wire lifts off the arc is nil and tangents and straight line are the same, so
that length and moment arm are continuous. Compiled by numba for one wire: the geometric model
calls it for many, the emulator in each of its steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.robot.description import Wrap
from musculoskeletal_ae.robot.kinematics import Kinematics

TINY = 1e-12
Vector = tuple[float, float, float]


class WrapObjects(NamedTuple):
    """One sphere or cylinder for each segment that has one, in the frame of its tree joint."""

    joint: Ints  # (S,)
    centre: Array  # [m], (S, 3)
    axis: Array  # unit vector of a cylinder, zero for a sphere, (S, 3)
    side: Array  # from the centre [m], NaN for none, (S, 3)
    radius: Array  # [m], 0 for no object, (S,)


def place_objects(kinematics: Kinematics, wraps: Sequence[Wrap]) -> WrapObjects:
    """Return what a description wraps segments round, one each, in the frames of tree joints."""
    joints, poses = zip(*(kinematics.placement(wrap.link) for wrap in wraps))
    rows = [
        (
            at.act(wrap.xyz),
            np.zeros(3) if wrap.axis is None else at.rotation @ wrap.axis,
            np.full(3, np.nan) if wrap.side is None else at.rotation @ (wrap.side - wrap.xyz),
            wrap.radius,
        )
        for at, wrap in zip(poses, wraps)
    ]
    return WrapObjects(np.array(joints), *map(np.array, zip(*rows)))


@njit(cache=True)
def _meet(ax: float, ay: float, bx: float, by: float, cx: float, cy: float, dx: float, dy: float) -> bool:  # noqa: E501  # fmt: skip
    """Return whether the segments a–b and c–d cross."""
    determinant = (dy - cy) * (bx - ax) - (dx - cx) * (by - ay)
    if abs(determinant) < TINY:
        return False
    p = ((dx - cx) * (ay - cy) - (dy - cy) * (ax - cx)) / determinant
    q = ((bx - ax) * (ay - cy) - (by - ay) * (ax - cx)) / determinant
    return 0.0 <= p <= 1.0 and 0.0 <= q <= 1.0


@njit(cache=True)
def _through_ring(ax: float, ay: float, bx: float, by: float, r: float) -> tuple[bool, float, float]:  # noqa: E501  # fmt: skip
    """Return whether a wire is drawn to a ring's inside, and the point where it touches it.

    There both straight parts make the same angle with the radius: with z its sine,
    asin(r z / a) + asin(r z / b) − 2 asin z + (angle between the ends) = 0.
    """
    a, b = math.hypot(ax, ay), math.hypot(bx, by)
    square = (bx - ax) ** 2 + (by - ay) ** 2
    if a <= r or b <= r or square < TINY:
        return False, 0.0, 0.0
    share = -((bx - ax) * ax + (by - ay) * ay) / square
    if 0.0 < share < 1.0 and math.hypot(ax + share * (bx - ax), ay + share * (by - ay)) <= r:
        return False, 0.0, 0.0
    cosine = (ax * bx + ay * by) / (a * b)
    if cosine <= -1.0 + TINY:
        return False, 0.0, 0.0
    angle = math.acos(min(1.0, cosine))
    low, high = 0.0, 1.0
    for _ in range(60):
        z = 0.5 * (low + high)
        if math.asin(r * z / a) + math.asin(r * z / b) - 2.0 * math.asin(z) + angle > 0.0:
            low = z
        else:
            high = z
    turn = math.asin(low) - math.asin(r * low / a)
    if ax * by - ay * bx < 0.0:
        turn = -turn
    start = math.atan2(ay, ax) + turn
    return True, r * math.cos(start), r * math.sin(start)


@njit(cache=True)
def _flat(ax: float, ay: float, bx: float, by: float, r: float, sided: bool, sx: float, sy: float) -> tuple[bool, float, float, float, float, float]:  # noqa: E501  # fmt: skip
    """Return whether it wraps in the plane, its length, and the unit pulls at a and at b."""
    straight = False, 0.0, 0.0, 0.0, 0.0, 0.0
    da, db = math.hypot(ax, ay), math.hypot(bx, by)
    dx, dy = bx - ax, by - ay
    square = dx * dx + dy * dy
    if da < r or db < r or square < TINY * TINY:
        return straight
    share = min(1.0, max(0.0, -(dx * ax + dy * ay) / square))
    nx, ny = ax + share * dx, ay + share * dy
    if nx * nx + ny * ny > r * r and (not sided or sx * nx + sy * ny >= 0.0):
        return straight
    best, found = -1e9, False
    arc = ta = tb = chosen = 0.0
    for way in (1.0, -1.0):
        pa = math.atan2(ay, ax) + way * math.acos(r / da)
        pb = math.atan2(by, bx) - way * math.acos(r / db)
        ux, uy, vx, vy = r * math.cos(pa), r * math.sin(pa), r * math.cos(pb), r * math.sin(pb)
        if sided:
            middle = math.hypot(ux + vx, uy + vy) + TINY
            good = ((ux + vx) * sx + (uy + vy) * sy) / middle
        else:
            good = -((ux - vx) ** 2) - (uy - vy) ** 2
        crosses = _meet(ax, ay, ux, uy, bx, by, vx, vy)
        if crosses:
            good = -1e4
        if good > best:
            # An arc that rounding made just less than nothing is no turn round the object.
            best, turn = good, (way * (pb - pa)) % (2.0 * math.pi)
            found = not crosses and turn < 2.0 * math.pi - 1e-9
            arc, ta, tb = turn, pa, pb
            chosen = way
    if not found:
        return straight
    length = math.sqrt(da * da - r * r) + math.sqrt(db * db - r * r) + r * arc
    # Where it meets the circle, the wire goes the way it turns.
    return True, length, -chosen * math.sin(ta), chosen * math.cos(ta), chosen * math.sin(tb), -chosen * math.cos(tb)  # noqa: E501  # fmt: skip


@njit(cache=True)
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def _cross(a: Vector, b: Vector) -> Vector:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@njit(cache=True)
def _unit(a: Vector) -> Vector:
    size = max(math.sqrt(_dot(a, a)), TINY)
    return a[0] / size, a[1] / size, a[2] / size


@njit(cache=True)
def _beside(a: Vector) -> Vector:
    """Return some unit vector across another one."""
    x, y, z = abs(a[0]), abs(a[1]), abs(a[2])
    if x <= y and x <= z:
        return _unit((0.0, -a[2], a[1]))
    if y <= z:
        return _unit((a[2], 0.0, -a[0]))
    return _unit((-a[1], a[0], 0.0))


@njit(cache=True)
def _placed(rotation: Array, vector: Array) -> Vector:
    return (
        rotation[0, 0] * vector[0] + rotation[0, 1] * vector[1] + rotation[0, 2] * vector[2],
        rotation[1, 0] * vector[0] + rotation[1, 1] * vector[1] + rotation[1, 2] * vector[2],
        rotation[2, 0] * vector[0] + rotation[2, 1] * vector[1] + rotation[2, 2] * vector[2],
    )


@njit(cache=True)
def wrapped_segment(
    objects: WrapObjects, s: int, rotation: Array, translation: Array, start: Array, end: Array,
    leave: Array, arrive: Array,
) -> float:  # fmt: skip
    """Return the length [m] of segment s from start to end, points in the root link's frame.

    The objects are placed by the poses (J, 3, 3), (J, 3) of the tree's joints. Fills the unit
    vectors along which the wire pulls its start (`leave`) and its end (`arrive`).
    """
    j, radius = objects.joint[s], objects.radius[s]
    centre = _placed(rotation[j], objects.centre[s])
    axis, side = _placed(rotation[j], objects.axis[s]), _placed(rotation[j], objects.side[s])
    base = translation[j]
    x, y, z = centre[0] + base[0], centre[1] + base[1], centre[2] + base[2]
    a = (start[0] - x, start[1] - y, start[2] - z)
    b = (end[0] - x, end[1] - y, end[2] - z)
    line = (end[0] - start[0], end[1] - start[1], end[2] - start[2])
    straight = math.sqrt(_dot(line, line))
    for k in range(3):
        leave[k] = line[k] / max(straight, TINY)
        arrive[k] = -leave[k]
    sided = not math.isnan(side[0])
    if _dot(axis, axis) > 0.5:
        u = _beside(axis)
        v = _cross(axis, u)
    else:
        u, normal = _unit(a), _cross(a, b)
        if _dot(normal, normal) < 1e-18 * _dot(a, a) * _dot(b, b):
            # Through the centre every plane is as good: take that of the side, or any.
            normal = _cross(a, side) if sided else _beside(u)
        v = _cross(_unit(normal), u)
    ax, ay, bx, by = _dot(a, u), _dot(a, v), _dot(b, u), _dot(b, v)
    sx = sy = 0.0
    if sided and _dot(side, side) < radius * radius:
        wraps, tx, ty = _through_ring(ax, ay, bx, by, radius)
        first, second = math.hypot(tx - ax, ty - ay), math.hypot(tx - bx, ty - by)
        flat = first + second
        lx, ly = (tx - ax) / max(first, TINY), (ty - ay) / max(first, TINY)
        rx, ry = (tx - bx) / max(second, TINY), (ty - by) / max(second, TINY)
    else:
        if sided:
            sx, sy = _dot(side, u), _dot(side, v)
            size = max(math.hypot(sx, sy), TINY)
            sx, sy = sx / size, sy / size
        wraps, flat, lx, ly, rx, ry = _flat(ax, ay, bx, by, radius, sided, sx, sy)
    if not wraps:
        return straight
    rise = _dot(line, axis)
    length = math.sqrt(flat * flat + rise * rise)
    for k in range(3):
        leave[k] = (flat * (lx * u[k] + ly * v[k]) + rise * axis[k]) / length
        arrive[k] = (flat * (rx * u[k] + ry * v[k]) - rise * axis[k]) / length
    return length


@njit(cache=True)
def wrapped_segments(
    objects: WrapObjects, rotation: Array, translation: Array, start: Array, end: Array
) -> tuple[Array, Array, Array]:
    """Return lengths (N, S) and pulls at start and end (N, S, 3) of segments, ends (N, S, 3)."""
    lengths = np.zeros((start.shape[0], start.shape[1]))
    leave, arrive = np.zeros(start.shape), np.zeros(start.shape)
    for n in range(start.shape[0]):
        for s in range(start.shape[1]):
            lengths[n, s] = wrapped_segment(
                objects, s, rotation[n], translation[n], start[n, s], end[n, s],
                leave[n, s], arrive[n, s],
            )  # fmt: skip
    return lengths, leave, arrive


def touched(
    objects: WrapObjects, s: int, rotation: Array, translation: Array, start: Array, end: Array
) -> Array:
    """Return points along the arc of one wrapped segment for drawing, (K, 3); none if straight."""
    leave, arrive = np.zeros(3), np.zeros(3)
    length = wrapped_segment(objects, s, rotation, translation, start, end, leave, arrive)
    if np.linalg.norm(leave + arrive) < 1e-9:
        return np.zeros((0, 3))
    j = objects.joint[s]
    axis = rotation[j] @ objects.axis[s]
    centre = translation[j] + rotation[j] @ objects.centre[s]

    def across(vector: Array) -> Array:
        return vector - (vector @ axis) * axis

    if objects.side[s] @ objects.side[s] < objects.radius[s] ** 2:
        # A ring: the straight parts meet where the wire touches it.
        both = np.stack([leave, -arrive], axis=1)
        first = float(np.linalg.lstsq(both, end - start, rcond=None)[0][0])
        return (start + first * leave)[None]

    def foot(point: Array, pull: Array) -> float:
        flat = across(pull)
        return float(-(across(point - centre) @ flat) / (flat @ flat))

    first, last = foot(start, leave), foot(end, arrive)
    arc = max(length - first - last, 0.0)
    ahead = across(leave)
    speed = np.linalg.norm(ahead)
    turn = np.linspace(0.0, speed * arc / objects.radius[s], 9)[:, None]
    begin = start + first * leave - centre
    along = begin @ axis + turn * objects.radius[s] / speed * (leave @ axis)
    points: Array = centre + along * axis + np.cos(turn) * across(begin)
    return points + np.sin(turn) * objects.radius[s] * ahead / speed
