# SPDX-License-Identifier: Apache-2.0
"""Robot directories for tests: an arm with other names, sizes and order than the shipped ones."""

import copy
import math
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from musculoskeletal_ae.robot.description import (
    SPEED_DEFAULT,
    STIFFNESS_DEFAULT,
    RobotDescription,
)
from musculoskeletal_ae.robot.directories import find_robot
from musculoskeletal_ae.robot.motors import FILE
from musculoskeletal_ae.robot.muscle_file import POSITION
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension_source import CURRENT, TensionSource

# The chain is listed from the hand to the base, and contains a fixed joint and a rotated frame.
# Tests therefore cannot pass only because elements are in order or rotations are identities.
URDF = """<?xml version="1.0"?>
<robot name="other">
  <link name="base"/>
  <joint name="mount" type="fixed">
    <parent link="base"/><child link="pillar"/><origin xyz="0.05 0.1 0.4" rpy="0 0 0.3"/>
  </joint>
  <joint name="bend" type="revolute">
    <parent link="upper"/><child link="lower"/><origin xyz="0 0 -0.3"/><axis xyz="0 1 0"/>
    <limit lower="-1.6" upper="-0.2" effort="20" velocity="5"/>
  </joint>
  <joint name="swing" type="revolute">
    <parent link="shoulder"/><child link="upper"/><origin xyz="0 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-0.7" upper="0.4" effort="20" velocity="5"/>
  </joint>
  <joint name="lift" type="revolute">
    <parent link="pillar"/><child link="shoulder"/><origin xyz="0 0 0"/><axis xyz="1 0 0"/>
    <limit lower="-0.3" upper="0.6" effort="20" velocity="5"/>
  </joint>
  <joint name="wrist" type="{wrist}">
    <parent link="lower"/><child link="tool"/><origin xyz="0.01 0 -0.22" rpy="0.1 0.2 0"/>
    <axis xyz="0.6 0 -0.8"/><limit lower="0.0" upper="0.05" effort="200" velocity="1"/>
  </joint>{finger}
  <link name="pillar"/>
  <link name="tool">
    <inertial><origin xyz="0 0.01 -0.03"/><mass value="0.25"/>
      <inertia ixx="0.0005" ixy="0" ixz="0" iyy="0.0005" iyz="0" izz="0.0004"/></inertial>
  </link>
  <link name="lower">
    <inertial><origin xyz="0 0 -0.1"/><mass value="0.6"/>
      <inertia ixx="0.003" ixy="0" ixz="0" iyy="0.003" iyz="0" izz="0.001"/></inertial>
  </link>
  <link name="upper">
    <inertial><origin xyz="0 0 -0.14"/><mass value="1.0"/>
      <inertia ixx="0.008" ixy="0" ixz="0" iyy="0.008" iyz="0" izz="0.0015"/></inertial>
  </link>
  <link name="shoulder">
    <inertial><origin xyz="0 0 0"/><mass value="0.3"/>
      <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/></inertial>
  </link>
</robot>
"""
FINGER = """
  <joint name="finger" type="revolute">
    <parent link="tool"/><child link="fingertip"/><origin xyz="0.02 0 -0.05"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="2" velocity="5"/>
  </joint>
  <link name="fingertip">
    <inertial><origin xyz="0.02 0 0"/><mass value="0.1"/>
      <inertia ixx="0.0001" ixy="0" ixz="0" iyy="0.0001" iyz="0" izz="0.0001"/></inertial>
  </link>"""
JOINTS = ('bend', 'lift', 'swing')  # order of θ; from the base, the order is lift, swing, bend
Route = Sequence[tuple[str, Sequence[float]]]
MUSCLES: dict[str, Route] = {
    'pull_front_out': [('pillar', (0.06, 0.05, 0.02)), ('upper', (0.04, 0.03, -0.12))],
    'pull_front_in': [('pillar', (0.06, -0.05, 0.02)), ('upper', (0.04, -0.03, -0.12))],
    'pull_back_out': [('pillar', (-0.06, 0.05, 0.0)), ('upper', (-0.04, 0.03, -0.12))],
    'pull_back_in': [('pillar', (-0.06, -0.05, 0.0)), ('upper', (-0.04, -0.03, -0.12))],
    'bender': [('upper', (0.03, 0.0, -0.15)), ('lower', (0.04, 0.0, -0.05))],
    'bender_long': [
        ('pillar', (0.05, 0.0, 0.01)),
        ('upper', (0.04, 0.0, -0.1)),
        ('upper', (0.04, 0.0, -0.22)),
        ('lower', (0.035, 0.0, -0.05)),
    ],
    'straightener': [
        ('upper', (-0.035, 0.01, -0.15)),
        ('upper', (-0.042, 0.01, -0.27)),
        ('lower', (-0.038, 0.01, 0.01)),
    ],
    'straightener_low': [
        ('upper', (-0.035, -0.01, -0.12)),
        ('upper', (-0.042, -0.01, -0.27)),
        ('lower', (-0.036, -0.01, 0.005)),
    ],
}


def with_modules(
    description: RobotDescription, actuation: str, tension_source: str = 'sensor'
) -> RobotDescription:
    """Return the description with another kind of muscle modules and their default values.

    `actuation` and `tension_source` have the values that they may have in muscles.yaml. A motor
    current becomes a tension at 60 N/A: 0.03 N·m/A, a gear of 20, and a spool of 10 mm.
    """
    follows_position, ones = actuation == POSITION, np.ones(len(description.muscles))
    scale = 60.0 * ones if tension_source == CURRENT else None
    return replace(
        description,
        actuation=actuation,
        tension_source=TensionSource(tension_source, scale),
        stiffness=ones * (math.inf if follows_position else STIFFNESS_DEFAULT),
        speed=ones * (SPEED_DEFAULT if follows_position else math.inf),
        release=np.full_like(ones, math.nan),
    )


def write_robot(
    directory: Path,
    *,
    joints: Sequence[str] = JOINTS,
    finger: bool = False,
    slider: bool = False,
    **top: Any,
) -> Path:
    """Write an arm of 3 joints and 8 muscles that `check_robot` accepts, with names of its own.

    Args:
        directory: Directory; it is created if it is missing.
        joints: Order of θ in muscles.yaml; the chain itself is lift, swing, bend.
        finger: Adds a joint to the URDF that muscles.yaml does not list.
        slider: Makes the wrist a prismatic joint, the last of θ, with a muscle on either side.
        top: Further or other top-level keys of muscles.yaml.

    Returns:
        The directory.
    """
    muscles = dict(MUSCLES)
    if slider:
        joints = [*joints, 'wrist']
        muscles['slider_in'] = [('lower', (0.0, 0.02, -0.1)), ('tool', (0.0, 0.02, 0.0))]
        muscles['slider_out'] = [('lower', (0.03, 0.0, -0.3)), ('tool', (0.01, 0.0, 0.0))]
    directory.mkdir(parents=True, exist_ok=True)
    wrist = 'prismatic' if slider else 'fixed'
    text = URDF.format(wrist=wrist, finger=FINGER if finger else '')
    (directory / 'robot.urdf').write_text(text, encoding='utf-8')
    document = {
        'joints': list(joints),
        'muscles': [
            {
                'name': name,
                'route': [{'link': link, 'xyz': [float(v) for v in xyz]} for link, xyz in route],
            }
            for name, route in muscles.items()
        ],
        'end_effector': 'tool',
        **top,
    }
    return write_muscles(directory, document)


DRUM = {
    'wrap': 'cylinder', 'link': 'upper', 'axis': [0.1, 2.0, 0.0], 'xyz': [0.0, 0.0, -0.3],
    'radius': 0.03, 'side': [-0.2, 0.0, -0.3],
}  # fmt: skip
#: two ends of a route: with the first, the tendon stays on the drum; with the second, it slips over
#: the end of the drum
DRUM_ENDS = {'stays': (0.035, 0.0, -0.008), 'jumps': (0.035, 0.0, 0.0)}


def behind_a_drum(directory: Path, end: Sequence[float]) -> Robot:
    """Return an arm whose muscle `straightener` wraps around a cylinder and ends behind it.

    `end` is the last point of the route in the frame of the link [m].
    """
    document = read_muscles(write_robot(directory))
    route = next(m['route'] for m in document['muscles'] if m['name'] == 'straightener')
    route[1:] = [DRUM, {'link': 'lower', 'xyz': list(end)}]
    return Robot.load(write_muscles(directory, document))


def copy_robot(name: str, directory: Path) -> Path:
    """Copy a shipped robot to a directory that a test may change."""
    return shutil.copytree(find_robot(name), directory, dirs_exist_ok=True)


def read_muscles(directory: Path) -> dict[str, Any]:
    """Return the content of muscles.yaml."""
    document: dict[str, Any] = yaml.safe_load((directory / 'muscles.yaml').read_text('utf-8'))
    return document


def write_muscles(directory: Path, document: object) -> Path:
    """Write muscles.yaml; return the directory."""
    text = yaml.safe_dump(copy.deepcopy(document), sort_keys=False, allow_unicode=True)
    (directory / 'muscles.yaml').write_text(text, encoding='utf-8')
    return directory


def chain(links: int) -> str:
    """Return a URDF with a chain of this number of links."""
    joints = ''.join(
        f'<link name="l{i + 1}"/><joint name="j{i}" type="fixed"><parent link="l{i}"/>'
        f'<child link="l{i + 1}"/></joint>'
        for i in range(links)
    )
    return f'<robot name="r"><link name="l0"/>{joints}</robot>'


def arm_with_motors(folder: Path, **content: Any) -> Path:
    """Write a copy of arm26 whose motors are joints of ros2_control; return its directory.

    Args:
        folder: Directory in which the copy is made.
        content: Content of motors.yaml.
    """
    directory = folder / 'arm26'
    shutil.copytree(find_robot('arm26'), directory)
    (directory / FILE).write_text(yaml.safe_dump(content), encoding='utf-8')
    return directory


def write_platform(directory: Path, height: float = 0.05, pulley: float = 0.0) -> Path:
    """Write a platform that hangs on four tendons, and return its directory.

    Args:
        directory: Directory to create.
        height: Height of the attachments above the origin of the platform [m]; its centre of mass
            is 0.05 m below the origin.
        pulley: Radius of swivelling pulleys at the frame [m]; with 0, tendons begin at points.
    """
    directory.mkdir()
    parent, lines = 'frame', ['<robot name="platform"><link name="frame"/>']
    for name, axis in zip(
        ('x', 'y', 'z', 'roll', 'pitch', 'yaw'), 2 * ('1 0 0', '0 1 0', '0 0 1'), strict=True
    ):
        child = 'platform' if name == 'yaw' else f'after_{name}'
        kind, limit = ('prismatic', 0.25) if name in 'xyz' else ('revolute', 0.3)
        lines.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<axis xyz="{axis}"/><limit lower="{-limit}" upper="{limit}" effort="500" '
            'velocity="2"/></joint>'
        )
        parent = child
        if name != 'yaw':
            lines.append(f'<link name="{child}"/>')
    lines.append(
        '<link name="platform"><inertial><origin xyz="0 0 -0.05"/><mass value="7.0"/><inertia '
        'ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.15"/></inertial></link></robot>'
    )
    (directory / 'robot.urdf').write_text('\n'.join(lines))
    muscles = [
        {
            'name': f'tendon_{i}',
            'route': [
                {'link': 'frame', 'xyz': [1.0 * a, 1.0 * b, 1.2]},
                {'link': 'platform', 'xyz': [0.15 * a, 0.15 * b, height]},
            ],
        }
        for i, (a, b) in enumerate(((1, 1), (1, -1), (-1, -1), (-1, 1)), 1)
    ]
    for muscle in muscles if pulley else ():
        x, y, z = muscle['route'][0]['xyz']
        entry = {'wrap': 'pulley', 'link': 'frame', 'xyz': [x, y, z], 'radius': pulley}
        muscle['route'].insert(1, {**entry, 'axis': [x, 0.0, 0.0]})
        muscle['route'][0]['xyz'] = [0.8 * x, y, z]
    document = {
        'joints': ['x', 'y', 'z', 'roll', 'pitch', 'yaw'],
        'muscles': muscles,
        'end_effector': 'platform',
        'actuation': 'position',
        'tension': {'bias': 5.0, 'limit': 150.0, 'max': 300.0},
        'series_elastic': {'force': 100.0, 'rate': 1000.0, 'wire_stretch': 1e-5},
    }
    (directory / 'muscles.yaml').write_text(yaml.safe_dump(document, sort_keys=False))
    return directory
