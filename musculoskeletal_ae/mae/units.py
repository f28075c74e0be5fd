# SPDX-License-Identifier: Apache-2.0
"""Scaled units inside the network, and the three ways to enter it.

The paper (section "Network Structure") scales (θ, T, l) to [rad], [N/200], [mm/100] so that their
sizes align, and enters the network with two of the three: the mask says which. SI outside.
"""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import NDArray

from musculoskeletal_ae.arrays import Array

THETA_SCALE = 1.0  # scaled units per [rad] (or [m] of a prismatic joint)
TENSION_SCALE = 1.0 / 200.0  # scaled units per [N]
LENGTH_SCALE = 10.0  # scaled units per [m]; mm/100 = 10 · l[m]

UNITS = 'theta rad, tension N/200, length mm/100'


class Mask(Enum):
    """Which of (θ, T, l) enter the network: the paper's ①, ②, ③."""

    THETA_TENSION = (1, 1, 0)
    TENSION_LENGTH = (0, 1, 1)
    THETA_LENGTH = (1, 0, 1)


def scale_vector(joints: int, muscles: int) -> Array:
    """Return what multiplies SI (θ, T, l) to give scaled units, shape (D+2M,)."""
    scales = (THETA_SCALE, TENSION_SCALE, LENGTH_SCALE)
    return np.repeat(np.array(scales), (joints, muscles, muscles))


def visible(mask: Mask, joints: int, muscles: int) -> NDArray[np.bool_]:
    """Return which of the D+2M entries of (θ, T, l) a mask lets in, shape (D+2M,)."""
    return np.repeat(np.array(mask.value, dtype=bool), (joints, muscles, muscles))
