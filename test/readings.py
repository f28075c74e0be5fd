# SPDX-License-Identifier: Apache-2.0
"""Readings of muscle modules for tests of cores."""

import numpy as np

from musculoskeletal_ae.signals.muscle_states import MuscleReadings


def reading(states):
    """Return the readings with these l [m], T [N] and temperatures [°C], (3, M)."""
    length, tension, temperature = np.array(states, dtype=float)
    return MuscleReadings(length=length, tension=tension, temperature=temperature)
