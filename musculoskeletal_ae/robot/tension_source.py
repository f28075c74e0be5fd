# SPDX-License-Identifier: Apache-2.0
"""How muscle modules report tension: `tension_source` of muscles.yaml.

    T_read = i k_t n / r

If motor currents are measured instead of tensions, this formula converts them. i is a motor
current, k_t the motor's torque constant, n the gear ratio and r the radius of the spool. T_read
also contains the friction of motor and gear, an offset, and the error of k_t. Online learning
identifies these errors (`signals.friction.Transmission`).
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
        newton_per_ampere: Tension per motor current of each muscle [N per A], (M,); None unless
            `kind` is CURRENT.
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
        """Return the tension source of an arm that has only the muscles with these indices."""
        if self.newton_per_ampere is None:
            return self
        return TensionSource(self.kind, self.newton_per_ampere[muscles])

    def to_newtons(self, values: Array) -> Array:
        """Convert the values of a message, (M,): tensions [N] or currents [A], to tensions [N]."""
        return values if self.newton_per_ampere is None else values * self.newton_per_ampere

    def known(self, tension: Array) -> Array:
        """Return `tension` [N], (..., M), or NaN if the robot does not measure tensions."""
        return tension if self.is_known else np.full_like(tension, np.nan)

    def to_message(self, tension: Array) -> Array:
        """Convert tensions [N], (M,), to the values of a message: tensions [N] or currents [A]."""
        return tension if self.newton_per_ampere is None else tension / self.newton_per_ampere


TENSION_SENSOR = TensionSource()
