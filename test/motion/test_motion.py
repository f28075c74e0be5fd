# SPDX-License-Identifier: Apache-2.0
"""Following of trajectories without an arm: the test provides sensor data and time.

Some tests use an emulated arm.
"""

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from control_bench import DT, OTHER, REST, ROBOT, Bench, values
from exact_mae import ExactMae, rest_readings
from nominal_body import nominal_arm

from musculoskeletal_ae.control import controller_status
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.settings import Settings, Setup
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.mae.residuals import TouchStatistics
from musculoskeletal_ae.messages.message_reading import TrajectoryPoints
from musculoskeletal_ae.motion import hand as hand_motion
from musculoskeletal_ae.motion.activities import LENGTH
from musculoskeletal_ae.motion.feedback import CORRECTION, SUPPORT
from musculoskeletal_ae.motion.hand import HAND_SPEED, Hand
from musculoskeletal_ae.motion.holdable_paths import NOTABLE, PathLimits
from musculoskeletal_ae.motion.methods import StiffnessModel
from musculoskeletal_ae.motion.slowness import BRAKING, SHARE, _eased, slowed_to_exert, slowness
from musculoskeletal_ae.motion.trajectory import STOPPING, Setpoint, Slowdown, Trajectory
from musculoskeletal_ae.motion.winches import Winches
from musculoskeletal_ae.robot.robot import Robot

STILL = np.zeros((1, 2))
PEAK_SPEED = 1.875  # ratio of peak to mean speed of a quintic from rest to rest


def points(goal, duration=1.0):
    return TrajectoryPoints(np.array([0, 1]), np.array([duration]), np.array([goal]), STILL, STILL)


def moved(bench, count):
    """Run `count` steps in which the arm reaches each setpoint exactly; return all commands."""
    sent = []
    for _ in range(count):
        sent += bench.step()
        if bench.follower.progress.trajectory is not None:
            bench.theta = bench.follower.progress.desired.theta
    return sent


@pytest.fixture
def bench():
    made = Bench(rate_limit=0.3)
    made.step(5)
    return made


def test_a_trajectory_is_followed_and_its_end_held_by_the_least_tension(bench):
    bench.core.trajectory(points(OTHER))
    sent = moved(bench, 50)
    assert bench.report().message == 'following a trajectory'
    sent += moved(bench, 200)
    assert {command.kind for command in sent} == {LENGTH}
    assert bench.report().message == 'holding'
    held = bench.follower.plan.bone_tension
    torque = ROBOT.kinematics.holding_torque(OTHER)
    np.testing.assert_allclose(-ROBOT.routes.muscle_jacobian(OTHER).T @ held, torque, atol=0.3)
    assert np.abs(np.diff(values(sent), axis=0)).max() <= 0.3 * DT + 1e-9


def test_a_trajectory_too_fast_for_the_winches_is_slowed_as_a_whole_and_reported(bench):
    bench.configure(rate_limit=0.05)
    bench.core.trajectory(points(OTHER, 0.5))
    trajectory = bench.follower.progress.trajectory
    assert trajectory.slowed > 1.2
    assert slowness(ROBOT, bench.mae, trajectory, bench.core.settings) == pytest.approx(1.0)
    sent = values(moved(bench, 20))
    assert 'slowed to' in bench.report().message
    sent = np.vstack([sent, values(moved(bench, 400))])
    assert np.abs(np.diff(sent, axis=0)).max() <= 0.05 * DT + 1e-9
    np.testing.assert_allclose(bench.follower.progress.desired.theta, OTHER)


def test_a_trajectory_of_zero_duration_takes_as_long_as_the_winches_need(bench):
    bench.core.trajectory(points(OTHER, 0.0))
    sent = values(moved(bench, 300))
    assert np.abs(np.diff(sent, axis=0)).max() <= 0.3 * DT + 1e-9
    np.testing.assert_allclose(bench.follower.progress.desired.theta, OTHER)
    assert not bench.follower.progress.is_moving


def test_a_new_trajectory_replaces_the_old_from_its_start_time_and_an_empty_one_holds(bench):
    bench.core.trajectory(points(OTHER, 2.0))
    moved(bench, 100)
    bench.core.trajectory(points(REST, 2.0), delay=0.5)
    first = bench.follower.progress.trajectory
    moved(bench, 45)
    assert bench.follower.progress.trajectory is first
    before = bench.follower.progress.desired
    moved(bench, 10)
    after = bench.follower.progress.desired
    assert bench.follower.progress.trajectory is not first
    assert np.abs(after.theta - before.theta).max() < 0.2
    np.testing.assert_allclose(bench.follower.progress.trajectory.end, REST)
    bench.core.trajectory(None)
    moved(bench, 40)
    assert not bench.follower.progress.desired.velocity.any()
    assert np.abs(bench.follower.progress.desired.theta - REST).max() > 0.1


def test_a_point_that_exceeds_a_joint_limit_by_the_error_of_an_estimate_is_moved_to_the_limit(
    bench,
):
    """A posture taught against a joint stop is estimated a little beyond it."""
    bench.core.trajectory(points(ROBOT.lower + [0.5, -0.005]))
    end = bench.follower.progress.trajectory.end
    np.testing.assert_allclose(end, ROBOT.lower + [0.5, 0.0])


def test_a_refused_trajectory_changes_nothing(bench):
    with pytest.raises(MessageError, match='beyond the joint limits'):
        bench.core.trajectory(points(ROBOT.upper + 0.1))
    with pytest.raises(MessageError, match='all points have passed'):
        bench.core.trajectory(points(OTHER), delay=-5.0)
    bench.stop()
    with pytest.raises(MessageError, match='stopped'):
        bench.core.trajectory(points(OTHER))
    assert bench.follower.progress.trajectory is None
    assert bench.step(3)[-1] is None


def test_a_stop_ends_a_trajectory_and_its_end_is_resumed_slowly(bench):
    bench.core.trajectory(points(OTHER))
    moved(bench, 50)
    bench.stop()
    bench.step(100)
    assert not bench.core.reset(bench.now)
    bench.step(5)
    resumed = bench.follower.progress.trajectory
    np.testing.assert_array_equal(resumed.end, OTHER)
    assert resumed.duration >= bench.core.settings.first_duration


def exploring(bench, velocity, end):
    """Let the arm of an exploring bench move with `velocity` [rad/s] until it is at `end`."""
    assert bench.core.explore(True) == ''
    for n in range(50, -1, -1):
        bench.theta = end - velocity * DT * n
        bench.step()


def test_a_motion_of_an_arm_that_another_activity_moves_first_brings_it_to_rest(bench):
    """A plan that took a moving arm for a resting one carried it beyond its target."""
    velocity = np.array([-0.8, 0.5])
    exploring(bench, velocity, REST)
    bench.target(OTHER)
    bench.step()
    desired = bench.follower.progress.desired
    np.testing.assert_allclose(desired.velocity, velocity, rtol=0.1)
    sent = moved(bench, round(STOPPING / DT))
    desired = bench.follower.progress.desired
    np.testing.assert_allclose(desired.theta, REST + 0.5 * STOPPING * velocity, atol=0.02)
    np.testing.assert_allclose(desired.velocity, 0.0, atol=0.02)
    moved(bench, 700)
    np.testing.assert_allclose(bench.follower.progress.desired.theta, OTHER)
    assert all(command is not None for command in sent)


@pytest.mark.parametrize('duration', [0.0, 0.1, 0.5])
def test_a_short_trajectory_of_a_moving_arm_follows_once_the_arm_is_at_rest(bench, duration):
    exploring(bench, np.array([-0.8, 0.5]), REST)
    bench.core.trajectory(TrajectoryPoints(*points(OTHER, duration)[:3], None, None))
    moved(bench, 300)
    np.testing.assert_allclose(bench.follower.progress.desired.theta, OTHER)


def test_an_arm_that_moves_towards_its_limit_comes_to_rest_before_it():
    velocity, end = np.array([1.0, 0.0]), ROBOT.upper - np.array([0.03, 0.5])
    bench = Bench()
    bench.theta = end - velocity * DT * 50
    bench.step(5)
    exploring(bench, velocity, end)
    bench.core.trajectory(None)
    desired = []
    for _ in range(30):
        moved(bench, 1)
        desired.append(bench.follower.progress.desired.theta)
    assert (np.array(desired) <= ROBOT.upper + 1e-9).all()
    assert bench.follower.progress.desired.theta[0] > end[0] + 0.02


def test_another_estimate_of_a_resting_arm_is_no_motion(bench):
    """With other muscles or another network, the estimate jumps."""
    bench.core.explore(True)
    bench.step(50)
    bench.isolate([0])
    bench.theta = REST + 0.1
    bench.step()
    bench.core.trajectory(points(OTHER))
    bench.step()
    assert np.abs(bench.follower.progress.desired.velocity).max() < 0.1


def test_a_trajectory_goes_on_after_a_pause_of_the_controller(bench):
    bench.core.trajectory(points(OTHER))
    sent = moved(bench, 50)
    bench.now += 2.0
    sent += moved(bench, 200)
    assert bench.core.is_following
    np.testing.assert_allclose(bench.follower.progress.desired.theta, OTHER)
    sent = [command for command in sent if command is not None]  # it waits for fresh readings
    assert np.abs(np.diff(values(sent), axis=0)).max() <= 0.3 * 0.1 + 1e-9


def test_a_posture_is_held_by_the_same_tensions_after_a_pause_of_the_controller(bench):
    bench.configure(target_duration=0.5)
    bench.target(OTHER, (2.0, 0.0))
    moved(bench, 200)
    held = bench.follower.plan.bone_tension
    assert held.max() > 1.5 * ROBOT.tension.bias[0]
    bench.now += 2.0
    moved(bench, 100)
    # The arm has come to rest. Its tensions may differ by the tendon friction, whose direction is
    # unknown at rest.
    np.testing.assert_allclose(bench.follower.plan.bone_tension, held, rtol=0.25)


@pytest.mark.parametrize('duration', [1.2, 5.0, 30.0])
def test_a_slow_target_does_not_carry_a_moving_arm_beyond_its_limits(bench, duration):
    bench.configure(target_duration=duration)
    bench.core.trajectory(points(OTHER, 0.6))
    moved(bench, 15)
    assert np.abs(bench.follower.progress.desired.velocity).max() > 0.3
    bench.target(REST + 0.1)
    bench.follower.progress.trajectory.check(ROBOT)
    np.testing.assert_allclose(bench.follower.progress.trajectory.end, REST + 0.1)
    assert bench.follower.progress.trajectory.duration < duration + 1.0


def test_slow_hand_poses_and_twists_keep_a_moving_arm_within_its_limits(bench, monkeypatch):
    monkeypatch.setattr(hand_motion, 'HAND_SPEED', 0.02)
    bench.configure(target_duration=1.2, unreachable='nearest')
    rng = np.random.default_rng(0)
    for theta in ROBOT.random_postures(3, rng):
        bench.target(ROBOT.random_postures(1, rng)[0])
        moved(bench, 40)
        hand(bench, theta)
        bench.follower.progress.trajectory.check(ROBOT)
        moved(bench, 30)
        bench.core.twist(np.array([0.1, 0.0, 0.1, 0.0, 0.0, 0.0]))
        bench.follower.progress.trajectory.check(ROBOT)


def test_a_target_takes_over_from_a_trajectory_without_a_jump(bench):
    bench.configure(target_duration=1.0)
    bench.core.trajectory(points(OTHER))
    sent = moved(bench, 50)
    bench.target(REST)
    sent += moved(bench, 200)
    assert np.abs(np.diff(values(sent), axis=0)).max() <= 0.3 * DT + 1e-9
    assert bench.report().message == 'holding'


def test_a_target_of_proposed_is_followed_like_a_trajectory_and_exerts_its_effort(bench):
    bench.configure(target_duration=0.5)
    bench.target(OTHER)
    moved(bench, 200)
    plain = bench.follower.plan.bone_tension
    assert bench.core.is_following
    bench.target(OTHER, (1.0, 0.0))
    moved(bench, 200)
    np.testing.assert_allclose(bench.follower.progress.desired.theta, OTHER)
    more = ROBOT.routes.muscle_jacobian(OTHER).T @ (plain - bench.follower.plan.bone_tension)
    np.testing.assert_allclose(more, [1.0, 0.0], atol=0.05)
    bench.target(ROBOT.upper + 1.0)
    bench.step()
    assert 'clamped' in bench.report().message


@pytest.mark.parametrize(('dt', 'late'), [(DT, 0.0), (0.002, 0.0), (DT, 0.8 * DT)])
def test_the_lag_of_the_winches_is_estimated_from_lengths_tensions_and_commands(dt, late):
    """Every third message arrives `late` seconds after the time at which it is due."""
    rng, winches, lag = np.random.default_rng(0), Winches(Setup(ROBOT, Settings())), 0.03
    length = np.zeros(ROBOT.muscle_count)
    for n in range(round(3.0 / dt)):
        if n % round(0.1 / dt) == 0:
            speed = rng.uniform(-0.2, 0.2, ROBOT.muscle_count)
            tension = rng.uniform(60.0, 120.0, ROBOT.muscle_count)
        length = length + speed * dt
        command = length - (tension - ROBOT.tension.bias) / ROBOT.stiffness + lag * speed
        noise = rng.normal(0.0, 1e-4, ROBOT.muscle_count)
        delay, before = (late * (k % 3 == 0) for k in (n, n - 1))
        winches.step(length + noise, tension, command, dt + delay - before, delay)
    assert winches.lag == pytest.approx(lag, rel=0.15)


def driven(arm, intervals=(10,), push=0.0, **chosen):
    """Return the tracking error [rad], (N, 2), of an emulated arm in a motion of 1 s.

    Args:
        arm: The emulated arm.
        intervals: Times [ms] from which each time between two messages is drawn at random.
        push: Force on the hand [N].
        chosen: Settings of the controller.
    """
    core, rng = Controller(ROBOT, Settings(rate_limit=0.3, **chosen)), np.random.default_rng(0)
    core.use(ExactMae(ROBOT))
    arm.reset(REST)
    now, off = 0.0, []
    while not off or core.activities.follower.progress.is_moving:
        theta, read = arm.sense()
        core.take(read, now)
        core.estimated(theta, now)
        if core.activities.follower.progress.trajectory is None:
            core.trajectory(points(REST, 0.3))
        elif now > 0.4 and not off:
            core.trajectory(points(OTHER))
            arm.set_wrench(np.array([push, 0.0, 0.0, 0.0, 0.0, 0.0]))
        arm.command_length(core.step(now).value)
        if now > 0.4:
            off.append(core.activities.follower.progress.desired.theta - arm.theta)
        interval = 0.001 * rng.choice(intervals)
        arm.step(interval)
        now += interval
    assert core.supervisor.is_running
    return np.array(off)


@pytest.mark.parametrize('seed', [pytest.param(0, marks=pytest.mark.thorough), 1])
def test_tracking_is_as_good_at_500_hz_and_at_irregular_times(seed):
    arm = EmulatedArm(ROBOT, seed)

    def error(*intervals):
        return np.linalg.norm(driven(arm, intervals), axis=1).mean()

    usual = error(10)
    for intervals in ((2,), (1, 2, 4, 8, 15, 25)):
        assert error(*intervals) < 1.25 * usual


def test_with_method_stiffness_a_moving_arm_yields_to_a_push_and_still_follows():
    arm, turned = nominal_arm(ROBOT), {}
    for method in ('proposed', 'stiffness'):
        free, pushed = (driven(arm, push=push, method=method) for push in (0.0, 6.0))
        assert np.linalg.norm(free, axis=1).mean() < 0.05
        turned[method] = np.linalg.norm(pushed - free, axis=1)[len(free) // 2 :].mean()
    assert turned['stiffness'] > 1.5 * turned['proposed']


def test_a_desired_stiffness_is_kept_during_a_trajectory_and_at_its_end(bench):
    follower, sent = bench.follower, []
    bench.configure(method='stiffness', joint_stiffness=(1000.0, 0.0))
    bench.core.trajectory(points(OTHER))
    for steps, desired in ((50, 1000.0), (40, 1000.0), (200, 1000.0), (100, 1.0)):
        bench.configure(joint_stiffness=(desired, 0.0))
        sent += moved(bench, steps)
        tension = follower.plan.bone_tension
        model = StiffnessModel.read(ROBOT, bench.mae, follower.progress.desired.theta, tension)
        planned = model.joint_stiffness(tension)[0, 0]
        _, lowest, highest = follower.plan.solution.stiffness
        end = (highest if desired > 1.0 else lowest)[0]
        assert abs(planned - end) < 0.3 * (highest - lowest)[0]
    assert 'desired 1.00 clamped' in bench.report().values['joint stiffness shoulder']
    assert np.abs(np.diff(values(sent), axis=0)).max() <= 0.3 * DT + 1e-9


def test_sudden_changes_of_planned_tension_slow_a_trajectory_little():
    # Near postures that the muscles cannot hold, planned tensions change suddenly even in a slow
    # motion.
    mae, chosen, slowed = Bench().mae, Settings(), []
    postures = ROBOT.random_postures(60, np.random.default_rng(0))
    bias = np.tile(ROBOT.tension.bias, (100, 1))
    for start, goal in zip(postures[::2], postures[1::2]):
        trajectory = Trajectory.to(Setpoint.resting(start), goal, 0.5)
        theta = trajectory.sample(np.linspace(0.0, 0.499, 100)).theta
        way = np.abs(np.diff(mae.lengths(theta, bias), axis=0)).sum(axis=0).max()
        fastest = PEAK_SPEED * way / (SHARE * chosen.rate_limit)
        slowed.append(slowness(ROBOT, mae, trajectory, chosen) / max(1.0, fastest / 0.5))
    # `fastest` assumes that every tendon is fastest in the middle of the motion, which is not
    # exact.
    assert 0.9 < min(slowed) <= max(slowed) < 1.5


def test_feedback_demands_bounded_tension_when_the_estimate_does_not_move(bench):
    bench.core.trajectory(points(OTHER))
    (length, _), limits = rest_readings(ROBOT, REST), ROBOT.tension
    demanded = np.array([ROBOT.actuation.demanded(length, c.value) for c in bench.step(400)])
    assert 0.9 < (demanded / limits.limit).max() <= 1.0 + 1e-9


@pytest.mark.parametrize('time', [90.0, pytest.param(0.0, marks=pytest.mark.thorough)])
def test_rest_feedback_pushes_in_every_direction_until_the_arm_has_arrived(time):
    # Lengths alone exert almost no torque in directions in which few muscles pull harder than
    # T_bias: the others cannot be relaxed any further. Without a measured residual torque, there
    # are only the lengths.
    mae, spread = ExactMae(ROBOT), np.array([0.6, 0.3])
    mae.touch = TouchStatistics(mae.friction, spread, time)
    bench = Bench(mae)

    def support():
        tension = bench.follower.plan.bone_tension
        torque = -mae.muscle_jacobian(REST, tension).T @ tension
        return torque - ROBOT.kinematics.holding_torque(REST)

    bench.target(REST)
    bench.step(200)
    bench.theta = REST - 0.1  # friction holds the arm beside its target
    bench.step(400)
    torque = SUPPORT * spread if time else np.zeros(2)
    supported = bench.follower.feedback.supported
    assert (supported > 0.05).all()
    np.testing.assert_allclose(support(), torque * supported / CORRECTION, atol=0.01)
    bench.theta = REST  # the arm arrives, and friction holds it there
    bench.step(1000)
    np.testing.assert_allclose(support(), 0.0, atol=0.01)


@pytest.mark.parametrize('trajectory', [True, False])
def test_feedback_does_not_overload_an_arm_that_is_stuck(bench, trajectory):
    bench.core.trajectory(points(OTHER)) if trajectory else bench.target(OTHER)
    pull, highest = ROBOT.tension.bias, -np.inf
    for _ in range(800):
        (command,) = bench.step()
        length, _ = rest_readings(ROBOT, REST, bench.tension)
        demanded = np.clip(ROBOT.actuation.demanded(length, command.value), 0.0, ROBOT.tension.max)
        bench.tension = pull = pull + 0.3 * (demanded - pull)
        highest = max(highest, (pull - ROBOT.tension.limit).max())
    assert -20.0 < highest < 5.0  # highest tension relative to its limit [N]
    assert bench.cause == ''


def test_the_feedback_of_a_blocked_arm_does_not_wind_up_against_the_tension_limit(bench):
    """The arm does not move, as if someone held it, so its muscles reach their tension limit."""
    bench.core.trajectory(points(OTHER))
    wound_up = []
    for _ in range(170):
        bench.step()
        wound_up.append(np.abs(bench.follower.feedback.correction).max())
    assert bench.follower.progress.error.max() > 0.3
    assert max(wound_up) < 0.5 * CORRECTION


def test_a_trajectory_that_leaves_the_limits_once_slowed_is_refused(monkeypatch):
    # The trajectory starts while the arm moves. The controller slows it because the winches are
    # slow. The arm then takes longer to brake, and overshoots the joint limits.
    bench = Bench(rate_limit=0.05)
    start = Setpoint(np.array([0.5, -0.5]), np.array([-1.4, 1.8]), np.zeros(2))
    Trajectory.through(start, points((-0.8, -1.1), 0.3), 0.0).check(ROBOT)
    monkeypatch.setattr(bench.core, '_ready', lambda *_: (start, bench.mae))
    with pytest.raises(MessageError, match='leaves the joint limits'):
        bench.core.trajectory(points((-0.8, -1.1), 0.3))
    assert not bench.core.is_following


def test_an_isolated_muscle_does_not_slow_a_trajectory():
    bench, trajectory = Bench(), Trajectory.to(Setpoint.resting(REST), OTHER, 0.2)
    robot = bench.core.robot
    theta = trajectory.sample(np.linspace(0.0, trajectory.duration, 200)).theta
    length = bench.mae.lengths(theta, np.tile(robot.tension.bias, (200, 1)))
    fastest = int(np.abs(np.diff(length, axis=0)).max(axis=0).argmax())
    before = slowness(robot, bench.mae, trajectory, Settings())
    reduced = robot.without([fastest])
    assert 1.0 < slowness(reduced, bench.mae, trajectory, Settings()) < 0.99 * before


def test_a_motion_that_lacks_torque_at_any_speed_is_slowed_only_as_far_as_that_helps():
    stated = Robot.load('musashi_left_arm').description
    weak = replace(stated.tension, limit=np.full_like(stated.tension.limit, 90.0))
    robot = Robot(replace(stated, tension=weak))
    mae, lag, slowed = ExactMae(robot), 0.02, []
    limits = PathLimits(robot, mae, used=1.0)

    def lack(motion, slower=1.0):
        """Return the largest missing torque of a slowed motion [N·m]."""
        instants = map(Setpoint._make, zip(*motion.sample(np.linspace(0.0, motion.duration, 60))))
        return max(
            limits.missing_in_motion(
                mae.muscle_jacobian(at.theta, robot.tension.bias), at, lag, slower
            )
            for at in instants
        )

    for start, goal in pairwise(robot.random_postures(30, np.random.default_rng(0))):
        motion = Trajectory.to(Setpoint.resting(start), goal[None], 1.0)
        at_any_speed = lack(motion, np.inf)
        if at_any_speed > 1.0:
            slowed.append(slowed_to_exert(robot, mae, motion, lag))
            assert lack(slowed[-1]) < at_any_speed + 2.0 * NOTABLE
    assert slowed and max(motion.slowed for motion in slowed) < 3.0


def test_slowing_where_necessary_keeps_the_path_and_its_derivatives():
    start = Setpoint(REST, np.array([0.4, -0.2]), np.zeros(2))
    motion = Trajectory.to(start, OTHER, 1.0)
    original = np.linspace(0.0, 1.0, 41)
    slowdown = Slowdown.by(original, 1.0 + 0.5 * np.sin(np.pi * original) ** 2)
    slow = motion.eased(slowdown)
    assert slow.duration == pytest.approx(1.25, abs=0.01) == slow.slowed
    time = np.linspace(0.01, slow.duration - 0.01, 300)
    at, step = slow.sample(time), 1e-4
    np.testing.assert_allclose(at.theta, motion.sample(slowdown.at(time)[0]).theta)
    np.testing.assert_allclose(slowdown.slowed(slowdown.at(time)[0]), time)
    late, early = slow.sample(time + step), slow.sample(time - step)
    numeric = (late.theta - early.theta) / (2.0 * step)
    np.testing.assert_allclose(at.velocity, numeric, atol=1e-3)
    numeric = (late.velocity - early.velocity) / (2.0 * step)
    assert np.median(np.abs(at.acceleration - numeric)) < 1e-3
    np.testing.assert_allclose(slow.path[1], motion.path[1])
    np.testing.assert_allclose(slow.sample(slow.path[0]).theta, motion.path[1], atol=1e-9)
    np.testing.assert_allclose(slow.sample(0.0).velocity, start.velocity)


@pytest.mark.parametrize('duration', [0.08, 1.0, 1000.0])
def test_slowing_is_nowhere_less_than_necessary(duration):
    rng = np.random.default_rng(0)
    instants = np.sort(rng.uniform(0.0, min(duration, 1.0), 17))
    slower = rng.choice([1.0, 1.1, 4.6], 17)
    slowdown = _eased(instants, slower, duration, starts_moving=False)
    assert (np.interp(instants, slowdown.original, slowdown.factor) > slower - 1e-9).all()
    braked = _eased(instants, slower, duration, starts_moving=True)
    assert (braked.factor <= 1.0 + BRAKING * braked.original).all()


def test_slowing_a_slow_trajectory_changes_nothing():
    trajectory = Trajectory.to(Setpoint.resting(REST), OTHER, 20.0)
    assert slowness(ROBOT, Bench().mae, trajectory, Settings()) == 1.0


def hand(bench, theta, whole=False):
    bench.core.pose(ROBOT.kinematics.end_effector_pose(theta), whole, bench.now)


def test_a_hand_pose_is_reached_and_one_out_of_reach_is_refused_or_approached(bench):
    hand(bench, OTHER)
    moved(bench, 300)
    at = ROBOT.kinematics.end_effector_pose(bench.follower.progress.desired.theta)
    wanted = ROBOT.kinematics.end_effector_pose(OTHER)
    np.testing.assert_allclose(at.translation, wanted.translation, atol=5e-3)
    far = pin.SE3(wanted.rotation, 3.0 * wanted.translation)
    before = bench.follower.progress.trajectory
    with pytest.raises(MessageError, match='out of reach'):
        bench.core.pose(far, False, bench.now)
    assert bench.follower.progress.trajectory is before
    bench.configure(unreachable='nearest')
    bench.core.pose(far, False, bench.now)
    bench.step()
    assert 'the arm goes to the nearest posture' in bench.report().message


def test_a_hand_pose_that_the_muscles_cannot_hold_is_refused(bench, monkeypatch):
    strong, half = bench.mae.muscle_jacobian, 0.5 * np.abs(OTHER - REST)

    def weak(theta, tension):  # without moment arms in the second half of the motion
        return strong(theta, tension) * (np.abs(theta - REST) < half).all()

    monkeypatch.setattr(bench.mae, 'muscle_jacobian', weak, raising=False)
    with pytest.raises(MessageError, match='the muscles lack'):
        hand(bench, OTHER)
    theta, short = Hand(Setup(ROBOT, Settings())).posture(
        bench.mae, ROBOT.kinematics.end_effector_pose(OTHER), False, REST, True
    )
    assert 'the muscles lack' in short
    share = (theta - REST) / (OTHER - REST)
    np.testing.assert_allclose(share, 0.5, atol=0.1)


def test_a_stream_of_hand_poses_is_followed_without_lag(bench):
    start, speed = REST, np.array([0.2, 0.3])
    hand(bench, start)
    moved(bench, 20)
    for n in range(60):
        hand(bench, start + 0.01 * n * speed)
        moved(bench, 1)
    wanted = ROBOT.kinematics.end_effector_pose(start + 0.6 * speed).translation
    at = ROBOT.kinematics.end_effector_pose(bench.follower.progress.desired.theta).translation
    assert np.linalg.norm(at - wanted) < 0.006
    moved(bench, 100)  # no other pose arrives, so the hand comes to rest at the last one
    assert not bench.follower.progress.is_moving
    last = ROBOT.kinematics.end_effector_pose(start + 0.59 * speed).translation
    at = ROBOT.kinematics.end_effector_pose(bench.follower.progress.desired.theta).translation
    assert np.linalg.norm(at - last) < 1e-3


@pytest.mark.parametrize('every', [10, pytest.param(20, marks=pytest.mark.thorough)])
def test_a_repeated_hand_pose_is_approached_at_hand_speed(bench, every):
    place, fastest, where = ROBOT.kinematics.end_effector_pose, 0.0, None
    for n in range(300):
        if n % every == 0:
            hand(bench, OTHER)
        moved(bench, 1)
        before, where = where, place(bench.follower.progress.desired.theta).translation
        if before is not None:
            fastest = max(fastest, float(np.linalg.norm(where - before)) / DT)
    assert fastest < 1.5 * HAND_SPEED
    np.testing.assert_allclose(where, place(OTHER).translation, atol=5e-3)


def test_the_duration_to_the_nearest_posture_does_not_grow_with_an_unreachable_distance(bench):
    bench.configure(unreachable='nearest')
    at, taken = ROBOT.kinematics.end_effector_pose(REST), []
    for far in (3.0, 1e3, 1e9):
        bench.core.pose(pin.SE3(at.rotation, at.translation + [far, 0.0, 0.0]), False, bench.now)
        taken.append(bench.follower.progress.latest.duration)
    assert max(taken) < 5.0
    bench.step(3)
    assert bench.cause == ''


def test_a_long_trajectory_is_slowed_as_a_short_one_is(bench):
    # The arm waits at REST until the time `late`, and then moves to OTHER and back three times.
    theta = np.vstack([REST, np.tile([OTHER, REST], (3, 1))])
    slowed, still = [], np.zeros_like(theta)
    for late in (0.0, 500.0):
        points = TrajectoryPoints(
            np.array([0, 1]), late + 0.3 * np.arange(1.0, 8.0), theta, still, still
        )
        trajectory = Trajectory.through(Setpoint.resting(REST), points)
        slowed.append(slowness(ROBOT, bench.mae, trajectory, bench.core.settings))
    assert slowed[0] > 1.2
    assert slowed[1] == pytest.approx(slowed[0], rel=0.05)


def test_a_twist_moves_the_hand_until_it_times_out(bench):
    begun = ROBOT.kinematics.end_effector_pose(REST).translation
    along = ROBOT.kinematics.end_effector_jacobian(REST)[:3] @ np.array([0.3, 0.3])
    twist = np.concatenate([0.1 * along / np.linalg.norm(along), np.zeros(3)])
    for _ in range(20):
        bench.core.twist(twist)
        moved(bench, 5)
    rate = ROBOT.kinematics.end_effector_jacobian(bench.follower.progress.desired.theta)[:3]
    np.testing.assert_allclose(
        rate @ bench.follower.progress.desired.velocity, twist[:3], atol=0.02
    )
    moved(bench, 80)
    assert not bench.follower.progress.is_moving
    gone = (
        ROBOT.kinematics.end_effector_pose(bench.follower.progress.desired.theta).translation
        - begun
    )
    assert gone @ twist[:3] / 0.1 > 0.08


def test_a_joint_that_a_twist_moves_to_its_limit_stops_there_and_the_others_go_on():
    bench, begun = Bench(), np.array([REST[0], ROBOT.upper[1] - 0.02])
    bench.theta = begun
    bench.step()
    twist = np.zeros(6)
    twist[:3] = ROBOT.kinematics.end_effector_jacobian(begun)[:3] @ np.array([0.3, 0.6])
    bench.core.twist(twist)
    trajectory = bench.follower.progress.trajectory
    _, theta = trajectory.path
    np.testing.assert_allclose(trajectory.end[1], ROBOT.upper[1])
    assert theta[:, 1].max() <= ROBOT.upper[1] + 1e-9
    assert theta[-1, 0] - begun[0] > 0.05


@pytest.mark.parametrize('apart', [1e-9, 1e-6])
def test_the_duration_of_points_that_hardly_differ_in_time_is_stated(bench, apart):
    goals = np.stack([np.array(REST), np.array(OTHER)])
    bench.core.trajectory(
        TrajectoryPoints(np.arange(2), np.array([1.0, 1.0 + apart]), goals, None, None)
    )
    follower = bench.follower
    text = controller_status.slowed(follower)
    assert f'takes {follower.progress.latest.duration:.3g} s' in text, text


def test_a_point_just_beyond_the_tolerance_of_a_limit_is_refused_in_numbers_that_differ(bench):
    beyond = np.array([0.0, ROBOT.upper[1] + 0.010001])
    with pytest.raises(MessageError) as error:
        bench.core.trajectory(points(beyond))
    assert len(set(re.findall(r'-?\d+\.\d+', str(error.value)))) == 3


def test_an_empty_trajectory_stops_the_arm_at_once_whatever_its_stamp(bench):
    bench.core.trajectory(points(OTHER, 2.0))
    moved(bench, 80)
    before = bench.follower.progress.desired
    bench.core.trajectory(None, delay=1.0)
    moved(bench, 1)
    step = np.abs(bench.follower.progress.desired.theta - before.theta).max()
    assert step <= 1.5 * DT * np.abs(before.velocity).max()
    moved(bench, 40)
    way = np.abs(bench.follower.progress.desired.theta - before.theta)
    assert (way <= 0.5 * STOPPING * np.abs(before.velocity) + 1e-3).all()


@pytest.mark.parametrize('late', [0.1, 0.1099, 0.10999])
def test_a_trajectory_that_is_a_little_late_takes_little_longer(bench, late):
    time = np.arange(0.01, 2.005, 0.01)
    path = REST + time[:, None] / 2.0 * (OTHER - REST)
    bench.core.trajectory(TrajectoryPoints(np.array([0, 1]), time, path, None, None), delay=-late)
    assert bench.follower.progress.trajectory.duration < 4.0
