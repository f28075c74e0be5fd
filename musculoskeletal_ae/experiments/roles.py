# SPDX-License-Identifier: Apache-2.0
"""Which joints of a robot play the parts of Musashi's elbow and shoulder (paper, §IV-D)."""

import math

import numpy as np

from musculoskeletal_ae.arrays import Bools
from musculoskeletal_ae.robot.robot import Robot

ELBOW, SHOULDER = ('elbow_pitch', 'elbow'), ('shoulder_pitch', 'shoulder')


def elbow(robot: Robot) -> int:
    """Return the joint to flex: elbow_pitch, else an elbow, else the last that turns."""
    return _named(robot, ELBOW, -1)


def elbows(robot: Robot) -> Bools:
    """Return which joints are elbows (D,): those so named, else the one to flex."""
    named = np.array([ELBOW[-1] in name for name in robot.joints])
    named[elbow(robot)] |= not named.any()
    return named


def shoulder(robot: Robot) -> int:
    """Return the joint to force and sweep: shoulder_pitch, a shoulder, or the first that turns."""
    return _named(robot, SHOULDER, 0)


def _named(robot: Robot, names: tuple[str, ...], otherwise: int) -> int:
    turning = np.flatnonzero(~robot.kinematics.slides).tolist()
    for name in names:
        for index in turning:
            if name in robot.joints[index]:
                return index
    return (turning or range(robot.joint_count))[otherwise]


def plotted(robot: Robot, joint: int) -> tuple[float, str]:
    """Return by what a joint's θ is multiplied in plots, and the unit it then has."""
    return (1000.0, 'mm') if robot.kinematics.slides[joint] else (math.degrees(1.0), 'deg')


def within(robot: Robot, joint: int, degrees: float) -> float:
    """Return the legal angle [rad] nearest to one given in degrees."""
    return min(max(math.radians(degrees), float(robot.lower[joint])), float(robot.upper[joint]))


def flexed(robot: Robot) -> float:
    """Return the elbow's angle nearest to 90°, whichever sign flexion has [rad]."""
    joint = elbow(robot)
    return max((within(robot, joint, -90.0), within(robot, joint, 90.0)), key=abs)
