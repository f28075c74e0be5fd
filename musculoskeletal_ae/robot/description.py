# SPDX-License-Identifier: Apache-2.0
"""A robot description: a directory with `robot.urdf` and `muscles.yaml`, read and checked.

Everything that can be wrong in the two files is refused here, with the file, the entry and the
legal values in the message, so that no later code needs to check again.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.files import read_text, read_yaml
from musculoskeletal_ae.robot import kinematics, series_elastic
from musculoskeletal_ae.robot.directories import find_robot
from musculoskeletal_ae.robot.entries import Entry, refusal
from musculoskeletal_ae.robot.kinematics import Coupling, body_frames, resolved
from musculoskeletal_ae.robot.series_elastic import SeriesElastic
from musculoskeletal_ae.robot.urdf import parse_xml, read_mimics, read_urdf

STIFFNESS_DEFAULT = 10000.0  # [N/m]
#: what URDF calls joints that are neither revolute nor prismatic, by their degrees of freedom
OTHER_JOINTS = {1: 'continuous', 3: 'planar', 6: 'floating'}

TENSION_DEFAULT = {'bias': 30.0, 'limit': 200.0, 'max': 500.0}  # [N]


class RoutePoint(NamedTuple):
    """A point that the wire passes."""

    link: str
    xyz: Array  # in the link's frame [m], (3,)


class Wrap(NamedTuple):
    """What the wire may wrap round between two points; vectors in the link's frame, (3,)."""

    link: str
    xyz: Array  # centre [m]
    radius: float  # [m]
    axis: Array | None  # unit vector of a cylinder; None: a sphere
    side: Array | None  # a point on the side that the wire takes [m]; inside: a ring


def written(item: RoutePoint | Wrap) -> dict[str, Any]:
    """Return an item of a route as muscles.yaml has it."""
    given = {key: value for key, value in item._asdict().items() if value is not None}
    given = {k: v if isinstance(v, str) else np.round(v, 9).tolist() for k, v in given.items()}
    if isinstance(item, Wrap):
        given = {'wrap': 'sphere' if item.axis is None else 'cylinder', **given}
    return given


#: points, joined by straight lines or round a wrap that stands between two of them
Route = tuple[RoutePoint | Wrap, ...]


@dataclass(frozen=True)
class TensionRange:
    """Muscle tensions [N], each of shape (M,)."""

    bias: Array  # what MSC keeps
    limit: Array  # the highest planned
    max: Array  # the highest ever


def shown(values: Array) -> str:
    """Return the one value of all muscles, or the span of their values."""
    low, high = np.min(values), np.max(values)
    return f'{low:g}' if low == high else f'{low:g}–{high:g}'


@dataclass(frozen=True)
class RobotDescription:
    """What the two files of a robot directory say, checked."""

    directory: Path
    urdf: str
    model: pin.Model  # of the whole URDF
    joints: tuple[str, ...]  # in the order of θ
    muscles: tuple[str, ...]  # in the order of T and l
    routes: tuple[Route, ...]  # one for each muscle
    series_elastic: SeriesElastic
    stiffness: Array  # K_stiff of muscle stiffness control [N/m], (M,)
    tension: TensionRange
    end_effectors: tuple[str, ...]  # the first grasps, is pushed and carries the marker
    couplings: dict[str, Coupling]  # of joints that follow others
    warnings: tuple[str, ...]  # what was accepted, but deserves a look

    @property
    def end_effector(self) -> str:
        """The link that grasps, is pushed and carries the marker."""
        return self.end_effectors[0]

    @property
    def held_joints(self) -> tuple[str, ...]:
        """Movable joints of the URDF that are in neither θ nor a coupling: held fixed."""
        known = {*self.couplings, *self.joints}
        return tuple(name for name in self.model.names[1:] if name not in known)

    @property
    def joint_notes(self) -> list[str]:
        """Lines that name the joints which are not in θ: coupled ones, and those held fixed."""
        lines = [
            f'{joint} = {c.ratio:g} · {c.master}' + (f' {c.offset:+g}' if c.offset else '')
            for joint, c in self.couplings.items()
        ]
        if held := ', '.join(self.held_joints):
            lines.append(f'held fixed at 0: {held}')
        return lines


def load_description(robot: str | Path) -> RobotDescription:
    """Read and check a robot description, by a shipped name such as 'arm26' or a directory.

    Raises:
        RobotDescriptionError: Naming the file, the entry and the legal values.
    """
    directory = find_robot(robot)
    urdf_file, muscle_file = directory / 'robot.urdf', directory / 'muscles.yaml'
    urdf = read_text(urdf_file, refusal)
    model = read_urdf(urdf_file, urdf)
    top = Entry(muscle_file, read_yaml(muscle_file, refusal), 'top level', '').mapping(
        'joints', 'muscles', 'series_elastic', 'stiffness', 'tension', 'end_effector',
        'end_effectors', 'couplings',
    )  # fmt: skip
    joints, parsed = _read_joints(top['joints'], model), parse_xml(urdf_file, urdf)
    couplings = _read_couplings(top, read_mimics(parsed), joints, model)
    order = [link.get('name', '') for link in parsed.iter('link')]
    default = _read_elastic(top.get('series_elastic'), series_elastic.DEFAULT)
    links = [str(frame.name) for frame in body_frames(model)]
    stiffness = top.get('stiffness', STIFFNESS_DEFAULT).number(above=0.0)
    tension = _read_tension(top.get('tension', {}), TENSION_DEFAULT)
    names, routes, elastic, module, warnings = [], [], [], [], list[str]()
    for item in top['muscles'].items(1, 'muscles'):
        entry = item.mapping('name', 'route', 'series_elastic', 'stiffness', 'tension')
        names.append(entry['name'].name())
        for wrong, legal in (
            (',' in names[-1], 'a comma, which lists of muscles have between names'),
            (names[-1] != names[-1].strip(), 'spaces around it, which lists of muscles may have'),
        ):
            if wrong:
                raise entry['name'].fail(f'expected a name without {legal}, got {names[-1]!r}')
        muscle = entry.called(f'muscle {names[-1]!r}')
        routes.append(_read_route(muscle['route'], links, warnings))
        elastic.append(_read_elastic(muscle.get('series_elastic'), default))
        own = _read_tension(muscle.get('tension', {}), tension)
        module.append(own | {'K': muscle.get('stiffness', stiffness).number(above=0.0)})
    return RobotDescription(
        directory=directory,
        urdf=urdf,
        model=model,
        joints=joints,
        muscles=top['muscles'].unique(names),
        routes=tuple(routes),
        series_elastic=SeriesElastic(**_columns(elastic, default)),
        stiffness=_columns(module, 'K')['K'],
        tension=TensionRange(**_columns(module, TENSION_DEFAULT)),
        end_effectors=_read_end_effectors(top, model, joints, couplings, order),
        couplings=couplings,
        warnings=tuple(warnings),
    )


def _columns(rows: list[dict[str, float]], keys: Iterable[str]) -> dict[str, Array]:
    return {key: np.array([row[key] for row in rows]) for key in keys}


def _read_joints(entry: Entry, model: pin.Model) -> tuple[str, ...]:
    names = [item.name() for item in entry.items(1, 'names')]
    for name in entry.unique(names):
        joint = _one_axis_joint(entry, name, model)
        limits = model.lowerPositionLimit, model.upperPositionLimit
        lower, upper = (limit[joint.idx_q] for limit in limits)
        if not -math.inf < lower < upper < math.inf:
            told = f'joint {name!r} has limits [{lower:g}, {upper:g}] in robot.urdf'
            raise entry.fail(f'{told}; expected finite lower < upper')
    return tuple(names)


def _one_axis_joint(entry: Entry, name: str, model: pin.Model) -> pin.JointModel:
    if name not in list(model.names)[1:]:
        legal = ', '.join(list(model.names)[1:])
        raise entry.fail(f'unknown joint {name!r}; movable joints of robot.urdf: {legal}')
    joint = model.joints[model.getJointId(name)]
    if joint.shortname() not in kinematics.REVOLUTE + kinematics.PRISMATIC:
        kind = OTHER_JOINTS.get(joint.nv, joint.shortname())
        raise entry.fail(
            f'joint {name!r} is {kind}; legal: revolute or prismatic joints '
            'with one degree of freedom and limits (continuous has none)'
        )
    return joint


def _read_couplings(
    top: Entry, mimics: dict[str, Coupling], joints: tuple[str, ...], model: pin.Model
) -> dict[str, Coupling]:
    """Return what each coupled joint follows, a joint that follows none itself."""
    entry, links, names = top.get('couplings', []), dict(mimics), list[str]()
    for item in entry.items(0, 'couplings'):
        given = item.mapping('joint', 'master', 'ratio', 'offset')
        names.append(given['joint'].name())
        ratio, offset = given.get('ratio', 1.0).number(), given.get('offset', 0.0).number()
        links[names[-1]] = Coupling(given['master'].name(), ratio, offset)
    entry.unique(names)
    for slave in links:
        if slave in joints:
            source = 'couplings' if slave in names else 'its <mimic> in robot.urdf'
            raise entry.fail(
                f'joint {slave!r} follows {links[slave].master!r} by {source}; '
                'list only joints that follow none under joints'
            )
    try:
        couplings = resolved(links)
    except ValueError as error:
        raise entry.fail(str(error)) from error
    for slave, coupling in list(couplings.items()):
        elsewhere = slave not in names and coupling.master not in joints
        try:
            for name in (slave, coupling.master):
                _one_axis_joint(entry, name, model)
        except RobotDescriptionError:
            if not (elsewhere and model.existJointName(coupling.master)):
                raise
            del couplings[slave]  # of wheels that the URDF has elsewhere: held as well
    return couplings


def _read_elastic(entry: Entry, default: dict[str, float]) -> dict[str, float]:
    if entry.value is None:
        return default
    given = entry.mapping(*default)
    force, rate, stretch = (given.get(key, value) for key, value in default.items())
    return {
        'force': force.number(above=0.0),
        'rate': rate.number(above=0.0),
        'wire_stretch': stretch.number(least=0.0),
    }


def _read_route(entry: Entry, links: list[str], warnings: list[str]) -> Route:
    route: list[RoutePoint | Wrap] = []
    for item in entry.items(2, 'points'):
        if isinstance(item.value, dict) and 'wrap' in item.value:
            route.append(_read_wrap(item, links))
            if len(route) < 2 or isinstance(route[-2], Wrap):
                raise item.fail('a wrap stands between two points')
            continue
        given = item.mapping('link', 'xyz')
        point = RoutePoint(_read_link(given['link'], links), _read_vector(given['xyz']))
        last = route[-1] if route and isinstance(route[-1], RoutePoint) else None
        if last and last.link == point.link and np.array_equal(last.xyz, point.xyz):
            warnings.append(f'{item.where} is the same point as the one before it, and left out')
            continue
        route.append(point)
    if isinstance(route[-1], Wrap):
        raise entry.fail('a wrap stands between two points')
    if len(route) < 2:
        raise entry.fail(f'expected at least 2 different points, {len(route)} given')
    return tuple(route)


def _read_wrap(item: Entry, links: list[str]) -> Wrap:
    kinds = {'sphere': (), 'cylinder': ('axis',)}
    if (kind := item['wrap'].name()) not in kinds:
        raise item['wrap'].fail(f'expected {" or ".join(kinds)}, got {kind!r}')
    given = item.mapping('wrap', 'link', 'xyz', *kinds[kind], 'radius', 'side')
    axis = side = None
    if kind == 'cylinder':
        axis = _read_vector(given['axis'])
        if (size := float(np.linalg.norm(axis))) < 1e-6:
            raise given['axis'].fail(f'expected a direction, got {axis.tolist()}')
        axis = axis / size
    xyz = _read_vector(given['xyz'])
    if given.get('side').value is not None:
        side = _read_vector(given['side'])
    radius = given['radius'].number(above=0.0)
    if axis is not None and side is not None:
        out = side - xyz
        if np.linalg.norm(np.cross(axis, out)) < 1e-9 and np.linalg.norm(out) >= radius:
            raise given['side'].fail('expected a point beside the axis, got one on it')
    return Wrap(_read_link(given['link'], links), xyz, radius, axis, side)


def _read_vector(entry: Entry) -> Array:
    xyz = entry.items(3, 'numbers')
    if len(xyz) != 3:
        raise entry.fail(f'expected 3 numbers, got {len(xyz)}')
    return np.array([coordinate.number() for coordinate in xyz])


def _read_link(entry: Entry, links: list[str]) -> str:
    name = entry.name()
    if name not in links:
        raise entry.fail(f'unknown link {name!r}; links of robot.urdf: {", ".join(links)}')
    return name


def _read_tension(entry: Entry, default: dict[str, float]) -> dict[str, float]:
    given = entry.mapping(*default)
    bias, limit, most = (given.get(key, default[key]).number(above=0.0) for key in default)
    if not bias < limit <= most:
        raise entry.fail(f'expected bias < limit <= max, got {bias:g}, {limit:g}, {most:g}')
    return {'bias': bias, 'limit': limit, 'max': most}


def _read_end_effectors(
    top: Entry, model: pin.Model, joints: Iterable[str], couplings: Iterable[str], order: list[str]
) -> tuple[str, ...]:
    one, several = top.get('end_effector'), top.get('end_effectors')
    moved, links = _joints_above(model, {*joints, *couplings}), _joints_above(model, {*joints})
    if one.value is not None and several.value is not None:
        raise several.fail('expected end_effector or end_effectors, both are given')

    def read(item: Entry) -> str:
        name = _read_link(item, list(links))
        if not moved[name]:
            legal = ', '.join(link for link in links if moved[link])
            raise item.fail(f'expected a link that the joints move, {legal}; got {name!r}')
        return name

    if one.value is not None:
        return (read(one),)
    if several.value is not None:
        return several.unique([read(item) for item in several.items(1, 'links')])
    # The last link of the chain: of several that so many joints move the tip of what is fixed to
    # them, then the one listed last, as the file has them.
    tips, last = _fixed_above(model), {link: i for i, link in enumerate(order)}
    return (max(links, key=lambda link: (links[link], tips[link], last[link])),)


def _fixed_above(model: pin.Model) -> dict[str, int]:
    """Return how many fixed joints are between each link and the joint that moves it."""
    counts = dict[str, int]()
    for link in body_frames(model):
        counts[str(link.name)], above = 0, link.parentFrame
        while above > 0 and model.frames[above].type != pin.FrameType.JOINT:
            counts[str(link.name)] += model.frames[above].type == pin.FrameType.FIXED_JOINT
            above = model.frames[above].parentFrame
    return counts


def _joints_above(model: pin.Model, names: set[str]) -> dict[str, int]:
    """Return how many of these joints move each link."""
    return {
        str(link.name): sum(model.names[i] in names for i in model.supports[link.parentJoint])
        for link in body_frames(model)
    }
