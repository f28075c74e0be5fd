# SPDX-License-Identifier: Apache-2.0
"""Readings of muscle modules for tests of cores."""

import numpy as np


def reading(states, robot=None):
    """Return a reading: the rows of l [m], T [N] and temperature [°C], (3, M).

    A `robot` that measures motor currents reports currents instead of tensions.
    """
    rows = np.array(states, dtype=float)
    if robot is not None:
        rows[1] = robot.tension_source.to_message(rows[1])
    return rows
