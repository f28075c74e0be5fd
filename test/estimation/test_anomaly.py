# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

import numpy as np
import pytest

from musculoskeletal_ae.estimation.anomaly import (
    DEAD_TIME,
    DISTANCE,
    IN_A_ROW,
    NORM,
    AnomalyDetector,
)
from musculoskeletal_ae.estimation.settings import Detection
from musculoskeletal_ae.mae.units import State

DT = 0.01


@pytest.fixture
def judge(robot):
    """Return a function that shows a detector with a network a message so many times."""

    def make(mae, threshold=0.0, preset='default'):
        detector = AnomalyDetector(robot, Detection(threshold), preset)
        detector.use(mae)

        def verdicts(message, times=1):
            state = mae.estimate(*message)
            return [detector.step(state, message.tension, *message, DT) for _ in range(times)]

        return detector, verdicts

    return make


def test_a_is_the_papers_sum_of_two_norms_in_scaled_units(mae, judge, wound):
    state = mae.estimate(*wound)
    tension = np.linalg.norm((state.tension - wound.tension) / 200.0)
    length = np.linalg.norm((state.length - wound.length) * 10.0)
    _, verdicts = judge(mae)
    assert verdicts(wound)[0].anomaly == pytest.approx(tension + length, rel=1e-12)


def test_d_is_the_distance_in_healthy_standard_deviations(mae, judge, wound):
    state, statistics = mae.estimate(*wound), mae.anomaly
    error = np.concatenate(
        [(state.tension - wound.tension) / 200.0, (state.length - wound.length) * 10.0]
    )
    centred = error - statistics.mean
    expected = np.sqrt(centred @ np.linalg.solve(statistics.covariance, centred))
    _, verdicts = judge(mae)
    assert verdicts(wound)[0].distance == pytest.approx(expected, rel=1e-6)


def test_without_statistics_there_is_no_distance(mae, judge, wound):
    _, verdicts = judge(replace(mae, anomaly=None))
    (verdict,) = verdicts(wound)
    assert np.isnan(verdict.distance) and np.isfinite(verdict.anomaly) and not verdict.cause


def test_statistics_of_the_geometric_model_detect_no_anomaly(mae, judge, wound):
    detector, verdicts = judge(mae)
    assert not detector.calibrated
    assert not any(verdict.cause for verdict in verdicts(wound, 3 * IN_A_ROW))


@pytest.mark.parametrize(('threshold', 'named'), [(0.0, 'd = '), (0.2, 'A = ')])
def test_an_anomaly_takes_five_messages_in_a_row(
    calibrated, judge, healthy, wound, threshold, named
):
    _, verdicts = judge(calibrated, threshold)
    assert not any(verdict.cause for verdict in verdicts(healthy, IN_A_ROW))
    assert not any(verdict.cause for verdict in verdicts(wound, IN_A_ROW - 1))
    assert not verdicts(healthy)[0].cause
    judged = verdicts(wound, IN_A_ROW)
    assert not any(verdict.cause for verdict in judged[:-1])
    assert judged[-1].cause.startswith(named)
    assert judged[-1].suspect == 1


def test_a_reset_starts_the_count_anew(calibrated, judge, wound):
    detector, verdicts = judge(calibrated)
    verdicts(wound, IN_A_ROW - 1)
    detector.reset()
    assert not verdicts(wound)[0].cause


@pytest.mark.parametrize('by_length', [True, False])
def test_a_muscle_without_its_commanded_tension_is_an_anomaly(mae, judge, slack, by_length):
    detector, verdicts = judge(mae)
    messages = round(DEAD_TIME / DT) + 1
    assert not any(verdict.cause for verdict in verdicts(slack, messages))  # no command: no demand
    if by_length:
        detector.commanded(length=slack.length - 0.003)
    else:
        detector.commanded(tension=np.full(6, 60.0))
    judged = verdicts(slack, messages)
    assert not judged[0].cause
    assert 'no tension' in judged[-1].cause and judged[-1].suspect == 2


def test_a_muscle_that_is_paid_out_to_no_tension_is_no_anomaly(robot, mae, judge, slack):
    detector, verdicts = judge(mae)
    detector.commanded(tension=np.full(6, 0.5 * robot.tension.bias))
    assert not any(verdict.cause for verdict in verdicts(slack, 100))


@pytest.mark.parametrize('moves', [True, False])
def test_shortening_by_motion_of_the_arm_does_not_count_as_slack_taken_up(robot, mae, judge, moves):
    detector, _ = judge(mae)
    steps = round(1.6 * DEAD_TIME / DT)
    theta = np.linspace(robot.lower, robot.upper, steps)
    length = robot.routes.relative_lengths(theta)
    shortest = int((length[-1] - length[0]).argmin())
    length = length[:, shortest]
    assert (np.diff(length) < 0.0).all() and length[0] - length[-1] > Detection().slack_length
    tension, causes = np.full(6, 60.0), set()
    tension[shortest] = 0.0
    for n in range(steps):
        at = theta[n] if moves else theta[0]
        each = robot.muscle_lengths(at, tension)
        each[shortest] = length[n]
        detector.commanded(length=each - 0.01)
        causes.add(detector.step(State(at, tension, each), tension, tension, each, DT).cause)
    assert causes == ({''} if moves else {'', 'no tension where the command demands it'})


@pytest.mark.parametrize(
    ('away', 'most', 'cut', 'found'),
    [
        (0.0, 0.5, 0, True),
        (0.5, 0.5, 0, False),
        (0.5, 0.5, 1, True),
        (0.0, 1.5, 0, False),
        (0.0, 1.5, 1, True),
    ],
)
def test_the_distance_counts_less_far_from_calibrated_postures_except_for_a_slack_muscle(
    robot, calibrated, judge, healthy, away, most, cut, found
):
    tension = np.where(np.arange(6) == 0, most * robot.tension.limit, healthy.tension)
    message = healthy._replace(tension=tension * (1.0 - cut * np.eye(6)[2]))
    state = calibrated.estimate(*message)
    distance = judge(calibrated)[1](message)[0].distance
    known = state.theta[None] + away * (robot.upper - robot.lower)
    statistics = replace(calibrated.anomaly, postures=known, thresholds={DISTANCE: 0.8 * distance})
    detector, verdicts = judge(replace(calibrated, anomaly=statistics))
    assert (detector.unfamiliar(state.theta) > 1.0) == bool(away)
    assert any(verdict.cause for verdict in verdicts(message, IN_A_ROW)) == found


@pytest.mark.parametrize('known', [True, False])
def test_preset_paper_decides_by_a_alone_once_it_is_calibrated(
    calibrated, judge, healthy, wound, slack, known
):
    largest = judge(calibrated)[1](healthy)[0].anomaly
    statistics = replace(calibrated.anomaly, thresholds={NORM: largest}, calibrated=known)
    detector, verdicts = judge(replace(calibrated, anomaly=statistics), preset='paper')
    detector.commanded(tension=np.full(6, 60.0))
    judged = verdicts(wound, IN_A_ROW)[-1]
    assert judged.cause.startswith('A = ') if known else not judged.cause
    detector.reset()
    assert not any(verdict.cause for verdict in verdicts(healthy, IN_A_ROW))
    detector.settings = Detection(1e6)  # as large as no A is: no physics comes to its aid
    assert not any(verdict.cause for verdict in verdicts(slack, round(2 * DEAD_TIME / DT)))


@pytest.mark.parametrize('kind', ['length', 'tension'])
@pytest.mark.parametrize('wound', [-0.01, 0.01])
def test_a_winch_that_does_not_follow_its_command_is_jammed(robot, mae, wound, kind):
    detector, rng, named = AnomalyDetector(robot), np.random.default_rng(0), []
    detector.use(mae)
    theta, tension = np.array([0.1, -1.0]), np.where(np.arange(6) == 3, 100.0, 60.0)
    state = State(theta, tension, mae.lengths(theta, tension))
    reported = np.where(np.arange(6) == 3, tension - 1e4 * wound, tension).clip(30.0)
    for n in range(300):
        length = state.length + 1e-4 * rng.standard_normal(6)
        length[0] -= 0.01 * n * (n < 200) / 200  # another lags behind its command, but moves
        reported[0] = 140.0 if n < 200 else 60.0
        command = {'length': length - (reported - 30.0) / 1e4, 'tension': reported}
        detector.commanded(**{kind: command[kind]})
        verdict = detector.step(state, tension, tension, length, 0.01)
        named += [(n, verdict.suspect)] * ('its winch stands' in verdict.cause)
    assert named
    assert {suspect for _, suspect in named} == {3}
    assert 95 <= named[0][0] <= 110
