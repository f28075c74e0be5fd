# SPDX-License-Identifier: Apache-2.0
"""Detect a module whose thermal constants drift: its drag, cooling or tension sensor has changed.

`heat.py` estimates the constants. Only a module with a hot winding is a finding. A cool one is
named in /diagnostics, but the arm is not stopped for it.
"""

from collections.abc import Iterable

from musculoskeletal_ae.estimation.finding import Detector, Finding, Kind, Observation
from musculoskeletal_ae.signals.heat import Heat

COOL = 60.0  # [°C] of the winding


class ThermalDrift(Detector):
    """Reports modules that have changed and are hot."""

    def __init__(self, heat: Heat) -> None:
        self._heat = heat

    def accept(self, muscles: Iterable[int]) -> None:
        """Consider the modules of these muscles healthy as they are now."""
        self._heat.accept(*muscles)

    def step(self, observation: Observation) -> Finding | None:  # noqa: ARG002 (heat has it)
        """Take a message."""
        for muscle, how in self._heat.changed.items():
            if self._heat.core[muscle] > COOL:
                return Finding(muscle, Kind.THERMAL_DRIFT, f'its module {how}')
        return None
