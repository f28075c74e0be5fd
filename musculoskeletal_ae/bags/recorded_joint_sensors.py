# SPDX-License-Identifier: Apache-2.0
"""Finds faults of the joint sensors of a recording, for `train` and `replay --check`."""

from musculoskeletal_ae.bags.streams import Pairs
from musculoskeletal_ae.problems import read_problems
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.joint_sensors import judge, stuck_sensors

#: compare joint angles and lengths only within parts of a recording of this duration [s], because
#: lengths may drift from one part to the next
SEGMENT = 30.0
PROBLEMS = read_problems(__file__, 'joint_sensor_problems.yaml')


def wrong_joint_sensors(robot: Robot, recording: Pairs, at_rest: bool = False) -> list[str]:
    """Return a warning for each fault of joint sensors that the recording of a moving arm reveals.

    Sensors can have the wrong sign or the wrong unit, be swapped with each other, or repeat one
    reading while the arm moves. The readings are compared with the recorded muscle lengths.
    Muscles that are isolated at any time during the recording are left out of the comparison.

    Args:
        robot: The geometric model.
        recording: The readings.
        at_rest: Whether each row is a resting posture. Rows then have no order, so no sensor can
            be stuck from one to the next.
    """
    if not len(recording.time):
        return []
    time, theta, length, tension, isolated = recording
    used = ~(isolated == 1).any(axis=0)
    segments = ((time - time[0]) // SEGMENT).astype(int) * (not at_rest)
    faults = judge(robot, theta, length, tension, used, segments).faults
    if not at_rest:
        faults += stuck_sensors(robot, time, theta, length, tension, used)
    warnings = []
    for fault in faults:
        names = ', '.join(robot.joints[j] for j in fault.joints)
        problem = PROBLEMS[fault.kind].filled(names=names, begin=fault.begin, end=fault.end)
        warnings.append(f'{problem.text}. {problem.remedy}')
    return warnings
