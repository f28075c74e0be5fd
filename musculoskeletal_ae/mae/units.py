# SPDX-License-Identifier: Apache-2.0
"""Inputs and outputs of the network: (θ, T, l), their scaled units and the three masks.

The paper (§III-A) scales (θ, T, l) to [rad], [N/200], [mm/100], which gives them similar
magnitudes. Two of the three quantities enter the network; the mask selects which two. Outside the
network, all values are in SI units.
"""

from enum import Enum
from typing import Literal, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools

THETA_SCALE = 1.0  # scaled units per [rad]
TENSION_SCALE = 1.0 / 200.0  # scaled units per [N]
LENGTH_SCALE = 10.0  # scaled units per [m]; mm/100 = 10 · l[m]

ActivationName = Literal['tanh', 'silu']  # legal activations of the hidden layers

UNITS = 'theta rad, tension N/200, length mm/100'  # scaled units, as checkpoints name them


class State(NamedTuple):
    """A body's state: θ [rad] (..., D), T [N] (..., M), l [m] (..., M)."""

    theta: Array
    tension: Array
    length: Array

    def scaled(self) -> Array:
        """Return the state in scaled units as one array (..., D+2M)."""
        scale = scale_vector(self.theta.shape[-1], self.tension.shape[-1])
        values: Array = np.concatenate(self, axis=-1) * scale
        return values


class Mask(Enum):
    """Selects the two quantities of (θ, T, l) that enter the network.

    The members are the masks ①, ② and ③ (paper, §III-A), in this order.
    """

    THETA_TENSION = (1, 1, 0)
    TENSION_LENGTH = (0, 1, 1)
    THETA_LENGTH = (1, 0, 1)


def scale_vector(joints: int, muscles: int) -> Array:
    """Return the factors from SI to scaled units of (θ, T, l), shape (D+2M,)."""
    scales = (THETA_SCALE, TENSION_SCALE, LENGTH_SCALE)
    return np.repeat(np.array(scales), (joints, muscles, muscles))


def visible(mask: Mask, joints: int, muscles: int) -> Bools:
    """Return which of the D+2M entries of (θ, T, l) a mask selects, shape (D+2M,)."""
    return np.repeat(np.array(mask.value, dtype=bool), (joints, muscles, muscles))
