# SPDX-License-Identifier: Apache-2.0
"""How muscle modules report tension: `tension_source` of muscles.yaml.

    T_read = i k_t n / r

i is a motor current, k_t the motor's torque constant, n the gear ratio and r the radius of the
spool. T_read also contains the friction of motor and gear, an offset, and the error of k_t, which
online learning identifies (`signals.friction.Transmission`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints

#: what a module measures: its tension (with a sensor), its motor current, or neither
SENSOR, CURRENT, NONE = 'sensor', 'current', 'none'


@dataclass(frozen=True, eq=False)
class TensionSource:
    """Source of the tensions of one arm.

    Attributes:
        kind: SENSOR, CURRENT or NONE.
        newton_per_ampere: k_t n / r of each muscle [N per A], (M,); None unless `kind` is CURRENT.
    """

    kind: str = SENSOR
    newton_per_ampere: Array | None = None

    @property
    def is_known(self) -> bool:
        """Whether tensions are measured, by sensors or as motor currents."""
        return self.kind != NONE

    @property
    def is_current(self) -> bool:
        """Whether motor currents are measured instead of tensions."""
        return self.newton_per_ampere is not None

    def of_muscles(self, muscles: Ints) -> TensionSource:
        """Return the source of some of the muscles."""
        if self.newton_per_ampere is None:
            return self
        return TensionSource(self.kind, self.newton_per_ampere[muscles])

    def from_message(self, values: Array) -> Array:
        """Return T_read [N] (M,) from the values of a message, in [N] or [A]; NaN if unknown."""
        scale = self.newton_per_ampere
        return self.known(values if scale is None else values * scale)

    def known(self, tension: Array) -> Array:
        """Return T_read [N] (..., M), or NaN if tensions are unknown."""
        return tension if self.is_known else np.full_like(tension, np.nan)

    def measured(self, rows: Array) -> Array:
        """Return the rows l and T_read of `rows` (2, ...), or only the row l if T is unknown."""
        return rows if self.is_known else rows[:1]

    def to_message(self, tension: Array) -> Array:
        """Return the values of a message, in [N] or [A], from T_read [N] (M,)."""
        return tension if self.newton_per_ampere is None else tension / self.newton_per_ampere


TENSION_SENSOR = TensionSource()
