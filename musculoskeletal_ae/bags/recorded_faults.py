# SPDX-License-Identifier: Apache-2.0
"""Judges by the geometric model whether the readings of a recording belong to a robot.

Arrays carry no names, so column i of the lengths should belong to muscle i, and joint angles should
have the unit, sign and name that robot.urdf defines. `replay --check` reports what is found as
faults, and `train` as warnings.
"""

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.bags.streams import Pairs
from musculoskeletal_ae.problems import read_problems
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals import joint_sensors
from musculoskeletal_ae.signals.joint_sensors import JointFault
from musculoskeletal_ae.signals.wiring import BETTER, Wiring, judge

#: compare joint angles and lengths only within parts of a recording of this duration [s], because
#: lengths may drift from one part to the next
SEGMENT = 30.0
#: leave out muscles that are isolated or suspected of a fault in at least this share of the rows
UNUSED = 0.3
PROBLEMS = read_problems(__file__, 'joint_sensor_problems.yaml')


class RecordedFaults(NamedTuple):
    """Faults of the readings: of the muscles, or of the joint sensors."""

    wiring: Wiring  # the muscle to which each column belongs, and the sign of its length
    joint_sensors: list[str]  # a text for users about each fault of joint sensors


def find_faults(robot: Robot, recording: Pairs, at_rest: bool = False) -> RecordedFaults:
    """Compare the lengths of a recording with the geometric model at its joint angles.

    Columns of muscles can be exchanged, and lengths can have the wrong sign. Joint sensors can have
    the wrong sign or the wrong unit, be swapped with each other, or repeat one reading while the
    arm moves. Muscles that are isolated or suspected of a fault for a large part of the recording
    (UNUSED) are not compared. Rows in which another muscle is so are left out for all muscles.

    On a symmetric arm, angles with the wrong sign look like exchanged muscles. Joint sensors are
    reported if correcting them explains all lengths, and not clearly worse (`wiring.BETTER`) than
    exchanged muscles do; the text then names these as well. Otherwise, muscles are reported.

    Args:
        robot: The geometric model.
        recording: The readings. Rows in which a joint angle is unknown are not compared.
        at_rest: Whether each row is a resting posture. Rows then have no order, so no sensor can
            be stuck from one to the next.
    """
    straight = Wiring.straight(robot.muscle_count)
    is_unreliable = recording.isolated == 1
    used = is_unreliable.sum(axis=0) < UNUSED * len(recording.time)
    time, theta, length, tension, _ = recording.at(~is_unreliable[:, used].any(axis=1))
    if np.count_nonzero(np.isfinite(theta).all(axis=1)) < 2:
        return RecordedFaults(straight, [])
    segments = ((time - time[0]) // SEGMENT).astype(int) * (not at_rest)

    inside = theta.clip(robot.lower, robot.upper)
    muscles = judge(robot.muscle_lengths, inside, length, tension, used=used)
    faults = joint_sensors.judge(robot, theta, length, tension, used, segments).faults
    if muscles.is_faulty and not faults:
        return RecordedFaults(muscles.wiring, [])
    texts = [_text(robot, fault) for fault in faults]
    if muscles.is_faulty:
        meant = joint_sensors.corrected(theta, faults, robot.units).clip(robot.lower, robot.upper)
        corrected = judge(robot.muscle_lengths, meant, length, tension, used=used)
        if corrected.is_faulty or corrected.misfit > BETTER * muscles.misfit:
            return RecordedFaults(muscles.wiring, [])
        texts[-1] += f'. If the angles are right, {muscles.wiring.text(robot.muscles)}'
    if not at_rest:
        stuck = joint_sensors.stuck_sensors(robot, time, theta, length, tension, used)
        texts += [_text(robot, fault) for fault in stuck]
    return RecordedFaults(straight, texts)


def _text(robot: Robot, fault: JointFault) -> str:
    names = ', '.join(robot.joints[j] for j in fault.joints)
    problem = PROBLEMS[fault.kind].filled(names=names, begin=fault.begin, end=fault.end)
    return f'{problem.text}. {problem.remedy}'
