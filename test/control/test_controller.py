# SPDX-License-Identifier: Apache-2.0
"""The whole controller without an arm: the test provides sensor data and time."""

from itertools import islice, pairwise

import numpy as np
import pytest
from control_bench import COLD, DT, OTHER, REST, ROBOT, Bench, settled, values
from exact_mae import ExactMae, rest_readings
from hypothesis import example, given, settings
from hypothesis import strategies as st
from readings import reading

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.settings import METHODS, Settings, Setup
from musculoskeletal_ae.exceptions import MessageError, MusculoskeletalError
from musculoskeletal_ae.messages.message_reading import TrajectoryPoints
from musculoskeletal_ae.motion import follower
from musculoskeletal_ae.motion.activities import LENGTH, TENSION
from musculoskeletal_ae.motion.exploration import Exploration
from musculoskeletal_ae.motion.feedback import REPLAN
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import LengthOffsets

EVENTS = {
    'target': lambda bench: bench.target(OTHER),
    'back': lambda bench: bench.target(REST, (0.5, -0.2)),
    'explore': lambda bench: bench.core.explore(True),
    'end': lambda bench: bench.core.explore(False),
    'stop': lambda bench: bench.stop(),
    'reset': lambda bench: bench.core.reset(bench.now),
    'swap': lambda bench: bench.core.use(shifted()),
    'moved': lambda bench: setattr(bench, 'theta', REST + 0.1),
    **{
        name: lambda bench, name=name: bench.configure(method=name)
        for name in METHODS
        if name not in ('tension', 'float')
    },
}


def shifted():
    mae = ExactMae(ROBOT)
    mae.offset = 0.01
    return mae


@settings(max_examples=15)
@given(st.lists(st.tuples(st.sampled_from(sorted(EVENTS)), st.integers(0, 60)), max_size=8))
@example([('moved', 1)])  # during the first motion
def test_length_commands_are_finite_and_keep_the_rate_limit_under_any_sequence_of_events(events):
    bench = Bench(first_duration=1.0, second_duration=0.5)
    bench.target(REST)
    sent = bench.step()
    for name, steps in events:
        EVENTS[name](bench)
        sent += bench.step(steps)
    lengths = values(sent)
    assert np.isfinite(lengths).all()
    if len(lengths) > 1:
        assert np.abs(np.diff(lengths, axis=0)).max() <= bench.core.settings.rate_limit * DT + 1e-9


@pytest.mark.parametrize('method', [name for name in METHODS if name != 'float'])
def test_every_method_arrives_at_its_command_and_stays_there(method):
    bench = Bench(method=method, first_duration=0.5, second_duration=0.5)
    bench.target(REST)
    sent = bench.step(200)
    kind = TENSION if method == 'tension' else LENGTH
    assert {command.kind for command in sent} == {kind}
    np.testing.assert_allclose(sent[-1].value, sent[-2].value, atol=1e-6 if kind == LENGTH else 0.1)
    assert bench.report().message == 'holding'


def test_the_first_command_demands_the_tension_that_the_muscles_have():
    bench = Bench()
    bench.tension = np.linspace(35.0, 90.0, ROBOT.muscle_count)
    bench.target(OTHER)
    first = bench.step()[0].value
    length = ROBOT.muscle_lengths(REST, bench.tension)
    np.testing.assert_allclose(first, length - (bench.tension - 30.0) / ROBOT.stiffness, atol=1e-4)


def test_second_runs_after_first_and_reads_the_tension_once():
    bench = Bench(method='second', first_duration=1.0, second_duration=0.5)
    bench.target(REST)
    bench.step(95)
    bench.tension = np.full(ROBOT.muscle_count, 80.0)
    done = bench.step(200)[-1].value
    wanted = ROBOT.muscle_lengths(REST, bench.tension) - 50.0 / ROBOT.stiffness
    np.testing.assert_allclose(done, wanted, atol=1e-9)
    # For a new network, the controller computes the lengths of the held target again. It uses the
    # tension that was measured when the target was reached, not the present one.
    bench.tension = np.full(ROBOT.muscle_count, 150.0)
    bench.core.use(shifted())
    np.testing.assert_allclose(bench.step(200)[-1].value, wanted + 0.01, atol=1e-9)


def test_second_runs_after_first_even_if_the_rate_limit_makes_first_take_longer():
    bench = Bench(method='second', first_duration=0.1, second_duration=0.1, rate_limit=0.02)
    near = REST + 0.1
    bench.target(near)
    bench.step(30)  # the arm is still on its way
    bench.tension = np.full(ROBOT.muscle_count, 80.0)
    done = bench.step(300)[-1].value
    wanted = ROBOT.muscle_lengths(near, bench.tension) - 50.0 / ROBOT.stiffness
    np.testing.assert_allclose(done, wanted, atol=1e-9)


def test_method_first_plans_with_the_tension_bias():
    bench = Bench(method='first', first_duration=1.0)
    bench.target(REST)
    wanted = ROBOT.muscle_lengths(REST, ROBOT.tension.bias)
    np.testing.assert_allclose(bench.step(200)[-1].value, wanted, atol=1e-9)


def test_changing_between_length_and_tension_commands_causes_no_step_in_tension():
    bench = settled(first_duration=0.5)
    (sent,) = bench.step()
    length, _ = rest_readings(ROBOT, REST)
    demand = ROBOT.actuation.demanded(length, sent.value)
    bench.configure(method='tension')
    first = bench.step()[0]
    assert first.kind == TENSION
    most = ROBOT.stiffness[0] * bench.core.settings.rate_limit * DT
    assert np.abs(first.value - demand).max() <= most + 1e-9
    bench.configure(method='proposed')
    back = bench.step()[0]
    assert back.kind == LENGTH
    assert np.abs(ROBOT.actuation.demanded(length, back.value) - first.value).max() <= most + 1e-9
    assert np.abs(back.value - sent.value).max() <= 2.0 * bench.core.settings.rate_limit * DT + 1e-9


def test_an_effort_is_exerted_by_proposed_and_reported_as_ignored_by_first():
    bench = settled(first_duration=0.5)
    plain = bench.step()[-1].value
    bench.target(REST, (1.0, 0.0))
    assert np.abs(bench.step(100)[-1].value - plain).max() > 1e-4
    bench.configure(method='first')
    bench.step()
    assert 'the effort of the target is ignored' in bench.report().message


def test_a_target_beyond_the_limits_is_clamped_and_joints_not_named_keep_theirs():
    bench = Bench()
    bench.target([-0.2, -0.7])
    bench.core.target({ROBOT.joints[1]: (-9.0, 0.0)})
    np.testing.assert_array_equal(bench.core.target_state.theta, [-0.2, ROBOT.lower[1]])
    bench.step()
    assert bench.report().values['target clamped at'] == ROBOT.joints[1]
    assert f'joint limits: {ROBOT.joints[1]}' in bench.report().message
    bench.core.target({ROBOT.joints[1]: (-1.0, 0.0)})
    assert 'target clamped at' not in bench.report().values


@pytest.mark.parametrize('what', ['muscles', 'estimate'])
def test_stale_sensor_data_stop_the_arm_and_a_reset_is_refused_while_they_are_stale(what):
    bench = Bench(max_age=0.2)
    bench.target(REST)
    bench.step(50)
    bench.blind = {what}
    bench.step(15)
    assert bench.cause == ''
    assert None not in bench.step(10)  # the controller continues to send commands
    assert 'for 0.2 s' in bench.condition
    assert 'no usable' in str(bench.core.reset(bench.now))
    bench.blind = set()
    bench.step(2)
    assert bench.cause
    assert bench.core.reset(bench.now) is None
    assert bench.cause == ''


def test_an_estimate_that_is_only_repeated_becomes_stale():
    bench = Bench(max_age=0.2)
    bench.target(REST)
    bench.step(50)
    bench.blind = {'estimate'}
    for _ in range(25):
        bench.core.estimated(bench.theta, bench.now, is_new=False)
        bench.step()
    assert bench.cause == 'stale_estimate'


def test_an_anomaly_stops_the_arm_even_before_the_first_command():
    bench = Bench()
    bench.find()
    bench.target(REST)
    assert bench.step(3) == [None] * 3
    bench.end_anomaly()
    assert bench.step(3) == [None] * 3
    assert bench.core.reset(bench.now) is None
    assert None not in bench.step(3)


@pytest.mark.parametrize('during', ['request', 'step'])
def test_an_exception_in_the_controller_stops_the_arm_and_the_controller_goes_on(during):
    bench = settled(first_duration=0.5)
    if during == 'step':
        bench.target(OTHER)
    bench.mae.fail = ZeroDivisionError()
    if during == 'request':
        bench.target(OTHER)
    assert None not in bench.step(50)
    assert 'ZeroDivisionError' in bench.condition
    bench.mae.fail = None
    assert bench.core.reset(bench.now) is None
    np.testing.assert_array_equal(bench.core.target_state.theta, OTHER)
    bench.step(300)
    assert bench.report().message == 'holding'


def test_a_network_that_answers_nan_stops_the_arm_and_no_command_is_nan():
    bench = settled(first_duration=0.5)
    broken = ExactMae(ROBOT)
    broken.offset = np.nan
    bench.core.use(broken)
    assert np.isfinite(values(bench.step(50))).all()
    assert bench.cause
    bench.core.use(ExactMae(ROBOT))
    assert bench.core.reset(bench.now) is None
    bench.step(100)
    assert bench.cause == ''


def test_after_reset_the_last_target_is_resumed_by_a_ramp(monkeypatch):
    monkeypatch.setattr(follower, 'FEEDBACK_GAIN', 0.0)
    bench = Bench(first_duration=0.5)
    bench.target(OTHER)
    goal = bench.step(200)[-1].value
    bench.stop()
    bench.step(150)
    assert bench.core.reset(bench.now) is None
    np.testing.assert_allclose(bench.step(200)[-1].value, goal, atol=1e-9)


@pytest.mark.parametrize('method', sorted(set(METHODS) - {'float'}))
def test_every_method_follows_a_trajectory_once_and_then_holds_its_end(method):
    bench = settled(method=method, first_duration=0.5, second_duration=0.5)
    way = TrajectoryPoints(np.arange(2), np.array([0.5, 1.0]), np.array([REST, OTHER]), None, None)
    bench.core.trajectory(way)
    followed, sent = bench.follower.progress.latest, []
    while bench.core.supervisor.mode != 'holding':
        sent += bench.step()
        bench.theta = bench.follower.progress.desired.theta.copy()
    assert {command.kind for command in sent} == {LENGTH}
    assert len(sent) == pytest.approx(followed.duration / DT, abs=2)
    np.testing.assert_allclose(bench.theta, OTHER)
    sent += bench.step(200)
    is_by_tension = METHODS[method].commands_tension
    assert sent[-1].kind == (TENSION if is_by_tension else LENGTH)
    assert bench.report().message == 'holding'
    bench.configure(method='stiffness' if method == 'proposed' else 'proposed')
    sent += bench.step(50)
    assert bench.follower.progress.latest is not followed
    np.testing.assert_allclose(bench.follower.progress.desired.theta, OTHER)
    for former, later in pairwise(sent):
        if former.kind == later.kind:
            rate = bench.core.settings.rate_limit * (1.0 if later.kind == LENGTH else 1e4)
            assert np.abs(later.value - former.value).max() <= rate * DT + 1e-9


@pytest.mark.parametrize('steps', [0, 1, 30])  # before and during the trajectory
@pytest.mark.parametrize('delay', [0.0, 0.1])
@pytest.mark.parametrize('stopped', [0, 30])
def test_after_a_stop_no_trajectory_goes_on_from_where_it_was(steps, delay, stopped):
    bench = settled(first_duration=3.0)
    points = TrajectoryPoints(
        np.arange(2), np.array([0.5, 1.0]), np.array([REST, OTHER]), None, None
    )
    bench.core.trajectory(points, delay)
    bench.step(steps)
    former = bench.follower.progress.latest
    bench.stop()
    bench.step(stopped)
    assert bench.core.reset(bench.now) is None
    bench.step()
    resumed = bench.follower.progress.latest
    assert resumed is not former and resumed.duration >= 3.0
    np.testing.assert_array_equal(resumed.end, OTHER)
    np.testing.assert_array_equal(resumed.start.theta, bench.theta)


def test_a_target_or_a_stop_ends_exploration_and_a_stop_refuses_it():
    bench = Bench()
    assert bench.core.explore(True) == ''
    bench.step(10)
    assert bench.report().message == 'exploring'
    bench.target(REST)
    assert not bench.core.supervisor.explores
    bench.core.explore(True)
    bench.stop()
    assert 'controller/stop' in bench.core.explore(True)
    assert bench.core.reset(bench.now) is None
    assert not bench.core.supervisor.explores
    assert bench.core.target_state.theta is None


def test_exploration_started_again_continues_its_stream_of_postures():
    bench = Bench()
    observed = []
    for _ in range(3):
        bench.core.explore(True)
        bench.core.explore(True)  # a second request does not restart the exploration
        bench.step(5)
        observed.append(bench.core.activities.ramps.solution.length)
        bench.core.explore(False)
        bench.step(5)
    assert len({tuple(length) for length in observed}) == 3


@pytest.mark.parametrize(('preset', 'sends'), [('default', True), ('paper', False)])
def test_the_preset_decides_whether_exploration_takes_joints_to_their_limits(preset, sends):
    goals = islice(Exploration(Setup(ROBOT, Settings(preset=preset)), 0), 30)
    at_limit = [(goal.theta == ROBOT.lower) | (goal.theta == ROBOT.upper) for goal in goals]
    assert np.any(at_limit) == sends


def test_a_subset_of_joints_waits_until_the_posture_of_the_others_is_known():
    bench = Bench()
    with pytest.raises(MessageError, match='no posture estimated yet'):
        bench.core.target({ROBOT.joints[0]: (0.1, 0.0)})
    bench.step()
    bench.core.target({ROBOT.joints[0]: (0.1, 0.0)})
    np.testing.assert_allclose(bench.core.target_state.theta, [0.1, REST[1]])


def test_a_target_of_one_joint_ends_exploring_and_leaves_the_others_where_they_are():
    bench = Bench()
    for ends in (lambda: None, lambda: bench.core.explore(False), bench.stop):
        bench.core.explore(True)
        bench.step(5)
        assert bench.core.supervisor.explores
        ends()
        bench.core.target({ROBOT.joints[0]: (0.1, 0.0)})
        np.testing.assert_allclose(bench.core.target_state.theta, [0.1, REST[1]])
        bench.core.reset(bench.now)


def test_a_hot_muscle_hands_its_load_to_others_and_is_reported():
    robot = Robot.load('musashi_left_arm')
    theta = np.array([0.2, -0.6, 0.1, -1.2, 0.0])
    core = Controller(robot, Settings(first_duration=1.0))
    core.use(ExactMae(robot))
    core.target(dict(zip(robot.joints, ((v, 0.0) for v in theta))))
    length, tension = rest_readings(robot, theta)
    temperature = np.full(robot.muscle_count, 30.0)
    planned = []
    for step in range(300):
        if step == 75:
            strongest = int(np.argmax(core.activities.follower.plan.bone_tension))
            temperature[strongest] = 84.0
        core.take(reading([length, tension, temperature]), 0.04 * step)
        core.estimated(theta, 0.04 * step)
        core.step(0.04 * step)
        planned.append(core.activities.follower.plan.bone_tension)
    limit = core.watchdog.heat.planned[strongest]
    assert limit < planned[74][strongest]
    assert planned[-1][strongest] <= limit + REPLAN
    reported = core.report(12.0)
    assert reported.level == 'warn'
    assert robot.muscles[strongest] in reported.values['tension limited by heat']


def test_a_muscle_without_a_measured_temperature_is_reported_as_not_protected():
    bench = Bench()
    bench.step(20)
    assert 'not protected from heat' not in bench.report().values
    bench.temperature = np.full(ROBOT.muscle_count, np.nan)
    bench.step(20)
    values = bench.report().values
    assert values['not protected from heat'] == 'no temperature is measured for any muscle'
    assert 'temperature of windings' not in values
    assert (bench.core.watchdog.heat.planned == ROBOT.tension.max).all()


def test_a_stop_is_reported_with_every_cause_that_refuses_the_reset():
    bench = Bench()
    bench.core.stop(ConditionKind.OPERATOR)
    bench.core.watchdog.second_publisher = 'two estimators'
    bench.now += 10.0  # no message arrives in this time
    reported = bench.report()
    assert reported.values['stop cause'] == 'operator_stop'
    for cause in (
        'controller/stop',
        'another node publishes for this arm, or has the same name: two estimators',
        'no usable muscle_states',
    ):
        assert f'stopped: {cause}' in reported.message
    steps = bench.steps()
    assert {'check_driver', 'stop_second_publisher'} <= set(steps)
    assert 'check_estimator' not in steps  # without readings there are no estimates
    assert steps[-1] == 'reset_controller'
    assert bench.core.reset(bench.now).identifier == 'second_publisher'


@pytest.mark.parametrize('silent', [False, True])
def test_after_a_stop_of_the_exploration_the_remedy_ends_with_exploring_again(silent):
    bench = Bench(max_age=0.2, hold_time=0.5)
    bench.core.explore(True)
    bench.step(50)
    if silent:  # stale data are an auto-recoverable cause, until the arm has been released
        bench.blind = {'muscles'}
        bench.step(80)
        assert bench.cause == 'stale_muscle_states'
    else:
        bench.stop()
    assert bench.steps()[-2:] == ['reset_controller', 'explore']
    bench.core.explore(False)
    assert 'explore' not in bench.steps()


@pytest.mark.parametrize('go_on', ['explore', 'end', 'target'])
def test_an_arm_that_no_longer_explores_says_so_until_a_request(go_on):
    bench = Bench(max_age=0.2, hold_time=0.5)
    bench.core.explore(True)
    bench.step(50)
    bench.stop()
    bench.step(50)
    assert bench.core.reset(bench.now) is None
    bench.blind = {'muscles'}
    bench.step(30)
    assert bench.core.supervisor.mode == 'paused'
    reason = bench.core.explore(True)  # refused, but a second try will do
    assert reason.startswith('paused: no usable muscle_states') and 'try again' in reason
    bench.blind = set()
    bench.step(50)
    assert bench.report().level == 'warn' and bench.steps() == ['explore']
    bench.stop()  # a second stop does not hide it
    assert bench.steps()[-2:] == ['reset_controller', 'explore']
    bench.step(50)
    assert bench.core.reset(bench.now) is None
    requests = {
        'explore': lambda: bench.core.explore(True),
        'end': lambda: bench.core.explore(False),
        'target': lambda: bench.target(REST),
    }
    requests[go_on]()
    bench.step(50)
    assert 'explore' not in bench.steps()


def test_an_exploration_that_cannot_begin_at_the_start_is_reported_after_the_stop():
    bench = Bench()
    bench.stop()
    assert 'controller/stop' in bench.core.explore_at_start()
    bench.step(50)
    assert bench.steps() == ['reset_controller', 'explore']
    assert bench.core.reset(bench.now) is None
    assert bench.steps() == ['explore']
    assert bench.core.explore_at_start() == '' and bench.report().message == 'exploring'


def test_a_stop_for_an_anomaly_needs_only_a_reset_and_the_estimator_states_the_repair():
    bench = Bench()
    bench.target(REST)
    bench.step(50)
    bench.find()
    bench.step(50)
    assert bench.steps() == ['reset_controller']
    bench.end_anomaly()
    bench.step(50)
    assert bench.steps() == ['reset_controller']


def test_a_new_network_keeps_the_correction_of_rest_feedback():
    bench = settled(first_duration=0.5)
    bench.theta = REST + 0.05  # the arm rests beside its target, as friction may cause
    bench.step(200)
    correction = bench.follower.feedback.correction.copy()
    assert np.abs(correction).max() > 0.02
    bench.theta = REST
    bench.core.use(ExactMae(ROBOT))
    bench.step(100)
    np.testing.assert_allclose(bench.follower.feedback.correction, correction)


@pytest.mark.parametrize('chosen', [{'method': 'stiffness'}, {'method': 'second'}])
def test_methods_stiffness_and_second_do_not_correct_a_push(chosen):
    bench = settled(150, first_duration=0.5, second_duration=0.5, **chosen)
    if chosen['method'] == 'stiffness':  # let the sensors read the tensions that it demands
        bench.tension = bench.follower.plan.bone_tension
    still = bench.step(100)[-1].value
    bench.theta = REST + 0.05
    bench.core.estimated(bench.theta, bench.now)
    np.testing.assert_allclose(bench.step(200)[-1].value, still, atol=1e-9)


def test_a_new_desired_stiffness_is_ramped_to_and_one_of_wrong_length_is_refused():
    bench = settled(method='stiffness', first_duration=0.5)
    before = bench.step()[-1].value
    free = bench.follower.plan.solution.stiffness
    stiffer = 0.25 * free.lowest + 0.75 * free.highest
    with pytest.raises(MusculoskeletalError, match='2 numbers'):
        bench.configure(joint_stiffness=(1.0, 2.0, 3.0))
    np.testing.assert_array_equal(bench.step(50)[-1].value, before)
    bench.configure(joint_stiffness=(float(stiffer[0]), 0.0))
    after = values(bench.step(100))
    assert np.abs(np.diff(after, axis=0)).max() <= bench.core.settings.rate_limit * DT + 1e-9
    assert np.abs(after[-1] - before).max() > 1e-4
    planned = bench.follower.plan.solution.stiffness.expected[0, 0]
    assert planned == pytest.approx(stiffer[0], rel=0.01)
    bench.configure(joint_stiffness=(1e3, 0.0))
    bench.step(100)
    assert 'clamped' in bench.report().values[f'joint stiffness {ROBOT.joints[0]}']


def test_a_hot_muscle_limited_to_the_tension_bias_does_not_stop_the_arm():
    for method in set(METHODS) - {'float'}:
        bench = settled(60, method=method, first_duration=0.5)
        bench.dt = 0.05
        bench.temperature = np.linspace(60.0, 100.0, ROBOT.muscle_count)
        bench.target(OTHER)
        bench.step(80)
        assert bench.cause == ''
        assert bench.core.watchdog.heat.planned.min() == ROBOT.tension.bias[0]


def test_gravity_compensation_follows_the_hand_refuses_targets_and_ends_where_the_arm_is():
    bench = settled(first_duration=0.5)
    bench.core.explore(True)
    bench.configure(method='float')
    sent = bench.step(100)
    assert {command.kind for command in sent} == {TENSION}
    assert not bench.core.supervisor.explores and bench.report().message == 'gravity compensation'
    with pytest.raises(MessageError, match='method float'):
        bench.target(OTHER)
    assert 'float' in bench.core.explore(True)
    for share in np.linspace(0.0, 1.0, 50):
        bench.theta = REST + share * (OTHER - REST)
        bench.step()
    bench.configure(method='proposed')
    assert {command.kind for command in bench.step(100)} == {LENGTH}
    np.testing.assert_allclose(bench.core.target_state.theta, OTHER)
    assert bench.report().message == 'holding'


def test_a_posture_from_unknown_lengths_does_not_become_a_target_after_gravity_compensation():
    bench = Bench(method='float')
    bench.step(20)
    unknown = LengthOffsets.unknown(ROBOT.muscle_count)
    bench.core.use_body(bench.core.stream.body.with_offsets(unknown))
    bench.step(20)
    bench.configure(method='proposed')
    bench.core.use_body(
        bench.core.stream.body.with_offsets(LengthOffsets.none(len(unknown.offset)))
    )
    bench.step(20)
    assert bench.core.target_state.theta is None and bench.report().message == 'no target'


def test_a_stop_ends_gravity_compensation_and_a_reset_resumes_it():
    bench = Bench(method='float')
    bench.step(50)
    bench.stop()
    bias = ROBOT.tension.bias
    np.testing.assert_array_equal(bench.step(200)[-1].value, bias)
    assert not bench.core.reset(bench.now)
    assert bench.step(100)[-1].value.max() > bias[0]


def test_a_reset_ends_a_stop_by_late_data_at_once():
    bench = Bench()
    bench.target(REST)
    bench.step(10)
    bench.blind = {'muscles'}
    bench.step(30)
    assert bench.core.supervisor.mode == 'paused'
    bench.blind = set()
    bench.step(2)
    assert bench.core.reset(bench.now) is None
    assert bench.core.supervisor.mode != 'paused'


@pytest.mark.parametrize('method', ['proposed', 'first', 'tension'])
def test_an_arm_without_a_target_gives_way_to_a_push(method):
    bench = settled(method=method)
    bench.core.explore(True)
    bench.step(5)
    bench.core.explore(False)
    bench.step(5)
    for share in np.linspace(0.0, 1.0, 50):
        bench.theta = REST + share * np.array([0.5, 0.6])
        bench.step()
    sent, length = bench.step(100)[-1], bench.core.sample.length
    assert (demanded(sent, length) <= ROBOT.tension.limit + 1e-6).all()


def demanded(command, length):
    """Return the tensions [N] that a command demands of modules at the lengths `length` [m]."""
    by_length = command.kind == LENGTH
    return ROBOT.actuation.demanded(length, command.value) if by_length else command.value


def test_a_target_before_the_first_command_is_kept_while_estimates_are_late():
    bench = Bench()
    bench.step(3)
    bench.blind = {'estimate'}
    bench.step(40)
    bench.target(OTHER)
    bench.blind = set()
    sent = bench.step(30)
    assert any(command is not None for command in sent)
    np.testing.assert_allclose(bench.core.target_state.theta, OTHER)


def test_an_operator_stop_releases_the_arm_although_the_clock_is_slow_and_the_computer_busy():
    bench = settled(method='proposed')
    core, time = bench.core, bench.now
    bench.stop()
    for _ in range(1000):  # 15 s on the steady clock, 3 s on the clock of the messages
        bench.now += 0.015
        time += 0.2 * 0.015
        bench.send(np.array([*rest_readings(ROBOT, REST), COLD]))
        core.estimated(REST, bench.now)
        sent = core.step(bench.now, time)
        core.sent_at = bench.now + 0.012
    assert demanded(sent, core.sample.length) == pytest.approx(ROBOT.tension.bias, abs=1.0)
