# SPDX-License-Identifier: Apache-2.0
"""Position-controlled modules: limits, stops and methods without tension control."""

import copy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from control_bench import sample
from exact_mae import ExactMae
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from readings import reading
from robots import with_modules
from sensor_loop import WithJointSensors

from musculoskeletal_ae.control.limiter import CommandLimiter
from musculoskeletal_ae.control.settings import METHODS, Settings, Setup
from musculoskeletal_ae.control.stop_commands import PAYING_OUT, SafeStop
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.emulator.kin.individual import NOMINAL, Individual
from musculoskeletal_ae.motion.activities import LENGTH, TENSION, Command
from musculoskeletal_ae.motion.methods import first_command
from musculoskeletal_ae.motion.tension_plan import plan_at_rest
from musculoskeletal_ae.robot.description import SPEED_DEFAULT
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.friction import slid
from musculoskeletal_ae.signals.muscle_stream import MuscleStream

ROBOT = Robot(with_modules(Robot.load('arm26').description, actuation='position'))
COUNT, BIAS = ROBOT.muscle_count, ROBOT.tension.bias[0]
LIMIT, MAX = ROBOT.tension.limit, ROBOT.tension.max
DT, THETA = 0.01, np.array([-0.3, -1.0])


def vectors(low, high):
    return st.lists(st.floats(low, high), min_size=COUNT, max_size=COUNT).map(np.array)


def pull_in_this_posture(length, tension, command):
    """Return the tensions [N] after modules moved from `length` to `command` with fixed joints."""
    stretch = ROBOT.elongation(tension) + length - command
    grid = np.linspace(0.0, 2.0 * MAX[0], 4001)
    table = ROBOT.elongation(grid[:, None] * np.ones(COUNT))
    return np.array([np.interp(s, column, grid) for s, column in zip(stretch, table.T)])


@hypothesis_settings(max_examples=40)
@given(st.lists(st.tuples(vectors(-1.0, 1.0), vectors(0.0, 260.0)), min_size=1, max_size=5),
       vectors(60.0, 190.0))  # fmt: skip
def test_no_command_stretches_a_muscle_beyond_the_limit_even_if_no_joint_gives_way(messages, limit):
    limiter, length = CommandLimiter(Setup(ROBOT, Settings(rate_limit=1.0))), np.zeros(COUNT)
    for desired, tension in messages:
        now = sample(length, tension, ROBOT)
        before = limiter.last(LENGTH, now).value
        sent = limiter.limit(Command(LENGTH, desired), now, limit, DT).value
        # No command changes faster than the modules move, except that a muscle above T_limit is
        # paid out faster.
        is_tense = tension > LIMIT
        assert (sent - before >= -SPEED_DEFAULT * DT - 1e-12).all()
        assert ((sent - before)[~is_tense] <= SPEED_DEFAULT * DT + 1e-12).all()
        result = pull_in_this_posture(length, tension, sent)
        assert (result <= np.maximum(LIMIT, 0.0) + 1e-3)[is_tense].all()
        wound_in = sent < before
        assert (result <= limit + 1.0)[wound_in & (before >= length)].all()


def test_a_muscle_at_its_limit_does_not_oscillate_although_friction_and_delay_hide_its_tension():
    limiter = CommandLimiter(Setup(ROBOT, Settings()))
    friction, stiffness = 0.35, 0.25 * LIMIT / 0.001
    length, sliding, readings, tensions = np.zeros(COUNT), np.ones(COUNT), [], []
    for n in range(400):
        end = np.maximum(0.1 * LIMIT - stiffness * length, 0.0)
        tension = end * np.exp(friction * sliding)
        tensions.append(tension / LIMIT)
        readings.append(replace(sample(length, tension, ROBOT), time=n * DT))
        now = readings[max(0, n - 3)]  # readings arrive with a delay of 30 ms
        goal = limiter.limit(Command(LENGTH, np.full(COUNT, -0.05)), now, LIMIT, DT).value
        moved = np.clip(goal - length, -SPEED_DEFAULT * DT, SPEED_DEFAULT * DT)
        sliding = slid(sliding, -np.sign(moved), moved)
        length = length + moved
    # Every reversal of friction halves or doubles the tension. If the muscle were wound in again at
    # full speed, it would therefore oscillate, with a tension of up to 1.6 T_limit.
    assert np.max(tensions[100:]) < 1.3
    assert (np.array(tensions[100:]) > 1.1).mean() < 0.06


def test_a_rising_tension_is_extrapolated_by_the_times_at_which_its_messages_were_sent():
    commands = []
    for delay in (0.0, 0.009):  # the second message arrives on time, or just before the third
        limiter = CommandLimiter(Setup(ROBOT, Settings()))
        for n, late in enumerate((0.0, delay, 0.0)):
            now = sample(0.0, 100.0 + 0.5 * n, ROBOT)
            now = replace(now, time=n * DT + late, delay=late)
            sent = limiter.limit(Command(LENGTH, np.full(COUNT, -0.05)), now, LIMIT, DT).value
        commands.append(sent)
    np.testing.assert_allclose(commands[1], commands[0], atol=1e-12)


def test_a_motor_current_that_reads_too_little_does_not_lead_to_too_much_tension():
    robot = Robot(with_modules(ROBOT.description, 'position', 'current'))
    stream, limiter = MuscleStream(robot), CommandLimiter(Setup(robot, Settings()))
    length, tension, highest = np.zeros(COUNT), np.full(COUNT, BIAS), 0.0
    for n in range(400):
        read = 0.75 * tension - 0.05 * LIMIT
        now = stream.take(reading([length, read, np.full(COUNT, 30.0)]), n * DT)
        goal = limiter.limit(Command(LENGTH, np.full(COUNT, -0.1)), now, LIMIT, DT).value
        tension, length = pull_in_this_posture(length, tension, goal), goal
        highest = max(highest, (tension / LIMIT).max())
    # If the limiter ignored the uncertainty of the current, the highest tension would be
    # 1.4 T_limit. If it were too cautious, the muscle would be too weak.
    assert 0.6 < highest < 1.0
    assert (tension > 0.6 * LIMIT).all()


def test_a_desired_tension_becomes_a_length_command_towards_it():
    limiter, now = CommandLimiter(Setup(ROBOT, Settings())), sample(0.0, 50.0, ROBOT)
    sent = limiter.limit(Command(TENSION, np.full(COUNT, 80.0)), now, LIMIT, DT)
    assert sent.kind == LENGTH
    assert (sent.value < 0.0).all()
    slack = limiter.limit(Command(TENSION, np.full(COUNT, BIAS)), sample(0.0, 120.0, ROBOT), LIMIT,
                          DT)  # fmt: skip
    assert (slack.value > sent.value).all()


def stopped(now, steps, suspect=None, settings=None):
    limiter = CommandLimiter(Setup(ROBOT, settings or Settings(hold_time=0.0)))
    limiter.limit(Command(LENGTH, np.zeros(COUNT)), sample(0.0, BIAS, ROBOT), LIMIT, DT)
    stop, sent = SafeStop(Setup(ROBOT, settings or Settings(hold_time=0.0)), limiter), []
    for step in range(steps):
        message = now(step, limiter.command.value)
        is_fresh = message is not None
        message = message or sample(0.0, 150.0, ROBOT)
        desired = stop.step(message, DT, is_fresh, suspect=suspect)
        sent.append(limiter.limit(desired, message, LIMIT, DT).value)
    return np.array(sent)


def test_a_stop_holds_and_then_pays_out_until_the_measured_tension_is_the_bias():
    def now(_, command):
        return sample(command, pull_in_this_posture(0.0, np.full(COUNT, 150.0), command), ROBOT)

    sent = stopped(now, 200, settings=Settings(hold_time=0.2))
    assert (sent[15] == 0.0).all()
    assert np.diff(sent, axis=0).min() >= 0.0  # no muscle is wound in
    assert np.diff(sent, axis=0).max() <= SPEED_DEFAULT * DT + 1e-12
    left = pull_in_this_posture(0.0, np.full(COUNT, 150.0), sent[-1])
    np.testing.assert_allclose(left, BIAS, atol=3.0)
    is_slack = stopped(lambda _, command: sample(command, 5.0, ROBOT), 50)
    assert (is_slack == 0.0).all()  # tendons below T_bias are not moved


def test_without_fresh_readings_a_stop_pays_out_the_stated_length():
    sent = stopped(lambda *_: None, 200)
    longest = CommandLimiter(Setup(ROBOT, Settings())).longest
    np.testing.assert_allclose(sent[-1], np.minimum(ROBOT.actuation.release, longest))


def test_a_stopped_suspect_is_wound_in_slightly_and_no_other_muscle():
    sent = stopped(lambda _, command: sample(command, 10.0, ROBOT), 350, suspect=2)
    begun = round(PAYING_OUT / DT) - 1
    assert (sent[:begun] == 0.0).all()
    others = np.arange(COUNT) != 2
    assert (sent[:, others] == 0.0).all()
    assert -ROBOT.actuation.release[2] - 1e-9 <= sent[-1, 2] < -0.005


def test_the_length_command_is_the_length_itself():
    mae = ExactMae(ROBOT)
    tension = np.linspace(40.0, 90.0, COUNT)
    np.testing.assert_array_equal(
        first_command(ROBOT, mae, THETA, tension), mae.lengths(THETA, tension)
    )
    plan = plan_at_rest(ROBOT, mae, THETA)
    np.testing.assert_allclose(plan.length(mae, THETA), mae.lengths(THETA, plan.bone_tension))


@cache
def loop_after(method):
    """Return a loop after 5 s, in which the arm moved to its target, if the method has one."""
    arm = EmulatedArm(ROBOT, 0, Individual(ROBOT, 0, NOMINAL))
    loop = WithJointSensors(arm, ExactMae(ROBOT), Settings(method=method, first_duration=1.0))
    loop.wait(0.1)
    if method != 'float':
        loop.target(THETA)
    loop.wait(5.0)
    return loop


# With an exact network, `first` commands the lengths of `geometric`.
@pytest.mark.parametrize(
    'method',
    [pytest.param(m, marks=[pytest.mark.thorough] * (m == 'first')) for m in METHODS],
)
def test_every_method_moves_the_arm_and_keeps_it_within_its_tensions(method):
    loop = loop_after(method)
    assert loop.core.supervisor.is_running
    assert loop.core.limiter.command.kind == LENGTH
    # Gravity compensation has no target. The arm stays near the posture in which it began.
    goal, near = (THETA, 0.1) if method != 'float' else (np.zeros(2), 0.15)
    assert np.abs(loop.arm.theta - goal).max() < near
    assert loop.arm.tension.max() < LIMIT[0]
    if method in ('proposed', 'stiffness'):
        assert loop.arm.tension.min() > 0.5 * BIAS  # no tendon is slack


def test_gravity_compensation_follows_a_hand():
    loop = copy.deepcopy(loop_after('float'))
    before = loop.arm.theta
    loop.arm.set_wrench([15.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    loop.wait(3.0)
    loop.arm.set_wrench(np.zeros(6))
    loop.wait(1.0)
    assert np.abs(loop.arm.theta - before).max() > 0.2


@pytest.mark.parametrize('read', [0.0, 150.0])
def test_a_method_that_wants_tensions_keeps_an_isolated_muscle_slack_whatever_it_reads(read):
    robot = ROBOT.without([1])
    limiter = CommandLimiter(Setup(robot, Settings()))
    tension = np.where(robot.used, BIAS, read)
    limiter.command = Command(LENGTH, np.zeros(COUNT))
    for _ in range(1000):
        now = sample(0.0, tension, robot)
        desired = Command(TENSION, np.where(robot.used, BIAS, 0.0))
        sent = limiter.limit(desired, now, LIMIT, DT).value
    assert sent[1] == pytest.approx(limiter.slack_length[1])
