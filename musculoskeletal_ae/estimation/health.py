# SPDX-License-Identifier: Apache-2.0
"""Monitors the health of the body with a list of detectors.

A new detector is one file in `estimation/detectors/` and one entry in the list of `HealthMonitor`.
The estimator, offline learning (`train --from-bag`) and the experiments use the same list.
"""

from collections.abc import Iterator

from musculoskeletal_ae.arrays import Bools
from musculoskeletal_ae.conditions import Condition
from musculoskeletal_ae.estimation.contact import Contact
from musculoskeletal_ae.estimation.detectors.exchanged_muscles import ExchangeCheck
from musculoskeletal_ae.estimation.detectors.frozen_sensor import FrozenSensor
from musculoskeletal_ae.estimation.detectors.joint_sensor_trust import JointSensorTrust
from musculoskeletal_ae.estimation.detectors.length_disagreement import LengthDisagreement
from musculoskeletal_ae.estimation.detectors.missing_values import MissingValues
from musculoskeletal_ae.estimation.detectors.mounting import MountingCheck
from musculoskeletal_ae.estimation.detectors.saturated_sensor import SaturatedSensor
from musculoskeletal_ae.estimation.detectors.thermal_drift import ThermalDrift
from musculoskeletal_ae.estimation.finding import Detector, Finding, Observation, jump_finding
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.presets.registry import preset_named
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_states import MuscleReadings
from musculoskeletal_ae.signals.muscle_stream import MuscleSample


class HealthMonitor:
    """Checks messages with all detectors, and returns the first finding.

    Attributes:
        residual: The detector that compares the network's residual with its healthy spread; it also
            names the most suspect muscle.
        joint_sensors: The detector that decides which joint sensors are trusted.
        heat: Thermal models of the muscle modules.
    """

    def __init__(self, robot: Robot, preset: str = 'default') -> None:
        """Start without a network.

        Args:
            robot: The nominal body.
            preset: Preset that provides the residual-based and physics-based detectors.
        """
        chosen = preset_named(preset)
        self.residual, by_physics = chosen.residual_detectors(robot)
        drift = ThermalDrift(robot)
        self.heat = drift.heat
        self.joint_sensors = JointSensorTrust(robot)
        self._exchange = ExchangeCheck(robot)
        #: if several report a finding for the same message, only that of the first one counts
        self._detectors: list[Detector] = [
            *by_physics,
            self.residual,
            LengthDisagreement(robot),
            FrozenSensor(robot),
            SaturatedSensor(robot),
            drift,
            MissingValues(robot),
            self._exchange,
            self.joint_sensors,
            MountingCheck(robot),
        ]

    def use(self, mae: Mae) -> None:
        """Use another network; its isolated muscles are ignored."""
        for detector in self._detectors:
            detector.use(mae)

    def reset(self) -> None:
        """Reset all detectors, for example after a jump of the clock or a reset by the user."""
        for detector in self._detectors:
            detector.reset()

    def forget(self) -> None:
        """Forget all stored messages, because the length offsets have changed."""
        for detector in self._detectors:
            detector.forget()

    def accept(self) -> None:
        """Accept the present state of the body as healthy, because a user says so."""
        for detector in self._detectors:
            detector.accept()

    def read(self, readings: MuscleReadings, usable: Bools, now: float) -> Finding | None:
        """Check the readings of a message, even of a rejected one; return the first finding.

        `Detector.read` describes the arguments.
        """
        findings = [detector.read(readings, usable, now) for detector in self._detectors]
        return next(filter(None, findings), None)

    def follow(self, sample: MuscleSample, elapsed: float) -> None:
        """Let all detectors follow an accepted sample, as `Detector.follow` describes."""
        for detector in self._detectors:
            detector.follow(sample, elapsed)

    def step(self, observation: Observation) -> Finding | None:
        """Check a message for which there is an estimate; return the first finding or None.

        A jump of lengths takes precedence. If a fault of the driver explains the finding
        (`exchanged_muscles`), it is reported instead.
        """
        findings = [detector.step(observation) for detector in self._detectors]
        if (jumped := observation.sample.jumped) and observation.lengths_known:
            findings.insert(0, jump_finding(jumped))
        return self._exchange.explain(next(filter(None, findings), None), observation)

    def step_healthy(self, observation: Observation, load: Contact | None) -> None:
        """Check a message of an arm without an anomaly again, as in `Detector.step_healthy`."""
        for detector in self._detectors:
            detector.step_healthy(observation, load)

    def conditions(self) -> Iterator[Condition]:
        """Yield the conditions of all detectors."""
        for detector in self._detectors:
            yield from detector.conditions()
