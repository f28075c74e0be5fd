# SPDX-License-Identifier: Apache-2.0
"""Reading robot.urdf by pinocchio, after a check of every number in it.

The check is ours because the URDF parser only warns about a mass or an inertia that is no number,
drops the whole inertial element and goes on with a link that weighs nothing.
"""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree as ET

import pinocchio as pin

from musculoskeletal_ae.exceptions import RobotDescriptionError

INERTIA = ('ixx', 'ixy', 'ixz', 'iyy', 'iyz', 'izz')
NUMBERS = {
    'origin': {'xyz': 3, 'rpy': 3},
    'axis': {'xyz': 3},
    'mass': {'value': 1},
    'inertia': dict.fromkeys(INERTIA, 1),
    'limit': {'lower': 1, 'upper': 1, 'effort': 1, 'velocity': 1},
    'box': {'size': 3},
    'cylinder': {'radius': 1, 'length': 1},
    'sphere': {'radius': 1},
}


def read_urdf(file: Path, text: str) -> pin.Model:
    """Return pinocchio's model of a URDF.

    Args:
        file: Named in messages.
        text: The URDF.

    Raises:
        RobotDescriptionError: Naming the file, the link or joint, and what is expected.
    """
    try:
        # The file is the user's own, and expat bounds the expansion of entities.
        root = ET.fromstring(text)  # noqa: S314
    except (ET.ParseError, ValueError) as error:
        raise RobotDescriptionError(f'{file}: not valid XML: {error}') from error
    for part in root:
        if part.tag in ('link', 'joint'):
            _check_part(f'{file}: {part.tag} {part.get("name")!r}', part)
    try:
        return pin.buildModelFromXML(text)
    except (ValueError, RuntimeError) as error:
        raise RobotDescriptionError(f'{file}: not a valid URDF: {error}') from error


def _check_part(entry: str, part: ET.Element) -> None:
    for element in part.iter():
        for attribute, count in NUMBERS.get(element.tag, {}).items():
            text = element.get(attribute)
            if text is None:
                continue
            where = f'{entry}: {element.tag} {attribute}'
            values = _finite(text)
            if len(values) != count:
                expected = 'a finite number' if count == 1 else f'{count} finite numbers'
                raise RobotDescriptionError(f'{where}: expected {expected}, got {text!r}')
            if element.tag == 'mass' and values[0] < 0.0:
                raise RobotDescriptionError(f'{where}: expected a mass >= 0 kg, got {text!r}')


def _finite(text: str) -> list[float]:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        return []
    return values if all(map(math.isfinite, values)) else []
