# SPDX-License-Identifier: Apache-2.0
"""The tendon friction that plans and commands assume."""

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

FRICTION = 0.05  # μ if none was learned: a typical value of hand-built arms


def tendon_friction(robot: Robot, mae: Mae) -> Array:
    """Return μ of each muscle, (M,): the learned value, or FRICTION if none was learned."""
    touch = getattr(mae, 'touch', None)
    friction: Array = np.full(robot.muscle_count, FRICTION) if touch is None else touch.friction
    return friction
