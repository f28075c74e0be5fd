# SPDX-License-Identifier: Apache-2.0
"""A muscle without tension: ruptured, or slack that a slow winch winds in."""

from dataclasses import replace

import numpy as np
import pytest

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.estimation.detectors.slack_tendon import DEAD_TIME, SLACK_LENGTH
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.estimation.health import HealthMonitor
from musculoskeletal_ae.experiments.detection import observe

DT = 0.01
MUSCLE = 2


@pytest.fixture
def noticed(robot, mae, slack):
    """Return a function that measures how long it takes until a slack muscle is reported."""

    def run(speed, until, longest=20.0):
        """Wind in muscle MUSCLE without tension, and return the time of the finding [s].

        Args:
            speed: Speed of winding in [m/s].
            until: Length after which the winding stops [m].
            longest: Time after which the test ends [s].

        Returns:
            The time, or infinity if there is no finding.
        """
        health, rng = HealthMonitor(robot), np.random.default_rng(0)
        health.use(mae)
        state = mae.estimate(*slack)
        for n in range(round(longest / DT)):
            wound = min(until, speed * n * DT) * np.eye(6)[MUSCLE]
            length = slack.length - wound + 1e-4 * rng.standard_normal(6)
            demand, tension = robot.actuation.demanded(length, length - 0.003), slack.tension
            finding = health.step(observe(mae, length, tension, tension, DT, demand, state))
            if finding is not None:
                assert (finding.muscle, finding.kind) == (MUSCLE, ConditionKind.SLACK_TENDON)
                return n * DT
        return np.inf

    return run


def test_a_standing_module_without_tension_is_a_rupture_after_half_a_second(noticed):
    assert noticed(0.0, 0.0) <= DEAD_TIME + DT


@pytest.mark.parametrize('speed', [0.009, 0.036])
def test_a_slow_winch_is_given_time_to_take_up_slack(noticed, speed):
    slack = 0.03
    assert noticed(speed, slack) >= slack / speed
    assert noticed(speed, slack) <= slack / speed + DEAD_TIME + 3 * DT


@pytest.mark.parametrize('speed', [0.009, 0.036, 0.25])
def test_slack_beyond_the_limit_is_a_rupture(noticed, speed):
    expected = max(DEAD_TIME, SLACK_LENGTH / speed)
    assert expected - 2 * DT <= noticed(speed, 1.0) <= expected + DEAD_TIME


def test_noise_of_the_length_sensor_does_not_count_as_winding_in(noticed):
    assert noticed(0.001, 1.0) <= 2.0 * DEAD_TIME


@pytest.mark.parametrize(('loose', 'found'), [(0.04, False), (-0.02, True)])
def test_the_distance_waits_for_slack_but_not_for_a_rupture(
    robot, calibrated, healthy, loose, found
):
    """A slack tendon is longer than a taut one in the same posture; a ruptured one is shorter."""
    health = HealthMonitor(robot)
    health.use(calibrated)
    one = np.eye(6)[MUSCLE]
    tension, start = healthy.tension * (1.0 - one), healthy.length + loose * one
    kinds = []
    for n in range(60):
        length = start - 0.009 * n * DT * one
        demand = robot.actuation.demanded(length, length - 0.003)
        finding = health.step(observe(calibrated, length, tension, tension, DT, demand))
        kinds.append(finding and finding.kind)
    assert (ConditionKind.RESIDUAL_DISTANCE in kinds[:50]) == found


@pytest.mark.parametrize(
    ('speed', 'commanded'),
    [
        (0.009, True),
        (0.036, False),
        pytest.param(0.009, False, marks=pytest.mark.thorough),
        pytest.param(0.036, True, marks=pytest.mark.thorough),
    ],
)
def test_an_emulated_slow_winch_takes_up_slack_without_an_anomaly(
    robot, calibrated, speed, commanded
):
    """This also holds before the detector is calibrated, and before the first command."""
    arm, name = EmulatedArm(robot, 1), robot.muscles[MUSCLE]
    arm.step(3.0)
    estimator, hold = Estimator(robot), arm.sense().muscles.length
    estimator.use(replace(calibrated, anomaly=None))
    arm.faults.set([f'slack:{name}:0.05', f'winch_speed:{name}:{speed}'])
    slack = 0
    for n in range(round((0.05 / speed + 1.0) / DT)):
        if commanded:
            arm.command_length(hold)
            estimator.commanded(n * DT, length=hold)
        read = arm.sense().muscles
        slack += read.tension[MUSCLE] < 1.0
        estimator.take(read, n * DT, n * DT)
        assert not estimator.cause
        arm.step(DT)
    assert slack * DT > 0.5
