# SPDX-License-Identifier: Apache-2.0
"""Read and check a robot description: a directory with `robot.urdf` and `muscles.yaml`.

All faults of the files are detected here or by `muscle_file`, `motors` and `urdf`. The error
message names the file, the entry and the legal values. Code that uses a description does not check
it again.
"""

import math
import re
from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from msgspec import UNSET, UnsetType, to_builtins

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.files import read_text, read_yaml
from musculoskeletal_ae.report import distinct
from musculoskeletal_ae.robot import series_elastic
from musculoskeletal_ae.robot.directories import find_robot
from musculoskeletal_ae.robot.joint_elasticity import JointElasticity
from musculoskeletal_ae.robot.joint_tree import REVOLUTE, Coupling, resolved
from musculoskeletal_ae.robot.joint_units import PRISMATIC, JointUnits
from musculoskeletal_ae.robot.kinematics import body_frames
from musculoskeletal_ae.robot.motors import NO_MOTORS, Motors, MotorTopics, read_motors
from musculoskeletal_ae.robot.muscle_file import (
    POSITION,
    MuscleEntry,
    MuscleFile,
    RouteEntry,
    TensionEntry,
)
from musculoskeletal_ae.robot.passive_tendons import Passive, PassiveTendons
from musculoskeletal_ae.robot.series_elastic import SeriesElastic
from musculoskeletal_ae.robot.tension_source import CURRENT, TensionSource
from musculoskeletal_ae.robot.urdf import parse_xml, read_mimics, read_urdf
from musculoskeletal_ae.schema import Strict, convert

#: function that returns the error for a problem in muscles.yaml
Fail = Callable[[str], RobotDescriptionError]

#: URDF's types of joints that are neither revolute nor prismatic, by degrees of freedom
OTHER_JOINTS = {1: 'continuous', 3: 'planar', 6: 'floating'}

#: refuse a stiffness matrix with an eigenvalue below this multiple of the largest one; rounding may
#: make an eigenvalue slightly negative
LEAST_EIGENVALUE = -1e-9

#: T_bias, T_limit and T_max of a muscle whose entry states none [N]
TENSION_DEFAULT = {'bias': 30.0, 'limit': 200.0, 'max': 500.0}
STIFFNESS_DEFAULT = 10000.0  # K_stiff of a muscle whose entry states none [N/m]
SPEED_DEFAULT = 0.1  # assume this speed of a position-controlled module that states none [m/s]
NO_TENSION = (
    'the tension is unknown, so these are not available: contact estimation, tension control, the '
    'torque balance, the tension limit, the heat limit, and the detection of slack and ruptured '
    'tendons by tension'
)
BY_CURRENT = (
    'tensions are computed from motor currents; scale, offset and drive friction are learned, and '
    'until then their errors make the tension limits equally wrong'
)


class RoutePoint(NamedTuple):
    """A point of a link through which a tendon runs."""

    link: str
    xyz: Array  # position in the link's frame [m], (3,)
    divisor: float | None = None  # if set, a branch begins here, whose length counts 1/divisor


class Wrap(NamedTuple):
    """A sphere, cylinder, ring or swivelling pulley around which a tendon wraps between two points.

    Vectors are in the frame of `link`, except `side` if `side_link` is set.
    """

    link: str
    xyz: Array  # centre, or the point of a pulley at which the tendon enters it [m]
    radius: float  # radius of the object [m]
    #: unit vector along a cylinder, or along the tendon where it enters a pulley; None for a sphere
    axis: Array | None
    #: point on the side where the tendon passes [m]; a point inside the object makes it a ring
    side: Array | None
    side_link: str | None = None  # link in whose frame `side` is; None for `link`
    swivels: bool = False  # whether the object is a pulley that swivels about `axis`


def written(item: RoutePoint | Wrap) -> dict[str, Any]:
    """Return a via point or wrap object as the entry of a route in muscles.yaml."""
    values = {key: value for key, value in item._asdict().items() if key != 'swivels'}
    entry = {key: value for key, value in values.items() if value is not None}
    entry = {k: v if isinstance(v, str) else np.round(v, 10).tolist() for k, v in entry.items()}
    if isinstance(item, Wrap):
        kind = 'pulley' if item.swivels else 'sphere' if item.axis is None else 'cylinder'
        entry = {'wrap': kind, **entry}
    return entry


#: route of a tendon: points, connected by straight lines or around the wrap between two points
Route = tuple[RoutePoint | Wrap, ...]


def branches(route: Route) -> list[Route]:
    """Return the branches of a route. Most routes have one branch, those over pulleys several."""
    starts = [i for i, item in enumerate(route) if isinstance(item, RoutePoint) and item.divisor]
    ends = sorted({0, *starts, len(route)})
    return [route[start:end] for start, end in pairwise(ends)]


@dataclass(frozen=True)
class TensionRange:
    """Muscle tensions [N], each of shape (M,)."""

    bias: Array  # T_bias, which muscle stiffness control maintains
    limit: Array  # T_limit, the highest planned tension
    max: Array  # T_max, the highest permitted tension


def shown(values: Array) -> str:
    """Return a text with the common value of all muscles, or with the range of their values."""
    low, high = np.min(values), np.max(values)
    return f'{low:g}' if low == high else f'{low:g}–{high:g}'


@dataclass(frozen=True)
class RobotDescription:
    """The checked content of a robot directory."""

    directory: Path
    urdf: str
    model: pin.Model  # pinocchio's model of the whole URDF
    joints: tuple[str, ...]  # names of the joints, in the order of θ
    muscles: tuple[str, ...]  # names of the muscles, in the order of T and l
    routes: tuple[Route, ...]  # one route for each muscle
    series_elastic: SeriesElastic
    #: K_stiff of muscle stiffness control [N/m], (M,); infinite for position-controlled modules
    stiffness: Array
    tension: TensionRange
    actuation: str  # kind of the muscle modules: STIFFNESS or POSITION
    tension_source: TensionSource
    speed: Array  # speed of position-controlled modules [m/s], (M,); infinite for others
    #: length that a stop pays out if tensions are unknown [m], (M,); NaN for the default
    release: Array
    end_effectors: tuple[str, ...]  # names of links; `end_effector` is the first of them
    couplings: dict[str, Coupling]  # coupling of each joint that follows another one
    joint_elasticity: JointElasticity  # springs and dampers of the joints
    #: how the motors of a ros2_control robot are connected; None for a robot with a driver
    motors: Motors | None
    warnings: tuple[str, ...]  # texts about questionable entries that were accepted

    @property
    def end_effector(self) -> str:
        """The link to which poses, external wrenches and the marker refer."""
        return self.end_effectors[0]

    @property
    def motor_topics(self) -> MotorTopics:
        """Topics of the motors; without names if the robot publishes muscle_states."""
        return NO_MOTORS if self.motors is None else self.motors.topics

    @property
    def held_joints(self) -> tuple[str, ...]:
        """Movable joints of the URDF that are held fixed: they are neither in θ nor coupled."""
        known = {*self.couplings, *self.joints}
        return tuple(name for name in self.model.names[1:] if name not in known)

    @property
    def notes(self) -> list[str]:
        """Texts for users on what the robot has besides links, joints, muscles and their routes.

        These are coupled joints, the kind of muscle modules, joints held fixed, springs at joints
        and passive tendons.
        """
        lines = [f'{joint} = {coupling}' for joint, coupling in self.couplings.items()]
        if self.actuation == POSITION:
            lines.append(f'muscle modules: position-controlled, at {shown(self.speed)} m/s at most')
        if not self.tension_source.is_known:
            lines.append(f'tension_source is none: {NO_TENSION}')
        if (scale := self.tension_source.newton_per_ampere) is not None:
            lines.append(f'tension_source is current, {shown(scale)} N per A: {BY_CURRENT}')
        if self.motors is not None:
            commands = self.motors.topics.commands or 'no topic'
            lines.append(
                f'its motors are joints of ros2_control: states on {self.motors.topics.states}, '
                f'commands on {commands} (motors.yaml)'
            )
        if held := ', '.join(self.held_joints):
            lines.append(f'held fixed at 0: {held}')
        springs = self.joint_elasticity
        for i, unit in enumerate(JointUnits.of_model(self.model, self.joints)):
            if springs.stiffness[i, i] > 0.0:
                own = unit.stiffness_text(springs.stiffness[i, i], '.3g')
                rest = unit.position_text(springs.rest[i], '.3g')
                lines.append(f'{self.joints[i]}: spring of {own}, at rest at {rest}')
        tendons = springs.tendons
        for name, law, own in zip(tendons.names, tendons.arrays.law, tendons.spanned, strict=True):
            joints = ', '.join(np.array(self.joints)[own])
            slack = f'no force from {1e3 * law[1]:.4g} to {1e3 * law[2]:.4g} mm'
            lines.append(f'passive tendon {name} of {law[0]:.4g} N/m at {joints}: {slack}')
        return lines


def refusal(file: Path, problem: str) -> RobotDescriptionError:
    """Return an error which states that a file of a robot directory cannot be read, and why."""
    remedy = '' if file.exists() else '; a robot directory contains robot.urdf and muscles.yaml'
    return RobotDescriptionError(f'{file}: {problem}{remedy}')


def load_description(robot: str | Path) -> RobotDescription:
    """Load and check a robot description: a shipped name such as 'arm26', or a directory.

    Raises:
        RobotDescriptionError: If the description is invalid; the message names the file, the entry
            and the legal values.
    """
    directory = find_robot(robot)
    urdf_file, muscle_file = directory / 'robot.urdf', directory / 'muscles.yaml'

    urdf = read_text(urdf_file, refusal)
    model, tree = read_urdf(urdf_file, urdf), parse_xml(urdf_file, urdf)
    document = read_yaml(muscle_file, refusal)

    def fail(problem: str) -> RobotDescriptionError:
        return RobotDescriptionError(f'{muscle_file}: {_with_muscle_name(problem, document)}')

    content = convert(document, MuscleFile, fail)
    mimics = read_mimics(tree)
    _check_joints(content.joints, mimics, model, fail)
    couplings = _read_couplings(content, mimics, model, urdf_file, fail)
    links = [str(frame.name) for frame in body_frames(model)]
    elastic_default = series_elastic.DEFAULT | _entries(content.series_elastic)
    tension_default = _read_tension('$.tension', content.tension, TENSION_DEFAULT, fail)
    follows_position = content.actuation == POSITION
    stiffness_default = math.inf if follows_position else _or(content.stiffness, STIFFNESS_DEFAULT)
    speed_default = _or(content.speed, SPEED_DEFAULT) if follows_position else math.inf
    routes, elastic, tension, stiffness, warnings = [], [], [], [], list[str]()
    speed, release = [], []
    for i, muscle in enumerate(content.muscles):
        place = f'$.muscles[{i}]'
        routes.append(_read_route(f'{place}.route', muscle, links, fail, warnings))
        elastic.append(elastic_default | _entries(muscle.series_elastic))
        tension.append(_read_tension(f'{place}.tension', muscle.tension, tension_default, fail))
        stiffness.append(_or(muscle.stiffness, stiffness_default))
        speed.append(_or(muscle.speed, speed_default))
        release.append(_or(muscle.release, _or(content.release, math.nan)))
    order = [link.get('name', '') for link in tree.iter('link')]
    muscles = tuple(muscle.name for muscle in content.muscles)
    return RobotDescription(
        directory=directory,
        urdf=urdf,
        model=model,
        joints=content.joints,
        muscles=muscles,
        routes=tuple(routes),
        series_elastic=SeriesElastic(**_columns(elastic)),
        stiffness=np.array(stiffness),
        tension=TensionRange(**_columns(tension)),
        actuation=content.actuation,
        tension_source=_read_tension_source(content),
        speed=np.array(speed),
        release=np.array(release),
        end_effectors=_read_end_effectors(content, model, couplings, order, fail),
        couplings=couplings,
        joint_elasticity=JointUnits.of_model(model, content.joints).elasticity_to_core(
            _read_joint_elasticity(content, couplings, fail)
        ),
        motors=read_motors(directory, muscles),
        warnings=tuple(warnings),
    )


def _with_muscle_name(problem: str, document: Any) -> str:
    """Return a problem, preceded by the name of the muscle if the problem concerns a muscle."""
    match = re.match(r'\$\.muscles\[(\d+)\]', problem)
    muscle = document['muscles'][int(match[1])] if match else None
    name = muscle.get('name') if isinstance(muscle, dict) else None
    return f'muscle {name!r}: {problem}' if isinstance(name, str) else problem


def _entries(entry: Strict | None) -> dict[str, float]:
    """Return the numbers that an entry of muscles.yaml states, by key; {} if it is omitted."""
    entries: dict[str, float] = {} if entry is None else to_builtins(entry)
    return entries


def _read_tension_source(content: MuscleFile) -> TensionSource:
    if content.tension_source != CURRENT:
        return TensionSource(content.tension_source)
    drives = [muscle.drive or content.drive for muscle in content.muscles]
    scales = [drive.newton_per_ampere for drive in drives if drive is not None]
    return TensionSource(CURRENT, np.array(scales))


def _or(value: float | UnsetType, default: float) -> float:
    return default if value is UNSET else value


def _columns(rows: list[dict[str, float]]) -> dict[str, Array]:
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}


def _check_joints(
    joints: tuple[str, ...], mimics: Container[str], model: pin.Model, fail: Fail
) -> None:
    """Check that every joint in `joints` of muscles.yaml is legal.

    A legal joint is a revolute or prismatic joint of robot.urdf with finite limits. `mimics` are
    the joints that follow another one by a <mimic>.
    """
    for i, name in enumerate(joints):
        if problem := _joint_problem(name, model, mimics):
            raise fail(f'$.joints[{i}]: {problem}')
        limits = model.lowerPositionLimit, model.upperPositionLimit
        index = model.joints[model.getJointId(name)].idx_q
        lower, upper = (limit[index] for limit in limits)
        if not -math.inf < lower < upper < math.inf:
            least, most = distinct(lower, upper)
            limits_text = f'joint {name!r} has the limits {least} to {most} in robot.urdf'
            expected = 'expected finite lower < upper in its <limit>'
            raise fail(f'$.joints[{i}]: {limits_text}; {expected}')


def _joint_problem(name: str, model: pin.Model, followers: Container[str] = ()) -> str:
    """Check whether a joint is suitable for `joints` or a coupling; return the problem, or ''.

    `followers` are joints that the text about an unknown joint does not list as legal.
    """
    movable = {str(n): joint.shortname() for n, joint in [*zip(model.names, model.joints)][1:]}
    suitable = [n for n, kind in movable.items() if kind in REVOLUTE + PRISMATIC]
    if name in suitable:
        return ''
    if name not in movable:
        legal = ', '.join(n for n in suitable if n not in followers) or 'none'
        return f'unknown joint {name!r}; revolute and prismatic joints of robot.urdf: {legal}'
    joint = model.joints[model.getJointId(name)]
    kind = OTHER_JOINTS.get(joint.nv, joint.shortname())
    legal = 'revolute or prismatic joints with one degree of freedom and limits'
    return f'joint {name!r} is {kind}; legal: {legal} (a continuous joint has no limits)'


def _read_couplings(
    content: MuscleFile, mimics: dict[str, Coupling], model: pin.Model, urdf: Path, fail: Fail
) -> dict[str, Coupling]:
    """Return the coupling of each coupled joint, by its name.

    Couplings come from muscles.yaml and from <mimic> elements of robot.urdf. If a master follows
    another joint itself, its coupling is replaced by one to that joint.

    Args:
        content: The content of muscles.yaml.
        mimics: The couplings of robot.urdf.
        model: The pinocchio model of robot.urdf.
        urdf: Path of robot.urdf, for messages.
        fail: Function that returns the error for a problem in muscles.yaml.
    """
    listed = {
        c.joint: Coupling.of_terms(c.master, c.polynomial or (c.offset, c.ratio))
        for c in content.couplings
    }
    links = mimics | listed
    for slave, coupling in links.items():
        if slave in content.joints:
            source = 'couplings' if slave in listed else 'its <mimic> in robot.urdf'
            raise fail(
                f'$.joints: joint {slave!r} follows {coupling.master!r} by {source}; '
                '`joints` may list only joints that follow no other joint'
            )

    def refused(slave: str, problem: str) -> RobotDescriptionError:
        if slave in listed:
            return fail(f'$.couplings: {problem}')
        return RobotDescriptionError(f'{urdf}: joint {slave!r}: mimic: {problem}')

    try:
        couplings = resolved(links)
    except ValueError as error:
        raise refused(next(iter(listed or mimics)), str(error)) from error
    for slave, coupling in list(couplings.items()):
        problem = _joint_problem(slave, model) or _joint_problem(coupling.master, model, couplings)
        if not problem:
            continue
        is_elsewhere = coupling.master not in content.joints and model.existJointName(
            coupling.master
        )
        if slave in listed or not is_elsewhere:
            raise refused(slave, problem)
        del couplings[slave]  # The joint, for example of a wheel, is held fixed like its master.
    return couplings


def _read_joint_elasticity(
    content: MuscleFile, couplings: Iterable[str], fail: Fail
) -> JointElasticity:
    """Return the springs, dampers and passive tendons in `content`, in the units of the joints.

    `couplings` are joints that follow another joint, and can therefore have no spring.
    """
    joints = content.joints
    stiffness, rest, damping = (
        np.zeros(shape) for shape in ((len(joints),) * 2, *[len(joints)] * 2)
    )

    def index(place: str, name: str) -> int:
        if name in joints:
            return joints.index(name)
        followed = ' (it follows another joint: state the spring there)' * (name in couplings)
        legal = ', '.join(joints)
        raise fail(f'{place}: unknown joint {name!r}{followed}; legal: {legal}')

    for k, entry in enumerate(content.joint_elasticity):
        place = f'$.joint_elasticity[{k}]'
        i = index(f'{place}.joint', entry.joint)
        stiffness[i, i], rest[i], damping[i] = entry.stiffness, entry.rest_angle, entry.damping
        for other, value in entry.coupled.items():
            j = index(f'{place}.coupled', other)
            if i == j:
                problem = f'{other!r} is the joint itself; state its own stiffness as `stiffness`'
                raise fail(f'{place}.coupled: {problem}')
            if stiffness[i, j]:
                problem = f'{entry.joint!r} and {other!r} are coupled twice; remove one entry'
                raise fail(f'{place}.coupled: {problem}')
            stiffness[i, j] = stiffness[j, i] = value
    for i, j in np.argwhere(np.triu(stiffness, 1)).tolist():
        most = math.sqrt(stiffness[i, i] * stiffness[j, j])
        if abs(stiffness[i, j]) > most * (1.0 - LEAST_EIGENVALUE):
            pair = f'{joints[i]!r} and {joints[j]!r}'
            # The limit has enough digits to be accepted as it is printed.
            legal = f'at most {most:.10g}, the geometric mean of their own stiffnesses'
            raise fail(
                f'$.joint_elasticity: the coupling of {pair} has the size '
                f'{abs(stiffness[i, j]):.10g}; legal: {legal}, '
                'because springs only store energy'
            )
    if joints and (values := np.linalg.eigvalsh(stiffness))[0] < LEAST_EIGENVALUE * values[-1]:
        raise fail(
            f'$.joint_elasticity: the stiffness matrix has the eigenvalue {values[0]:.3g}; legal: '
            'none below 0, because springs only store energy; reduce the values in `coupled`'
        )
    tendons = _read_passive_tendons(content, index, fail)
    return JointElasticity(stiffness, stiffness @ rest, damping, tendons)


def _read_passive_tendons(
    content: MuscleFile, index: Callable[[str, str], int], fail: Fail
) -> PassiveTendons:
    """Return the passive tendons, in the units of the joints.

    Args:
        content: The content of muscles.yaml.
        index: Returns the index of a joint, from its place in the file and its name.
        fail: Returns the error for a problem.
    """
    joints, entries = len(content.joints), content.passive_tendons
    if not entries:
        return PassiveTendons.none(joints)
    centre, stated = np.zeros(joints), np.zeros(joints, dtype=bool)
    coefficient, power, first = list[float](), list[list[int]](), [0]
    for k, entry in enumerate(entries):
        own = [index(f'$.passive_tendons[{k}].joints', name) for name in entry.joints]
        for j, name, value in zip(own, entry.joints, entry.centre, strict=True):
            if stated[j] and centre[j] != value:
                problem = f'{value} for {name!r}, but another passive tendon states {centre[j]}'
                raise fail(f'$.passive_tendons[{k}].centre: {problem}; state the same value')
            centre[j], stated[j] = value, True
        for factor, *powers in entry.length:
            row = [0] * joints
            for j, value in zip(own, powers, strict=True):
                row[j] = int(value)
            coefficient.append(factor)
            power.append(row)
        first.append(len(coefficient))
    law = np.array([(entry.stiffness, *entry.slack) for entry in entries])
    terms = np.array(power, np.int64), np.array(coefficient), np.array(first, np.int64)
    names = tuple(entry.name for entry in entries)
    return PassiveTendons(names, Passive(centre, *terms, law))


def _read_tension(
    place: str, entry: TensionEntry, default: dict[str, float], fail: Fail
) -> dict[str, float]:
    tension = default | _entries(entry)
    bias, limit, most = (tension[key] for key in ('bias', 'limit', 'max'))
    if not bias < limit <= most:
        values = ', '.join(f'{value:.17g}' for value in (bias, limit, most))
        raise fail(f'{place}: expected bias < limit <= max, got {values}')
    return tension


def _read_route(
    place: str, muscle: MuscleEntry, links: list[str], fail: Fail, warnings: list[str]
) -> Route:
    """Return the route of a muscle, without points that repeat the point before them.

    A warning about each of these points is appended to `warnings`.
    """
    route: list[RoutePoint | Wrap] = []
    for i, entry in enumerate(muscle.route):
        _check_link(f'{place}[{i}].link', entry.link, links, fail)
        if entry.wrap is not None:
            if entry.side_link is not None:
                _check_link(f'{place}[{i}].side_link', entry.side_link, links, fail)
            route.append(_read_wrap(entry))
            continue
        point = RoutePoint(entry.link, np.array(entry.xyz), entry.divisor)
        last = route[-1] if route and isinstance(route[-1], RoutePoint) else None
        is_same = last and last.link == point.link and np.array_equal(last.xyz, point.xyz)
        if is_same and not point.divisor:
            warnings.append(
                f'muscle {muscle.name!r}: route[{i}] is the same point as the one before it and '
                'was left out'
            )
            continue
        route.append(point)
    parts = branches(tuple(route))
    if short := [part for part in parts if len(part) < 2]:
        each = ' in each branch' if len(parts) > 1 else ''
        raise fail(f'{place}: expected at least 2 different points{each}, got {len(short[0])}')
    return tuple(route)


def _read_wrap(entry: RouteEntry) -> Wrap:
    axis = None if entry.axis is None else np.array(entry.axis)
    side = None if entry.side is None else np.array(entry.side)
    if axis is not None:
        axis = axis / float(np.linalg.norm(axis))
    assert entry.radius is not None  # checked by `RouteEntry`
    own = None if entry.side_link == entry.link else entry.side_link
    return Wrap(
        entry.link, np.array(entry.xyz), entry.radius, axis, side, own, entry.wrap == 'pulley'
    )


def _check_link(place: str, name: str, links: Iterable[str], fail: Fail) -> None:
    if name not in links:
        raise fail(f'{place}: unknown link {name!r}; links of robot.urdf: {", ".join(links)}')


def _read_end_effectors(
    content: MuscleFile,
    model: pin.Model,
    couplings: Iterable[str],
    order: list[str],
    fail: Fail,
) -> tuple[str, ...]:
    """Return the links that muscles.yaml names as end effectors.

    If it names none, return the link that the largest number of joints move. `couplings` are the
    coupled joints, and `order` are the links in the order of robot.urdf.
    """
    links = _joints_above(model, {*content.joints})
    moved = _joints_above(model, {*content.joints, *couplings})
    places = {f'$.end_effectors[{i}]': n for i, n in enumerate(content.end_effectors or ())}
    if content.end_effector is not None:
        places = {'$.end_effector': content.end_effector}
    for place, name in places.items():
        _check_link(place, name, links, fail)
        if not moved[name]:
            legal = ', '.join(link for link in links if moved[link])
            raise fail(f'{place}: expected a link that the joints move ({legal}), got {name!r}')
    if places:
        return tuple(places.values())
    # Choose the link that the largest number of joints move. If several links are equal in this,
    # choose the one behind the largest number of fixed joints, and then the last one in the file.
    tips, last = _fixed_above(model), {link: i for i, link in enumerate(order)}
    return (max(links, key=lambda link: (links[link], tips[link], last[link])),)


def _fixed_above(model: pin.Model) -> dict[str, int]:
    """Return the number of fixed joints between each link and the joint that moves it."""
    counts = dict[str, int]()
    for link in body_frames(model):
        counts[str(link.name)], above = 0, link.parentFrame
        while above > 0 and model.frames[above].type != pin.FrameType.JOINT:
            counts[str(link.name)] += model.frames[above].type == pin.FrameType.FIXED_JOINT
            above = model.frames[above].parentFrame
    return counts


def _joints_above(model: pin.Model, names: set[str]) -> dict[str, int]:
    """Return how many of the joints in `names` move each link."""
    return {
        str(link.name): sum(model.names[i] in names for i in model.supports[link.parentJoint])
        for link in body_frames(model)
    }
