# SPDX-License-Identifier: Apache-2.0
"""The tendon friction that plans and commands assume."""

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

#: assume this friction coefficient μ if a network has learned none: typical of hand-built arms
FRICTION = 0.05


def tendon_friction(robot: Robot, mae: Mae) -> Array:
    """Return the friction coefficient μ of each muscle, (M,).

    The values are those that the network has learned. A network without learned friction gets
    `FRICTION`, a typical value of hand-built arms, for all muscles.
    """
    touch = getattr(mae, 'touch', None)
    friction: Array = np.full(robot.muscle_count, FRICTION) if touch is None else touch.friction
    return friction
