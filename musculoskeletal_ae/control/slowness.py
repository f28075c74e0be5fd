# SPDX-License-Identifier: Apache-2.0
"""Slows trajectories that are too fast for the muscle modules."""

import numpy as np

from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.control.trajectory import Trajectory
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

#: fraction of the rate limit that the lengths of a trajectory may use; the remaining fraction is
#: for tensions and feedback
SHARE = 0.7
#: largest number of moments of a trajectory at which the network is evaluated; even if a trajectory
#: has 10 000 points, each piece between two points contains at least one moment
MOST_MOMENTS = 12_500


def slowness(robot: Robot, mae: Mae, trajectory: Trajectory, settings: Settings) -> float:
    """Return the factor by which to slow a trajectory so that the muscle modules can follow it.

    Only the lengths at T_bias count. Tensions are ignored, because they change suddenly, at any
    speed, near postures that are hard to hold; `SHARE` reserves speed for tensions. A trajectory
    that starts in motion keeps its initial speed. It may therefore have to be slowed by more.
    """
    # Skip moments of very long trajectories, which would otherwise delay a command by 0.1 s.
    time, theta = (part[:: 1 + len(part) // MOST_MOMENTS] for part in trajectory.path)
    length = mae.lengths(theta, np.tile(robot.tension.bias, (len(theta), 1)))
    speed = np.diff(length, axis=0) * robot.used / np.diff(time)[:, None]
    fastest = SHARE * robot.actuation.fastest(settings.rate_limit)
    return float(max(1.0, (np.abs(speed) / fastest).max()))
