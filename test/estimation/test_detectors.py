# SPDX-License-Identifier: Apache-2.0

from copy import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from exact_mae import ExactMae

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.detectors.frozen_sensor import FrozenSensor
from musculoskeletal_ae.estimation.detectors.residual_distance import DISTANCE, IN_A_ROW
from musculoskeletal_ae.estimation.detectors.slack_tendon import DEAD_TIME, SLACK_LENGTH
from musculoskeletal_ae.estimation.health import HealthMonitor
from musculoskeletal_ae.experiments.detection import observe
from musculoskeletal_ae.mae.residuals import NORM
from musculoskeletal_ae.mae.units import State

DT = 0.01


class MonitorBench:
    """A health monitor with a network, and the tensions commanded to its modules."""

    def __init__(self, robot, mae, preset='default'):
        self.mae, self.demand = mae, None
        self.health = HealthMonitor(robot, preset)
        self.health.use(mae)

    def step(self, message, state=None):
        tension, length = message
        demand = self.demand(length) if callable(self.demand) else self.demand
        observation = observe(self.mae, length, tension, tension, DT, demand, state)
        finding = self.health.step(observation)
        return observation.estimate.anomaly, self.health.residual.reading, finding

    def findings(self, message, times=1):
        """Process a message `times` times, and return all findings."""
        return [self.step(message)[2] for _ in range(times)]


@pytest.fixture
def watch(robot):
    def make(mae, preset='default'):
        return MonitorBench(robot, mae, preset)

    return make


def test_a_is_the_papers_sum_of_two_norms_in_scaled_units(mae, watch, wound):
    state = mae.estimate(*wound)
    tension = np.linalg.norm((state.tension - wound.tension) / 200.0)
    length = np.linalg.norm((state.length - wound.length) * 10.0)
    anomaly, _, _ = watch(mae).step(wound)
    assert anomaly == pytest.approx(tension + length, rel=1e-12)


def test_d_is_the_distance_in_healthy_standard_deviations(mae, watch, wound):
    state, statistics = mae.estimate(*wound), mae.anomaly
    error = np.concatenate(
        [(state.tension - wound.tension) / 200.0, (state.length - wound.length) * 10.0]
    )
    centred = error - statistics.mean
    expected = np.sqrt(centred @ np.linalg.solve(statistics.covariance, centred))
    _, reading, _ = watch(mae).step(wound)
    assert reading.distance == pytest.approx(expected, rel=1e-6)


def test_without_statistics_there_is_no_distance(mae, watch, wound):
    anomaly, reading, finding = watch(replace(mae, anomaly=None)).step(wound)
    assert np.isnan(reading.distance)
    assert np.isfinite(anomaly)
    assert finding is None


def test_statistics_of_the_geometric_model_detect_no_anomaly(mae, watch, wound):
    watched = watch(mae)
    assert not watched.health.residual.is_calibrated
    assert not any(watched.findings(wound, 3 * IN_A_ROW))


def test_an_anomaly_takes_five_messages_in_a_row(calibrated, watch, healthy, wound):
    watched = watch(calibrated)
    assert not any(watched.findings(healthy, IN_A_ROW))
    assert not any(watched.findings(wound, IN_A_ROW - 1))
    assert watched.findings(healthy) == [None]
    *before, finding = watched.findings(wound, IN_A_ROW)
    assert not any(before)
    assert (finding.muscle, finding.kind) == (1, ConditionKind.RESIDUAL_DISTANCE)
    assert finding.evidence.startswith('d = ')


def test_a_reset_restarts_the_count(calibrated, watch, wound):
    watched = watch(calibrated)
    watched.findings(wound, IN_A_ROW - 1)
    watched.health.reset()
    assert watched.findings(wound) == [None]


@pytest.mark.parametrize('by_length', [True, False])
def test_a_muscle_without_its_commanded_tension_is_an_anomaly(robot, mae, watch, slack, by_length):
    watched = watch(mae)
    messages = round(DEAD_TIME / DT) + 1
    # Without a command no tension is demanded, so a muscle without tension is no anomaly.
    assert not any(watched.findings(slack, messages))
    watched.demand = np.full(6, 60.0)
    if by_length:
        watched.demand = robot.actuation.demanded(slack.length, slack.length - 0.003)
    findings = watched.findings(slack, messages)
    assert findings[0] is None
    assert (findings[-1].muscle, findings[-1].kind) == (2, ConditionKind.SLACK_TENDON)


def test_a_muscle_that_is_paid_out_to_no_tension_is_no_anomaly(robot, mae, watch, slack):
    watched = watch(mae)
    watched.demand = np.full(6, 0.5 * robot.tension.bias)
    assert not any(watched.findings(slack, 100))


@pytest.mark.parametrize('moves', [True, False])
def test_shortening_by_motion_of_the_arm_does_not_count_as_slack_taken_up(robot, mae, watch, moves):
    watched = watch(mae)
    steps = round(1.6 * DEAD_TIME / DT)
    theta = np.linspace(robot.lower, robot.upper, steps)
    length = robot.routes.relative_lengths(theta)
    shortest = int((length[-1] - length[0]).argmin())
    length = length[:, shortest]
    assert (np.diff(length) < 0.0).all() and length[0] - length[-1] > SLACK_LENGTH
    tension, kinds = np.full(6, 60.0), set()
    tension[shortest] = 0.0
    for n in range(steps):
        at = theta[n] if moves else theta[0]
        each = robot.muscle_lengths(at, tension)
        each[shortest] = length[n]
        watched.demand = robot.actuation.demanded(each, each - 0.01)
        _, _, finding = watched.step((tension, each), State(at, tension, each))
        kinds.add(finding and finding.kind)
    assert kinds == ({None} if moves else {None, ConditionKind.SLACK_TENDON})


@pytest.mark.parametrize(
    ('away', 'most', 'cut', 'is_expected'),
    [
        (0.0, 0.5, 0, True),
        (0.5, 0.5, 0, False),
        (0.5, 0.5, 1, True),
        (0.0, 1.5, 0, False),
        (0.0, 1.5, 1, True),
    ],
)
def test_the_distance_counts_less_far_from_calibrated_postures_except_for_a_slack_muscle(
    robot, calibrated, watch, healthy, away, most, cut, is_expected
):
    tension = np.where(np.arange(6) == 0, most * robot.tension.limit, healthy.tension)
    message = healthy._replace(tension=tension * (1.0 - cut * np.eye(6)[2]))
    state = calibrated.estimate(*message)
    distance = watch(calibrated).step(message)[1].distance
    known = state.theta[None] + away * (robot.upper - robot.lower)
    statistics = replace(calibrated.anomaly, postures=known, thresholds={DISTANCE: 0.8 * distance})
    watched = watch(replace(calibrated, anomaly=statistics))
    assert (watched.health.residual.unfamiliarity(state.theta) > 1.0) == bool(away)
    assert any(watched.findings(message, IN_A_ROW)) == is_expected


@pytest.mark.parametrize('known', [True, False])
def test_preset_paper_decides_by_a_alone_once_it_is_calibrated(
    calibrated, watch, healthy, wound, slack, known
):
    largest, _, _ = watch(calibrated).step(healthy)
    statistics = replace(calibrated.anomaly, thresholds={NORM: largest}, calibrated=known)
    watched = watch(replace(calibrated, anomaly=statistics), preset='paper')
    watched.demand = np.full(6, 60.0)
    finding = watched.findings(wound, IN_A_ROW)[-1]
    assert finding.evidence.startswith('A = ') if known else finding is None
    watched.health.reset()
    assert not any(watched.findings(healthy, IN_A_ROW))
    # A never reaches this threshold, so only the detectors that do not use A could find something.
    # The preset `paper` has none of them.
    statistics = replace(statistics, thresholds={NORM: 1e6})
    watched.health.use(replace(calibrated, anomaly=statistics))
    assert not any(watched.findings(slack, round(2 * DEAD_TIME / DT)))


@pytest.mark.parametrize('kind', ['length', 'tension'])
@pytest.mark.parametrize('wound', [-0.01, 0.01])
def test_a_module_that_does_not_follow_its_command_is_found(robot, mae, watch, wound, kind):
    watched, rng, findings = watch(mae), np.random.default_rng(0), []
    theta, tension = np.array([0.1, -1.0]), np.where(np.arange(6) == 3, 100.0, 60.0)
    state = State(theta, tension, mae.lengths(theta, tension))
    reported = np.where(np.arange(6) == 3, tension - 1e4 * wound, tension).clip(30.0)
    for n in range(300):
        length = state.length + 1e-4 * rng.standard_normal(6)
        length[0] -= 0.2 * DT * min(n, 200)  # muscle 0 lags too, but its winch turns fast
        reported[0] = 140.0 if n < 200 else 60.0
        watched.demand = reported
        if kind == 'length':
            watched.demand = robot.actuation.demanded(length, length - (reported - 30.0) / 1e4)
        _, _, finding = watched.step((tension, length), state)
        if finding is not None and finding.kind is ConditionKind.MODULE_NOT_FOLLOWING:
            findings.append((n, finding.muscle))
    assert findings
    assert {muscle for _, muscle in findings} == {3}
    assert 95 <= findings[0][0] <= 110


class KnowingMae(ExactMae):
    """A network that estimates the true posture θ without some muscles as well as with them."""

    theta, isolated, is_calibrated = np.zeros(2), (), True

    def without(self, isolated):
        reduced = copy(self)
        reduced.isolated = tuple(isolated)
        return reduced

    def estimate(self, *_):
        return SimpleNamespace(theta=KnowingMae.theta)


def test_a_frozen_sensor_is_found_beside_the_constant_reading_of_a_winch_that_stands(robot):
    """Only the elbow moves, so the lengths of the two shoulder muscles stay the same."""
    detector, frozen, found = FrozenSensor(robot), 3, []
    detector.use(KnowingMae(robot))
    tension = np.full(6, 60.0)
    length = start = robot.muscle_lengths(0.5 * (robot.lower + robot.upper), tension)
    for n in range(400):
        elbow = 0.5 * np.sin(0.01 * n)
        KnowingMae.theta = 0.5 * (robot.lower + robot.upper) + np.array([0.0, elbow])
        before, length = length, robot.muscle_lengths(KnowingMae.theta, tension)
        length[[0, 1]] = start[[0, 1]]
        if n >= 50:
            length[frozen] = before[frozen]
        sample = SimpleNamespace(
            length=length,
            length_read=length,
            motor_tension=tension + 0.01 * (n % 7),
            bone_tension=tension,
            usable=np.ones(6, dtype=bool),
        )
        found.append(detector.step(SimpleNamespace(sample=sample, dt=0.01, lengths_known=True)))
    assert {each.muscle for each in found if each is not None} == {frozen}
