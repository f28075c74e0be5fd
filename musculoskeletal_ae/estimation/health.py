# SPDX-License-Identifier: Apache-2.0
"""Monitors the health of the body with a list of detectors.

A new detector is one file in `estimation/detectors/` and one entry in the list of `HealthMonitor`.
The estimator, offline learning (`train --from-bag`) and the experiments use the same list.
"""

from musculoskeletal_ae.arrays import Bools
from musculoskeletal_ae.estimation.detectors.frozen_sensor import FrozenSensor
from musculoskeletal_ae.estimation.detectors.length_disagreement import LengthDisagreement
from musculoskeletal_ae.estimation.detectors.missing_values import MissingValues
from musculoskeletal_ae.estimation.detectors.saturated_sensor import SaturatedSensor
from musculoskeletal_ae.estimation.detectors.thermal_drift import ThermalDrift
from musculoskeletal_ae.estimation.finding import Detector, Finding, Observation, jump_finding
from musculoskeletal_ae.estimation.lengths.exchange import ExchangeCheck
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.presets.registry import preset_named
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.heat import Heat
from musculoskeletal_ae.signals.muscle_states import MuscleReadings


class HealthMonitor:
    """Checks messages with all detectors, and returns the first finding.

    Attributes:
        residual: The detector that compares the network's residual with its healthy spread; it also
            names the most suspect muscle.
        joints: The detector of lengths that disagree with joint sensors.
        heat: Thermal models of the muscle modules, which the caller updates.
    """

    def __init__(self, robot: Robot, preset: str = 'default') -> None:
        """Start without a network.

        Args:
            robot: The nominal body.
            preset: Preset that provides the residual-based and physics-based detectors.
        """
        chosen = preset_named(preset)
        self.residual, by_physics = chosen.residual_detectors(robot)
        self.joints = LengthDisagreement(robot)
        self.heat = Heat(robot)
        self._exchange = ExchangeCheck(robot)
        self._missing = MissingValues(robot)
        self._detectors: list[Detector] = [
            *by_physics,
            self.residual,
            self.joints,
            FrozenSensor(robot),
            SaturatedSensor(robot),
            ThermalDrift(self.heat),
        ]

    def use(self, mae: Mae) -> None:
        """Use another network; its isolated muscles are ignored."""
        for detector in self._detectors:
            detector.use(mae)
        self._exchange.use(mae)

    def reset(self) -> None:
        """Reset all detectors, for example after a jump of the clock or a reset by the user."""
        for detector in self._detectors:
            detector.reset()

    def forget(self) -> None:
        """Forget all stored messages, because the length offsets have changed."""
        self.joints.forget()
        self._exchange.forget()

    def read(self, readings: MuscleReadings, usable: Bools, now: float) -> Finding | None:
        """Check the readings of a message, even of a rejected one; return a finding or None.

        Args:
            readings: The readings, with lengths as the sensors measured them.
            usable: Whether each muscle is used, (M,).
            now: Time of the message on a steady clock [s].
        """
        self._exchange.read(readings, now)
        return self._missing.step(readings, usable, now)

    def step(self, observation: Observation) -> Finding | None:
        """Check a message for which there is an estimate; return the first finding or None.

        A jump of lengths takes precedence. If a fault of the driver explains the finding
        (`exchange`), it is reported instead.
        """
        findings = [detector.step(observation) for detector in self._detectors]
        if (jumped := observation.sample.jumped) and observation.lengths_known:
            findings.insert(0, jump_finding(jumped))
        self._exchange.note(observation)
        return self._exchange.explain(next(filter(None, findings), None), observation)
