# SPDX-License-Identifier: Apache-2.0
"""A tension sensor that saturates below the limit is a finding; healthy readings are none."""

from types import SimpleNamespace

import numpy as np
import pytest

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.detectors.saturated_sensor import SaturatedSensor
from musculoskeletal_ae.signals.muscle_states import MuscleReadings

DT, SATURATED = 0.01, 2


def watched(robot, sense, seconds=40.0):
    """Return the first finding while all tensions swing, and the time of it [s]."""
    detector, rng = SaturatedSensor(robot), np.random.default_rng(0)
    phase = rng.uniform(0.0, 6.0, robot.muscle_count)
    for n in range(round(seconds / DT)):
        tension = 110.0 + 70.0 * np.clip(1.5 * np.sin(n * DT + phase), -1.0, 1.0)
        reading = sense(tension, rng, n)
        sample = SimpleNamespace(
            newest=MuscleReadings(tension=reading),
            length=np.zeros(len(reading)),
            usable=np.ones(len(reading), dtype=bool),
        )
        if finding := detector.step(SimpleNamespace(sample=sample, dt=DT)):
            return finding
    return None


def noisy(tension, rng, _):
    return np.round(8.0 * (tension + rng.normal(0.0, 1.0, len(tension)))) / 8.0


def clipped(at):
    def sense(tension, rng, n):
        reading = noisy(tension, rng, n)
        reading[SATURATED] = min(reading[SATURATED], at)
        if n % 97 == 0:
            reading[SATURATED] = 450.0  # a spike is no tension
        return reading

    return sense


def test_a_sensor_that_saturates_below_the_limit_is_found_with_its_value(robot):
    finding = watched(robot, clipped(150.0))
    assert (finding.muscle, finding.kind) == (SATURATED, ConditionKind.SENSOR_SATURATED)
    assert '150 N' in finding.evidence


def test_a_constant_reading_while_the_module_winds_in_is_found_at_once(robot):
    detector, rng = SaturatedSensor(robot), np.random.default_rng(0)
    length, usable = np.zeros(robot.muscle_count), np.ones(robot.muscle_count, dtype=bool)
    for n in range(2100):
        reading = noisy(np.full(robot.muscle_count, 80.0 + 0.02 * n), rng, n)
        if n >= 2000:
            reading[SATURATED] = 120.0
            length = length - 2e-4 * (np.arange(robot.muscle_count) == SATURATED)
        sample = SimpleNamespace(
            newest=MuscleReadings(tension=reading), length=length, usable=usable
        )
        finding = detector.step(SimpleNamespace(sample=sample, dt=DT))
        assert finding is None or n >= 2050
    assert 'winds in' in finding.evidence


def still(tension, rng, n):
    """Return readings without noise; the modules hold T_bias exactly."""
    del rng, n
    return np.clip(tension - 100.0, 30.0, None)


def coarse(tension, rng, n):
    """Return readings in steps of 5 N, which repeat often."""
    return 5.0 * np.round(noisy(tension, rng, n) / 5.0)


def stalling(tension, rng, n):
    """Return readings of a driver that repeats its last message for half a second now and then."""
    stalls = (n // 50) % 7 == 3
    generator = np.random.default_rng(0 if stalls else n)
    return noisy(180.0 * np.ones_like(tension) if stalls else tension, generator, rng)


@pytest.mark.parametrize('sense', [noisy, still, coarse, stalling, clipped(230.0)])
def test_healthy_readings_are_no_saturation(robot, sense):
    assert watched(robot, sense) is None
