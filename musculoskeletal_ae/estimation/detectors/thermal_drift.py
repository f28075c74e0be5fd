# SPDX-License-Identifier: Apache-2.0
"""Detects a hot muscle module whose drag, cooling or tension sensor has changed.

Such a change alters the constants of the module's thermal model, which `signals/heat.py` estimates.
A changed module is a finding only if its winding is hot. A cool module that has changed is reported
in /diagnostics, and the arm is not stopped.
"""

from collections.abc import Iterator

import numpy as np

from musculoskeletal_ae.conditions import Condition, ConditionKind
from musculoskeletal_ae.estimation.finding import Detector, Finding, Observation
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.heat import Heat
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

#: stop the arm because of a changed module only if its winding is hotter than this [°C]; a cooler
#: module is only reported in /diagnostics
COOL = 60.0


class ThermalDrift(Detector):
    """Warns of modules whose thermal constants have changed, and reports one that is hot.

    Attributes:
        heat: Thermal models of the muscle modules.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot, self.heat = robot, Heat(robot)

    def accept(self) -> None:
        """Accept the present thermal constants of all modules as their reference."""
        self.heat.accept(*range(self._robot.muscle_count))

    def follow(self, sample: MuscleSample, elapsed: float) -> None:
        """Update the thermal models; the temperatures of isolated muscles are unknown."""
        housing = np.where(sample.usable, sample.temperature, np.nan)
        self.heat.step(sample.motor_tension, housing, elapsed)

    def step(self, observation: Observation) -> Finding | None:  # noqa: ARG002
        """Report a module with changed thermal constants and a hot winding, or return None."""
        for muscle, change in self.heat.changed.items():
            if self.heat.core[muscle] > COOL:
                return Finding(muscle, ConditionKind.HOT_MODULE_CHANGED, f'its module {change}')
        return None

    def conditions(self) -> Iterator[Condition]:
        """Yield a condition for each module whose thermal constants have changed."""
        for muscle, change in self.heat.changed.items():
            name = self._robot.muscles[muscle]
            yield ConditionKind.MODULE_CHANGED.condition(f'the module of {name} {change}', [name])
