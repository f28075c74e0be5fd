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

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin
from scipy.interpolate import CubicSpline

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.files import read_text
from musculoskeletal_ae.importing.source import (
    PRISMATIC,
    REVOLUTE,
    STRENGTH,
    Link,
    Source,
    SourceError,
    inertia,
    linear_fit,
    refuse,
    safe_name,
)
from musculoskeletal_ae.robot.description import RoutePoint, Wrap
from musculoskeletal_ae.robot.kinematics import Coupling
from musculoskeletal_ae.robot.urdf import parse_xml

OLDEST = 40000  # version of a document: joints in a JointSet, frames by sockets
LARGEST = 20_000_000  # [bytes]
Function = Callable[[Array], Array]

#: (prismatic, axis) of each coordinate of joints without a SpatialTransform
AXES = {
    'PinJoint': [(False, 2)],
    'SliderJoint': [(True, 0)],
    'UniversalJoint': [(False, 0), (False, 1)],
    'BallJoint': [(False, 0), (False, 1), (False, 2)],
    'GimbalJoint': [(False, 0), (False, 1), (False, 2)],
    'PlanarJoint': [(False, 2), (True, 0), (True, 1)],
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
    at: list[tuple[str, Function]] | Array  # fixed, or a function of a coordinate for each axis
    condition: tuple[str, float, float] | None  # active while the coordinate is within


def read_osim(file: Path) -> Source:
    """Read an .osim file.

    Raises:
        SourceError: Naming what is wrong or not supported.
        RobotDescriptionError: If it is not valid XML.
    """
    root = parse_xml(file, read_text(file, refuse, LARGEST))
    model = root.find('Model')
    version = root.get('Version', '0')
    if root.tag != 'OpenSimDocument' or model is None:
        raise refuse(file, 'expected an OpenSimDocument with a Model')
    if not version.isdigit() or int(version) < OLDEST:
        told = f'version {version[:20]!r}; open it in OpenSim 4 and save it, {OLDEST} is read'
        raise refuse(file, told)
    try:
        return _Reader(file, model).source
    except (KeyError, AttributeError, IndexError, ValueError, TypeError) as error:
        raise refuse(file, f'it is not as OpenSim writes it: {error!r}') from error


class _Reader:
    def __init__(self, file: Path, model: ET.Element) -> None:
        self.file, self.model = file, model
        self.source = Source(safe_name(model.get('name', ''), 'robot'))
        if model.find('gravity') is not None:
            self.source.gravity = self._vector(model, 'gravity')
        else:
            self.source.gravity = np.array([0.0, -1.0, 0.0])
        self.coordinates: dict[str, Coordinate] = {}
        #: for each body: parent, pose before, axes, pose after; as OpenSim has it
        self.tree: dict[str, tuple[str, pin.SE3, list[Axis], pin.SE3]] = {}
        self.frames: dict[str, tuple[str, pin.SE3]] = {'ground': ('ground', pin.SE3.Identity())}
        self.body_frame = {'ground': pin.SE3.Identity()}
        self.points: dict[str, list[Point]] = {}
        #: what a muscle wraps round: number of the point that it follows, and the object
        self.wraps: dict[str, dict[int, Wrap]] = {}
        self._bodies()
        self._joints()
        self._couplers()
        self._chain()
        self._couple_coordinates()
        self.objects = self._wrap_objects()
        self._muscles()
        self.source.lengths = self._lengths

    def _vector(self, element: ET.Element, tag: str, count: int = 3) -> Array:
        text = element.findtext(tag) or ' '.join('0' * count)
        values = np.array([float(word) for word in text.split()])
        if len(values) != count or not np.isfinite(values).all() or np.abs(values).max() > 1e6:
            raise refuse(
                self.file, f'{element.get("name")}: {tag}: expected {count} finite numbers'
            )
        return values

    def _offset(self, element: ET.Element) -> pin.SE3:
        turn = _body_xyz(self._vector(element, 'orientation'))
        return pin.SE3(turn, self._vector(element, 'translation'))

    # -- bodies and joints -----------------------------------------------------------------------

    def _bodies(self) -> None:
        self.mass = {}
        for body in self.model.findall('BodySet/objects/Body'):
            name = body.get('name', '')
            xx, yy, zz, xy, xz, yz = self._vector(body, 'inertia', 6)
            tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            mass = max(self._vector(body, 'mass', 1)[0], 0.0)
            self.mass[name] = inertia(mass, self._vector(body, 'mass_center'), tensor)
            self.frames[name] = name, pin.SE3.Identity()
            self._local_frames(body, name)

    def _local_frames(self, owner: ET.Element, path: str) -> None:
        for frame in owner.iter('PhysicalOffsetFrame'):
            parent, offset = self._frame(frame.findtext('socket_parent', path), path)
            at = parent, offset * self._offset(frame)
            self.frames[f'{path}/{frame.get("name")}'] = at

    def _frame(self, socket: str, owner: str = '') -> tuple[str, pin.SE3]:
        """Return the body of a frame that a socket names, and its pose in that body."""
        parts = [part for part in socket.strip().split('/') if part not in ('', '..', 'bodyset')]
        for name in ('/'.join([owner, *parts]), '/'.join(parts[-2:]), parts[-1]):
            if name in self.frames:
                return self.frames[name]
        raise refuse(self.file, f'there is no frame {socket!r}')

    def _joints(self) -> None:
        for joint in self.model.find('JointSet/objects') or ():
            name = joint.get('name', '')
            self._local_frames(joint, name)
            parent, before = self._frame(joint.findtext('socket_parent_frame', ''), name)
            child, after = self._frame(joint.findtext('socket_child_frame', ''), name)
            names = []
            for item in joint.findall('coordinates/Coordinate'):
                low, high = self._vector(item, 'range', 2) if item.find('range') is not None else (-np.inf, np.inf)  # noqa: E501  # fmt: skip
                default = self._vector(item, 'default_value', 1)[0]
                locked = item.findtext('locked', 'false').strip().lower() == 'true'
                names.append(item.get('name', ''))
                self.coordinates[names[-1]] = Coordinate(low, high, default, locked)
            self.tree[child] = parent, before, self._axes(joint, names), after.inverse()

    def _axes(self, joint: ET.Element, names: list[str]) -> list[Axis]:
        if joint.tag == 'WeldJoint':
            return []
        if joint.tag == 'FreeJoint':
            self.source.note('held fixed', f'free joint {joint.get("name")} at 0')
            return []
        if joint.tag in AXES:
            kinds = AXES[joint.tag]
            return [
                Axis(slides, np.eye(3)[axis], name, lambda x: x)
                for name, (slides, axis) in zip(names, kinds, strict=True)
            ]
        if joint.tag != 'CustomJoint':
            legal = ', '.join(['WeldJoint', 'FreeJoint', 'CustomJoint', *AXES])
            raise refuse(self.file, f'joint {joint.get("name")} is a {joint.tag}; read are {legal}')
        axes = []
        for item in joint.findall('SpatialTransform/TransformAxis'):
            functions = [part for part in item if part.tag not in ('coordinates', 'axis')]
            coordinate = (item.findtext('coordinates') or '').split()
            if len(coordinate) > 1:
                told = f'joint {joint.get("name")}: an axis of several coordinates'
                raise refuse(self.file, f'{told} cannot be expressed')
            axis = self._vector(item, 'axis')
            function = self._function(functions[0]) if functions else _constant(0.0)
            slides = item.get('name', '').startswith('translation')
            size = max(float(np.linalg.norm(axis)), 1e-12)
            axes.append(Axis(slides, axis / size, (coordinate or [''])[0], function))
        return [a for a in axes if a.slides] + [a for a in axes if not a.slides]

    def _function(self, element: ET.Element) -> Function:
        kind = element.tag
        if kind in ('function', 'Function') or (element.get('name') == 'function' and len(element) == 1 and element[0].tag[:1].isupper()):  # noqa: E501  # fmt: skip
            return self._function(element[0])
        if kind == 'Constant':
            return _constant(self._vector(element, 'value', 1)[0])
        if kind == 'LinearFunction':
            slope, start = self._vector(element, 'coefficients', 2)
            return lambda x: slope * x + start
        if kind == 'PolynomialFunction':
            text = element.findtext('coefficients', '0').split()
            return lambda x: np.asarray(np.polyval([float(word) for word in text], x))
        if kind == 'MultiplierFunction':
            inner, scale = element.find('function'), self._vector(element, 'scale', 1)[0]
            assert inner is not None
            of = self._function(inner[0])
            return lambda x: scale * of(x)
        if kind in ('SimmSpline', 'NaturalCubicSpline', 'PiecewiseLinearFunction'):
            x, y = (np.array(element.findtext(tag, '').split(), float) for tag in 'xy')
            return _spline(kind, x, y)
        raise refuse(self.file, f'a {kind} is not read')

    def _chain(self) -> None:
        """Make links of the bodies, parents first, and joints of their axes."""
        source = self.source
        source.links.append(Link('ground', ''))
        waiting, ready = dict(self.tree), ['ground']
        carried: set[str] = set()
        #: links of each axis that follows a coordinate: joint, prismatic, function
        followers: list[tuple[Link, Axis]] = []
        while ready:
            above = ready.pop(0)
            for body in [b for b, (parent, *_) in waiting.items() if parent == above]:
                _, before, axes, after = waiting.pop(body)
                ready.append(body)
                at, parent = self.body_frame[above] * before, above
                moving = [
                    a for a in axes if a.coordinate and not self.coordinates[a.coordinate].locked
                ]
                for axis in axes:
                    kind = PRISMATIC if axis.slides else REVOLUTE
                    if not any(axis is a for a in moving):
                        value = (
                            self.coordinates[axis.coordinate].default if axis.coordinate else 0.0
                        )
                        rest = float(axis.function(np.array([value]))[0])
                        still = Link('', '', at, '', kind, axis.axis, (0.0, 0.0), rest)
                        at = still.motion_at_rest
                        continue
                    last = axis is moving[-1]
                    link = Link(body if last else f'{body}_{axis.coordinate}_{len(source.links)}', parent, at)  # noqa: E501  # fmt: skip
                    link.kind, link.axis = kind, axis.axis
                    exact = self._unit_slope(axis)
                    if exact and axis.coordinate not in carried:
                        carried.add(axis.coordinate)
                        link.joint, link.axis = axis.coordinate, exact * axis.axis
                        link.limits, link.rest = self._limits(axis.coordinate, kind)
                    else:
                        link.joint = f'{axis.coordinate}_of_{link.name}'
                        followers.append((link, axis))
                    source.links.append(link)
                    at, parent = pin.SE3.Identity(), link.name
                frame = at * after
                if not moving:
                    source.links.append(Link(body, above, frame))
                    frame = pin.SE3.Identity()
                self.body_frame[body] = frame
                source.links[-1].inertia = frame.act(self.mass[body])
        if waiting:
            raise refuse(self.file, f'body {min(waiting)} does not hang on ground')
        for name, c in self.coordinates.items():
            if c.locked:
                source.note('held fixed', f'locked coordinate {name} at {c.default:.4g}')
        for link, axis in followers:
            name = axis.coordinate
            if name not in carried:
                # No joint turns by the coordinate itself: a link without mass carries its value.
                carried.add(name)
                limits, rest = self._limits(name, REVOLUTE)
                extra = Link(f'value_of_{name}', 'ground', joint=name, kind=REVOLUTE)
                extra.limits, extra.rest = limits, rest
                source.links.append(extra)
                source.note('chosen', f'link value_of_{name}: it carries a coordinate, and no mass')
            limits = source.joint(name).limits
            slope, start, error = linear_fit(axis.function, *limits)
            source.couplings[link.joint] = Coupling(name, slope, start)
            ends = sorted(slope * limit + start for limit in limits)
            link.limits = ends[0] - 1e-6, ends[1] + 1e-6
            if error > 1e-6:
                unit = 'm' if axis.slides else 'rad'
                told = (
                    f'joint {link.joint} follows {name} by a line, off by up to {error:.3g} {unit}'
                )
                source.note('approximated', told)

    def _unit_slope(self, axis: Axis) -> float:
        """Return ±1 if the axis turns or slides by ± the coordinate itself, else 0."""
        x = np.linspace(-1.0, 1.0, 5)
        y = axis.function(x)
        return next((sign for sign in (1.0, -1.0) if np.allclose(y, sign * x, atol=1e-12)), 0.0)

    def _limits(self, name: str, kind: str) -> tuple[tuple[float, float], float]:
        return self.source.limited(name, kind, *self._span(name)), self.coordinates[name].default

    def _couplers(self) -> None:
        #: coordinate that follows another, and how
        self.coupled: dict[str, tuple[str, Function]] = {}
        for item in self.model.findall('ConstraintSet/objects/*'):
            masters = (item.findtext('independent_coordinate_names') or '').split()
            slave = (item.findtext('dependent_coordinate_name') or '').strip()
            element = item.find('coupled_coordinates_function')
            known = {slave, *masters} <= set(self.coordinates) and slave not in masters
            if element is None or len(masters) != 1 or not known:
                self.source.note('dropped', f'{item.tag} {item.get("name")}')
                continue
            function, scale = self._function(element[0]), 1.0
            if item.find('scale_factor') is not None:
                scale = self._vector(item, 'scale_factor', 1)[0]

            def scaled(x: Array, function: Function = function, scale: float = scale) -> Array:
                return scale * function(x)

            self.coupled[slave] = masters[0], scaled

    def _couple_coordinates(self) -> None:
        there = {link.joint for link in self.source.links}
        for slave, (master, function) in self.coupled.items():
            if not {slave, master} <= there:
                self.source.note('dropped', f'coupling of {slave} to {master}')
                continue
            slope, start, error = linear_fit(function, *self.source.joint(master).limits)
            self.source.couplings[slave] = Coupling(master, slope, start)
            if error > 1e-6:
                told = f'{slave} follows {master} by a line, off by up to {error:.3g}'
                self.source.note('approximated', told)
        # What follows a coordinate that follows another follows that one.
        for joint, c in list(self.source.couplings.items()):
            while c.master in self.coupled:
                up = self.source.couplings[c.master]
                c = Coupling(up.master, c.ratio * up.ratio, c.ratio * up.offset + c.offset)
            self.source.couplings[joint] = c

    # -- muscles ---------------------------------------------------------------------------------

    def _wrap_objects(self) -> dict[str, Wrap]:
        objects = {}
        sets = [('ground', self.model.find('Ground')), *((b.get('name', ''), b) for b in self.model.findall('BodySet/objects/Body'))]  # noqa: E501  # fmt: skip
        for body, owner in sets:
            if owner is None or body not in self.body_frame:
                continue
            for item in owner.findall('WrapObjectSet/objects/*'):
                if item.findtext('active', 'true').strip().lower() != 'true':
                    continue
                frame = self.body_frame[body]
                turn = frame.rotation @ _body_xyz(self._vector(item, 'xyz_body_rotation'))
                centre = frame.act(self._vector(item, 'translation'))
                name, kind = item.get('name', ''), item.tag
                radius, axis = self._shape(item, turn)
                if radius <= 0.0:
                    self.source.note('dropped', f'{kind} {name}')
                    continue
                # Whether a quadrant forces a wire round depends on where a finite object ends.
                if (item.findtext('quadrant') or 'all').strip().lower() != 'all':
                    self.source.note('approximated', f'{kind} {name}: it is passed on any side')
                side = centre if kind == 'WrapTorus' else None
                objects[name] = Wrap(body, centre, radius, axis, side)
        return objects

    def _shape(self, item: ET.Element, turn: Array) -> tuple[float, Array | None]:
        note, name = self.source.note, item.get('name', '')
        if item.tag == 'WrapSphere':
            return float(self._vector(item, 'radius', 1)[0]), None
        if item.tag == 'WrapCylinder':
            note('approximated', f'WrapCylinder {name}: without its ends')
            return float(self._vector(item, 'radius', 1)[0]), turn[:, 2]
        if item.tag == 'WrapTorus':
            note('approximated', f'WrapTorus {name}: a ring along its axis')
            return float(self._vector(item, 'inner_radius', 1)[0]), turn[:, 2]
        if item.tag != 'WrapEllipsoid':
            return 0.0, None
        sizes = self._vector(item, 'dimensions')
        first, second, longest = np.argsort(sizes)
        across = float(np.sqrt(sizes[first] * sizes[second]))
        if sizes[second] < 1.25 * sizes[first] and sizes[longest] > 1.25 * sizes[second]:
            note('approximated', f'WrapEllipsoid {name}: a cylinder of {1e3 * across:.1f} mm')
            return across, turn[:, longest]
        radius = float(np.cbrt(np.prod(sizes)))
        note('approximated', f'WrapEllipsoid {name}: a sphere of {1e3 * radius:.1f} mm')
        return radius, None

    def _muscles(self) -> None:
        source = self.source
        for item in self.model.find('ForceSet/objects') or ():
            name, path = safe_name(item.get('name', ''), 'force'), item.find('GeometryPath')
            if path is None or not ('Muscle' in item.tag or item.tag == 'PathActuator'):
                source.note('dropped', f'{item.tag} {name}: no muscle with a path of points')
                continue
            points = [self._point(name, p) for p in path.findall('PathPointSet/objects/*')]
            self.points[name] = points
            always = self._always_active(name)
            route: list[RoutePoint | Wrap] = []
            kept: list[int] = []
            for i, point in enumerate(points):
                at = self._standing(name, point, always[i])
                if always[i]:
                    kept.append(i)
                    route.append(RoutePoint(point.body, self.body_frame[point.body].act(at)))
            if len(route) < 2:
                source.note('dropped', f'muscle {name}: fewer than 2 points')
                continue
            source.routes[name] = tuple(route)
            self._place_wraps(name, path, kept)
            force = item.findtext('max_isometric_force') or item.findtext('optimal_force') or '0'
            if float(force) > 0.0:
                source.strength[name] = float(force)
        if any(self.wraps.values()):
            source.note('approximated', 'lengths are compared round the wrap objects of the result')
        if source.strength:
            source.note('chosen', STRENGTH)

    def _point(self, muscle: str, item: ET.Element) -> Point:
        body, offset = self._frame(item.findtext('socket_parent_frame', ''))

        def coordinate(tag: str) -> str:
            return item.findtext(tag, '').strip().split('/')[-1]

        if item.tag == 'MovingPathPoint':
            parts = []
            for letter in 'xyz':
                element = item.find(f'{letter}_location')
                function = self._function(element[0]) if element is not None and len(element) else _constant(0.0)  # noqa: E501  # fmt: skip
                parts.append((coordinate(f'socket_{letter}_coordinate'), function))
            if not offset.isIdentity(1e-9):
                raise refuse(self.file, f'muscle {muscle}: a moving point in an offset frame')
            return Point(body, parts, None)
        at, condition = offset.act(self._vector(item, 'location')), None
        if item.tag == 'ConditionalPathPoint':
            low, high = self._vector(item, 'range', 2)
            condition = coordinate('socket_coordinate'), low, high
        return Point(body, at, condition)

    def _span(self, name: str) -> tuple[float, float]:
        """Return between which values a coordinate moves."""
        c = self.coordinates[name]
        if name in self.coupled:
            master, function = self.coupled[name]
            values = function(np.linspace(*self._span(master), 201))
            return float(values.min()), float(values.max()) + 1e-6
        return (c.low, c.high) if c.high - c.low < 100.0 else (-np.pi, np.pi)

    def _always_active(self, name: str) -> list[bool]:
        """Return which points the route keeps: of conditional ones those that err least.

        Begins with all and changes one at a time, as long as that lowers the squared error of how
        the length changes.
        """
        points = self.points[name]
        places, active = self._positions(name, self._random(200))
        true, kept = _path(places, active), [True] * len(points)

        def error(tried: list[bool]) -> float:
            off = _path(places, np.broadcast_to(tried, active.shape)) - true
            return float(np.square(off - off.mean()).mean())

        least = error(kept)
        conditional = [i for i, point in enumerate(points) if point.condition]
        for _ in conditional:
            flips = [[k != (j == i) for j, k in enumerate(kept)] for i in conditional]
            best = min(flips, key=error)
            if error(best) >= least:
                break
            kept, least = best, error(best)
        return kept

    def _standing(self, muscle: str, point: Point, kept: bool) -> Array:
        """Return where a point is taken to be, in its body."""
        note = self.source.note
        if point.condition:
            name, low, high = point.condition
            least, most = self._span(name)
            share = (min(high, most) - max(low, least)) / (most - least)
            told = f'muscle {muscle}: a point active in {100 * max(share, 0.0):.0f} % of {name}'
            note('approximated', f'{told} is {"always there" if kept else "left out"}')
        if isinstance(point.at, list):
            ways = [f(np.linspace(*self._span(name), 201)) if name else f(np.zeros(1)) for name, f in point.at]  # noqa: E501  # fmt: skip
            off = 1e3 * max(float(np.abs(way - way.mean()).max()) for way in ways)
            note(
                'approximated', f'muscle {muscle}: a moving point stands still, off by {off:.1f} mm'
            )
            return np.array([way.mean() for way in ways])
        return point.at

    def _place_wraps(self, name: str, path: ET.Element, kept: list[int]) -> None:
        """Put each wrap object between the two points between which it is met most often."""
        source, chosen = self.source, self.wraps.setdefault(name, {})
        theta = self._random(100)
        points = self._positions(name, theta)[0]
        poses = self._poses(theta)
        for item in path.findall('PathWrapSet/objects/PathWrap'):
            label = (item.findtext('wrap_object') or '').strip().split('/')[-1]
            if label not in self.objects:
                source.note('dropped', f'muscle {name}: wrap round {label}')
                continue
            wrap = self.objects[label]
            first, last = (int(float(word)) for word in (item.findtext('range') or '-1 -1').split())
            best, most = None, 0.0
            for i, k in pairwise(kept):
                if (first > 0 and i + 1 < first) or (last > 0 and k + 1 > last) or i in chosen:
                    continue
                detour = _wrap_length(wrap, poses[wrap.link], self.body_frame[wrap.link], points[:, i], points[:, k])  # noqa: E501  # fmt: skip
                added = float((detour - np.linalg.norm(points[:, k] - points[:, i], axis=1)).mean())
                if added > most:
                    best, most = i, added
            if best is None:
                source.note('dropped', f'muscle {name}: wrap round {label}, which it does not meet')
                continue
            chosen[best] = wrap
        route: list[RoutePoint | Wrap] = []
        for i, point in zip(kept, source.routes[name], strict=True):
            route += [point, chosen[i]] if i in chosen else [point]
        source.routes[name] = tuple(route)

    # -- OpenSim's own lengths -------------------------------------------------------------------

    def _random(self, count: int) -> dict[str, Array]:
        rng = np.random.default_rng(0)
        return {
            name: np.full(count, c.default) if c.locked else rng.uniform(*self._span(name), count)
            for name, c in self.coordinates.items()
        }

    def _poses(self, values: dict[str, Array]) -> dict[str, Array]:
        """Return poses (N, 4, 4) of bodies for coordinates (N,), functions as OpenSim has them."""
        count = len(next(iter(values.values())))
        values = {
            name: values.get(name, np.full(count, c.default))
            for name, c in self.coordinates.items()
        }
        for _ in self.coupled:
            for slave, (master, function) in self.coupled.items():
                values[slave] = function(values[master])
        poses = {'ground': np.tile(np.eye(4), (count, 1, 1))}

        def pose(body: str) -> Array:
            if body not in poses:
                parent, before, axes, after = self.tree[body]
                at = pose(parent) @ before.homogeneous
                for axis in axes:
                    x = values[axis.coordinate] if axis.coordinate else np.zeros(count)
                    at = at @ _motion(axis, axis.function(x))
                poses[body] = at @ after.homogeneous
            return poses[body]

        for body in self.tree:
            pose(body)
        self._values = values
        return poses

    def _positions(self, name: str, values: dict[str, Array]) -> tuple[Array, Array]:
        """Return a muscle's points (N, P, 3), and whether each is active (N, P)."""
        poses, points = self._poses(values), self.points[name]
        count = len(next(iter(poses.values())))
        places = np.empty((count, len(points), 3))
        active = np.ones((count, len(points)), dtype=bool)
        for i, point in enumerate(points):
            local = np.empty((count, 3))
            if isinstance(point.at, list):
                for axis, (coordinate, function) in enumerate(point.at):
                    x = self._values[coordinate] if coordinate else np.zeros(count)
                    local[:, axis] = function(x)
            else:
                local[:] = point.at
            pose = poses[point.body]
            places[:, i] = (pose[:, :3, :3] @ local[..., None])[..., 0] + pose[:, :3, 3]
            if point.condition:
                coordinate, low, high = point.condition
                value = self._values[coordinate]
                active[:, i] = np.equal(np.clip(value, low, high), value)
        return places, active

    def _lengths(self, values: dict[str, Array]) -> dict[str, Array]:
        poses, result = self._poses(values), {}
        for name in self.source.routes:
            places, active = self._positions(name, values)
            total = np.zeros(len(places))
            # From each active point to the next active one.
            for i in range(places.shape[1]):
                after = np.zeros(len(places), dtype=bool)
                for k in range(i + 1, places.shape[1]):
                    now = np.logical_and(active[:, i], active[:, k]) & ~after
                    after = np.logical_or(after, active[:, k])
                    ends = places[now, i], places[now, k]
                    if not now.any():
                        continue
                    if (wrap := self.wraps[name].get(i)) is not None:
                        pose = poses[wrap.link][now]
                        total[now] += _wrap_length(wrap, pose, self.body_frame[wrap.link], *ends)
                    else:
                        total[now] += np.linalg.norm(ends[1] - ends[0], axis=-1)
            result[name] = total
        return result


def _path(places: Array, active: Array) -> Array:
    """Return lengths (N,) of straight paths over those of the points (N, P, 3) that are active."""
    total, last = np.zeros(len(places)), places[:, 0].copy()
    begun = np.zeros(len(places), dtype=bool)
    for place, now in zip(places.swapaxes(0, 1), active.T):
        step = np.linalg.norm(place - last, axis=1)
        total += np.where(np.logical_and(now, begun), step, 0.0)
        last[now] = place[now]
        begun = np.logical_or(begun, now)
    return total


def _constant(value: float) -> Function:
    return lambda x: np.full_like(x, value, dtype=float)


def _body_xyz(angles: Array) -> Array:
    """Return the rotation of body-fixed x-y-z angles [rad]."""
    x, y, z = (pin.exp3(axis * angle) for axis, angle in zip(np.eye(3), angles))
    turn: Array = x @ y @ z
    return turn


def _spline(kind: str, x: Array, y: Array) -> Function:
    """Return a function through points, going on straight beyond them."""
    if len(x) < 2 or len(x) != len(y) or not (np.diff(x) > 0.0).all():
        raise SourceError(f'a {kind} needs at least 2 points with rising x')
    if kind == 'PiecewiseLinearFunction' or len(x) == 2:
        return lambda at: np.interp(at, x, y)
    spline = CubicSpline(x, y, bc_type='natural' if kind.startswith('Natural') else 'not-a-knot')

    def value(at: Array) -> Array:
        inside = np.clip(at, x[0], x[-1])
        reached: Array = spline(inside) + spline(inside, 1) * (at - inside)
        return reached

    return value


def _motion(axis: Axis, value: Array) -> Array:
    """Return transforms (N, 4, 4) along or about an axis."""
    motion = np.tile(np.eye(4), (len(value), 1, 1))
    if axis.slides:
        motion[:, :3, 3] = value[:, None] * axis.axis
        return motion
    cross = pin.skew(axis.axis)
    turn = np.sin(value)[:, None, None] * cross
    motion[:, :3, :3] += turn + (1.0 - np.cos(value))[:, None, None] * (cross @ cross)
    return motion


def _wrap_length(wrap: Wrap, pose: Array, frame: pin.SE3, start: Array, end: Array) -> Array:
    """Return lengths (N,) round an object; its frame is that of the link in the body's frame."""
    from musculoskeletal_ae.robot.wrapping import WrapObjects, wrapped_segments

    none = np.full(3, np.nan)
    objects = WrapObjects(
        np.zeros(1, dtype=np.int64),
        wrap.xyz[None],
        np.zeros((1, 3)) if wrap.axis is None else wrap.axis[None],
        (none if wrap.side is None else wrap.side - wrap.xyz)[None],
        np.array([wrap.radius]),
    )
    link = pose @ frame.inverse().homogeneous
    turned, moved = (np.ascontiguousarray(part[:, None]) for part in (link[:, :3, :3], link[:, :3, 3]))  # noqa: E501  # fmt: skip
    return wrapped_segments(objects, turned, moved, start[:, None], end[:, None])[0][:, 0]
