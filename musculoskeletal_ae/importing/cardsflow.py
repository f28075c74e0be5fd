# SPDX-License-Identifier: Apache-2.0
"""Import of CARDSflow robots (`cardsflow.xml` with `model.urdf` or `model.sdf`), and of URDFs.

CARDSflow states via points relative to a link's centre of mass, in the axes of the link; those of
the link 'world' are fixed. SPHERICAL and CYLINDRICAL via points (axis z) become wraps, and a MESH
via point becomes a fixed point. `joint_limits.yaml` in the same directory may list angles of each
joint; the smallest and the largest of them become the limits of the joint. A URDF alone gives a
skeleton of muscles.yaml, with a placeholder muscle for each joint. The user replaces these muscles.
"""

import os
from itertools import combinations_with_replacement
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.files import file_error, read_text, read_yaml
from musculoskeletal_ae.importing.source import (
    KINDS,
    Source,
    distinct,
    link_inertia,
    numbers,
    safe_name,
    unique,
)
from musculoskeletal_ae.robot.description import RoutePoint, Wrap
from musculoskeletal_ae.robot.kinematics import Kinematics, body_frames
from musculoskeletal_ae.robot.routes import Routes
from musculoskeletal_ae.robot.urdf import MOST_PARTS, ONE_AXIS, parse_xml, read_mimics, read_urdf

Limits = dict[str, tuple[float, float]]  # lower and upper limit of each joint [rad] or [m]

ROUND = 'SPHERICAL', 'CYLINDRICAL'  # count via points of these kinds as wraps
#: reject SDF 1.6 files with these attributes: SDF 1.6 lacks them, and they change poses and axes
FRAMES = 'relative_to', 'expressed_in', 'rotation_format'


def read_cardsflow(file: Path, root: ET.Element) -> Source:
    """Read the robot of a cardsflow.xml and of the model.urdf or model.sdf beside it."""
    limits_file = file.parent / 'joint_limits.yaml'
    limits = _read_limits(limits_file)
    for model, read in (('model.urdf', _read_urdf), ('model.sdf', _read_sdf)):
        if os.path.lexists(beside := file.parent / model):
            tree = parse_xml(beside, read_text(beside))
            source, centres = read(beside, tree, (limits, limits_file.name))
            break
    else:
        problem = 'the directory of this file contains neither model.urdf nor model.sdf'
        raise file_error(file, problem)
    if limits:
        known = [name for name in limits if source.model.existJointName(name)]
        source.note(
            'chosen', f'limits of joints from {limits_file.name}: {", ".join(known) or "none"}'
        )
        if unknown := [name for name in limits if name not in known]:
            source.note(
                'dropped', f'limits of unknown joints in {limits_file.name}: {", ".join(unknown)}'
            )
    centres.setdefault('world', np.zeros(3))
    for muscle in root.iter('myoMuscle'):
        fallback = f'muscle_{len(source.routes)}'
        kinds = [via.get('type') for via in muscle.findall('link/viaPoint')]
        if sum(kind not in ROUND for kind in kinds) < 2:
            problem = f'muscle {muscle.get("name") or fallback}: it has fewer than 2 points'
            source.note('dropped', problem)
            continue
        name = source.rename('muscle', muscle.get('name'), fallback, source.routes)
        route: list[RoutePoint | Wrap] = []
        for part in muscle.findall('link'):
            if (link := part.get('name', '')) not in centres:
                raise file_error(
                    file, f'muscle {name}: unknown link {link!r}; links: {", ".join(centres)}'
                )
            body = link if link in source.links else source.links[0]
            for via in part.findall('viaPoint'):
                where, kind = f'muscle {name}: viaPoint', via.get('type', 'FIXPOINT')
                at = centres[link] + numbers(via.text, 3, where)
                if link not in source.links:
                    at = source.place(body)[1].actInv(at)
                if kind in ROUND:
                    if not route or isinstance(route[-1], Wrap):
                        source.note(
                            'dropped',
                            f'{kind} via point in the route of {name}, because no fixed point '
                            'directly precedes it',
                        )
                        continue
                    radius = float(numbers(via.get('radius'), 1, f'{where} radius')[0])
                    axis = np.eye(3)[2] if kind == 'CYLINDRICAL' else None
                    route.append(Wrap(body, at, radius, axis, None))
                    source.note('chosen', f'muscle {name} wraps the short way around the object')
                    continue
                if kind != 'FIXPOINT':
                    source.note(
                        'approximated',
                        f'muscle {name}: a {kind} via point was imported as a fixed point',
                    )
                route.append(RoutePoint(body, at))
        if route and isinstance(route[-1], Wrap):
            route.pop()
            source.note(
                'dropped',
                f'last wrap of the route of {name}, because no fixed point follows it',
            )
        source.routes[name] = tuple(route)
    if model == 'model.urdf':
        _measure(source)
    return source


def _read_limits(file: Path) -> dict[str, tuple[float, float]]:
    """Read the limits of joints in a joint_limits.yaml; {} if there is no such file."""
    if not os.path.lexists(file):
        return {}
    document, limits = read_yaml(file), dict[str, tuple[float, float]]()
    expected = 'expected a list of at least 2 different finite numbers [rad] for each joint'
    if not isinstance(document, dict):
        raise file_error(file, f'{expected}, got {str(document)[:60]!r}')
    for name, values in document.items():
        try:
            span = np.array(values, dtype=float).ravel()
        except (TypeError, ValueError):
            span = np.zeros(0)
        if not span.size or not (np.abs(span) <= 1e6).all() or span.min() == span.max():
            raise file_error(file, f'joint {str(name)[:60]}: {expected}, got {str(values)[:60]}')
        limits[str(name)] = float(span.min()), float(span.max())
    return limits


def _measure(source: Source) -> None:
    """Let `source.lengths` measure the lengths of all straight routes.

    Only straight routes can be compared: CARDSflow, too, connects their points by straight lines.
    """
    straight = {n: r for n, r in source.routes.items() if not any(isinstance(p, Wrap) for p in r)}
    joints = [n for n, j in zip(source.model.names, source.model.joints) if j.shortname() in KINDS]
    if not straight or not joints:
        return
    kinematics = Kinematics(source.model, joints, source.links[0])
    routes = Routes(kinematics, list(straight.values()))

    def lengths(values: dict[str, Array]) -> dict[str, Array]:
        still = np.zeros(len(next(iter(values.values()))))
        q = np.stack([values.get(name, still) for name in joints], axis=-1)
        return dict(zip(straight, routes.absolute_lengths(kinematics.units.to_theta(q)).T))

    source.lengths = lengths


def read_urdf_skeleton(file: Path, root: ET.Element) -> Source:
    """Read the robot of a URDF, with a placeholder muscle over each joint."""
    source, _ = _read_urdf(file, root)
    carried = {source.place(link)[0]: link for link in reversed(source.links)}
    names = distinct(safe_name(f'muscle_of_{joint}', '') for joint in source.model.names[1:])
    for i, name in enumerate(names, 1):
        ends = carried[source.model.parents[i]], carried[i]
        source.routes[name] = tuple(RoutePoint(n, np.zeros(3)) for n in ends)
        source.note(
            'chosen',
            f'muscle {name} connects the origins of two links: replace its route by the real one',
        )
    return source


def _endless(*ends: str | None) -> bool:
    """Return whether one of the limits is a placeholder for no limit, such as 1e16."""
    try:
        return any(abs(float(end or 0.0)) > 1e6 for end in ends)
    except ValueError:
        return False


def _read_urdf(
    file: Path, root: ET.Element, limits_and_file: tuple[Limits, str] = ({}, '')
) -> tuple[Source, dict[str, Array]]:
    """Read the links and joints of a URDF by pinocchio, and each link's centre of mass.

    `limits_and_file` are limits that replace those of the URDF, and the name of their file.
    """
    for joint in root.findall('joint'):
        limits, kind = joint.findall('limit'), joint.get('type')
        ends = [limit.get(end) for limit in limits for end in ('lower', 'upper')]
        if kind != 'continuous' and not (kind in ONE_AXIS and _endless(*ends)):
            continue
        if kind == 'continuous':
            joint.set('type', 'revolute')
        for limit in limits:
            joint.remove(limit)
        ET.SubElement(joint, 'limit', lower='0', upper='0', effort='1', velocity='1')
    text = ET.tostring(root, encoding='unicode')
    source = Source(safe_name(root.get('name'), 'robot'), read_urdf(file, text))
    source.given_limits, source.limits_file = limits_and_file
    model = source.model
    source.links = [str(frame.name) for frame in body_frames(model)]
    if shaped := [link for link in root.findall('link') if link.find('visual') is not None]:
        source.note('dropped', f'meshes and other shapes of {len(shaped)} links')
    for joint in root.findall('joint'):
        parent, child = joint.find('parent'), joint.find('child')
        if parent is not None and child is not None:
            source.above[child.get('link', '')] = parent.get('link', '')
    low, high = model.lowerPositionLimit.copy(), model.upperPositionLimit.copy()
    for name, joint in zip(model.names[1:], model.joints[1:]):
        if joint.shortname() in KINDS:
            q = joint.idx_q
            low[q], high[q] = source.limited(name, source.slides(name), low[q], high[q])
    model.lowerPositionLimit, model.upperPositionLimit = low, high
    source.couplings = read_mimics(root)
    names = {joint.get('name') for joint in root.findall('joint')}
    if lost := [c.master for c in source.couplings.values() if c.master not in names]:
        raise file_error(file, f'a joint mimics {lost[0]!r}, but there is no such joint')
    origins = {e.get('name', ''): e.find('inertial/origin') for e in root.findall('link')}
    centres = {n: '0 0 0' if e is None else e.get('xyz', '0 0 0') for n, e in origins.items()}
    return source, {name: numbers(xyz, 3, f'link {name}') for name, xyz in centres.items()}


def _read_sdf(
    file: Path, root: ET.Element, limits_and_file: tuple[Limits, str] = ({}, '')
) -> tuple[Source, dict[str, Array]]:
    """Read the links and joints of an SDF with one model, and each link's centre of mass.

    `limits_and_file` are limits that replace those of the SDF, and the name of their file.
    """
    model = root.find('.//model')
    if root.tag != 'sdf' or model is None:
        raise file_error(file, 'expected an <sdf> element with a <model>')
    if len([*root.iter('model')]) > 1 or model.find('include') is not None:
        problem = 'expected a single <model> without <include>; merge all models into one'
        raise file_error(file, problem)
    version = [int(part) for part in root.get('version', '1.6').split('.')]
    # Before SDF 1.5, axes were given in the frame of the model. Since then, they are given in the
    # frame of the joint.
    frame_of_axis = '1' if version < [1, 5] else '0'
    source, centres = Source(safe_name(model.get('name'), 'robot')), dict[str, Array]()
    source.given_limits, source.limits_file = limits_and_file
    for element in model.iter():
        if element.get('degrees') == 'true' or any(element.get(frame) for frame in FRAMES):
            problem = f'{element.tag} with {element.attrib}: only SDF 1.6 is supported'
            raise file_error(
                file, f'{problem}, with angles in radians, and without {", ".join(FRAMES)}'
            )

    def value(element: ET.Element | None, tag: str, count: int = 1, default: str = '0') -> Array:
        if element is None:
            return numbers(default, count, tag)
        return numbers(element.findtext(tag, default), count, f'{tag} of {element.get("name")}')

    def pose(element: ET.Element | None) -> pin.SE3:
        values = value(element, 'pose', 6, '0 0 0 0 0 0')
        return pin.SE3(pin.rpy.rpyToMatrix(*values[3:]), values[:3])

    links = unique('link', ((e.get('name', ''), e) for e in model.findall('link')))

    def placed(link: str) -> pin.SE3:
        return pose(model) * pose(links[link])

    hung = ((e.findtext('child', '').strip(), e) for e in model.findall('joint'))
    carried_by = unique('child of a joint', hung, 'one joint for each link')
    above = {name: e.findtext('parent', '').strip() for name, e in carried_by.items()}
    order = [name for name in links if above.get(name, 'world') == 'world'][:MOST_PARTS]
    if len(order) == 1:
        for name in order:
            order += [child for child, parent in above.items() if parent == name]
    if set(order) != set(links) or not above.keys() <= links.keys():
        lost = sorted({*above, *above.values(), *links} - {'world'} - set(order)) or order
        problem = f'expected a tree of links with one root; outside it: {", ".join(lost)}'
        raise file_error(file, problem)
    source.above = above
    #: for each link, the index of the joint that carries it, and the joint's pose in the model
    stands: dict[str, tuple[int, pin.SE3]] = {}
    for name in order:
        carrier, at = stands.get(above.get(name, ''), (0, pin.SE3.Identity()))
        if not stands and name in carried_by:
            if (kind := carried_by[name].get('type', '')) != 'fixed':
                label = carried_by[name].get('name', '')
                source.note('held fixed', f'joint {label} ({kind}), which carries the root link')
        elif stands:
            joint = carried_by[name]
            label, kind = joint.get('name', ''), joint.get('type', '')
            here, axis = placed(name) * pose(joint), value(joint, 'axis/xyz', 3, '0 0 1')
            in_model_frame = joint.findtext('axis/use_parent_model_frame', frame_of_axis)
            if in_model_frame.strip() in ('1', 'true'):
                axis = here.rotation.T @ pose(model).rotation @ axis
            if kind in ONE_AXIS:
                limit = joint.find('axis/limit') if kind != 'continuous' else None
                ends = 'lower', 'upper'
                if limit is not None and _endless(*(limit.findtext(e, '1e16') for e in ends)):
                    limit = None
                limits = float(value(limit, 'lower')[0]), float(value(limit, 'upper')[0])
                here_in, slides = at.inverse() * here, kind == 'prismatic'
                carrier = source.add_joint(label, carrier, here_in, slides, axis, limits)
                at = here
            elif kind != 'fixed':
                source.note('held fixed', f'joint {label}: its type {kind} is not supported')
        stands[name] = carrier, at
        own = links[name].find('inertial')
        parts = None if own is None else own.find('inertia')
        pairs = combinations_with_replacement('xyz', 2)
        xx, xy, xz, yy, yz, zz = (value(parts, f'i{a}{b}')[0] for a, b in pairs)
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        weight = link_inertia(name, float(value(own, 'mass')[0]), np.zeros(3), tensor)
        centres[name] = pose(own).translation
        source.add_link(name, carrier, at.inverse() * placed(name), pose(own).act(weight))
    return source, centres
