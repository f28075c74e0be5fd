# SPDX-License-Identifier: Apache-2.0
"""Commands for arms without a controller."""

import numpy as np

from musculoskeletal_ae.motion.activities import msc_compensation


def to_mid_range(robot, tension):
    """Return target lengths [m] (M,) that give all muscles a tension [N] at mid-range."""
    tensions = np.full(robot.muscle_count, tension)
    middle = 0.5 * (robot.lower + robot.upper)
    return robot.muscle_lengths(middle, tensions) + msc_compensation(robot, tensions)
