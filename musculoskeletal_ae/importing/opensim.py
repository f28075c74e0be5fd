# SPDX-License-Identifier: Apache-2.0
"""OpenSim models (.osim of version 4), without OpenSim.

A joint becomes a chain of massless links, one for each axis that moves, translations before
rotations as OpenSim applies them. An axis whose value is the coordinate itself carries it; others
are coupled to it, by the line nearest to their function. Moving path points stand at the mean of
where they move; of the conditional ones those are kept that let the length change most as it does.
The source's own lengths are computed with all these as OpenSim has them, so that the error shows
what the approximation costs; wrap objects are those of the result on both sides.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin
from scipy.interpolate import CubicSpline

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.importing.source import (
    STRENGTH,
    Function,
    Source,
    inertia,
    numbers,
    refuse,
    safe_name,
)
from musculoskeletal_ae.robot.description import RoutePoint, Wrap
from musculoskeletal_ae.robot.kinematics import Kinematics

OLDEST = 40000  # version of a document: joints in a JointSet, frames by sockets

#: axis of each coordinate of joints without a SpatialTransform; it slides along capital letters
AXES = {
    'PinJoint': 'z',
    'SliderJoint': 'X',
    'UniversalJoint': 'xy',
    'BallJoint': 'xyz',
    'GimbalJoint': 'xyz',
    'PlanarJoint': 'zXY',
    'WeldJoint': '',
}


class Axis(NamedTuple):
    """One axis of a joint: its value is a function of a coordinate, or of none."""

    slides: bool
    axis: Array
    coordinate: str
    function: Function


class Coordinate(NamedTuple):
    """A coordinate of the model."""

    low: float
    high: float
    default: float
    locked: bool


class Point(NamedTuple):
    """A path point as OpenSim has it."""

    body: str
    at: list[
        tuple[str, Function]
    ]  # in the body, a function of a coordinate ('': none) for each axis
    condition: tuple[str, float, float] | None  # active while the coordinate is within


class Postures(NamedTuple):
    """Postures in which lengths are asked for."""

    values: dict[str, Array]  # of coordinates, '' is 0, (N,)
    poses: Array  # of the model's joints, (N, J, 4, 4)


def read_osim(file: Path, root: ET.Element) -> Source:
    """Read an .osim file."""
    model, version = root.find('Model'), root.get('Version', '0')
    if model is None or not version.isdigit() or int(version) < OLDEST:
        told = f'expected a Model of version {OLDEST} or later, got {version[:20]!r}'
        raise refuse(file, f'{told}; open it in OpenSim 4 and save it')
    return _Reader(model).source


def _vector(element: ET.Element, tag: str, count: int = 3) -> Array:
    where = f'{element.tag} {element.get("name")}: {tag}'
    return numbers(element.findtext(tag) or '0 ' * count, count, where)


def _number(element: ET.Element, tag: str) -> float:
    return float(_vector(element, tag, 1)[0])


def _word(element: ET.Element, tag: str) -> str:
    """Return the last part of a path, or ''."""
    return element.findtext(tag, '').strip().split('/')[-1]


def _turn(angles: Array) -> Array:
    """Return the rotation of body-fixed x-y-z angles [rad]."""
    x, y, z = (pin.exp3(axis * angle) for axis, angle in zip(np.eye(3), angles))
    turned: Array = x @ y @ z
    return turned


def _function(element: ET.Element | None) -> Function:
    """Return a function of OpenSim; splines go on straight beyond their points."""
    if element is None:
        return np.poly1d([0.0])
    kind = element.tag
    if kind == 'function' or kind.endswith('_location') or kind == 'coupled_coordinates_function':
        return _function(next(iter(element), None))
    if kind == 'Constant':
        return np.poly1d(_vector(element, 'value', 1))
    if kind in ('LinearFunction', 'PolynomialFunction'):
        words = element.findtext('coefficients', '0').split()
        return np.poly1d(numbers(' '.join(words), len(words), f'{kind}: coefficients'))
    if kind == 'MultiplierFunction':
        inner, scale = _function(element.find('function')), _number(element, 'scale')
        return lambda x: scale * inner(x)
    if kind not in ('SimmSpline', 'NaturalCubicSpline', 'PiecewiseLinearFunction'):
        raise ValueError(f'a {kind} is not read')
    count = len(element.findtext('x', '').split())
    x, y = _vector(element, 'x', count), _vector(element, 'y', count)
    if count < 2 or not (np.diff(x) > 0.0).all():
        raise ValueError(f'a {kind} needs at least 2 points with rising x')
    if kind == 'PiecewiseLinearFunction' or count == 2:
        return lambda at: np.interp(at, x, y)
    spline = CubicSpline(x, y, bc_type='natural' if kind.startswith('Natural') else 'not-a-knot')

    def value(at: Array) -> Array:
        inside = np.clip(at, x[0], x[-1])
        return np.asarray(spline(inside) + spline(inside, 1) * (at - inside))

    return value


class _Reader:
    def __init__(self, model: ET.Element) -> None:
        self.model, self.source = model, Source(safe_name(model.get('name'), 'robot'))
        down = model.find('gravity') is None
        self.source.model.gravity.linear = -np.eye(3)[1] if down else _vector(model, 'gravity')
        self.coordinates = {
            e.get('name', ''): self._coordinate(e) for e in model.iter('Coordinate')
        }
        #: coordinate that follows another, and how
        self.coupled: dict[str, tuple[str, Function]] = {}
        #: coordinate that each joint of the result follows as OpenSim has it, and how
        self.moves: dict[str, tuple[str, Function]] = {}
        #: body that a frame belongs to, and its pose there
        self.frames = {'ground': ('ground', pin.SE3.Identity())}
        self.points: dict[str, list[Point]] = {}
        #: what a muscle wraps round after its points, by their numbers
        self.wraps: dict[str, dict[int, Wrap]] = {}
        self._couplers()
        self._tree()
        self._couple()
        self.kinematics = Kinematics(self.source.model, list(self.moves), 'ground')
        self.objects = self._wrap_objects()
        rng = np.random.default_rng(0)
        self.random = self._postures(
            {n: rng.uniform(*self._span(n), 200) for n in self.coordinates}
        )
        for item in model.find('ForceSet/objects') or ():
            self._muscle(item)
        if any(self.wraps.values()):
            told = 'lengths are compared round the wrap objects of the result'
            self.source.note('approximated', told)
        if self.source.strength:
            self.source.note('chosen', STRENGTH)
        self.source.lengths = self._lengths

    # -- bodies and joints -----------------------------------------------------------------------

    def _coordinate(self, item: ET.Element) -> Coordinate:
        ranged = item.find('range') is not None
        low, high = _vector(item, 'range', 2) if ranged else (-np.inf, np.inf)
        locked = item.findtext('locked', 'false').strip().lower() == 'true'
        default = _number(item, 'default_value')
        if locked:
            self.source.note('held fixed', f'locked coordinate {item.get("name")} at {default:.4g}')
        return Coordinate(low, high, default, locked)

    def _span(self, name: str) -> tuple[float, float]:
        """Return between which values a coordinate moves."""
        c = self.coordinates[name]
        if c.locked:
            return c.default, c.default
        if name in self.coupled:
            master, function = self.coupled[name]
            values = function(np.linspace(*self._span(master), 201))
            return float(values.min()), float(values.max()) + 1e-6
        return (c.low, c.high) if c.high - c.low < 100.0 else (-np.pi, np.pi)

    def _add_frames(self, owner: ET.Element, path: str) -> None:
        for frame in owner.iter('PhysicalOffsetFrame'):
            parent, offset = self._frame(frame.findtext('socket_parent', path), path)
            at = pin.SE3(_turn(_vector(frame, 'orientation')), _vector(frame, 'translation'))
            self.frames[f'{path}/{frame.get("name")}'] = parent, offset * at

    def _frame(self, socket: str, owner: str = '') -> tuple[str, pin.SE3]:
        """Return the body of a frame that a socket names, and its pose in that body."""
        parts = [part for part in socket.strip().split('/') if part not in ('', '..', 'bodyset')]
        for name in ('/'.join([owner, *parts]), '/'.join(parts[-2:]), *parts[-1:]):
            if name in self.frames:
                return self.frames[name]
        raise ValueError(f'there is no frame {socket!r}')

    def _couplers(self) -> None:
        for item in self.model.findall('ConstraintSet/objects/*'):
            masters = item.findtext('independent_coordinate_names', '').split()
            slave = item.findtext('dependent_coordinate_name', '').strip()
            element = item.find('coupled_coordinates_function')
            if (
                element is None
                or len(masters) != 1
                or not {slave, *masters} <= set(self.coordinates)
            ):
                self.source.note('dropped', f'{item.tag} {item.get("name")}')
                continue
            function = _function(element)
            scale = 1.0 if item.find('scale_factor') is None else _number(item, 'scale_factor')
            self.coupled[slave] = masters[0], lambda x, f=function, s=scale: s * f(x)

    def _tree(self) -> None:
        """Make links of the bodies, parents first, and joints of the axes between them."""
        bodies = {b.get('name', ''): b for b in self.model.findall('BodySet/objects/Body')}
        for name, body in bodies.items():
            self.frames[name] = name, pin.SE3.Identity()
            self._add_frames(body, name)
        joints = {}
        for joint in self.model.find('JointSet/objects') or ():
            name = joint.get('name', '')
            self._add_frames(joint, name)
            parent, before = self._frame(joint.findtext('socket_parent_frame', ''), name)
            child, after = self._frame(joint.findtext('socket_child_frame', ''), name)
            joints[child] = parent, before, self._axes(joint), after.inverse()
        source, order = self.source, ['ground']
        source.add_link('ground', 0, pin.SE3.Identity())
        for above in order:
            for name in [body for body, (parent, *_) in joints.items() if parent == above]:
                _, before, axes, after = joints.pop(name)
                carrier, at = source.place(above)
                carrier, at = self._chain(name, axes, carrier, at * before)
                xx, yy, zz, xy, xz, yz = _vector(bodies[name], 'inertia', 6)
                tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
                mass = max(_number(bodies[name], 'mass'), 0.0)
                own = inertia(mass, _vector(bodies[name], 'mass_center'), tensor)
                source.add_link(name, carrier, at * after, own)
                order.append(name)
        if lost := sorted(joints.keys() | bodies.keys() - set(order)):
            raise ValueError(f'body {lost[0]} does not hang on ground')

    def _axes(self, joint: ET.Element) -> list[Axis]:
        names = [item.get('name', '') for item in joint.findall('coordinates/Coordinate')]
        if joint.tag == 'FreeJoint':
            self.source.note('held fixed', f'free joint {joint.get("name")} at 0')
            return []
        if joint.tag in AXES:
            letters = zip(names, AXES[joint.tag], strict=True)
            identity = np.poly1d([1.0, 0.0])
            return [Axis(c.isupper(), np.eye(3)['xyz'.index(c.lower())], n, identity) for n, c in letters]  # noqa: E501  # fmt: skip
        if joint.tag != 'CustomJoint':
            legal = ', '.join(['FreeJoint', 'CustomJoint', *AXES])
            raise ValueError(f'joint {joint.get("name")} is a {joint.tag}; read are {legal}')
        axes = []
        for item in joint.findall('SpatialTransform/TransformAxis'):
            part = next((part for part in item if part.tag not in ('coordinates', 'axis')), None)
            coordinate = item.findtext('coordinates', '').split() or ['']
            if len(coordinate) > 1:
                told = f'joint {joint.get("name")}: an axis of several coordinates'
                raise ValueError(f'{told} cannot be expressed')
            slides, axis = item.get('name', '').startswith('translation'), _vector(item, 'axis')
            size = max(float(np.linalg.norm(axis)), 1e-12)
            axes.append(Axis(slides, axis / size, coordinate[0], _function(part)))
        return sorted(axes, key=lambda axis: not axis.slides)

    def _chain(self, body: str, axes: list[Axis], carrier: int, at: pin.SE3) -> tuple[int, pin.SE3]:
        """Add a joint for each axis that moves; return the last one, and what follows in it."""
        for slides, axis, name, function in axes:
            c = self.coordinates[name] if name else Coordinate(0.0, 0.0, 0.0, True)
            if c.locked:
                still = float(function(np.array([c.default]))[0]) * axis
                turn, shift = (np.zeros(3), still) if slides else (still, np.zeros(3))
                at = at * pin.SE3(pin.exp3(turn), shift)
                continue
            x = np.linspace(-1.0, 1.0, 5)
            sign = next(
                (s for s in (1.0, -1.0) if np.allclose(function(x), s * x, atol=1e-12)), 0.0
            )
            if sign and name not in self.moves:
                joint, axis, function = name, sign * axis, np.poly1d([1.0, 0.0])
                limits, rest = self._span(name), c.default
            else:
                joint = f'{name}_of_{body}_{len(self.moves)}'
                y = function(np.linspace(*self._span(name), 201))
                limits, rest = (float(y.min()) - 1e-6, float(y.max()) + 1e-6), 0.0
            carrier = self.source.add_joint(joint, carrier, at, slides, axis, limits, rest)
            self.moves[joint], at = (name, function), pin.SE3.Identity()
        return carrier, at

    def _couple(self) -> None:
        """Couple joints to coordinates, and coordinates to each other."""
        source = self.source
        for joint, (name, function) in list(self.moves.items()):
            if joint == name:
                continue
            if name not in self.moves:
                # No joint turns by the coordinate itself: a link without mass carries its value.
                limits, rest = self._span(name), self.coordinates[name].default
                carrier = source.add_joint(
                    name, 0, pin.SE3.Identity(), False, np.eye(3)[0], limits, rest
                )
                source.add_link(f'value_of_{name}', carrier, pin.SE3.Identity())
                self.moves[name] = name, np.poly1d([1.0, 0.0])
                source.note('chosen', f'link value_of_{name}: it carries a coordinate, and no mass')
            source.couple(joint, name, function)
        for slave, (master, function) in self.coupled.items():
            if {slave, master} <= self.moves.keys():
                source.couple(slave, master, function)
            else:
                source.note('dropped', f'coupling of {slave} to {master}')

    # -- muscles ---------------------------------------------------------------------------------

    def _wrap_objects(self) -> dict[str, Wrap]:
        objects = {}
        owners = [*self.model.findall('Ground'), *self.model.findall('BodySet/objects/Body')]
        for body, item in [
            (b, item) for b in owners for item in b.findall('WrapObjectSet/objects/*')
        ]:
            if item.findtext('active', 'true').strip().lower() != 'true':
                continue
            kind, name, centre = item.tag, item.get('name', ''), _vector(item, 'translation')
            turn = _turn(_vector(item, 'xyz_body_rotation'))
            axis, side, told = None, None, ''
            if kind == 'WrapSphere':
                radius = _number(item, 'radius')
            elif kind == 'WrapCylinder':
                radius, axis, told = _number(item, 'radius'), turn[:, 2], 'without its ends'
            elif kind == 'WrapTorus':
                radius, axis, side = _number(item, 'inner_radius'), turn[:, 2], centre
                told = 'a ring along its axis'
            elif kind == 'WrapEllipsoid':
                sizes = np.abs(_vector(item, 'dimensions'))
                least, middle, most = np.sort(sizes)
                radius, told = float(np.cbrt(sizes.prod())), 'a sphere'
                if middle < 1.25 * least and most > 1.25 * middle:
                    radius, axis = float(np.sqrt(least * middle)), turn[:, sizes.argmax()]
                    told = 'a cylinder'
                told += f' of {1e3 * radius:.1f} mm'
            else:
                radius = 0.0
            if radius <= 0.0:
                self.source.note('dropped', f'{kind} {name}')
                continue
            # Whether a quadrant forces a wire round depends on where a finite object ends.
            anywhere = item.findtext('quadrant', 'all').strip().lower() in ('', 'all')
            for note in (told, '' if anywhere else 'it is passed on any side'):
                if note:
                    self.source.note('approximated', f'{kind} {name}: {note}')
            objects[name] = Wrap(body.get('name') or 'ground', centre, radius, axis, side)
        return objects

    def _point(self, item: ET.Element) -> Point:
        body, offset = self._frame(item.findtext('socket_parent_frame', ''))
        if item.tag == 'MovingPathPoint':
            if not offset.isIdentity(1e-9):
                raise ValueError(f'a moving point {item.get("name")} in an offset frame')
            names = [_word(item, f'socket_{letter}_coordinate') for letter in 'xyz']
            functions = [_function(item.find(f'{letter}_location')) for letter in 'xyz']
            return Point(body, list(zip(names, functions)), None)
        at = [('', np.poly1d([v])) for v in offset.act(_vector(item, 'location'))]
        if item.tag != 'ConditionalPathPoint':
            return Point(body, at, None)
        return Point(body, at, (_word(item, 'socket_coordinate'), *_vector(item, 'range', 2)))

    def _muscle(self, item: ET.Element) -> None:
        source, name = self.source, safe_name(item.get('name'), 'force')
        path = item.find('GeometryPath')
        if path is None or not ('Muscle' in item.tag or item.tag == 'PathActuator'):
            source.note('dropped', f'{item.tag} {name}: no muscle with a path of points')
            return
        points = [self._point(p) for p in path.findall('PathPointSet/objects/*')]
        places, active = self._path(points, self.random)
        always = _always_active(points, places, active)
        kept = np.flatnonzero(always).tolist()
        stands = [self._standing(f'muscle {name}', *each) for each in zip(points, always)]
        if len(kept) < 2:
            source.note('dropped', f'muscle {name}: fewer than 2 points')
            return
        self.points[name], self.wraps[name] = points, {}
        for wrap in path.findall('PathWrapSet/objects/PathWrap'):
            label = _word(wrap, 'wrap_object')
            if told := self._place_wrap(name, wrap, label, places, kept):
                source.note('dropped', f'muscle {name}: wrap round {label}{told}')
        route: list[RoutePoint | Wrap] = []
        for i in kept:
            route.append(RoutePoint(points[i].body, stands[i]))
            route += [self.wraps[name][i]] if i in self.wraps[name] else []
        source.routes[name] = tuple(route)
        force = 'max_isometric_force' if item.find('max_isometric_force') is not None else 'optimal_force'  # noqa: E501  # fmt: skip
        source.strength[name] = _number(item, force)

    def _standing(self, muscle: str, point: Point, kept: bool) -> Array:
        """Return where a point is taken to be, in its body, and say so."""
        note = self.source.note
        if point.condition:
            name, low, high = point.condition
            least, most = self._span(name)
            share = max(min(high, most) - max(low, least), 0.0) / max(most - least, 1e-9)
            told = f'{muscle}: a point active in {100 * share:.0f} % of {name}'
            note('approximated', f'{told} is {"always there" if kept else "left out"}')
        span = {n: np.linspace(*self._span(n), 201) if n else np.zeros(1) for n, _ in point.at}
        ways = [function(span[name]) for name, function in point.at]
        off = 1e3 * max(float(np.abs(way - way.mean()).max()) for way in ways)
        if off > 0.0:
            note('approximated', f'{muscle}: a moving point stands still, off by {off:.1f} mm')
        return np.array([way.mean() for way in ways])

    def _place_wrap(
        self, muscle: str, item: ET.Element, label: str, places: Array, kept: list[int]
    ) -> str:
        """Put a wrap object between the points between which it is met most; say if nowhere."""
        if label not in self.objects:
            return ', which is not there'
        wrap, most, best = self.objects[label], 0.0, -1
        first, last = map(int, numbers(item.findtext('range') or '-1 -1', 2, f'range of {label}'))
        for i, k in pairwise(kept):
            if (
                (first > 0 and i + 1 < first)
                or (last > 0 and k + 1 > last)
                or i in self.wraps[muscle]
            ):
                continue
            ends = places[:, i], places[:, k]
            added = self._round(wrap, self.random, *ends) - np.linalg.norm(
                ends[1] - ends[0], axis=1
            )
            if added.mean() > most:
                best, most = i, float(added.mean())
        if best < 0:
            return ', which it does not meet'
        self.wraps[muscle][best] = wrap
        return ''

    # -- OpenSim's own lengths -------------------------------------------------------------------

    def _postures(self, given: dict[str, Array]) -> Postures:
        """Return postures for coordinates (N,); those that are not given are at their defaults."""
        count = len(next(iter(given.values())))
        values = {n: given.get(n, np.full(count, c.default)) for n, c in self.coordinates.items()}
        values[''] = np.zeros(count)
        for _ in self.coupled:  # as often as one may follow another
            for slave, (master, function) in self.coupled.items():
                values[slave] = function(values[master])
        q = np.stack([function(values[name]) for name, function in self.moves.values()], axis=1)
        return Postures(values, self.kinematics.transforms(q))

    def _path(self, points: list[Point], at: Postures) -> tuple[Array, Array]:
        """Return points (N, P, 3), and whether each is active (N, P)."""
        places, active = [], []
        for body, functions, condition in points:
            joint, pose = self.source.place(body)
            local = np.stack([function(at.values[name]) for name, function in functions], axis=1)
            local = local @ pose.rotation.T + pose.translation
            world = at.poses[:, joint]
            places.append(np.einsum('nij,nj->ni', world[:, :3, :3], local) + world[:, :3, 3])
            name, low, high = condition or ('', -1.0, 1.0)
            active.append((at.values[name] >= low) & (at.values[name] <= high))
        return np.stack(places, axis=1), np.stack(active, axis=1)

    def _round(self, wrap: Wrap, at: Postures, start: Array, end: Array) -> Array:
        """Return lengths (N,) round an object from start to end (N, 3)."""
        from musculoskeletal_ae.robot.wrapping import place_objects, wrapped_segments

        objects = place_objects(self.kinematics, [wrap])
        turned, moved = (np.ascontiguousarray(part) for part in (at.poses[..., :3, :3], at.poses[..., :3, 3]))  # noqa: E501  # fmt: skip
        ends = (np.ascontiguousarray(point[:, None]) for point in (start, end))
        return wrapped_segments(objects, turned, moved, *ends)[0][:, 0]

    def _lengths(self, values: dict[str, Array]) -> dict[str, Array]:
        at, result = self._postures(values), {}
        for name, points in self.points.items():
            places, active = self._path(points, at)
            after = _following(places, active)
            steps = np.linalg.norm(after - places, axis=2)
            for i, wrap in self.wraps[name].items():
                steps[:, i] = self._round(wrap, at, places[:, i], after[:, i])
            result[name] = np.nansum(np.where(active, steps, 0.0), axis=1)
        return result


def _following(places: Array, active: Array) -> Array:
    """Return for each of the points (N, P, 3) the active one that follows, NaN for none."""
    after, last = np.empty_like(places), np.full(places[:, 0].shape, np.nan)
    for i in reversed(range(places.shape[1])):
        after[:, i], last = last, np.where(active[:, i, None], places[:, i], last)
    return after


def _always_active(points: list[Point], places: Array, active: Array) -> Array:
    """Return which points the route keeps: of conditional ones those that err least.

    Begins with all and changes one at a time, as long as that lowers the squared error of how the
    length changes.
    """

    def length(mask: Array) -> Array:
        steps = np.linalg.norm(_following(places, mask) - places, axis=2)
        return np.nansum(np.where(mask, steps, 0.0), axis=1)

    def error(tried: Array) -> float:
        return float(np.var(length(np.broadcast_to(tried, active.shape)) - true))

    true, kept = length(active), np.ones(len(points), dtype=bool)
    conditional = [i for i, point in enumerate(points) if point.condition]
    for _ in conditional:
        best = min((kept ^ (np.arange(len(points)) == i) for i in conditional), key=error)
        if error(best) >= error(kept):
            break
        kept = best
    return kept
