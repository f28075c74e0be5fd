# SPDX-License-Identifier: Apache-2.0
"""Public recordings of a platform that hangs on four cables, and baselines for them.

The joints x, y, z, roll, pitch and yaw stand for the free platform. Its orientation was measured by
an inclinometer and gyroscope on it. Its position was not measured, so θ of x, y and z is NaN. Each
cable leaves the frame over a pulley that swivels about the line along which the cable enters it.
"""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from scipy.io import loadmat

from bench.recordings_read import Files, Recording, Run, written_robot
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError

JOINTS = 'x', 'y', 'z', 'roll', 'pitch', 'yaw'
#: joint limits [m, rad] around the middle position of the platform, and its height there [m]
LIMITS, HEIGHT = (0.8, 0.8, 0.7, 0.4, 0.4, 0.3), 0.6
MASS, CENTRE = 12.966, 0.173  # mass [kg], and height of its centre above the origin [m]
#: points at which the cables enter their pulleys, and attachments to the platform [m]
ENTRY = np.array([[a, b, 1.839] for a, b in ((1.068, -1.155), (1.068, 1.155))])
ENTRY = np.vstack([ENTRY, ENTRY[::-1] * [-1.0, 1.0, 1.0]])
ATTACHED = np.array([[0.075, b, 0.28] for b in (-0.075, 0.075)])
ATTACHED = np.vstack([ATTACHED, ATTACHED[::-1] * [-1.0, 1.0, 1.0]])
PULLEY = 0.03  # radius of the swivelling pulleys [m]
STILL = 0.002  # treat a length as at rest if it changes by less than this within SPAN rows [m]
SPAN = 5  # average this many rows (0.5 s) in a rest sample


@dataclass(frozen=True)
class Platform:
    """The platform as a robot of six joints; its muscle modules regulate positions."""

    measures_tension: ClassVar[bool] = True

    name: str = 'cable_platform'

    def write(self, directory: Path, tension_source: str = 'none') -> Path:
        """Write the robot directory, with `tension_source` in muscles.yaml; return its path."""
        lines, parent = ['<robot name="cable_platform"><link name="frame"/>'], 'frame'
        for name, axis, limit in zip(JOINTS, 2 * ('1 0 0', '0 1 0', '0 0 1'), LIMITS, strict=True):
            child = 'platform' if name == 'yaw' else f'after_{name}'
            kind = 'prismatic' if name in 'xyz' else 'revolute'
            at = f'<origin xyz="0 0 {HEIGHT}"/>' if name == 'x' else ''
            lines.append(
                f'<joint name="{name}" type="{kind}"><parent link="{parent}"/>'
                f'<child link="{child}"/>{at}<axis xyz="{axis}"/><limit lower="{-limit}" '
                f'upper="{limit}" effort="500" velocity="2"/></joint>'
            )
            if name != 'yaw':
                lines.append(f'<link name="{child}"/>')
            parent = child
        lines.append(
            f'<link name="platform"><inertial><origin xyz="0 0 {CENTRE}"/><mass value="{MASS}"/>'
            '<inertia ixx="0.184" ixy="0" ixz="0" iyy="0.1154" iyz="0" izz="0.1864"/></inertial>'
            '</link></robot>'
        )
        muscles = []
        for i, (entry, end) in enumerate(zip(ENTRY, ATTACHED, strict=True), 1):
            forward = np.array([np.sign(entry[0]), 0.0, 0.0])
            pulley = {'axis': forward.tolist(), 'radius': PULLEY}
            route = [
                {'link': 'frame', 'xyz': (entry - 0.2 * forward).tolist()},
                {'wrap': 'pulley', 'link': 'frame', 'xyz': entry.tolist(), **pulley},
                {'link': 'platform', 'xyz': end.tolist()},
            ]
            muscles.append({'name': f'cable_{i}', 'route': route})
        document = {
            'joints': [*JOINTS], 'muscles': muscles, 'end_effector': 'platform',
            'actuation': 'position', 'tension_source': tension_source,
            'series_elastic': {'force': 1000.0, 'rate': 1000.0, 'wire_stretch': 1e-6},
            'tension': {'bias': 20.0, 'limit': 200.0, 'max': 300.0},
        }  # fmt: skip
        return written_robot(directory, '\n'.join(lines), document)


def cable_length(entry: Array, end: Array) -> float:
    """Return the length of a cable from the entry of its swivelling pulley to its end [m].

    In the plane of the pulley, u points from the entry to the centre of the pulley, and f is the
    direction in which the cable enters, away from the middle of the frame.
    """
    forward = np.array([np.sign(entry[0]), 0.0, 0.0])
    away = end - entry
    height = float(away @ forward)
    out = float(np.linalg.norm(away - height * forward)) - PULLEY
    far = float(np.hypot(out, height))
    arc = np.pi - np.arctan2(height, out) - np.arccos(PULLEY / far)
    return float(PULLEY * arc + np.sqrt(far**2 - PULLEY**2))


def cable_platform(files: Files) -> Recording:
    """Read the runs, with 10 rows per second: cable lengths [m], tensions [N], orientation [rad].

    The lengths are absolute. They are returned relative to those of the platform in the middle.
    """
    middle = [
        cable_length(entry, end + [0.0, 0.0, HEIGHT])
        for entry, end in zip(ENTRY, ATTACHED, strict=True)
    ]
    runs = []
    # Leave out sc_8_medium_b, which is a copy of sc_8_medium_a.
    for name in ('sc_27_final', 'sc_27_medium_a', 'sc_8_final', 'sc_8_medium_a'):
        try:
            data: Any = BytesIO(files.data(f'{name}_parsed.mat'))
            content = loadmat(data, squeeze_me=True)
            parts = {part: np.array(content['st'][part].item(), float).T for part in PARTS}
        except (ValueError, KeyError, TypeError) as error:
            raise MusculoskeletalError(f'{name}_parsed.mat cannot be read: {error}') from error
        orientation, length, tension = (parts[part] for part in PARTS)
        theta = np.hstack([np.full((len(length), 3), np.nan), orientation])
        moved = np.array([
            np.ptp(length[row : row + SPAN], axis=0).max() for row in range(len(length) - SPAN)
        ])  # fmt: skip
        rests, row = list[tuple[int, int]](), 0
        while row < len(moved):
            if moved[row] < STILL:
                rests.append((row, row + SPAN))
                row += SPAN
            row += 1
        runs.append(Run(name, 0.0, length - middle, tension, theta, np.array(rests)))
    return Recording(Platform(), runs)


PARTS = 'epsilon', 'cable_length', 'tensions'
