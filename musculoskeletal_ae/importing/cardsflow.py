# SPDX-License-Identifier: Apache-2.0
"""CARDSflow robots: `cardsflow.xml` beside `model.urdf` or `model.sdf`; a URDF alone.

CARDSflow measures via points from a link's centre of mass, in the axes of the link; those of the
link 'world' stand still. SPHERICAL and CYLINDRICAL via points (axis z) are wraps, a MESH is taken
as the point it names. A URDF alone gives a skeleton of muscles.yaml, one muscle to be replaced.
"""

from __future__ import annotations

import os
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.files import read_text
from musculoskeletal_ae.importing.source import (
    FIXED,
    PRISMATIC,
    REVOLUTE,
    Link,
    Source,
    inertia,
    refuse,
    rotation,
    safe_name,
    straight,
)
from musculoskeletal_ae.robot.description import RoutePoint, Wrap
from musculoskeletal_ae.robot.urdf import parse_xml, read_mimics, read_urdf

KINDS = {'revolute': REVOLUTE, 'continuous': REVOLUTE, 'prismatic': PRISMATIC, 'fixed': FIXED}


def read_cardsflow(file: Path) -> Source:
    """Read a cardsflow.xml and the model beside it.

    Raises:
        SourceError: Naming the file and what is wrong.
        RobotDescriptionError: If it is not valid XML.
    """
    root = parse_xml(file, read_text(file, refuse))
    if root.tag != 'cardsflow':
        raise refuse(file, f'expected the element cardsflow, got {root.tag!r}')
    for model, read in (('model.urdf', read_urdf_model), ('model.sdf', read_sdf_model)):
        if os.path.lexists(file.parent / model):
            source = read(file.parent / model)
            break
    else:
        raise refuse(file, 'there is no model.urdf and no model.sdf beside it')
    links = {link.name: link for link in source.links}
    for muscle in root.iter('myoMuscle'):
        name = safe_name(muscle.get('name', ''), f'muscle_{len(source.routes)}')
        route: list[RoutePoint | Wrap] = []
        for part in muscle.findall('link'):
            link = part.get('name', '')
            if link == 'world' and link not in links:
                link = source.links[0].name
            if link not in links:
                raise refuse(file, f'muscle {name}: no link {link!r}; links: {", ".join(links)}')
            centre = np.zeros(3) if part.get('name') == 'world' else links[link].inertia.lever
            for via in part.findall('viaPoint'):
                where = f'muscle {name}: viaPoint'
                at = centre + _numbers(file, where, via.text or '', 3)
                kind = via.get('type', 'FIXPOINT')
                if kind in ('SPHERICAL', 'CYLINDRICAL'):
                    radius = _numbers(file, f'{where} radius', via.get('radius', ''), 1)[0]
                    axis = np.array([0.0, 0.0, 1.0]) if kind == 'CYLINDRICAL' else None
                    route.append(Wrap(link, at, float(radius), axis, None))
                    source.note('chosen', f'muscle {name}: it wraps the shorter way round')
                    continue
                if kind != 'FIXPOINT':
                    source.note('approximated', f'muscle {name}: a {kind} via point is a point')
                route.append(RoutePoint(link, at))
        if sum(isinstance(item, RoutePoint) for item in route) < 2:
            source.note('dropped', f'muscle {name}: fewer than 2 points')
            continue
        source.routes[name] = tuple(route)
    if not source.routes:
        raise refuse(file, 'it has no myoMuscle with a route')
    if model == 'model.urdf':
        source.lengths = _Own(file.parent / model, source)
    return source


class _Own:
    """Lengths as CARDSflow computes them, over pinocchio's model of its URDF; straight routes."""

    def __init__(self, file: Path, source: Source) -> None:
        self._model = read_urdf(file, read_text(file, refuse))
        self._routes = {
            name: route
            for name, route in source.routes.items()
            if all(isinstance(item, RoutePoint) for item in route)
        }

    def __call__(self, values: dict[str, Array]) -> dict[str, Array]:
        model, data = self._model, self._model.createData()
        count = len(next(iter(values.values())))
        points = {name: np.empty((count, len(route), 3)) for name, route in self._routes.items()}
        for n in range(count):
            q = pin.neutral(model)
            for i, joint in enumerate(model.joints[1:], 1):
                angle = values[model.names[i]][n]
                q[joint.idx_q : joint.idx_q + joint.nq] = (
                    angle if joint.nq == 1 else (np.cos(angle), np.sin(angle))
                )
            pin.framesForwardKinematics(model, data, q)
            for name, route in self._routes.items():
                frames = [model.getFrameId(item.link, pin.FrameType.BODY) for item in route]
                at = [data.oMf[f].act(item.xyz) for f, item in zip(frames, route)]
                points[name][n] = at
        return {name: straight(at) for name, at in points.items()}


def read_urdf_skeleton(file: Path) -> Source:
    """Read a URDF and invent a muscle, to be replaced, between the first two links that move."""
    source = read_urdf_model(file)
    for link in source.links:
        if link.kind != FIXED:
            ends = RoutePoint(link.parent, np.zeros(3)), RoutePoint(link.name, np.zeros(3))
            source.routes[f'muscle_of_{link.joint}'] = ends
            source.note('chosen', f'muscle_of_{link.joint}, origin to origin: replace it')
    return source


def _numbers(file: Path, where: str, text: str, count: int) -> Array:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all() or np.abs(values).max() > 1e6:
        raise refuse(file, f'{where}: expected {count} finite numbers, got {text[:60]!r}')
    return values


def _origin(file: Path, where: str, element: ET.Element | None) -> pin.SE3:
    if element is None:
        return pin.SE3.Identity()
    xyz, rpy = (_numbers(file, where, element.get(key, '0 0 0'), 3) for key in ('xyz', 'rpy'))
    return pin.SE3(rotation(*rpy), xyz)


def _tensor(file: Path, where: str, get: dict[str, str]) -> Array:
    entries = [[get.get('i' + ''.join(sorted(a + b)), '0') for b in 'xyz'] for a in 'xyz']
    return np.array([[_numbers(file, where, text, 1)[0] for text in row] for row in entries])


def _sorted(file: Path, source: Source, links: list[Link]) -> Source:
    """Order links from the root; all others must hang on it."""
    waiting = {link.name: link for link in links}
    roots = [link for link in links if not link.parent]
    if len(waiting) < len(links) or len(roots) != 1:
        raise refuse(file, f'expected a tree of links with one root, got {len(roots)} roots')
    source.links = [waiting.pop(roots[0].name)]
    for link in source.links:
        children = [child for child in links if child.parent == link.name]
        source.links += [waiting.pop(child.name) for child in children if child.name in waiting]
    if waiting:
        raise refuse(file, f'link {min(waiting)} hangs in a loop or on a link that is not there')
    return source


def read_urdf_model(file: Path) -> Source:
    """Read links and joints of a URDF; shapes and meshes are left out."""
    text = read_text(file, refuse)
    read_urdf(file, text)  # says what is wrong with any number in it
    root, source = parse_xml(file, text), Source(safe_name(file.stem, 'robot'))
    source.name = safe_name(root.get('name', ''), 'robot')
    links = {}
    for element in root.findall('link'):
        link = Link(element.get('name', ''), '')
        if (own := element.find('inertial')) is not None:
            where, mass, tensor = f'link {link.name}', own.find('mass'), own.find('inertia')
            at = _origin(file, where, own.find('origin'))
            weight = 0.0 if mass is None else float(mass.get('value', 0.0))
            matrix = _tensor(file, where, {} if tensor is None else dict(tensor.attrib))
            link.inertia = inertia(weight, at.translation, matrix, at.rotation)
        links[link.name] = link
    for element in root.findall('joint'):
        name, kind = element.get('name', ''), element.get('type', '')
        child, parent = element.find('child'), element.find('parent')
        assert child is not None and parent is not None  # pinocchio read it
        link = links[child.get('link', '')]
        link.parent, link.joint = parent.get('link', ''), name
        link.placement = _origin(file, f'joint {name}', element.find('origin'))
        if kind not in KINDS:
            source.note('held fixed', f'joint {name}: it is {kind}')
        _joint(file, source, link, KINDS.get(kind, FIXED), element)
    source.couplings = read_mimics(file, text)
    return _sorted(file, source, list(links.values()))


def _joint(file: Path, source: Source, link: Link, kind: str, element: ET.Element) -> None:
    link.kind = kind
    if kind == FIXED:
        return
    axis, limit = element.find('axis'), element.find('limit')
    if axis is not None:
        link.axis = _unit(file, f'joint {link.joint}: axis', axis.get('xyz', '1 0 0'))
    low, high = -np.inf, np.inf
    if limit is not None and element.get('type') != 'continuous':
        low, high = (float(limit.get(key, 0.0)) for key in ('lower', 'upper'))
    link.limits = source.limited(link.joint, kind, low, high)


def _unit(file: Path, where: str, text: str) -> Array:
    vector = _numbers(file, where, text, 3)
    if (size := float(np.linalg.norm(vector))) < 1e-9:
        raise refuse(file, f'{where}: expected a direction, got {text!r}')
    return vector / size


def read_sdf_model(file: Path) -> Source:
    """Read links and joints of the first model in an SDF; link frames move to their joints."""
    root = parse_xml(file, read_text(file, refuse))
    model = root.find('.//model')
    if root.tag != 'sdf' or model is None:
        raise refuse(file, 'expected an sdf with a model')
    source = Source(safe_name(model.get('name', ''), 'robot'))

    def pose(element: ET.Element) -> pin.SE3:
        text = element.findtext('pose', '0 0 0 0 0 0')
        values = _numbers(file, f'pose of {element.get("name")}', text, 6)
        return pin.SE3(rotation(*values[3:]), values[:3])

    links, frames, bodies = {}, {}, {}
    for element in model.findall('link'):
        name = element.get('name', '')
        links[name], frames[name] = Link(name, ''), pose(element)
        if (own := element.find('inertial')) is not None:
            parts, at = own.find('inertia'), pose(own)
            get = {} if parts is None else {part.tag: part.text or '0' for part in parts}
            mass = _numbers(file, f'mass of {name}', own.findtext('mass', '0'), 1)[0]
            bodies[name] = inertia(mass, at.translation, _tensor(file, name, get), at.rotation)
    #: where the link frame of the result stands in the model: at its joint
    stands = dict(frames)
    parents = {}
    for element in model.findall('joint'):
        name, kind = element.get('name', ''), element.get('type', '')
        child, parent = (element.findtext(key, '').strip() for key in ('child', 'parent'))
        if child not in links or parent not in {*links, 'world'}:
            raise refuse(file, f'joint {name}: no link {child!r} or {parent!r}')
        if parent == 'world':
            continue
        links[child].joint, links[child].parent, parents[child] = name, parent, element
        # A joint's pose is given in its child's frame, without rotation of its own here.
        at = frames[child] * pose(element)
        stands[child] = at
        if kind not in KINDS:
            source.note('held fixed', f'joint {name}: it is {kind}')
        limit = element.find('axis/limit')
        bounds = [float(_numbers(file, name, limit.findtext(key, '0'), 1)[0]) for key in ('lower', 'upper')] if limit is not None else [0.0, 0.0]  # noqa: E501  # fmt: skip
        flat = ET.Element('joint', {'type': kind})
        ET.SubElement(flat, 'limit', lower=str(bounds[0]), upper=str(bounds[1]))
        ET.SubElement(flat, 'axis', xyz=element.findtext('axis/xyz', '1 0 0'))
        _joint(file, source, links[child], KINDS.get(kind, FIXED), flat)
        if element.findtext('axis/use_parent_model_frame', '0').strip() in ('1', 'true'):
            links[child].axis = at.rotation.T @ links[child].axis
    for name, link in links.items():
        if link.parent:
            link.placement = stands[link.parent].inverse() * stands[name]
        if name in bodies:
            link.inertia = (stands[name].inverse() * frames[name]).act(bodies[name])
    if len([link for link in links.values() if not link.parent]) > 1:
        raise refuse(file, 'expected one link that hangs on no other')
    return _sorted(file, source, list(links.values()))
