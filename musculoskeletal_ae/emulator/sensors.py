# SPDX-License-Identifier: Apache-2.0
"""Sensors of an emulated arm in addition to those of its muscle modules.

A line describes a sensor: 'joints' (joint angles), 'marker[:RATE]' (pose of a marker at the hand,
as a camera sees it) or 'imu:LINK' (an accelerometer on a link).
"""

from collections.abc import Iterable
from typing import NamedTuple

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.kinematics import body_frames
from musculoskeletal_ae.robot.robot import Robot

MARKER_RATE = 10.0  # publish the marker's pose at this rate by default [Hz]
HIGHEST_RATE = 100.0  # reject a higher rate of the marker's pose [Hz]
LEGAL = f'joints, marker[:RATE] (above 0 to {HIGHEST_RATE:g} Hz) and imu:LINK, each once'


class Sensors(NamedTuple):
    """The sensors that an emulated arm has in addition to those of its muscle modules."""

    joints: bool = False  # whether there are joint sensors
    marker_rate: float = 0.0  # rate of the marker's pose [Hz]; 0: there is no marker
    imu_link: str = ''  # link that carries an accelerometer; '': there is none


def read_sensors(lines: Iterable[str], robot: Robot) -> Sensors:
    """Read which sensors the lines describe.

    Raises:
        MusculoskeletalError: If a line is not legal; the message lists the legal forms.
    """
    sensors, kinds = Sensors(), set[str]()
    for line in lines:
        kind, _, detail = (word.strip() for word in line.partition(':'))
        if kind == 'joints' and not detail:
            sensors = sensors._replace(joints=True)
        elif kind == 'marker':
            sensors = sensors._replace(marker_rate=_rate(line, detail))
        elif kind == 'imu':
            links = [str(frame.name) for frame in body_frames(robot.kinematics.model)]
            if detail not in links:
                problem = f'sensor {line[:80]!r}: unknown link {detail[:80]!r}'
                raise MusculoskeletalError(f'{problem}; legal: {", ".join(links)}')
            sensors = sensors._replace(imu_link=detail)
        else:
            raise MusculoskeletalError(f'{line[:80]!r} describes no sensor; legal: {LEGAL}')
        if kind in kinds:
            problem = f'sensor {line[:80]!r} is the second sensor of its kind'
            raise MusculoskeletalError(f'{problem}; legal: {LEGAL}')
        kinds.add(kind)
    return sensors


def _rate(line: str, word: str) -> float:
    try:
        rate = float(word) if word else MARKER_RATE
    except ValueError:
        rate = 0.0
    if not 0.0 < rate <= HIGHEST_RATE:
        raise MusculoskeletalError(f'sensor {line[:80]!r}: wrong rate; legal: {LEGAL}')
    return rate
