# SPDX-License-Identifier: Apache-2.0
"""The length of a tendon between two points, which may wrap around a sphere or a cylinder.

In the plane of the end points and the centre (sphere), or in the plane normal to the axis
(cylinder), the tendon is straight, or it follows a tangent, an arc and another tangent:

    length = √(a² − r²) + √(b² − r²) + r · arc        a, b: distances of the ends from the centre

On a cylinder the tendon also advances evenly along the axis, which gives √(length² + Δz²).

- Without a `side`, the tendon takes the short way around if a straight line would cut the object.
- With a `side`, it passes the object on that side.
- A side *inside* the object makes the object a ring through which the tendon runs.

A *swivelling pulley* turns about the line along which the tendon enters it, until the tendon leaves
in its plane. With the entry E, the direction f of entering, and the end at the height h along f and
the distance d from this line,

    length = (E − start) · f + r · arc + √(D² − r²),   arc = π − atan2(h, d − r) − acos(r / D)

where D = √((d − r)² + h²) is the distance of the end from the centre of the pulley.

The tangents are chosen as by MuJoCo's `mju_wrap`, so that imported models keep their lengths.
Where the tendon lifts off, the arc has length zero and the tangents lie on the straight line.
Length and moment arm are therefore continuous there. A point within RIM · r of the surface counts
as lying on the rim, that is, outside the object. In MuJoCo, rounding decides about such points.

Numba compiles the functions. The geometric model evaluates many segments in one call. The emulator
evaluates one segment after another in each step.
"""

import cmath
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.robot.description import Wrap
from musculoskeletal_ae.robot.kinematics import Kinematics

TINY = 1e-12  # divide by at least this, and count a smaller distance as zero
#: count a point as outside if it lies beneath the surface by less than this share of the radius
RIM = 1e-6
Vector = tuple[float, float, float] | Array


class WrapObjects(NamedTuple):
    """The sphere or cylinder of each of S segments, in the frame of the joint that carries it."""

    joint: Ints  # joint of the tree that carries the object, (S,)
    centre: Array  # centre of each object [m], (S, 3)
    axis: Array  # unit vector of a cylinder, zero for a sphere, (S, 3)
    #: side point [m], (S, 3); NaN if there is none. It is relative to the centre if the object and
    #: the side point have the same joint, otherwise in the frame of `side_joint`.
    side: Array
    side_joint: Ints  # joint of the tree that carries the side point, (S,)
    radius: Array  # radius of each object [m], (S,); 0 for a segment without an object
    #: whether it is a swivelling pulley, with its entry as centre and f as axis, (S,)
    swivels: Bools


def place_objects(kinematics: Kinematics, wraps: Sequence[Wrap]) -> WrapObjects:
    """Express the wrap objects of a robot description in the frames of the tree's joints.

    Args:
        kinematics: The kinematics of the robot.
        wraps: The wrap objects, in the frames of their links.
    """
    rows = []
    for wrap in wraps:
        joint, at = kinematics.placement(wrap.link)
        axis = np.zeros(3) if wrap.axis is None else at.rotation @ wrap.axis
        centre, side, carrier = at.act(wrap.xyz), np.full(3, np.nan), joint
        if wrap.side is not None:
            carrier, place = kinematics.attach(wrap.side_link or wrap.link, wrap.side)
            side = place - centre if carrier == joint else place
        rows.append((joint, centre, axis, side, carrier, wrap.radius, wrap.swivels))
    return WrapObjects(*map(np.array, zip(*rows)))


@njit(cache=True)
def _product(a: complex, b: complex) -> complex:
    """Return the dot product (real part) and cross product (imaginary part) of plane vectors.

    The complex numbers a and b are vectors in the plane.
    """
    return a.conjugate() * b


@njit(cache=True)
def _cross_each_other(a: complex, b: complex, c: complex, d: complex) -> bool:
    """Return whether the line segments a–b and c–d in the complex plane cross."""
    determinant = _product(b - a, d - c).imag
    if abs(determinant) < TINY:
        return False
    p = _product(d - c, a - c).imag / determinant
    q = _product(b - a, a - c).imag / determinant
    return 0.0 <= p <= 1.0 and 0.0 <= q <= 1.0


@njit(cache=True)
def _through_ring(a: complex, b: complex, r: float) -> tuple[bool, float, complex, complex]:
    """Bend a tendon through a ring of radius r around the origin of the complex plane.

    The tendon touches the ring at one point, where its two straight parts make the same angle with
    the radius. The sine z of this angle is the root of asin(r z / |a|) + asin(r z / |b|) −
    2 asin z + (angle between the ends) = 0.

    Args:
        a: Start of the tendon [m].
        b: End of the tendon [m].
        r: Radius of the ring [m].

    Returns:
        Whether the tendon touches the ring; its length [m]; and the unit vectors along the tendon,
        away from a and away from b. The last three are zero if it does not touch the ring.
    """
    straight = False, 0.0, 0j, 0j
    d, far, near = b - a, abs(a), abs(b)
    if min(far, near) < r * (1.0 - RIM) or abs(d) < TINY:
        return straight
    far, near = max(far, r), max(near, r)
    share = min(1.0, max(0.0, -_product(d, a).real / _product(d, d).real))
    cosine = _product(a, b).real / (far * near)
    if abs(a + share * d) <= r or cosine <= TINY - 1.0:
        return straight
    angle = math.acos(min(1.0, cosine))
    low, high = 0.0, 1.0
    for _ in range(60):
        z = 0.5 * (low + high)
        if math.asin(r * z / far) + math.asin(r * z / near) - 2.0 * math.asin(z) + angle > 0.0:
            low = z
        else:
            high = z
    turn = math.asin(low) - math.asin(r * low / far)
    touch = a / far * r * cmath.rect(1.0, math.copysign(turn, _product(a, b).imag))
    first, second = max(abs(touch - a), TINY), max(abs(touch - b), TINY)
    return True, first + second, (touch - a) / first, (touch - b) / second


@njit(cache=True)
def _beyond_rim(distance: float, r: float) -> float:
    """Return `distance` [m], or exactly the radius r if it differs from r by at most RIM · r.

    A point so near to the rim of the object thus counts as lying on the rim.
    """
    return r if abs(distance - r) <= RIM * r else distance


@njit(cache=True)
def _round(a: complex, b: complex, r: float, side: complex) -> tuple[bool, float, complex, complex]:
    """Wrap a tendon around a circle of radius r at the origin of the complex plane.

    Args:
        a: Start of the tendon [m].
        b: End of the tendon [m].
        r: Radius [m].
        side: Direction in which the tendon passes the circle, or 0 for the short way around.

    Returns:
        Whether the tendon wraps; its length [m]; and the unit vectors along the tendon, away from
        a and away from b. The last three are zero if it does not wrap.
    """
    straight = False, 0.0, 0j, 0j
    d, sided = b - a, abs(side) > 0.5
    far, near = _beyond_rim(abs(a), r), _beyond_rim(abs(b), r)
    if far < r or near < r or abs(d) < TINY:
        return straight
    nearest = a + min(1.0, max(0.0, -_product(d, a).real / _product(d, d).real)) * d
    passes = abs(nearest) > r * (1.0 - RIM) if min(far, near) == r else abs(nearest) > r
    if passes and (not sided or _product(side, nearest).real >= 0.0):
        return straight
    best, result = -1e9, straight
    for way in (1.0, -1.0):
        start = cmath.phase(a) + way * math.acos(r / far)
        end = cmath.phase(b) - way * math.acos(r / near)
        u, v = cmath.rect(r, start), cmath.rect(r, end)
        good = _product(u + v, side).real / (abs(u + v) + TINY) if sided else -abs(u - v)
        crosses = _cross_each_other(a, u, b, v)
        if crosses:
            good = -1e4
        if good > best:
            best, arc = good, (way * (end - start)) % (2.0 * math.pi)
            # Rounding may turn an arc of length zero into an almost full turn. Such an arc
            # therefore counts as no wrapping.
            wraps = not crosses and arc < 2.0 * math.pi - 1e-9
            length = math.sqrt(far**2 - r * r) + math.sqrt(near**2 - r * r) + r * arc
            # Each straight part has the direction of the tangent at its point of contact.
            result = wraps, length, way * 1j * u / r, -way * 1j * v / r
    return result


@njit(cache=True)
def dot(a: Vector, b: Vector) -> float:
    """Return the dot product a · b of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def cross(a: Vector, b: Vector) -> Vector:
    """Return the cross product a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def plus(a: Vector, b: Vector, scale: float = 1.0) -> Vector:
    """Return the vector a + scale · b."""
    return a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]


@njit(cache=True)
def _unit(a: Vector) -> Vector:
    size = max(math.sqrt(dot(a, a)), TINY)
    return a[0] / size, a[1] / size, a[2] / size


@njit(cache=True)
def _beside(a: Vector) -> Vector:
    """Return any unit vector that is perpendicular to the unit vector a."""
    return _unit(cross(a, (1.0, 0.0, 0.0) if abs(a[0]) < 0.6 else (0.0, 1.0, 0.0)))


@njit(cache=True)
def turned(rotation: Array, vector: Array) -> Vector:
    """Return a vector (3,), rotated by a matrix (3, 3)."""
    return dot(rotation[0], vector), dot(rotation[1], vector), dot(rotation[2], vector)


@njit(cache=True)
def side_of(objects: WrapObjects, s: int, rotation: Array, translation: Array) -> Vector:
    """Return the side point of object s, relative to its centre and in root-link axes [m].

    It is NaN if the object has no side.
    """
    j, k = objects.joint[s], objects.side_joint[s]
    side = turned(rotation[k], objects.side[s])
    if j == k:
        return side
    centre = plus(turned(rotation[j], objects.centre[s]), translation[j])
    return plus(plus(side, translation[k]), centre, -1.0)


@njit(cache=True)
def _over_pulley(a: Vector, b: Vector, forward: Vector, r: float) -> tuple[float, Vector, float]:
    """Guide a tendon over a swivelling pulley.

    Args:
        a: Start of the tendon, relative to the entry of the pulley [m].
        b: End of the tendon, relative to the entry [m].
        forward: Unit vector along which the tendon enters the pulley.
        r: Radius [m].

    Returns:
        The length [m], which is 0 if the end lies inside the pulley; the unit vector from the entry
        to the centre of the pulley; and the angle of the arc [rad].
    """
    height = dot(b, forward)
    away = plus(b, forward, -height)
    out = math.sqrt(dot(away, away)) - r
    distance = math.hypot(out, height)
    if distance <= r * (1.0 + RIM):
        return 0.0, away, 0.0
    arc = math.pi - math.atan2(height, out) - math.acos(r / distance)
    length = r * arc + math.sqrt(distance * distance - r * r) - dot(a, forward)
    return length, _unit(away), arc


@njit(cache=True)
def wrapped_segment(
    objects: WrapObjects, s: int, rotation: Array, translation: Array, start: Array, end: Array,
    leave: Array, arrive: Array,
) -> float:  # fmt: skip
    """Return the length of segment s [m] and write its directions into `leave` and `arrive`.

    Args:
        objects: The objects of all segments.
        s: Index of the segment.
        rotation: Rotations of the joints of the tree, (J, 3, 3).
        translation: Translations of the joints of the tree [m], (J, 3).
        start: Start point in the root link's frame [m], (3,).
        end: End point in the root link's frame [m], (3,).
        leave: Output: unit vector along the tendon away from the start, (3,).
        arrive: Output: unit vector along the tendon away from the end, (3,).
    """
    j, radius, line = objects.joint[s], objects.radius[s], plus(end, start, -1.0)
    straight = math.sqrt(dot(line, line))
    for k in range(3):
        leave[k] = line[k] / max(straight, TINY)
        arrive[k] = -leave[k]
    if radius <= 0.0:
        return straight
    axis, side = turned(rotation[j], objects.axis[s]), side_of(objects, s, rotation, translation)
    centre, sided = turned(rotation[j], objects.centre[s]), not math.isnan(side[0])
    a = plus(plus(start, translation[j], -1.0), centre, -1.0)
    b = plus(plus(end, translation[j], -1.0), centre, -1.0)
    if objects.swivels[s]:
        length, u, arc = _over_pulley(a, b, axis, radius)
        if length <= 0.0:
            return straight
        for k in range(3):
            leave[k] = axis[k]
            arrive[k] = -math.cos(arc) * axis[k] - math.sin(arc) * u[k]
        return length
    if dot(axis, axis) > 0.5:
        u = _beside(axis)
        v = cross(axis, u)
    else:
        u = _unit(a)
        normal = cross(u, _unit(b))  # uses unit vectors, because ends may be close to the centre
        if dot(normal, normal) < 1e-18:
            # The line passes through the centre: use the plane of the side, or any plane.
            normal = cross(a, side) if sided else _beside(u)
        v = cross(_unit(normal), u)
    flat_a, flat_b = complex(dot(a, u), dot(a, v)), complex(dot(b, u), dot(b, v))
    if sided and dot(side, side) < radius * radius:
        wraps, flat, first, last = _through_ring(flat_a, flat_b, radius)
    else:
        way = complex(dot(side, u), dot(side, v)) if sided else 0j
        wraps, flat, first, last = _round(flat_a, flat_b, radius, way / max(abs(way), TINY))
    if not wraps:
        return straight
    rise = dot(line, axis)
    length = math.sqrt(flat * flat + rise * rise)
    for k in range(3):
        leave[k] = (flat * (first.real * u[k] + first.imag * v[k]) + rise * axis[k]) / length
        arrive[k] = (flat * (last.real * u[k] + last.imag * v[k]) - rise * axis[k]) / length
    return length


@njit(cache=True, nogil=True)
def wrapped_segments(
    objects: WrapObjects, rotation: Array, translation: Array, start: Array, end: Array
) -> tuple[Array, Array, Array]:
    """Return lengths and directions of S segments, wrapped where necessary, in N postures.

    `wrapped_segment` describes the arguments, which have further axes (N) or (N, S) here.

    Returns:
        Lengths [m], (N, S), and the unit vectors away from the start and from the end, (N, S, 3).
    """
    lengths = np.zeros((start.shape[0], start.shape[1]))
    leave, arrive = np.zeros(start.shape), np.zeros(start.shape)
    for n in range(start.shape[0]):
        for s in range(start.shape[1]):
            lengths[n, s] = wrapped_segment(
                objects, s, rotation[n], translation[n], start[n, s], end[n, s],
                leave[n, s], arrive[n, s],
            )  # fmt: skip
    return lengths, leave, arrive


def arc_points(
    objects: WrapObjects, s: int, most: int, rotation: Array, translation: Array,
    start: Array, end: Array,
) -> Array:  # fmt: skip
    """Return points along the arc of segment s for drawing, in the root link's frame [m], (K, 3).

    K is 0 for a straight segment, 1 for a tendon that is bent through a ring, and `most` for an
    arc. `wrapped_segment` describes the other arguments.
    """
    leave, arrive = np.zeros(3), np.zeros(3)
    length = wrapped_segment(objects, s, rotation, translation, start, end, leave, arrive)
    if np.linalg.norm(leave + arrive) < 1e-9:
        return np.zeros((0, 3))
    j, radius = objects.joint[s], objects.radius[s]
    if objects.swivels[s]:
        entry = translation[j] + rotation[j] @ objects.centre[s]
        forward = rotation[j] @ objects.axis[s]
        _, towards, arc = _over_pulley(start - entry, end - entry, forward, radius)
        turn, u = np.linspace(0.0, arc, most)[:, None], np.array(towards)
        on_pulley: Array = entry + radius * (np.sin(turn) * forward + (1.0 - np.cos(turn)) * u)
        return on_pulley
    side = np.array(side_of(objects, s, rotation, translation))
    if side @ side < radius**2:
        # A ring: the straight parts meet at the point of contact.
        parts = np.linalg.lstsq(np.stack([leave, -arrive], axis=1), end - start, rcond=None)[0]
        return (start + parts[0] * leave)[None]
    axis, centre = rotation[j] @ objects.axis[s], translation[j] + rotation[j] @ objects.centre[s]
    across = np.eye(3) - np.outer(axis, axis)
    ahead, speed = across @ leave, float(np.linalg.norm(across @ leave))
    # The straight parts end where they are nearest to the axis of a cylinder, or the centre of a
    # sphere.
    first, last = ((centre - start) @ ahead / speed**2, (centre - end) @ across @ arrive / speed**2)
    turn = np.linspace(0.0, max(length - first - last, 0.0) * speed / radius, most)[:, None]
    begin = start + first * leave - centre
    along = (begin @ axis + turn * radius / speed * (leave @ axis)) * axis
    points: Array = centre + along + np.cos(turn) * (across @ begin)
    return points + np.sin(turn) * radius * ahead / speed
