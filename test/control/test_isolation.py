# SPDX-License-Identifier: Apache-2.0
"""Control while muscles are isolated, by the other muscles; verification of a suspected muscle."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from control_bench import OTHER, REST, ROBOT, Bench, values
from exact_mae import ExactMae, rest_readings
from readings import reading
from robots import write_robot

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.control.settings import METHODS, Settings, Setup
from musculoskeletal_ae.control.stop_commands import LARGEST_RISE, PAYING_OUT
from musculoskeletal_ae.control.supervisor import LASTING
from musculoskeletal_ae.emulator.faults import SPEED_LIMIT
from musculoskeletal_ae.exceptions import InfeasibleError, MessageError
from musculoskeletal_ae.mae.residuals import LEAST_MOTION, TouchStatistics
from musculoskeletal_ae.messages.message_reading import TrajectoryPoints
from musculoskeletal_ae.motion import holdable_paths
from musculoskeletal_ae.motion.activities import LENGTH, TENSION
from musculoskeletal_ae.motion.feedback import SUPPORT
from musculoskeletal_ae.motion.holdable_paths import FRICTION, lacking
from musculoskeletal_ae.motion.planner import Planner
from musculoskeletal_ae.motion.slowness import slowness
from musculoskeletal_ae.motion.tension_plan import TURNING
from musculoskeletal_ae.motion.trajectory import Setpoint, Trajectory
from musculoskeletal_ae.robot.actuation import DEPTH
from musculoskeletal_ae.robot.joint_stops import AT_STOP, supporting_stops
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import TensionProgramme, least_tension
from musculoskeletal_ae.signals.body_state import BodyState
from musculoskeletal_ae.simulation.simulation import Simulation

LOST = 0
USED = np.arange(ROBOT.muscle_count) != LOST
ROBOT_WITHOUT = ROBOT.without([LOST])
SELDOM = 0.1  # time between messages that makes long motions cheaper [s]


def held(theta, torque=0.0):
    """Return whether the muscles can hold a posture without muscle LOST.

    `torque` is added to the torque that the weight requires [N·m].
    """
    limits, weight = ROBOT.tension, ROBOT.kinematics.holding_torque(theta) + torque
    slope = ExactMae(ROBOT).muscle_jacobian(theta, limits.bias)
    try:
        TensionProgramme(slope, weight, USED * limits.bias, USED * limits.limit).nearest(0.0)
    except InfeasibleError:
        return False
    return True


POSTURES = ROBOT.random_postures(300, np.random.default_rng(0))
THERE = next(theta for theta in POSTURES if held(theta) and np.abs(theta - REST).max() > 0.4)
NOT_THERE = next(theta for theta in POSTURES if not held(theta))


@pytest.mark.parametrize(
    ('method', 'duration'),
    [
        *((method, 0.5) for method in METHODS),
        ('proposed', 1.0),
        pytest.param('stiffness', 1.0, marks=pytest.mark.thorough),
    ],
)
def test_no_method_commands_tension_of_an_isolated_muscle(method, duration):
    bench = Bench(method=method, first_duration=0.5, second_duration=0.5, target_duration=duration)
    bench.tension = np.full(ROBOT.muscle_count, 60.0)  # also of the isolated muscle
    bench.isolate([LOST])
    if method != 'float':
        bench.theta = THERE
        bench.step()
        bench.target(THERE)
    sent = bench.step(200)
    core, last = bench.core, sent[-1]
    assert core.supervisor.is_running
    if last.kind == TENSION:
        assert last.value[LOST] == 0.0
        assert (last.value[USED] >= 30.0).all()
    else:
        assert last.value[LOST] == core.limiter.slack_length[LOST]
    assert np.abs(np.diff(values(sent)[:, USED], axis=0)).max() <= (
        0.1 * 0.01 * (1.0 if last.kind == LENGTH else 1e4) + 1e-9
    )
    assert ROBOT.isolated == ()


def test_the_sensors_of_an_isolated_muscle_do_not_move_the_arm():
    sent = []
    for tension, longer in ((0.0, 0.0), (450.0, 0.5)):
        bench = Bench()
        bench.isolate([LOST])
        length, pull = rest_readings(ROBOT, REST)
        pull = np.where(USED, pull, tension)
        bench.tension = pull
        bench.target(THERE)
        for _ in range(50):
            bench.now += 0.01
            read = np.array([length + longer * ~USED, pull, np.full(6, 30.0)])
            bench.core.take(reading(read), bench.now)
            bench.core.estimated(REST, bench.now)
            bench.core.step(bench.now)
        assert bench.cause == ''
        sent.append(bench.core.limiter.command.value)
    np.testing.assert_array_equal(sent[0][USED], sent[1][USED])


@pytest.mark.parametrize(
    ('temperature', 'tension', 'cause'),
    [
        (150.0, 60.0, f'overheated: {ROBOT.muscles[LOST]}'),  # an isolated motor can still overheat
        pytest.param(500.0, 60.0, '', marks=pytest.mark.thorough),
        (np.nan, 60.0, ''),
        (90.0, 450.0, ''),  # an impossible tension does not warm the motor further
    ],
)
def test_an_isolated_muscle_stops_the_arm_for_real_heat_but_not_for_impossible_readings(
    temperature, tension, cause
):
    bench = Bench()
    bench.isolate([LOST])
    bench.step()
    bench.target(REST)
    bench.step(10)
    bench.tension = np.where(USED, 60.0, tension)
    bench.temperature = np.where(USED, 30.0, temperature)
    bench.dt = 0.1
    bench.step(300)
    assert bench.condition[: len(cause) or None] == cause


def test_the_arm_stops_when_all_remaining_muscles_are_overheated():
    bench = Bench()
    bench.isolate([LOST])
    bench.step()
    bench.target(REST)
    bench.step(10)
    bench.temperature = np.where(USED, bench.core.settings.temperature_limit + 10.0, 30.0)
    bench.dt = 0.1
    bench.step(50)  # the controller accepts a jump of temperature only if it lasts
    assert bench.condition.startswith('overheated')


def test_a_target_that_the_others_cannot_hold_is_refused_or_approached():
    bench = Bench(target_duration=1.0)
    bench.isolate([LOST])
    bench.theta = THERE
    bench.step()
    name = ROBOT.muscles[LOST]
    with pytest.raises(
        MessageError, match=f'lack .* N·m at .*, because {name} is isolated; nearest'
    ):
        bench.target(NOT_THERE)
    assert bench.core.target_state.theta is None
    bench.configure(unreachable='nearest')
    bench.target(NOT_THERE)
    goal = bench.core.target_state.theta
    assert not lacking(bench.core.robot, bench.mae, goal)
    way, whole = goal - THERE, NOT_THERE - THERE
    np.testing.assert_allclose(way, whole * (way @ whole) / (whole @ whole), atol=1e-9)
    bench.step()
    assert 'nearest holdable posture' in bench.report().message
    bench.isolate([])
    bench.target(NOT_THERE)
    np.testing.assert_array_equal(bench.core.target_state.theta, NOT_THERE)


@pytest.mark.parametrize('method', ['proposed', 'tension', 'stiffness'])
def test_a_posture_that_the_others_hold_with_a_joint_stop_is_held_and_lacks_no_torque(method):
    lifted = [np.where(joint, ROBOT.lower, at) for joint in np.eye(2) for at in POSTURES[:50]]
    theta = next(
        theta
        for theta in lifted
        if not held(theta) and not lacking(ROBOT_WITHOUT, ExactMae(ROBOT), theta)
    )
    bench = Bench(method=method, target_duration=0.2)
    bench.dt = SELDOM
    bench.isolate([LOST])
    bench.theta = theta
    bench.step()
    bench.target(theta)
    bench.step(50)
    assert not bench.core.activities.entered.missing_torque.any()


def test_exploration_is_refused_without_muscles_and_the_report_names_the_remedy():
    bench = Bench()
    bench.step()
    bench.isolate(range(ROBOT.muscle_count))
    assert 'estimator/restore' in bench.core.explore(True)
    assert not bench.core.supervisor.explores
    bench.isolate(range(ROBOT.muscle_count - 1))
    assert bench.core.explore(True) == ''
    bench.step()
    assert 'too few postures are holdable' in bench.report().message
    bench.isolate([])
    assert 'too few' not in bench.report().message


def test_a_motion_of_an_arm_that_has_fallen_starts_where_the_arm_is():
    for lost, starts_there in (([LOST], True), ([], False)):
        bench = Bench(target_duration=0.2)
        bench.dt = SELDOM
        bench.isolate(lost)
        bench.theta = REST  # where the arm stays
        bench.step()
        bench.target(THERE)
        bench.step(50)
        bench.target(THERE)
        start = bench.follower.progress.trajectory.start.theta
        np.testing.assert_allclose(start, REST if starts_there else THERE)


def test_the_report_says_what_keeps_a_fallen_arm_from_its_target():
    bench = Bench(target_duration=0.2)
    bench.dt = SELDOM
    bench.isolate([LOST])
    bench.theta = NOT_THERE
    bench.step()
    bench.target(THERE)
    reported = lacking(ROBOT_WITHOUT, bench.mae, NOT_THERE)
    assert reported
    for _ in range(150):
        bench.step(round(1.0 / SELDOM))
        if f'the muscles lack {reported}; lift the arm by hand' in bench.report().message:
            return
    raise AssertionError(bench.report().message)


#: without these muscles, arm26 can hold both postures, but cannot move from HERE to BEYOND
TWO_LOST = [ROBOT.muscles.index(name) for name in ('deltoid_anterior', 'triceps_long')]
HERE, BEYOND = np.array([0.29, -1.09]), np.array([-1.24, -1.9])


def test_a_target_on_the_way_to_which_the_muscles_lack_torque_is_refused():
    robot, bench = ROBOT.without(TWO_LOST), Bench()
    assert not lacking(robot, bench.mae, HERE)
    assert not lacking(robot, bench.mae, BEYOND)
    bench.isolate(TWO_LOST)
    bench.theta = HERE
    bench.step()
    there = TrajectoryPoints(np.arange(2), np.array([5.0]), BEYOND[None], None, None)
    pose = ROBOT.kinematics.end_effector_pose(BEYOND)
    for request in (
        lambda: bench.target(BEYOND),
        lambda: bench.core.trajectory(there),
        lambda: bench.core.pose(pose, False, bench.now),
    ):
        with pytest.raises(MessageError, match=r'on the way, the muscles lack .* at joint elbow'):
            request()
    assert bench.core.target_state.theta is None


def test_with_unreachable_nearest_the_arm_goes_as_far_as_the_muscles_can_move_it():
    bench = Bench(unreachable='nearest')
    bench.isolate(TWO_LOST)
    bench.theta = HERE
    bench.step()
    bench.target(BEYOND)
    goal = bench.core.target_state.theta
    assert 0.1 < np.linalg.norm(goal - HERE) < np.linalg.norm(BEYOND - HERE) - 0.1
    np.testing.assert_array_equal(bench.follower.progress.trajectory.end, goal)
    bench.step()
    assert 'on the way, the muscles lack' in bench.report().message
    bench.configure(unreachable='refuse')
    bench.target(goal)


def test_the_residual_torque_of_the_healthy_arm_stays_in_reserve_on_the_way():
    for spread in (0.01, 20.0):
        mae = ExactMae(ROBOT)
        mae.touch = TouchStatistics(mae.friction, np.full(2, spread), LEAST_MOTION)
        bench = Bench(mae)
        bench.isolate([LOST])
        bench.theta = REST
        bench.step()
        if spread < 1.0:
            bench.target(THERE)
            continue
        with pytest.raises(MessageError, match='on the way, the muscles lack'):
            bench.target(THERE)


def test_a_motion_of_an_arm_that_falls_is_not_repeated():
    bench = Bench(target_duration=0.2)
    bench.dt = SELDOM
    bench.isolate([LOST])
    bench.theta = REST  # where the arm stays
    bench.step()
    bench.target(THERE)
    first = bench.follower.progress.trajectory
    bench.step(200)
    assert bench.follower.progress.trajectory is first


def test_an_arm_that_cannot_move_to_its_target_any_more_says_so_and_does_not_stop():
    bench = Bench(target_duration=2.0)
    bench.theta = HERE
    bench.step()
    bench.target(BEYOND)
    bench.step()
    bench.stop()
    bench.step(10)
    bench.isolate(TWO_LOST)
    assert bench.core.reset(bench.now) is None
    bench.step(10)
    assert bench.cause == ''
    assert 'on the way, the muscles lack' in bench.report().message
    assert bench.core.target_state.theta is None


def test_a_path_avoids_postures_that_cannot_be_held():
    whole = Robot.load('musashi_left_arm')
    robot = whole.without([whole.muscles.index('pectoralis_major')])
    mae = ExactMae(robot)

    def lack(start, path):
        ends = pairwise([start, *path])
        ways = [a + np.linspace(0.0, 1.0, 12)[:, None] * (b - a) for a, b in ends]
        return np.mean([bool(lacking(robot, mae, at)) for at in np.vstack(ways)])

    postures = robot.random_postures(200, np.random.default_rng(0))
    known = [theta for theta in postures if not lacking(robot, mae, theta)]
    start, goal = next(pair for pair in pairwise(known) if lack(pair[0], pair[1:]) > 0.3)
    path = holdable_paths.way(robot, mae, start, goal)
    np.testing.assert_array_equal(path[-1], goal)
    assert ((robot.lower <= path) & (path <= robot.upper)).all()
    assert lack(start, path) == 0.0
    np.testing.assert_array_equal(holdable_paths.way(whole, mae, start, goal), [goal])


def test_a_path_keeps_a_reserve_of_torque_for_errors_of_the_learned_body():
    whole = Robot.load('musashi_left_arm')
    robot = whole.without([whole.muscles.index('pectoralis_major')])
    limits, residual = robot.tension, np.full(robot.joint_count, 0.4)
    friction = np.full(robot.muscle_count, FRICTION)
    unaware, aware = ExactMae(robot), ExactMae(robot)
    aware.touch = TouchStatistics(friction, residual, LEAST_MOTION)

    def lack(start, path):
        """Return by how much the muscles miss SUPPORT times the residual torque on a path [N·m]."""
        lacks = []
        for a, b in pairwise([start, *path]):
            direction = (b - a) / np.linalg.norm(b - a)
            for theta in np.linspace(a, b, 12):
                torque = robot.kinematics.holding_torque(theta) + SUPPORT * residual * direction
                jacobian = unaware.muscle_jacobian(theta, limits.bias)
                stops = supporting_stops(robot, theta, direction)
                exertion = least_tension(jacobian, torque, limits.bias, limits.limit, stops=stops)
                lacks.append(np.abs(exertion.missing_torque).max())
        return max(lacks)

    postures = robot.random_postures(200, np.random.default_rng(0))
    known = [theta for theta in postures if not lacking(robot, unaware, theta)]
    pairs = list(pairwise(known))[:40]
    hard = [
        pair for pair in pairs if lack(pair[0], holdable_paths.way(robot, unaware, *pair)) > 0.2
    ]
    assert hard
    for start, goal in hard:
        assert lack(start, holdable_paths.way(robot, aware, start, goal)) < holdable_paths.NOTABLE


@pytest.mark.parametrize(
    ('lost', 'limit', 'duration'),
    [
        (['pectoralis_major'], 200.0, 1.2),
        pytest.param([], 120.0, 0.6, marks=pytest.mark.thorough),
    ],
)
def test_a_motion_is_slow_enough_for_the_torque_of_the_muscles(lost, limit, duration):
    stated = Robot.load('musashi_left_arm').description
    tension = replace(stated.tension, limit=np.full_like(stated.tension.limit, limit))
    whole = Robot(replace(stated, tension=tension))
    robot = whole.without(whole.muscle_indices(lost))
    mae, limits, lag = ExactMae(robot), robot.tension, 0.02
    settings = Settings(rate_limit=SPEED_LIMIT)

    def lack(trajectory):
        """Return the largest torque that the muscles cannot exert in a motion [N·m].

        Tendon friction and the lag of the muscle modules are taken into account.
        """
        lacks = []
        for at in zip(*trajectory.sample(np.linspace(0.0, trajectory.duration, 40))):
            jacobian = mae.muscle_jacobian(at[0], limits.bias)
            speed = jacobian @ at[1]
            loss = np.exp(-FRICTION * np.tanh(speed / TURNING))
            low = limits.bias + robot.actuation.tension_of_lag(lag, np.maximum(speed, 0.0))
            torque = robot.kinematics.inverse_dynamics(*at)
            exertion = least_tension(jacobian, torque, low / loss, limits.limit / loss)
            lacks.append(np.abs(exertion.missing_torque).max())
        return max(lacks)

    postures = robot.random_postures(60, np.random.default_rng(0))
    known = [theta for theta in postures if not lacking(robot, mae, theta)]
    hard = 0
    for start, goal in list(pairwise(known))[:21]:
        rest = Setpoint.resting(start)
        fast = Trajectory.to(rest, holdable_paths.way(robot, mae, start, goal), duration)
        fast = fast.scaled(slowness(robot, mae, fast, settings))
        if lack(fast) > 0.3:
            hard += 1
            planner = Planner(Setup(robot, settings))
            plans = [
                planner.to_posture(mae, rest, goal, duration, lag)[0],
                planner.through(mae, rest, fast.points, 0.0, lag),
            ]
            for planned in plans:
                np.testing.assert_array_equal(planned.end, goal)
                assert lack(planned) < 0.25 * lack(fast)
    assert hard >= 3


@pytest.fixture(scope='module')
def sliding(tmp_path_factory):
    """Return an arm whose last joint is prismatic and has no muscles.

    Returns:
        The robot, random postures, and the force that the last joint carries in each of them [N].
    """
    robot = Robot.load(write_robot(tmp_path_factory.mktemp('slider'), slider=True))
    robot = robot.without(robot.muscle_indices(['slider_in', 'slider_out']))
    postures = robot.random_postures(100, np.random.default_rng(0))
    return robot, postures, robot.units.to_effort(robot.kinematics.holding_torque(postures))[:, -1]


def test_a_prismatic_joint_without_muscles_lacks_force_in_newtons(sliding):
    robot, postures, force = sliding
    wrist, low, high = postures[:, -1], robot.lower[-1] + AT_STOP, robot.upper[-1] - AT_STOP
    is_supported = (wrist < low) & (force > 0.0) | (wrist > high) & (force < 0.0)
    missing = np.where(is_supported, 0.0, np.abs(force))
    reported = [lacking(robot, ExactMae(robot), theta) for theta in postures]
    notable = holdable_paths.NOTABLE / robot.units[-1].radian
    assert reported == [f'{f:.2f} N at joint wrist' if f > notable else '' for f in missing]
    assert 0 < np.sum(missing > notable) < len(force)
    assert is_supported.any()


def test_a_prismatic_joint_without_muscles_is_led_along_its_stop(sliding):
    robot, postures, force = sliding
    steep = postures[force < -1.6]  # the weight presses the joint to its upper stop
    apart = np.linalg.norm((steep[:, None] - steep)[..., :3], axis=2)
    start, goal = steep[list(np.unravel_index(apart.argmax(), apart.shape))]
    start[-1], goal[-1] = robot.upper[-1], 0.5 * robot.upper[-1]
    path = holdable_paths.way(robot, ExactMae(robot), start, goal)
    np.testing.assert_array_equal(path[:, -1], [robot.upper[-1], goal[-1]])


class VerificationBench(Bench):
    """A stopped arm whose suspect is verified; only the suspect's module moves."""

    def __init__(self, **chosen):
        super().__init__(**chosen)
        self.target(REST)
        self.step(50)
        self.verify(LOST)

    def wound(self, count):
        return values(self.step(count))[:, LOST]


def test_a_suspect_is_wound_in_gently_during_verification_and_the_arm_goes_on_afterwards():
    bench = VerificationBench()
    before = bench.wound(round((bench.core.settings.hold_time + PAYING_OUT) / 0.01) - 2)
    assert (np.diff(before) >= 0.0).all()  # until the verification begins, it is only paid out
    after = bench.wound(100)
    assert np.diff(after).min() >= -0.02 * 0.01 - 1e-12
    fell = before[-1] - after[-1]
    length = rest_readings(ROBOT, REST)[0][LOST]
    assert 1e4 * (length - after[-1]) >= LARGEST_RISE
    assert 0.0 < fell <= DEPTH
    assert np.abs(np.diff(after[-20:])).max() == 0.0
    assert bench.cause == 'anomaly_detected'
    bench.end_anomaly()
    bench.step(2)
    assert bench.cause == ''
    assert bench.step(400)[-1].value[LOST] == bench.core.limiter.slack_length[LOST]


@pytest.mark.parametrize('is_missed', [True, False])
def test_a_restart_of_the_estimator_does_not_end_the_stop_for_a_suspect(is_missed):
    bench = VerificationBench()
    bench.step(50)
    length, tension = rest_readings(ROBOT, REST)
    for _ in range(50 if is_missed else 0):  # the estimator sends nothing, while the modules do
        bench.now += 0.01
        bench.core.take(reading([length, tension, np.full(6, 30.0)]), bench.now)
        bench.core.step(bench.now)
    bench.core.use_body(BodyState.healthy(ROBOT.muscle_count))
    bench.step(100)
    assert bench.cause == 'anomaly_detected'
    assert bench.core.supervisor.mode == 'stopped'
    assert bench.core.reset(bench.now) is None


def test_a_gap_of_estimates_interrupts_a_verification_and_does_not_latch_the_stop():
    bench = VerificationBench(max_age=0.05)
    bench.wound(round((bench.core.settings.hold_time + PAYING_OUT) / 0.01) + 3)
    assert np.diff(bench.wound(3)).max() < 0.0
    bench.blind = {'estimate'}
    assert np.diff(bench.wound(50)[8:]).min() >= 0.0  # nobody would notice that it pulls
    bench.blind = set()
    assert np.diff(bench.wound(5)).max() < 0.0
    assert bench.core.supervisor.mode == 'verifying'
    bench.end_anomaly()
    bench.step(2)
    assert bench.cause == ''


def test_after_a_long_gap_of_data_during_a_verification_only_a_reset_moves_the_arm():
    bench = VerificationBench(max_age=0.05)
    bench.wound(round((bench.core.settings.hold_time + PAYING_OUT) / 0.01) + 3)
    bench.blind = {'estimate'}
    bench.wound(round(1.2 * LASTING / 0.01))  # a person may be at the arm by now
    assert not bench.core.supervisor.ends_by_itself
    bench.blind = set()
    bench.end_anomaly()
    bench.step(50)
    assert bench.core.supervisor.mode == 'stopped'
    assert bench.core.reset(bench.now) is None


def test_a_verification_whose_suspect_is_in_use_again_is_abandoned_while_the_anomaly_lasts():
    bench = VerificationBench()
    bench.step(50)
    assert bench.core.supervisor.mode == 'verifying'
    bench.find(LOST)
    bench.isolate([])
    assert bench.core.supervisor.mode == 'stopped'
    bench.end_anomaly()
    bench.step(100)
    assert bench.cause == 'anomaly_detected'
    assert bench.core.reset(bench.now) is None


def test_a_suspect_with_dead_sensors_is_wound_in_by_a_bounded_length():
    bench = VerificationBench()
    bench.step(200)
    highest = bench.core.limiter.command.value[LOST]
    length, tension = rest_readings(ROBOT, REST)
    for _ in range(300):
        bench.now += 0.01
        read = np.array([length - 0.1 * ~USED, tension * USED, np.full(6, 30.0)])
        bench.core.take(reading(read), bench.now)
        bench.core.estimated(REST, bench.now)
        bench.core.step(bench.now)
    assert highest - bench.core.limiter.command.value[LOST] <= DEPTH + 1e-9


@pytest.mark.parametrize('first', [True, False])
def test_a_requested_stop_outlasts_a_verification(first):
    bench = Bench()
    bench.target(REST)
    bench.step(5)
    events = [bench.stop, lambda: bench.verify(LOST)]
    for event in events if first else events[::-1]:
        event()
        bench.step(5)
    bench.end_anomaly()
    bench.step(10)
    assert bench.cause
    assert bench.core.reset(bench.now) is None


@pytest.mark.parametrize('is_winding', [True, False])
def test_no_suspect_is_wound_in_after_an_operator_has_stopped_the_arm(is_winding):
    bench = VerificationBench()
    start = round((bench.core.settings.hold_time + PAYING_OUT) / 0.01)
    bench.step(start + 3 if is_winding else 50)
    bench.stop()
    lengths = values([bench.core.limiter.command, *bench.step(start)])
    assert bench.core.supervisor.mode == 'verifying'
    assert np.diff(lengths, axis=0).min() >= 0.0


def test_the_end_of_an_anomaly_without_a_suspect_does_not_end_the_stop():
    bench = Bench()
    bench.target(REST)
    bench.isolate([LOST])
    bench.step(150)
    bench.find(0)
    lengths = bench.step(300)[-1].value
    assert (lengths <= np.where(USED, bench.core.limiter.slack_length, np.inf)).all()
    bench.end_anomaly()
    bench.step(10)
    assert bench.cause == 'anomaly_detected'


def test_exploration_resumes_after_the_suspect_was_verified():
    bench = Bench()
    bench.core.explore(True)
    bench.step(20)
    bench.verify(0)
    bench.step(300)
    bench.end_anomaly([])  # the suspect is healthy
    bench.step(5)
    assert bench.core.supervisor.explores


@pytest.mark.parametrize('stopped_before', [True, False])
def test_exploration_resumes_whichever_finding_of_the_muscle_stopped_the_arm_first(stopped_before):
    bench = Bench()
    bench.core.explore(True)
    bench.step(20)
    if stopped_before:
        bench.core.stop(ConditionKind.IMPLAUSIBLE_MUSCLE_STATES, 'length jumped')
        bench.step(5)
    bench.verify(0)
    bench.step(100)
    bench.end_anomaly([])
    bench.step(5)
    assert bench.core.supervisor.explores


def test_another_method_during_a_verification_does_not_end_the_exploration():
    bench = Bench()
    bench.core.explore(True)
    bench.step(20)
    bench.verify(0)
    bench.step(100)
    bench.configure(method='second')
    bench.end_anomaly([])
    bench.step(5)
    assert bench.core.supervisor.mode == 'exploring'


@pytest.mark.parametrize('wish', ['hold', 'target'])
def test_a_request_during_verification_ends_exploration(wish):
    bench = Bench()
    bench.core.explore(True)
    bench.step(20)
    bench.verify(0)
    bench.step(100)
    assert bench.core.explore(False) == '' if wish == 'hold' else bench.target(THERE) is None
    bench.step(100)
    bench.end_anomaly([])
    bench.step(5)
    assert bench.cause == ''
    assert not bench.core.supervisor.explores
    if wish == 'target':
        np.testing.assert_array_equal(bench.core.target_state.theta, THERE)


def test_a_stop_by_stale_data_outlasts_a_later_verification():
    bench = VerificationBench()
    bench.step(200)
    bench.end_anomaly([])
    bench.step(50)
    assert bench.cause == ''
    bench.blind = {'estimate'}
    bench.step(200)
    bench.blind = set()
    bench.step(100)
    bench.verify(LOST)
    bench.step(200)
    bench.end_anomaly([])
    bench.step(50)
    assert 'no usable' in bench.condition


def test_a_stop_pays_an_isolated_muscle_out_to_its_longest_length_at_most():
    bench = Bench()
    bench.isolate([LOST])
    bench.target(REST)
    bench.step(100)
    bench.stop()
    length, tension = rest_readings(ROBOT, REST)
    for _ in range(600):
        bench.now += 0.01
        bench.core.take(reading([length + 5.0 * ~USED, tension, np.full(6, 30.0)]), bench.now)
        bench.core.estimated(REST, bench.now)
        bench.core.step(bench.now)
    assert bench.core.limiter.command.value[LOST] <= bench.core.limiter.slack_length[LOST]


def test_a_trajectory_to_a_posture_that_cannot_be_held_is_refused():
    bench = Bench(unreachable='nearest')
    bench.isolate([0])
    bench.step(5)
    still = np.zeros((1, 2))
    end = TrajectoryPoints(
        np.array([0, 1]), np.array([3.0]), np.array([[-1.2, -0.2]]), still, still
    )
    with pytest.raises(MessageError, match='nearest holdable posture'):
        bench.core.trajectory(end)
    assert not bench.core.is_following


@pytest.mark.parametrize('preset', ['default', 'paper'])
def test_the_simulator_gives_an_isolated_muscle_no_tension(trained, preset):
    arm = Simulation(ROBOT, trained[preset], preset)
    arm.isolate([LOST])
    arm.command = trained[preset].lengths(OTHER[None], np.full((1, 6), 60.0)) - 0.01
    for _ in range(20):
        state = arm.step(0.01)
    assert state.tension[0, LOST] == 0.0
    assert (state.tension[0, USED] >= 30.0).all()
    arm.isolate([])
    assert arm.step(0.01).tension[0, LOST] >= 30.0


@pytest.mark.parametrize('has_paused', [False, True])
def test_a_wrong_reading_of_an_isolated_muscle_does_not_make_it_pull(has_paused):
    bench = Bench()
    bench.isolate([LOST])
    bench.tension = np.where(USED, ROBOT.tension.bias, 450.0)
    bench.target(REST)
    if has_paused:
        bench.step(100)
        bench.now += 2.0
    for command in filter(None, bench.step(100)):
        demand = ROBOT.actuation.demanded(bench.core.sample.length, command.value)
        assert demand[LOST] <= ROBOT.tension.bias[LOST] + 1e-6


def test_a_twist_to_a_posture_that_the_others_cannot_hold_is_refused():
    bench = Bench()
    bench.theta = np.array([-0.13, -0.58])
    bench.isolate([LOST])
    bench.step(5)
    with pytest.raises(MessageError, match='the muscles lack'):
        bench.core.twist(np.array([0.25, 0.0, -0.25, 0.0, 0.0, 0.0]))
