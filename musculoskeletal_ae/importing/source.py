# SPDX-License-Identifier: Apache-2.0
"""A body read from another format: cut, written as a robot directory, compared with its source."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin
import yaml

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.description import Route, RoutePoint, Wrap
from musculoskeletal_ae.robot.kinematics import Coupling
from musculoskeletal_ae.robot.robot import Robot

POSTURES = 1000  # in which lengths are compared
GOAL = 0.001  # [m] of error that a route should have which the format can express
REVOLUTE, PRISMATIC, FIXED = 'revolute', 'prismatic', 'fixed'
STRENGTH = 'tension.limit is what the source says a muscle can pull, bias a tenth, max 1.5 times'
UNLIMITED = {REVOLUTE: np.pi, PRISMATIC: 0.5}  # ± [rad], [m], where the source has no limits

#: absolute lengths [m] (N,) of muscles, for joint values (N,) by name
Lengths = Callable[[dict[str, Array]], dict[str, Array]]


class SourceError(MusculoskeletalError):
    """A file that cannot be imported, and why."""


def refuse(file: Path, problem: str) -> SourceError:
    """Return the error that says what is wrong with a file."""
    return SourceError(f'{file}: {problem}')


@dataclass
class Link:
    """A link and the joint that carries it; link frame = joint frame."""

    name: str
    parent: str  # '' for the root
    placement: pin.SE3 = field(default_factory=pin.SE3.Identity)  # in the parent, at joint value 0
    joint: str = ''
    kind: str = FIXED
    axis: Array = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    limits: tuple[float, float] = (0.0, 0.0)
    rest: float = 0.0  # the joint's value where it is held fixed
    inertia: pin.Inertia = field(default_factory=pin.Inertia.Zero)  # in the link's frame

    @property
    def motion_at_rest(self) -> pin.SE3:
        """Placement in the parent with the joint held."""
        if self.kind == REVOLUTE:
            return self.placement * pin.SE3(pin.exp3(self.axis * self.rest), np.zeros(3))
        shift = self.axis * self.rest if self.kind == PRISMATIC else np.zeros(3)
        return self.placement * pin.SE3(np.eye(3), shift)


@dataclass
class Source:
    """Everything that was read, root link first, parents before children."""

    name: str
    links: list[Link] = field(default_factory=list)
    couplings: dict[str, Coupling] = field(default_factory=dict)
    routes: dict[str, Route] = field(default_factory=dict)
    strength: dict[str, float] = field(default_factory=dict)  # highest tension [N], where known
    notes: list[str] = field(default_factory=list)  # chosen, dropped, approximated
    lengths: Lengths | None = None
    gravity: Array = field(
        default_factory=lambda: np.array([0.0, 0.0, -1.0])
    )  # in the root's frame

    def note(self, kind: str, told: str) -> None:
        """Remember what was 'chosen', 'dropped' or 'approximated'."""
        self.notes.append(f'{kind}: {told}')

    def limited(self, joint: str, kind: str, low: float, high: float) -> tuple[float, float]:
        """Return limits of a joint, chosen ones where there are none."""
        if np.isfinite([low, high]).all() and low < high and high - low < 100.0:
            return float(low), float(high)
        end = UNLIMITED[kind]
        self.note('chosen', f'joint {joint}: limits ±{end:.4g}, the source has none')
        return -end, end

    def joint(self, name: str) -> Link:
        """Return the link that a joint carries."""
        return next(link for link in self.links if link.joint == name)


def rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Return the rotation of URDF's and SDF's rpy [rad]."""
    turn: Array = pin.rpy.rpyToMatrix(roll, pitch, yaw)
    return turn


def inertia(mass: float, centre: Array, tensor: Array, turn: Array | None = None) -> pin.Inertia:
    """Return an inertia in the link's frame; the tensor [kg·m²] is about the centre of mass."""
    turn = np.eye(3) if turn is None else turn
    return pin.Inertia(float(mass), np.asarray(centre, float), turn @ tensor @ turn.T)


def linear_fit(value: Callable[[Array], Array], low: float, high: float) -> tuple[float, float, float]:  # noqa: E501  # fmt: skip
    """Return slope, intercept and largest error of the best line through a function on [low, high].

    The line minimises squares; a function that is a line is met to rounding.
    """
    x = np.linspace(low, high, 201)
    y = value(x)
    slope, intercept = np.polyfit(x, y, 1)
    slope, intercept = (round(float(v), 12) for v in (slope, intercept))
    return slope, intercept, float(np.abs(slope * x + intercept - y).max())


# -- cutting ---------------------------------------------------------------------------------------


def cut(
    source: Source,
    joints: Sequence[str] = (),
    muscles: Sequence[str] = (),
    base: str = '',
    end: str = '',
) -> str:
    """Cut the source to a chain in place; return the end effector.

    Joints that are not asked for are held fixed and said so; a link outside the base's tree goes,
    and with it the muscles that are fastened to it; a muscle that moves no joint goes too.
    """
    names = [link.name for link in source.links]
    for option, name in (('--base', base), ('--end', end)):
        if name and name not in names:
            raise SourceError(f'{option} {name}: no such link; links: {", ".join(names)}')
    upright = _rest_rotation(source, base)
    if base:
        kept = {base}
        for link in source.links:
            if link.parent in kept:
                kept.add(link.name)
        if end and end not in kept:
            raise SourceError(f'--end {end}: it does not hang on --base {base}')
        source.links = [link for link in source.links if link.name in kept]
        source.links[0] = Link(base, '', inertia=source.links[0].inertia)
    if not np.allclose(upright, np.eye(3), atol=1e-9):
        # A root link's z axis points upwards.
        root = source.links[0]
        root.parent, root.placement = f'{root.name}_upright', pin.SE3(upright, np.zeros(3))
        source.links.insert(0, Link(root.parent, ''))
        source.note('chosen', f'link {root.parent}: the root, upright; {root.name} as it rests')
    there = {link.name: link for link in source.links}
    movable = [link.joint for link in source.links if link.kind != FIXED]
    free = [name for name in movable if name not in source.couplings]
    wanted = set(joints or free)
    if missing := sorted(wanted - set(free)):
        told = 'coupled' if missing[0] in source.couplings else 'no such joint'
        raise SourceError(f'--joints {missing[0]}: {told}; joints: {", ".join(free)}')
    if end:
        above, at = set(), there[end]
        while at.parent:
            above.add(at.joint)
            # A joint whose coupled one is in the chain moves the chain as well.
            if at.joint in source.couplings:
                above.add(source.couplings[at.joint].master)
            at = there[at.parent]
        wanted &= above
    source.couplings = {s: c for s, c in source.couplings.items() if s in movable}
    following = {slave for slave, c in source.couplings.items() if c.master in wanted}
    for slave, c in source.couplings.items():
        if slave not in following:
            master = next((x.rest for x in source.links if x.joint == c.master), 0.0)
            source.joint(slave).rest = c.ratio * master + c.offset
    source.couplings = {s: c for s, c in source.couplings.items() if s in following}
    for link in source.links:
        if link.kind != FIXED and link.joint not in wanted | following:
            source.note('held fixed', f'joint {link.joint} at {link.rest:.4g}')
            link.placement, link.kind = link.motion_at_rest, FIXED
    if muscles and (unknown := [m for m in muscles if m not in source.routes]):
        raise SourceError(
            f'--muscles {unknown[0]}: no such muscle; muscles: {", ".join(source.routes)}'
        )
    moved: dict[str, frozenset[str]] = {}
    for link in source.links:
        own = {link.joint} if link.kind != FIXED else set()
        moved[link.name] = moved.get(link.parent, frozenset()) | own
    kept_routes = {}
    for name, route in source.routes.items():
        if muscles and name not in muscles:
            continue
        lost = [item.link for item in route if item.link not in there]
        if lost:
            source.note('dropped', f'muscle {name}: fastened to {lost[0]}, which was cut off')
        elif len({moved[item.link] for item in route if isinstance(item, RoutePoint)}) < 2:
            source.note('dropped', f'muscle {name}: it moves no joint')
        else:
            kept_routes[name] = route
    source.routes = kept_routes
    if not any(link.kind != FIXED for link in source.links):
        raise SourceError('no joint is left that moves')
    tips = [link.name for link in source.links]
    return end or max(reversed(tips), key=lambda name: len(moved[name]))


def _rest_rotation(source: Source, link: str) -> Array:
    """Return how a link (the root for '') is turned at rest in a frame whose z axis is up."""
    there = {each.name: each for each in source.links}
    at, pose = there.get(link, source.links[0]), pin.SE3.Identity()
    while at.parent:
        pose, at = at.motion_at_rest * pose, there[at.parent]
    down = np.array([0.0, 0.0, -1.0])
    if (size := float(np.linalg.norm(source.gravity))) < 1e-6:
        source.note('chosen', 'gravity: along −z, the source has none')
        return np.array(pose.rotation)
    turn = pin.Quaternion.FromTwoVectors(source.gravity / size, down).matrix()
    return np.array(turn @ pose.rotation)


# -- writing ---------------------------------------------------------------------------------------


def _text(values: Any) -> str:
    return ' '.join(f'{v:.12g}' for v in np.ravel(values))


def urdf(source: Source) -> str:
    """Return the links and joints as the text of a URDF."""
    robot = ET.Element('robot', name=source.name)
    for link in source.links:
        element = ET.SubElement(robot, 'link', name=link.name)
        if link.inertia.mass > 0.0:
            inertial = ET.SubElement(element, 'inertial')
            ET.SubElement(inertial, 'origin', xyz=_text(link.inertia.lever))
            ET.SubElement(inertial, 'mass', value=_text(link.inertia.mass))
            entries = {
                f'i{"xyz"[i]}{"xyz"[j]}': _text(link.inertia.inertia[i, j])
                for i in range(3)
                for j in range(i, 3)
            }
            ET.SubElement(inertial, 'inertia', entries)
        if not link.parent:
            continue
        joint = ET.SubElement(robot, 'joint', name=link.joint or f'to_{link.name}', type=link.kind)
        ET.SubElement(joint, 'parent', link=link.parent)
        ET.SubElement(joint, 'child', link=link.name)
        turn = pin.rpy.matrixToRpy(link.placement.rotation)
        ET.SubElement(joint, 'origin', xyz=_text(link.placement.translation), rpy=_text(turn))
        if link.kind != FIXED:
            low, high = (_text(v) for v in link.limits)
            ET.SubElement(joint, 'axis', xyz=_text(link.axis))
            ET.SubElement(joint, 'limit', lower=low, upper=high, effort='1000', velocity='10')
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding='unicode') + '\n'


def _item(item: RoutePoint | Wrap) -> dict[str, Any]:
    at: dict[str, Any] = {'link': item.link, 'xyz': [round(float(v), 9) for v in item.xyz]}
    if isinstance(item, RoutePoint):
        return at
    kind: dict[str, Any] = {'wrap': 'sphere' if item.axis is None else 'cylinder', **at}
    if item.axis is not None:
        kind['axis'] = [round(float(v), 12) for v in item.axis]
    kind['radius'] = round(item.radius, 9)
    if item.side is not None:
        kind['side'] = [round(float(v), 9) for v in item.side]
    return kind


def write(source: Source, out: Path, end_effector: str) -> None:
    """Write robot.urdf and muscles.yaml into a directory, which must be new or empty."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise SourceError(f'{out}: expected a new or empty directory')
    coupled = source.couplings
    muscles: list[dict[str, Any]] = []
    for name, route in source.routes.items():
        muscles.append({'name': name, 'route': [_item(item) for item in route]})
        if (force := source.strength.get(name, 0.0)) > 0.0:
            bias = min(30.0, 0.1 * force)
            tension = {'bias': bias, 'limit': force, 'max': 1.5 * force}
            muscles[-1]['tension'] = {k: round(float(v), 3) for k, v in tension.items()}
    document: dict[str, Any] = {
        'joints': [x.joint for x in source.links if x.kind != FIXED and x.joint not in coupled],
        'muscles': muscles,
        'end_effector': end_effector,
    }
    if coupled:
        document['couplings'] = [
            {'joint': slave, 'master': c.master, 'ratio': c.ratio, 'offset': c.offset}
            for slave, c in coupled.items()
        ]
    out.mkdir(parents=True, exist_ok=True)
    head = ''.join(f'# {line}\n' for line in [f'Imported from {source.name}.', *source.notes])
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100)
    (out / 'muscles.yaml').write_text(head + text, encoding='utf-8')
    (out / 'robot.urdf').write_text(urdf(source), encoding='utf-8')


def compare(source: Source, robot: Robot, seed: int = 0) -> dict[str, float] | None:
    """Return each muscle's largest length error [m] over POSTURES, or None without own lengths."""
    if source.lengths is None:
        return None
    theta = robot.random_postures(POSTURES, np.random.default_rng(seed))
    ours = robot.routes.absolute_lengths(theta)
    values = {link.joint: np.full(POSTURES, link.rest) for link in source.links if link.joint}
    kin = robot.kinematics
    for i, q in enumerate(kin.tree_angles(theta).T, 1):
        values[kin.model.names[i]] = q
    theirs = source.lengths(values)
    return {
        name: float(np.abs(ours[:, m] - theirs[name]).max())
        for m, name in enumerate(robot.muscles)
        if name in theirs
    }


def safe_name(text: str, fallback: str) -> str:
    """Return a name that URDF and YAML take, made of what the source calls it."""
    return re.sub(r'[^\w.+-]+', '_', text).strip('_')[:100] or fallback


def straight(points: Array) -> Array:
    """Return the length [m] (N,) of polylines (N, P, 3)."""
    return sum(np.linalg.norm(b - a, axis=-1) for a, b in pairwise(points.swapaxes(0, 1)))
