# SPDX-License-Identifier: Apache-2.0
"""The joints of a robot that take the roles of Musashi's elbow and shoulder (paper, §IV-D)."""

import math

import numpy as np

from musculoskeletal_ae.arrays import Bools
from musculoskeletal_ae.robot.robot import Robot

ELBOW, SHOULDER = ('elbow_pitch', 'elbow'), ('shoulder_pitch', 'shoulder')


def elbow(robot: Robot) -> int:
    """Return the index of the joint that plays the role of elbow_pitch in the experiments.

    This is the first revolute joint with "elbow_pitch" in its name, or else with "elbow", or else
    the last revolute joint. Without revolute joints, it is the last joint.
    """
    return _named(robot, ELBOW, -1)


def elbows(robot: Robot) -> Bools:
    """Return a mask of the elbow joints, (D,).

    These are all joints with "elbow" in their names. If there are none, it is the joint whose
    index `elbow` returns.
    """
    named = np.array([ELBOW[-1] in name for name in robot.joints])
    named[elbow(robot)] |= not named.any()
    return named


def shoulder(robot: Robot) -> int:
    """Return the index of the joint that plays the role of shoulder_pitch in the experiments.

    This is the first revolute joint with "shoulder_pitch" in its name, or else with "shoulder", or
    else the first revolute joint. Without revolute joints, it is the first joint.
    """
    return _named(robot, SHOULDER, 0)


def _named(robot: Robot, names: tuple[str, ...], otherwise: int) -> int:
    revolute = np.flatnonzero(~robot.units.slides).tolist()
    for name in names:
        for index in revolute:
            if name in robot.joints[index]:
                return index
    return (revolute or range(robot.joint_count))[otherwise]


def plot_unit(robot: Robot, joint: int) -> tuple[float, str]:
    """Return the factor that converts θ of a joint to the unit of plots, and that unit."""
    if robot.units.slides[joint]:
        return 1000.0 * robot.units[joint].radian, 'mm'
    return math.degrees(1.0), 'deg'


def within(robot: Robot, joint: int, degrees: float) -> float:
    """Return the angle [rad] within a joint's limits that is nearest to `degrees`."""
    return min(max(math.radians(degrees), float(robot.lower[joint])), float(robot.upper[joint]))


def flexed(robot: Robot) -> float:
    """Return the angle [rad] within the limits of the elbow that is nearest to 90° or −90°."""
    joint = elbow(robot)
    return max((within(robot, joint, -90.0), within(robot, joint, 90.0)), key=abs)
