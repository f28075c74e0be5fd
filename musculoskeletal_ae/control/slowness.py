# SPDX-License-Identifier: Apache-2.0
"""Slows trajectories that are too fast for the muscle modules."""

import numpy as np

from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.control.trajectory import Trajectory
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

#: fraction of the rate limit for a trajectory's lengths; the rest is for tensions and feedback
SHARE = 0.7
#: largest number of moments of a trajectory at which the network is evaluated; even with 10 000
#: points, each piece of the trajectory has at least one
MOST_MOMENTS = 12_500


def slowness(robot: Robot, mae: Mae, trajectory: Trajectory, settings: Settings) -> float:
    """Return the factor by which a trajectory has to be slowed for the muscle modules.

    Only the lengths at T_bias count. Tensions are ignored, because near postures that are hard to
    hold they change suddenly at any speed; `SHARE` reserves speed for them. A trajectory that
    starts in motion keeps its initial speed, so it can need more than this factor.
    """
    # Evaluate fewer moments of very long trajectories, so that no command is delayed by 0.1 s.
    time, theta = (part[:: 1 + len(part) // MOST_MOMENTS] for part in trajectory.path)
    length = mae.lengths(theta, np.tile(robot.tension.bias, (len(theta), 1)))
    speed = np.diff(length, axis=0) * robot.used / np.diff(time)[:, None]
    fastest = SHARE * robot.actuation.fastest(settings.rate_limit)
    return float(max(1.0, (np.abs(speed) / fastest).max()))
