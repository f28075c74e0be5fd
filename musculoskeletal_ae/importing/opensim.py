# SPDX-License-Identifier: Apache-2.0
"""OpenSim models (.osim of version 4), without OpenSim.

A joint becomes a chain of massless links, one for each axis that moves, translations before
rotations as OpenSim applies them. An axis whose value is the coordinate itself carries it; others
are coupled to it, by the line nearest to their function. Moving path points stand at the mean of
where they move; of the conditional ones those are kept that let the length change most as it does.
The source's own lengths are computed with all these as OpenSim has them, so that the error shows
what the approximation costs; wrap objects are those of the result on both sides.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.spatial.transform import Rotation

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.importing.source import (
    EARTH,
    Function,
    Source,
    link_inertia,
    numbers,
    safe_name,
    unique,
)
from musculoskeletal_ae.robot.description import RoutePoint, Wrap
from musculoskeletal_ae.robot.kinematics import Kinematics

OLDEST = 40000  # version of a document: joints in a JointSet, frames by sockets

#: axis of each coordinate of joints without a SpatialTransform; it slides along capital letters
AXES = {
    'PinJoint': 'z', 'SliderJoint': 'X', 'UniversalJoint': 'xy', 'BallJoint': 'xyz',
    'GimbalJoint': 'xyz', 'PlanarJoint': 'zXY', 'WeldJoint': '', 'FreeJoint': '',
}  # fmt: skip
IDENTITY: Function = np.poly1d([1.0, 0.0])

#: whether it slides, direction, coordinate ('': none), function of it that is its value
Axis = tuple[bool, Array, str, Function]
#: body, a coordinate and a function of it for each axis, and within what a coordinate must be
Point = tuple[str, Sequence[tuple[str, Function]], tuple[str, float, float]]
#: values (N,) of coordinates, and poses (N, J, 4, 4) of the model's joints
Postures = tuple[dict[str, Array], Array]


def read_osim(_file: Path, root: ET.Element) -> Source:
    """Read an .osim file."""
    model, version = root.find('Model'), root.get('Version', '0')
    if model is None or not version.isdigit() or int(version) < OLDEST:
        told = f'expected a Model of version {OLDEST} or later, got {version[:20]!r}'
        raise ValueError(f'{told}; open it in OpenSim 4 and save it')
    return _Reader(model).source


def _vector(element: ET.Element, tag: str, count: int = 3) -> Array:
    where = f'{element.tag} {element.get("name")}: {tag}'
    return numbers(element.findtext(tag) or '0 ' * count, count, where)


def _number(element: ET.Element, tag: str) -> float:
    return float(_vector(element, tag, 1)[0])


def _word(element: ET.Element, tag: str, default: str = '') -> str:
    """Return a word of a child, the last part of a path."""
    return (element.findtext(tag) or default).strip().split('/')[-1]


def _offset(element: ET.Element, angles: str) -> pin.SE3:
    """Return a pose whose rotation is given by body-fixed x-y-z angles [rad]."""
    turn = Rotation.from_euler('XYZ', _vector(element, angles)).as_matrix()
    return pin.SE3(turn, _vector(element, 'translation'))


def _scaled(function: Function, scale: float) -> Function:
    return lambda x: scale * function(x)


def _function(element: ET.Element | None) -> Function:
    """Return a function of OpenSim; those through points go on straight beyond them."""
    if element is None:
        return np.poly1d([0.0])
    kind = element.tag
    if kind.endswith(('function', '_location')):
        return _function(next(iter(element), None))
    if kind == 'Constant':
        return np.poly1d(_vector(element, 'value', 1))
    if kind in ('LinearFunction', 'PolynomialFunction'):
        text = element.findtext('coefficients') or ('1 0' if kind[0] == 'L' else '0')
        return np.poly1d(numbers(text, len(text.split()), 'coefficients'))
    if kind == 'MultiplierFunction':
        scale = _number(element, 'scale') if element.findtext('scale') else 1.0
        return _scaled(_function(element.find('function')), scale)
    if kind not in ('SimmSpline', 'NaturalCubicSpline', 'PiecewiseLinearFunction'):
        raise ValueError(f'a {kind} is not read')
    x, y = (_vector(element, tag, len(element.findtext('x', '').split())) for tag in 'xy')
    spline: Any
    if kind == 'PiecewiseLinearFunction':
        spline = make_interp_spline(x, y, k=1)
    else:
        spline = CubicSpline(x, y, bc_type='natural' if kind[0] == 'N' else 'not-a-knot')

    def value(at: Array) -> Array:
        inside = np.clip(at, x[0], x[-1])
        return np.asarray(spline(inside) + spline(inside, 1) * (at - inside))

    return value


class _Reader:
    def __init__(self, model: ET.Element) -> None:
        self.model, self.source = model, Source(safe_name(model.get('name'), 'robot'))
        given = model.find('gravity') is not None
        self.source.model.gravity.linear = (
            _vector(model, 'gravity') if given else -EARTH * np.eye(3)[1]
        )
        #: ranges and defaults of coordinates that are free; which of them ('': none) drives each
        #: coordinate, and by what function
        self.ranges, self.rest = {'': (0.0, 0.0)}, {'': 0.0}
        self.drivers: dict[str, tuple[str, Function]] = {'': ('', IDENTITY)}
        self._coordinates()
        #: the coordinate and the function that are each joint's exact value
        self.moves: dict[str, tuple[str, Function]] = {}
        #: body that a frame belongs to, and its pose there
        self.frames = {'ground': ('ground', pin.SE3.Identity())}
        self._tree()
        self._couple()
        self.kinematics = Kinematics(self.source.model, list(self.moves), 'ground')
        rng = np.random.default_rng(0)
        self.random = self._postures({n: rng.uniform(*r, 200) for n, r in self.ranges.items() if n})
        self.objects = self._wrap_objects()
        self.points: dict[str, list[Point]] = {}
        #: what a muscle wraps round after some of its points
        self.wraps: dict[str, dict[int, Wrap]] = {}
        for item in model.find('ForceSet/objects') or ():
            self._muscle(item)
        if any(self.wraps.values()):
            told = 'lengths are compared round the wrap objects of the result, not round OpenSim’s'
            self.source.note('approximated', told)
        self.source.lengths = self._lengths

    # -- bodies and joints -----------------------------------------------------------------------

    def _coordinates(self) -> None:
        named = [(c.get('name', ''), c) for c in self.model.iter('Coordinate')]
        if '' in dict(named):
            raise ValueError('a Coordinate has no name; expected one')
        for name, item in unique('coordinate', named).items():
            default = _number(item, 'default_value')
            low, high = _vector(item, 'range', 2)
            if _word(item, 'locked').lower() == 'true':
                self.drivers[name] = '', np.poly1d([default])
                self.source.note('held fixed', f'locked coordinate {name} at {default:.4g}')
            else:
                self.drivers[name], self.ranges[name] = (name, IDENTITY), (low, high)
                self.rest[name] = default
                if _word(item, 'prescribed').lower() == 'true':
                    self.source.note(
                        'dropped', f'prescribed motion of coordinate {name}: it is free'
                    )
        for item in self.model.findall('ConstraintSet/objects/*'):
            master = _word(item, 'independent_coordinate_names')
            slave = _word(item, 'dependent_coordinate_name')
            if _word(item, 'isEnforced').lower() == 'false':
                continue
            known = self.drivers.keys() >= {master, slave} and '' not in (master, slave)
            if item.tag != 'CoordinateCouplerConstraint' or not known:
                self.source.note('dropped', f'{item.tag} {item.get("name")}')
                continue
            if self.drivers[slave][0] != slave or self._driver(master)[0] == slave:
                told = f'{item.tag} {item.get("name")}: {slave} is coupled or locked already'
                self.source.note('dropped', told)
                continue
            scale = 1.0 if item.find('scale_factor') is None else _number(item, 'scale_factor')
            function = _function(item.find('coupled_coordinates_function'))
            self.drivers[slave] = master, _scaled(function, scale)
        axes = [a for j in self.model.findall('JointSet/objects/*') for a in self._axes(j)]
        turned = {coordinate for slides, _, coordinate, _ in axes if not slides}
        for name, span in self.ranges.items():
            if name and self.drivers[name][0] == name:
                self.ranges[name] = self.source.limited(name, name not in turned, *span)

    def _driver(self, name: str, function: Function = IDENTITY) -> tuple[str, Function]:
        """Return a function of a coordinate as one of the free coordinate that drives it."""
        if name not in self.drivers:
            raise ValueError(f'there is no coordinate {name!r}')
        master, inner = self.drivers[name]
        both: Function = lambda x: function(inner(x))  # noqa: E731
        return (master, both) if master in ('', name) else self._driver(master, both)

    def _span(self, name: str, function: Function = IDENTITY) -> Array:
        """Return values (201,) of a function of a coordinate over its range."""
        free, value = self._driver(name, function)
        return value(np.linspace(*self.ranges[free], 201))

    def _frame(self, item: ET.Element, tag: str, owner: str = '') -> tuple[str, pin.SE3]:
        """Return the body of the frame that a socket names, and its pose in that body."""
        socket = item.findtext(tag, owner).strip()
        parts = [part for part in socket.split('/') if part not in ('', '..', 'bodyset')]
        for name in ('/'.join([owner, *parts]), '/'.join(parts[-2:]), *parts[-1:]):
            if name in self.frames:
                return self.frames[name]
        raise ValueError(f'there is no frame {socket!r}')

    def _tree(self) -> None:
        """Make links of the bodies, parents first, and joints of the axes between them."""
        bodies, joints = (
            unique(kind, ((e.get('name', ''), e) for e in self.model.findall(where)))
            for kind, where in (('body', 'BodySet/objects/Body'), ('joint', 'JointSet/objects/*'))
        )
        own = [(name, (name, pin.SE3.Identity())) for name in bodies]
        self.frames = unique('frame', [*self.frames.items(), *own])
        for path, owner in [*bodies.items(), *joints.items()]:
            for frame in owner.iter('PhysicalOffsetFrame'):
                parent, pose = self._frame(frame, 'socket_parent', path)
                at = pose * _offset(frame, 'orientation')
                if (label := f'{path}/{frame.get("name")}') in self.frames:
                    told = 'expected unique names: rename one'
                    raise ValueError(f'frame {label!r} comes twice; {told}')
                self.frames[label] = parent, at
        hung = []
        for name, joint in joints.items():
            parent, before = self._frame(joint, 'socket_parent_frame', name)
            child, after = self._frame(joint, 'socket_child_frame', name)
            hung.append((child, (parent, before, joint, after.inverse())))
        waiting = unique('child of a joint', hung, 'one joint for each body')
        source, order = self.source, ['ground']
        source.add_link('ground', 0, pin.SE3.Identity())
        for above in order:
            for name in [body for body, (parent, *_) in waiting.items() if parent == above]:
                _, before, joint, after = waiting.pop(name)
                carrier, at = source.place(above)
                carrier, at = self._chain(name, joint, carrier, at * before)
                xx, yy, zz, xy, xz, yz = _vector(bodies[name], 'inertia', 6)
                tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
                mass, centre = _number(bodies[name], 'mass'), _vector(bodies[name], 'mass_center')
                own = link_inertia(name, max(mass, 0.0), centre, tensor)
                source.add_link(name, carrier, at * after, own)
                source.above[name] = above
                order.append(name)
        if lost := waiting.keys() | bodies.keys() - set(order):
            raise ValueError(f'body {min(lost)} does not hang on ground')

    def _axes(self, joint: ET.Element) -> Iterator[Axis]:
        if joint.tag in AXES:
            names = [item.get('name', '') for item in joint.findall('coordinates/Coordinate')]
            for name, letter in zip(names, AXES[joint.tag]):
                yield letter.isupper(), np.eye(3)['xyz'.index(letter.lower())], name, IDENTITY
        elif joint.tag != 'CustomJoint':
            legal = ', '.join(['CustomJoint', *AXES])
            raise ValueError(f'joint {joint.get("name")} is a {joint.tag}; read are {legal}')
        for item in joint.findall('SpatialTransform/TransformAxis'):
            part = next((part for part in item if part.tag not in ('coordinates', 'axis')), None)
            slides = item.get('name', '').startswith('translation')
            coordinate, axis = item.findtext('coordinates', '').strip(), _vector(item, 'axis')
            size = max(float(np.linalg.norm(axis)), 1e-12)
            yield slides, axis / size, coordinate, _function(part)

    def _chain(
        self, body: str, joint: ET.Element, carrier: int, at: pin.SE3
    ) -> tuple[int, pin.SE3]:
        """Add a joint for each axis that moves; return the last one, and what follows in it."""
        if joint.tag == 'FreeJoint':
            self.source.note('held fixed', f'free joint {joint.get("name")} at 0')
        for slides, axis, coordinate, own in sorted(self._axes(joint), key=lambda a: not a[0]):
            name, function = self._driver(coordinate, own)
            if not name:
                still = float(function(np.zeros(1))[0]) * axis
                turn, shift = (np.zeros(3), still) if slides else (still, np.zeros(3))
                at = at * pin.SE3(pin.exp3(turn), shift)
                continue
            x, label = np.linspace(-1.0, 1.0, 5), f'{coordinate}_of_{body}_{len(self.moves)}'
            for sign in (1.0, -1.0):
                if name not in self.moves and np.allclose(function(x), sign * x, atol=1e-12):
                    # It carries the coordinate itself.
                    label, axis, function = name, sign * axis, IDENTITY
            y, rest = self._span(name, function), float(function(np.array([self.rest[name]]))[0])
            margin = 0.0 if label == name else 1e-6
            limits = float(y.min()) - margin, float(y.max()) + margin
            carrier = self.source.add_joint(label, carrier, at, slides, axis, limits, rest)
            self.moves[label], at = (name, function), pin.SE3.Identity()
        return carrier, at

    def _couple(self) -> None:
        source = self.source
        for joint, (name, function) in list(self.moves.items()):
            if name not in self.moves:
                # No joint turns by the coordinate itself: a link without mass carries its value.
                place, axis, limits = pin.SE3.Identity(), np.eye(3)[0], self.ranges[name]
                carrier = source.add_joint(name, 0, place, False, axis, limits, self.rest[name])
                source.add_link(f'value_of_{name}', carrier, place)
                source.note('chosen', f'link value_of_{name}: it carries a coordinate, and no mass')
                self.moves[name] = name, IDENTITY
            if joint != name:
                source.couple(joint, name, function)

    # -- muscles ---------------------------------------------------------------------------------

    def _wrap_objects(self) -> dict[str, Wrap]:
        objects = {}
        owners = [*self.model.findall('Ground'), *self.model.findall('BodySet/objects/Body')]
        items = [(b, item) for b in owners for item in b.findall('WrapObjectSet/objects/*')]
        seen = set[str]()
        for body, item in items:
            kind, name = item.tag, item.get('name', '')
            if name in seen:
                told = f'{kind} {name} of {body.get("name")}: OpenSim leads muscles round the first'
                self.source.note('dropped', f'{told} of that name')
                continue
            seen.add(name)
            if _word(item, 'active', 'true').lower() != 'true':
                continue
            pose = _offset(item, 'xyz_body_rotation')
            axis, side, told, radius = pose.rotation[:, 2], None, '', 0.0
            if kind in ('WrapSphere', 'WrapCylinder'):
                radius = _number(item, 'radius')
                axis, told = (None, '') if kind == 'WrapSphere' else (axis, 'without its ends')
            elif kind == 'WrapTorus':
                radius, side = _number(item, 'inner_radius'), pose.translation
                told = 'a ring along its axis'
            elif kind == 'WrapEllipsoid':
                sizes = np.abs(_vector(item, 'dimensions'))
                least, middle, most = np.sort(sizes)
                radius, axis, told = float(np.cbrt(sizes.prod())), None, 'a sphere'
                if middle < 1.25 * least and most > 1.25 * middle:
                    radius, axis = float(np.sqrt(least * middle)), pose.rotation[:, sizes.argmax()]
                    told = 'a cylinder'
                told += f' of {1e3 * radius:.1f} mm'
            if radius <= 0.0:
                self.source.note('dropped', f'{kind} {name}')
                continue
            if told:
                self.source.note('approximated', f'{kind} {name}: {told}')
            # Whether a quadrant forces a wire round depends on where a finite object ends.
            if _word(item, 'quadrant', 'all').lower() != 'all':
                self.source.note('approximated', f'{kind} {name}: it is passed on any side')
            objects[name] = Wrap(body.get('name') or 'ground', pose.translation, radius, axis, side)
        return objects

    def _point(self, item: ET.Element) -> Point:
        (body, offset), always = self._frame(item, 'socket_parent_frame'), ('', -1.0, 1.0)
        if item.tag == 'MovingPathPoint':
            if not offset.isIdentity(1e-9):
                raise ValueError(f'a moving point {item.get("name")} in an offset frame')
            names = [_word(item, f'socket_{letter}_coordinate') for letter in 'xyz']
            functions = [_function(item.find(f'{letter}_location')) for letter in 'xyz']
            return body, list(zip(names, functions)), always
        at = [('', np.poly1d([v])) for v in offset.act(_vector(item, 'location'))]
        if item.tag != 'ConditionalPathPoint':
            return body, at, always
        low, high = _vector(item, 'range', 2)
        return body, at, (_word(item, 'socket_coordinate'), low, high)

    def _muscle(self, item: ET.Element) -> None:
        source, path, given = self.source, item.find('GeometryPath'), item.get('name') or 'force'
        if path is None or not ('Muscle' in item.tag or item.tag == 'PathActuator'):
            source.note('dropped', f'{item.tag} {given}: no muscle with a path of points')
            return
        if _word(item, 'appliesForce').lower() == 'false':
            source.note('dropped', f'muscle {given}: it applies no force')
            return
        points = [self._point(p) for p in path.findall('PathPointSet/objects/*')]
        if len(points) < 2:
            source.note('dropped', f'muscle {given}: fewer than 2 points')
            return
        for _, axes, (condition, *_) in points:
            for coordinate in (condition, *(name for name, _ in axes)):
                self._driver(coordinate)  # which says if there is none
        places, active = self._path(points, self.random)
        always = _always_active(places, active)
        kept = np.flatnonzero(always).tolist()
        if len(kept) < 2:
            source.note('dropped', f'muscle {given}: fewer than 2 points are kept')
            return
        name = source.rename('muscle', item.get('name'), 'force', source.routes)
        stands = [self._standing(f'muscle {name}', *each) for each in zip(points, always)]
        self.points[name] = points
        wraps = self.wraps[name] = self._place_wraps(name, path, places, kept)
        route: list[RoutePoint | Wrap] = []
        for i in kept:
            route += [RoutePoint(points[i][0], stands[i]), *([wraps[i]] if i in wraps else [])]
        source.routes[name] = tuple(route)
        forces = (_number(item, f'{kind}_force') for kind in ('max_isometric', 'optimal'))
        source.strength[name] = max(forces)

    def _standing(self, muscle: str, point: Point, kept: bool) -> Array:
        """Return where a point is taken to be, in its body, and say so."""
        _, axes, (name, low, high) = point
        if name:
            values = self._span(name)
            share = 100 * np.mean((values >= low) & (values <= high))
            told = f'{muscle}: a point active in {share:.0f} % of {name}'
            told += f' is {"always there" if kept else "left out"}'
            self.source.note('approximated', told)
        ways = [self._span(*axis) for axis in axes]
        stands = np.array([way.mean() for way in ways])
        if (off := 1e3 * np.abs(np.transpose(ways) - stands).max()) > 1e-6:
            told = f'{muscle}: a moving point stands still, off by {off:.1f} mm'
            self.source.note('approximated', told)
        return stands

    def _place_wraps(
        self, muscle: str, path: ET.Element, places: Array, kept: list[int]
    ) -> dict[int, Wrap]:
        """Return after which point each wrap object stands: where it is met most."""
        chosen: dict[int, str] = {}
        for item in path.findall('PathWrapSet/objects/PathWrap'):
            best, most, label, taken = -1, 0.0, _word(item, 'wrap_object'), ''
            first, last = numbers(item.findtext('range') or '-1 -1', 2, f'range of {label}')
            for i, k in pairwise(kept):
                if i + 1 < first or k + 1 > last > 0 or label not in self.objects:
                    continue
                if i in chosen:
                    taken = taken or chosen[i]
                    continue
                line = np.linalg.norm(places[:, k] - places[:, i], axis=1)
                ends = places[:, i], places[:, k]
                added = (self._round(self.objects[label], self.random, *ends) - line).mean()
                if added > most:
                    best, most = i, added
            if best >= 0:
                chosen[best] = label
            else:
                why = 'as converted it does not touch' if label in self.objects else 'is not read'
                why = f'would be a second one beside {taken}' if taken else why
                told = f'muscle {muscle}: wrap round {label}, which {why}'
                self.source.note('dropped', told)
        return {i: self.objects[label] for i, label in chosen.items()}

    # -- OpenSim's own lengths -------------------------------------------------------------------

    def _postures(self, given: dict[str, Array]) -> Postures:
        """Return postures for free coordinates (N,); those not given are at their defaults."""
        count = len(next(iter(given.values())))
        free = {n: given.get(n, np.full(count, rest)) for n, rest in self.rest.items()}
        values = {}
        for name in self.drivers:
            master, function = self._driver(name)
            values[name] = function(free[master])
        q = np.stack([function(values[name]) for name, function in self.moves.values()], axis=1)
        return values, self.kinematics.transforms(q)

    def _path(self, points: list[Point], at: Postures) -> tuple[Array, Bools]:
        """Return points (N, P, 3), and whether each is active (N, P)."""
        values, poses = at
        places, active = [], []
        for body, axes, (name, low, high) in points:
            joint, pose = self.kinematics.placement(body)  # as it was before a cut
            local = np.stack([function(values[name]) for name, function in axes], axis=1)
            world, local = poses[:, joint], local @ pose.rotation.T + pose.translation
            places.append(np.einsum('nij,nj->ni', world[:, :3, :3], local) + world[:, :3, 3])
            active.append((values[name] >= low) & (values[name] <= high))
        return np.stack(places, axis=1), np.stack(active, axis=1)

    def _round(self, wrap: Wrap, at: Postures, start: Array, end: Array) -> Array:
        """Return lengths (N,) round an object from start to end (N, 3)."""
        from musculoskeletal_ae.robot.wrapping import place_objects, wrapped_segments

        parts = at[1][..., :3, :3], at[1][..., :3, 3], start[:, None], end[:, None]
        arrays = (np.ascontiguousarray(part) for part in parts)
        return wrapped_segments(place_objects(self.kinematics, [wrap]), *arrays)[0][:, 0]

    def _lengths(self, values: dict[str, Array]) -> dict[str, Array]:
        at, result = self._postures(values), {}
        for name, points in self.points.items():
            places, active = self._path(points, at)
            after = _following(places, active)
            steps = np.linalg.norm(after - places, axis=2)
            for i, wrap in self.wraps[name].items():
                steps[:, i] = self._round(wrap, at, places[:, i], after[:, i])
            result[name] = np.nansum(steps * active, axis=1)
        return result


def _following(places: Array, active: Bools) -> Array:
    """Return for each of the points (N, P, 3) the active one that follows, NaN for none."""
    after, last = np.empty_like(places), np.full(places[:, 0].shape, np.nan)
    for i in reversed(range(places.shape[1])):
        after[:, i], last = last, np.where(active[:, i, None], places[:, i], last)
    return after


def _always_active(places: Array, active: Bools) -> Bools:
    """Return which points the route keeps: of conditional ones those that err least.

    From all, changes one at a time while that lowers the squared error of how the length changes.
    """

    def length(mask: Bools) -> Array:
        steps = np.linalg.norm(_following(places, mask) - places, axis=2)
        return np.nansum(steps * mask, axis=1)

    def error(tried: Bools) -> float:
        return float(np.var(length(np.broadcast_to(tried, active.shape)) - true))

    true, kept, best = length(active), None, np.ones(active.shape[1], dtype=bool)
    flips = np.eye(len(best), dtype=bool)[~active.all(axis=0)]
    while kept is None or error(best) < error(kept):
        kept = best
        best = min((kept ^ flip for flip in flips), key=error, default=kept)
    return kept
