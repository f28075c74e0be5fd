# SPDX-License-Identifier: Apache-2.0

from contextlib import suppress
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from readings import reading

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation import health
from musculoskeletal_ae.estimation.detectors.missing_values import SILENT
from musculoskeletal_ae.estimation.detectors.slack_tendon import DEAD_TIME
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.estimation.finding import Detector
from musculoskeletal_ae.estimation.module_commands import COMMAND_AGE
from musculoskeletal_ae.exceptions import MessageError, MusculoskeletalError
from musculoskeletal_ae.mae.residuals import TouchStatistics
from musculoskeletal_ae.messages.arrival import INTERRUPTION, SILENCE
from musculoskeletal_ae.signals.muscle_stream import RejectionError
from musculoskeletal_ae.signals.reading_limits import LIMITS

DT = 0.01


def states(message):
    """Return l, T and temperature (3, M) of a message."""
    return np.array([message.length, message.tension, np.full(6, 25.0)])


class EstimatorBench:
    """An estimator and both of its clocks."""

    def __init__(self, robot, mae) -> None:
        self.core, self.now = Estimator(robot), 100.0
        self.core.use(mae)

    def step(self, message, times=1, dt=DT):
        """Process a message `times` times, `dt` seconds apart; return the estimates."""
        estimates = []
        for _ in range(times):
            self.now += dt
            estimates.append(self.core.take(reading(states(message)), self.now, self.now))
        return estimates

    def found(self, message, times, dt=DT):
        """Process a message `times` times; return after each one whether there is an anomaly."""
        found = []
        for _ in range(times):
            self.step(message, 1, dt)
            found.append(self.core.body.has_anomaly)
        return found

    def move(self, message):
        """Change the lengths gradually to those of a message, as fast as a muscle can."""
        before = self.core.sample.length_read
        for share in np.linspace(0.0, 1.0, 21):
            length = before + share * (message.length - before)
            self.step(message._replace(length=length))

    def report(self):
        return self.core.report(self.now)


@pytest.fixture
def stepped(robot, calibrated):
    return EstimatorBench(robot, calibrated)


def test_the_estimator_waits_for_a_checkpoint(robot, healthy):
    core = Estimator(robot)
    assert core.take(reading(states(healthy)), 0.0, 0.0) is None
    (condition,) = core.conditions(0.0)
    assert condition.identifier == 'no_checkpoint' and condition.level == 'warn'


def test_the_estimate_is_the_networks(stepped, calibrated, healthy):
    (estimate,) = stepped.step(healthy)
    expected = calibrated.estimate(*healthy)
    for got, want in zip(estimate.state, expected, strict=True):
        np.testing.assert_array_equal(got, want)


def test_the_report_says_whether_it_estimates_and_whether_the_detector_is_calibrated(
    stepped, mae, healthy
):
    stepped.step(healthy)
    assert (stepped.report().level, stepped.report().message) == ('ok', 'estimating')
    stepped.core.use(replace(mae, version=7))
    report = stepped.report()
    assert (report.level, report.message) == ('ok', 'estimating, uncalibrated')
    assert report.values['checkpoint version'] == '7'


def test_a_network_with_singular_statistics_is_refused_and_the_one_in_use_stays(
    stepped, calibrated, healthy
):
    singular = replace(calibrated.anomaly, covariance=np.zeros((12, 12)))
    with pytest.raises(np.linalg.LinAlgError):
        stepped.core.use(replace(calibrated, version=9, anomaly=singular))
    assert stepped.core.mae is calibrated
    assert np.isfinite(stepped.step(healthy)[0].anomaly)


@pytest.mark.parametrize('dt', [0.01, 0.002, 0.001])
def test_an_anomaly_is_detected_within_50_ms_at_any_rate(stepped, wound, dt):
    found = stepped.found(wound, round(0.1 / dt), dt)
    assert (found.index(True) + 1) * dt < 0.0501


def test_late_messages_that_arrive_together_are_all_checked(stepped, wound):
    stepped.step(wound)
    stepped.now += 0.05
    detected = []
    for late in (0.04, 0.03, 0.02, 0.01, 0.0):  # sent 10 ms apart, received 0.1 ms apart
        stepped.now += 0.0001
        message = reading(states(wound))
        stepped.core.take(message, stepped.now, stepped.now, late)
        detected.append(stepped.core.body.has_anomaly)
    assert detected == [False, False, False, True, True]


@pytest.mark.parametrize('dt', [0.01, 0.002])
def test_a_jump_of_lengths_is_found_at_any_rate(stepped, healthy, dt):
    stepped.step(healthy, 20, dt)
    jumped = healthy._replace(length=healthy.length + 0.05)
    for _ in range(round(2.0 * LIMITS.settled / dt)):
        with suppress(RejectionError):
            stepped.step(jumped, 1, dt)
    assert stepped.core.suspects.finding.kind is ConditionKind.LENGTHS_JUMPED


def test_an_anomaly_is_latched_with_its_first_suspect(stepped, robot, healthy, wound):
    assert stepped.found(wound, 10) == [False] * 4 + [True] * 6
    suspect = robot.muscles[1]
    assert stepped.core.cause.startswith(f'{suspect}: ')
    stepped.move(healthy)
    stepped.step(healthy, 10)
    report = stepped.report()
    assert report.level == 'error' and suspect in report.message
    assert report.values['suspect muscle'] == suspect
    stepped.core.reset()
    assert stepped.report().level == 'ok'
    stepped.move(wound)
    with pytest.raises(MusculoskeletalError, match='shorter than'):
        stepped.core.reset()  # the muscle is not repaired
    assert stepped.core.cause


def test_a_jump_of_the_clock_clears_counts_but_not_the_latched_anomaly(stepped, wound):
    stepped.step(wound, 4)
    stepped.core.clock_jumped_back()
    assert stepped.found(wound, 5) == [False] * 4 + [True]
    stepped.core.clock_jumped_back()
    assert stepped.core.cause


def test_an_old_command_makes_no_muscle_a_suspect(robot, mae, slack):
    stepped = EstimatorBench(robot, mae)
    stepped.core.commanded(stepped.now, length=slack.length - 0.003)
    stepped.now += COMMAND_AGE
    assert not any(stepped.found(slack, 100))
    stepped.core.commanded(stepped.now, tension=np.full(6, 60.0))
    assert not any(stepped.found(slack, round(DEAD_TIME / DT) - 1))
    stepped.core.commanded(stepped.now, tension=np.full(6, 60.0))
    assert any(stepped.found(slack, 2))


@pytest.mark.parametrize('pause', [10.0, 1.5 * INTERRUPTION])
def test_messages_before_a_pause_are_no_evidence_of_a_muscle_without_tension(
    robot, mae, slack, pause
):
    """If the computer pauses, the modules may not have received the commands in time."""
    stepped = EstimatorBench(robot, mae)
    for _ in range(10):
        stepped.core.commanded(stepped.now + pause, length=slack.length - 0.003)
        assert not any(stepped.found(slack, 1, pause))
        assert not any(stepped.found(slack, round(0.3 * DEAD_TIME / DT)))
    stepped.core.commanded(stepped.now, length=slack.length - 0.003)
    assert any(stepped.found(slack, round(DEAD_TIME / DT)))


@pytest.mark.parametrize(('late', 'found'), [(0.4, False), (0.0, True)])
def test_readings_that_arrive_late_are_compared_with_the_commands_of_their_time(
    robot, mae, healthy, late, found
):
    """The modules follow their commands at once; only the message says how late it is."""
    core, theta, delay = Estimator(robot), 0.5 * (robot.lower + robot.upper), 0.4
    core.use(mae)

    def demand(time):
        return np.full(6, 110.0 + 70.0 * np.sin(4.0 * time))

    for n in range(300):
        now = 100.0 + n * DT
        core.commanded(now, tension=demand(now))
        tension = demand(now - delay)
        length = robot.muscle_lengths(theta, tension)
        states_then = states(healthy._replace(tension=tension, length=length))
        core.take(reading(states_then), now, now, late)
    assert (core.suspects.finding is not None) == found


def message_of(values):
    layout = SimpleNamespace(dim=[], data_offset=0)
    return SimpleNamespace(data=values.ravel(), layout=layout)


@pytest.mark.parametrize('network', [True, False])
def test_a_muscle_without_numbers_is_isolated_only_if_it_lacks_them_in_all_messages_for_a_while(
    robot, mae, healthy, network
):
    core = Estimator(robot)
    core.suspects.isolates = True
    if network:
        core.use(mae)
    sound = states(healthy)
    broken = message_of(np.where(np.arange(6) == 2, np.nan, sound))
    now = 0.0

    def isolates(at):
        with pytest.raises(RejectionError, match='not finite'):
            core.take(broken, at, at)
        return core.body.isolated == (2,)

    # Two bad messages isolate no muscle if three good messages, or a pause of 5 s, lie between
    # them.
    for good, pause in ((3, 0.01), (0, 5.0)):
        assert not isolates(now)
        for _ in range(good):
            now += pause
            core.take(reading(sound), now, now)
        now += max(pause, SILENT)
        assert not isolates(now)
        now += 10.0
    assert not isolates(now)
    n = 0
    while core.body.isolated == () and n < 20:
        n += 1
        isolates(now + 0.01 * n)
    assert core.body.isolated == (2,)
    assert not core.cause  # missing numbers need no verification, so the arm does not stop


def test_several_muscles_without_numbers_isolate_none_because_their_sensors_may_be_sound(
    robot, mae, healthy
):
    core = Estimator(robot)
    core.suspects.isolates = True
    core.use(mae)
    broken = message_of(np.where(np.isin(np.arange(6), (2, 4)), np.nan, states(healthy)))
    for now in np.arange(0.0, 3.0 * SILENT, DT):
        with pytest.raises(RejectionError, match='not finite'):
            core.take(broken, now, now)
    assert core.body.isolated == ()


def test_rejected_muscle_states_are_reported_as_long_as_they_arrive(stepped, healthy):
    def reported():
        conditions = stepped.core.conditions(stepped.now)
        return 'readings_rejected' in [each.identifier for each in conditions]

    broken = healthy._replace(tension=np.full(6, 9e3))
    stepped.step(healthy)
    for _ in range(round(2.0 * LIMITS.glitch / DT)):
        with pytest.raises(RejectionError):
            stepped.step(broken)
    assert reported()
    stepped.now += 0.5 * SILENCE
    assert reported()
    stepped.now += SILENCE  # the driver has ended
    assert not reported()
    with pytest.raises(RejectionError):
        stepped.step(broken)
    assert reported()
    stepped.step(healthy)
    assert not reported()


def test_tendon_friction_that_the_network_has_learned_is_removed_from_the_tensions(
    robot, mae, healthy
):
    friction = np.full(6, 0.1)
    learned = TouchStatistics(friction, np.ones(robot.joint_count))
    stepped = EstimatorBench(robot, replace(mae, touch=learned))
    for _ in range(100):  # every tendon is wound in
        healthy = healthy._replace(length=healthy.length - 1e-4)
        (output,) = stepped.step(healthy)
    bone = np.exp(-friction) * healthy.tension
    np.testing.assert_allclose(output.sample.bone_tension, bone, rtol=1e-3)
    expected = mae.estimate(bone, healthy.length)
    np.testing.assert_allclose(output.state.theta, expected.theta, atol=1e-3)


def test_a_new_entry_in_the_list_of_detectors_warns_of_rejected_readings_until_a_reset(
    robot, healthy, monkeypatch
):
    class HasReadNan(Detector):
        def __init__(self, _):
            self.count = 0

        def read(self, readings, usable, _):
            self.count += np.count_nonzero(np.isnan(readings.length) & usable)

        def accept(self):
            self.count = 0

        def conditions(self):
            if self.count:
                yield ConditionKind.OTHER_MOUNTING.condition(f'{self.count} readings')

    monkeypatch.setattr(health, 'MountingCheck', HasReadNan)
    core = Estimator(robot)  # without a network
    broken = states(healthy)
    broken[0, 2] = np.nan

    def warnings(now):
        report = core.report(now).conditions
        return [each.text for each in report if each.identifier == 'other_mounting']

    core.take(reading(states(healthy)), 0.0, 0.0)
    assert not warnings(0.0)
    with pytest.raises(RejectionError):
        core.take(message_of(broken), DT, DT)
    assert [text.rpartition(': ')[2] for text in warnings(DT)] == ['1 readings']
    core.reset()
    assert not warnings(DT)


@pytest.mark.parametrize('row', [0, 1])
def test_an_isolated_muscle_whose_sensor_reads_nan_is_used_again_after_its_repair(
    robot, mae, healthy, row
):
    """Without the check, a reading of 0 in place of NaN would pass for a slack tendon."""
    core, sound, broken = Estimator(robot), states(healthy), states(healthy)
    broken[row, 2] = np.nan
    core.use(mae)
    core.isolate([2])
    core.take(message_of(broken), 0.0, 0.0)
    with pytest.raises(MusculoskeletalError, match='a sensor reports NaN instead of a number; re'):
        core.restore([2])
    assert core.body.isolated == (2,)
    for n in range(1, 10):
        core.take(reading(sound), 0.01 * n, 0.01 * n)
    core.restore([2])
    assert core.body.isolated == ()


def test_a_marker_pose_gives_the_joint_angles_that_reach_it(stepped, robot, healthy):
    stepped.step(healthy)
    theta = robot.lower + 0.4 * (robot.upper - robot.lower)
    observed = stepped.core.posture_of_marker(robot.kinematics.end_effector_pose(theta))
    np.testing.assert_allclose(observed, theta, atol=1e-3)


def test_a_marker_that_the_arm_cannot_reach_is_refused(stepped):
    with pytest.raises(MessageError, match='out of reach'):
        stepped.core.posture_of_marker(pin.SE3(np.eye(3), np.array([3.0, 0.0, 0.0])))
