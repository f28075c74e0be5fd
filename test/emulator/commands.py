# SPDX-License-Identifier: Apache-2.0
"""Commands for arms that nobody controls."""

import numpy as np

from musculoskeletal_ae.control.command import msc_compensation


def to_mid_range(robot, tension):
    """Return the lengths [m] (M,) with which all muscles pull so hard [N] at mid-range."""
    tensions = np.full(robot.muscle_count, tension)
    middle = 0.5 * (robot.lower + robot.upper)
    return robot.muscle_lengths(middle, tensions) + msc_compensation(robot, tensions)
