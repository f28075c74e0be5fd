# SPDX-License-Identifier: Apache-2.0
"""Read robot.urdf with pinocchio, after a check of its structure and its numbers.

The URDF parser silently ignores elements that it does not know, so the file is checked here first.
The parser only warns about a missing or malformed mass or inertia, and continues with a massless
link. If a file still contains xacro macros, the parser ignores the macros and reads the rest.
"""

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.exceptions import RobotDescriptionError, printable
from musculoskeletal_ae.robot.joint_tree import Coupling

#: refuse a file with more links and joints than this; recursive parsers overflow their stack at
#: thousands of links
MOST_PARTS = 2000
#: refuse elements that are nested more deeply than this; the parser that MuJoCo and pinocchio use
#: has the same limit
DEEPEST = 500
#: elements below <robot> that xacro understands only with its prefix
PREPROCESSED = 'include', 'macro', 'property'
#: namespace of the elements of xacro, a preprocessor of URDFs
XACRO = 'http://www.ros.org/wiki/xacro'
EXPAND = 'expand it to a new file first:  xacro FILE > NEW.urdf'
#: refuse any number beyond ± this, except efforts and velocities [SI units]
LARGEST = 1e6

LIMITED = 'revolute', 'prismatic'  # types of joints that need limits
ONE_AXIS = *LIMITED, 'continuous'  # types of joints with one axis
KINDS = *ONE_AXIS, 'fixed', 'floating', 'planar'  # all types of joints

#: number of values in each attribute, by element
NUMBERS = {
    'origin': {'xyz': 3, 'rpy': 3},
    'axis': {'xyz': 3},
    'mass': {'value': 1},
    'inertia': dict.fromkeys(('ixx', 'ixy', 'ixz', 'iyy', 'iyz', 'izz'), 1),
    'limit': {'lower': 1, 'upper': 1, 'effort': 1, 'velocity': 1},
    'box': {'size': 3},
    'cylinder': {'radius': 1, 'length': 1},
    'sphere': {'radius': 1},
    'mimic': {'multiplier': 1, 'offset': 1},
}


def read_urdf(file: Path, text: str) -> pin.Model:
    """Return the pinocchio model of a URDF.

    Args:
        file: The file, for error messages.
        text: The content of the file.

    Raises:
        RobotDescriptionError: If the URDF is invalid; the message names the file, the link or
            joint, and the legal values.
    """
    root = parse_xml(file, text)
    _check_expanded(file, root)
    parts = [part for part in root if part.tag in ('link', 'joint')]
    if len(parts) > MOST_PARTS:
        raise RobotDescriptionError(
            f'{file}: {len(parts)} links and joints; legal: at most {MOST_PARTS}'
        )
    for part in parts:
        where = f'{file}: {part.tag} {part.get("name")!r}'
        if printable(name := part.get('name', '')) != name:
            raise RobotDescriptionError(f'{where}: expected a name of printable characters only')
        if part.tag == 'joint' and name == 'universe':
            raise RobotDescriptionError(
                f'{where}: pinocchio reserves this name for the world; rename the joint'
            )
        for element in part.iter():
            _check(where, element)
    if parts:
        _check_tree(file, parts)
        if _limit_mimics(parts):
            text = ET.tostring(root, encoding='unicode')
    try:
        return pin.buildModelFromXML(text)
    except (ValueError, RuntimeError) as error:
        raise RobotDescriptionError(f'{file}: not a valid URDF: {error}') from error


def parse_xml(file: Path, text: str) -> ET.Element:
    """Return the root element of an XML text.

    A DOCTYPE is rejected, so that the text cannot define entities.

    Raises:
        RobotDescriptionError: If the text is not valid XML, has a DOCTYPE or is nested too deeply.
    """
    try:
        if '<!DOCTYPE' in text or '<!ENTITY' in text:
            raise ValueError('no DOCTYPE is allowed here; remove it')
        root = ET.fromstring(text)  # noqa: S314 - without a DOCTYPE there are no entities
        level, depth = [root], 0
        while level:
            level, depth = [child for element in level for child in element], depth + 1
        if depth > DEEPEST:
            raise ValueError(f'elements are nested {depth} levels deep; legal: at most {DEEPEST}')
        # Remove a default namespace, because the URDF parser ignores it too.
        if space := root.tag.rpartition('}')[0]:
            for element in root.iter():
                element.tag = element.tag.removeprefix(space + '}')
    except (ET.ParseError, ValueError) as error:
        raise RobotDescriptionError(f'{file}: not valid XML: {error}') from error
    return root


def read_mimics(root: ET.Element) -> dict[str, Coupling]:
    """Return the couplings that a URDF, checked by `read_urdf`, declares with <mimic>."""
    mimics = {}
    for joint in root.findall('joint'):
        mimic = joint.find('mimic')
        if mimic is not None and joint.get('type') != 'fixed':
            ratio, offset = (float(mimic.get(*d)) for d in (('multiplier', '1'), ('offset', '0')))
            mimics[joint.get('name', '')] = Coupling(mimic.get('joint', ''), (offset, ratio))
    return mimics


def _check_expanded(file: Path, root: ET.Element) -> None:
    """Check that a file contains no macros, which the URDF parser would ignore."""
    for problem, remedy in _preprocessor_parts(root):
        raise RobotDescriptionError(f'{file}: this is not a finished URDF ({problem}); {remedy}')


def _preprocessor_parts(root: ET.Element) -> Iterator[tuple[str, str]]:
    """Yield elements and attributes that a preprocessor has to replace, each with its remedy."""
    for element in root.iter():
        namespace, _, name = element.tag.rpartition('}')
        described = f'element {name!r} of {namespace.strip("{")}'
        if 'XInclude' in namespace:
            yield described, 'replace it by the elements of the file that it names'
        if 'xacro' in namespace:
            yield described, EXPAND
    for part in root:
        if part.tag in PREPROCESSED:
            prefix = f'write it as <xacro:{part.tag}>, with xmlns:xacro="{XACRO}" in <robot>'
            yield f'element {part.tag!r} of xacro without a prefix', f'{prefix}, and {EXPAND}'
        if part.tag in ('link', 'joint'):
            for element in part.iter():
                for attribute, value in element.items():
                    if '${' in value or '$(' in value:
                        yield f'{element.tag} {attribute} {value!r:.100}', EXPAND


def _limit_mimics(parts: list[ET.Element]) -> bool:
    """Turn continuous joints with <mimic> into limited revolute joints; return whether any exist.

    Pinocchio represents a continuous joint by two coordinates, which cannot follow the single
    coordinate of the mimicked joint. A revolute joint must have limits. It gets limits so wide that
    they never act, because the limits of the mimicked joint suffice.
    """
    followers = [
        part
        for part in parts
        if part.get('type') == 'continuous' and part.find('mimic') is not None
    ]
    for joint in followers:
        joint.set('type', 'revolute')
        for limit in joint.findall('limit'):
            joint.remove(limit)
        span = {'lower': f'{-LARGEST:g}', 'upper': f'{LARGEST:g}'}
        ET.SubElement(joint, 'limit', span, effort='0', velocity='0')
    return bool(followers)


def _check_tree(file: Path, parts: list[ET.Element]) -> None:
    """Check that links and joints form a tree.

    If they do not, pinocchio's parser would only print a message on stderr, or leave parts out. If
    several joints have the same child, it would use the last one.
    """
    links = {part.get('name', '') for part in parts if part.tag == 'link'}
    for (tag, name), count in Counter((part.tag, part.get('name')) for part in parts).items():
        if not name or count > 1:
            problem = f'comes {count} times' if name else 'has no name'
            raise RobotDescriptionError(f'{file}: {tag} {name!r} {problem}; expected unique names')
    children: dict[str, list[str]] = {link: [] for link in links}
    held = set[str]()
    for part in parts:
        if part.tag == 'joint':
            where = f'{file}: joint {part.get("name")!r}'
            _check_joint(where, part)
            parent, child = (_link_at(where, part, end, links) for end in ('parent', 'child'))
            if child in held:
                expected = 'expected a link that is the child of no other joint'
                raise RobotDescriptionError(f'{where}: child: {expected}, got {child!r}')
            held.add(child)
            children[parent].append(child)
    if len(roots := sorted(links - held)) != 1:
        got = ', '.join(roots) or 'none'
        expected = 'expected exactly one root link, which is the child of no joint'
        raise RobotDescriptionError(f'{file}: {expected}; got {got}')
    reached = [*roots]
    for link in reached:
        reached += children[link]
    if lost := sorted(links - {*reached}):
        expected = f'expected links that descend from the root link {roots[0]!r}'
        problem = f'a loop of joints holds {", ".join(lost)}; correct the parent of one of them'
        raise RobotDescriptionError(f'{file}: {expected}; {problem}')


def _link_at(where: str, joint: ET.Element, end: str, links: set[str]) -> str:
    """Return the link that is the 'parent' or 'child' (`end`) of a joint.

    It has to be one of `links`; the message of the error begins with `where`.
    """
    element = joint.find(end)
    link = '' if element is None else element.get('link', '')
    if link not in links:
        legal = f'a link of this file ({", ".join(sorted(links))})'
        raise RobotDescriptionError(f'{where}: {end}: expected {legal}, got {link!r}')
    return link


def _check_joint(where: str, joint: ET.Element) -> None:
    kind, axis, limit = joint.get('type'), joint.find('axis'), joint.find('limit')
    if kind not in KINDS:
        legal = ', '.join(KINDS)
        raise RobotDescriptionError(f'{where}: type: expected one of {legal}, got {kind!r}')
    if kind in ONE_AXIS and axis is not None and not any(map(float, axis.get('xyz', '1').split())):
        raise RobotDescriptionError(f'{where}: axis: expected a nonzero vector, got 0 0 0')
    present = set() if limit is None else set(limit.keys())
    if kind in LIMITED and {'effort', 'velocity'} - present:
        missing = ', '.join(name for name in NUMBERS['limit'] if name not in present)
        expected = f'effort, velocity, lower and upper, which a {kind} joint needs'
        raise RobotDescriptionError(f'{where}: limit: expected {expected}; missing: {missing}')


def _check(part: str, element: ET.Element) -> None:
    for attribute, count in NUMBERS.get(element.tag, {}).items():
        if (text := element.get(attribute)) is None:
            continue
        try:
            # Refuse 1_000 and digits of other alphabets, which only Python accepts as numbers.
            values = [float(word) for word in text.split() if word.isascii() and '_' not in word]
        except ValueError:
            values = []
        expected = 'a finite number' if count == 1 else f'{count} finite numbers'
        right = len(values) == count and all(map(math.isfinite, values))
        if right and attribute not in ('effort', 'velocity'):
            expected += f' of at most {LARGEST:g}'
            right = max(map(abs, values)) <= LARGEST
        if right and element.tag == 'mass':
            expected, right = 'a mass >= 0 kg', values[0] >= 0.0
        if not right:
            problem = f'expected {expected}, got {text!r}'
            raise RobotDescriptionError(f'{part}: {element.tag} {attribute}: {problem}')
    if element.tag == 'inertial':
        for tag in ('mass', 'inertia'):
            child = element.find(tag)
            present = set() if child is None else set(child.keys())
            if missing := NUMBERS[tag].keys() - present:
                expected = f'expected {", ".join(sorted(missing))}'
                remedy = 'or remove <inertial> if the link has no mass'
                raise RobotDescriptionError(f'{part}: {tag}: {expected}, {remedy}')
    if element.tag == 'inertia':
        names = [['ixx', 'ixy', 'ixz'], ['ixy', 'iyy', 'iyz'], ['ixz', 'iyz', 'izz']]
        inertia = [[float(element.get(name, 0.0)) for name in row] for row in names]
        least, *_, most = np.linalg.eigvalsh(inertia)
        if least < -1e-9 * max(most, 1e-9):
            problem = f'expected principal moments >= 0, got {least:g} kg·m²'
            raise RobotDescriptionError(f'{part}: inertia: {problem}')
