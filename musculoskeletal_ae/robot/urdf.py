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

#: how many numbers an attribute holds, by element
NUMBERS = {
    'origin': {'xyz': 3, 'rpy': 3},
    'axis': {'xyz': 3},
    'mass': {'value': 1},
    'inertia': dict.fromkeys(('ixx', 'ixy', 'ixz', 'iyy', 'iyz', 'izz'), 1),
    'limit': {'lower': 1, 'upper': 1, 'effort': 1, 'velocity': 1},
    'box': {'size': 3},
    'cylinder': {'radius': 1, 'length': 1},
    'sphere': {'radius': 1},
}


def read_urdf(file: Path, text: str) -> pin.Model:
    """Return pinocchio's model of the text of a URDF.

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
            for element in part.iter():
                _check(f'{file}: {part.tag} {part.get("name")!r}', element)
    try:
        return pin.buildModelFromXML(text)
    except (ValueError, RuntimeError) as error:
        raise RobotDescriptionError(f'{file}: not a valid URDF: {error}') from error


def _check(part: str, element: ET.Element) -> None:
    for attribute, count in NUMBERS.get(element.tag, {}).items():
        text = element.get(attribute)
        if text is None:
            continue
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            values = []
        expected = 'a finite number' if count == 1 else f'{count} finite numbers'
        wrong = len(values) != count or not all(map(math.isfinite, values))
        if not wrong and element.tag == 'mass' and values[0] < 0.0:
            wrong, expected = True, 'a mass >= 0 kg'
        if wrong:
            raise RobotDescriptionError(
                f'{part}: {element.tag} {attribute}: expected {expected}, got {text!r}'
            )
