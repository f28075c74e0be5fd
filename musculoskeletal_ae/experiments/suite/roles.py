# SPDX-License-Identifier: Apache-2.0
"""Which joints of a robot play the parts that the paper gives to Musashi's elbow and shoulder."""

from __future__ import annotations

import math

from musculoskeletal_ae.robot.robot import Robot

ELBOW, SHOULDER = ('elbow_pitch', 'elbow'), ('shoulder_pitch', 'shoulder')


def elbow(robot: Robot) -> int:
    """Return the joint to flex: elbow_pitch, else a joint called elbow, else the last."""
    return _named(robot, ELBOW, robot.joint_count - 1)


def shoulder(robot: Robot) -> int:
    """Return the joint to force and to sweep: shoulder_pitch, else a shoulder, else the first."""
    return _named(robot, SHOULDER, 0)


def _named(robot: Robot, names: tuple[str, ...], otherwise: int) -> int:
    for name in names:
        for index, joint in enumerate(robot.joints):
            if name in joint:
                return index
    return otherwise


def within(robot: Robot, joint: int, degrees: float) -> float:
    """Return the legal angle [rad] nearest to one given in degrees."""
    return min(max(math.radians(degrees), float(robot.lower[joint])), float(robot.upper[joint]))


def flexed(robot: Robot) -> float:
    """Return the elbow's angle nearest to 90°, whichever sign flexion has [rad]."""
    joint = elbow(robot)
    return max((within(robot, joint, -90.0), within(robot, joint, 90.0)), key=abs)
