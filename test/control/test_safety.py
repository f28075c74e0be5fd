# SPDX-License-Identifier: Apache-2.0
"""What leaves is never faster, stronger or less finite than allowed, whatever control commands."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from musculoskeletal_ae.arrays import median_of_rows
from musculoskeletal_ae.control.safety import (
    LENGTH,
    LENGTH_MARGIN,
    TENSION,
    Command,
    Muscles,
    SafetyFilter,
    unchanging,
)
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.robot.robot import Robot

ROBOT = Robot.load('arm26')
COUNT, BIAS, MAX = ROBOT.muscle_count, ROBOT.tension.bias[0], ROBOT.tension.max[0]
COLD = np.full(COUNT, 25.0)
LIMIT = np.full(COUNT, MAX)
DT = 0.01
VALUES = st.floats(-1e3, 1e3) | st.sampled_from([np.nan, -np.inf])


@given(st.integers(1, 6).flatmap(lambda rows: arrays(float, (rows, 3), elements=VALUES)))
@pytest.mark.filterwarnings('ignore:invalid value')
def test_median_of_rows_agrees_with_numpy(rows):
    np.testing.assert_array_equal(median_of_rows(rows), np.median(rows, axis=0))


def muscles(length=0.0, tension=BIAS):
    return Muscles(np.full(COUNT, length), np.full(COUNT, tension), COLD)


def step(guard, desired, now=None, limit=LIMIT, fresh=True):
    """Step a guard that has just been told how the muscles are."""
    guard.muscles(now or muscles())
    return guard.step(desired, limit, DT, fresh)


def vectors(low, high):
    return st.lists(st.floats(low, high), min_size=COUNT, max_size=COUNT).map(np.array)


@given(
    st.lists(st.tuples(vectors(-1.0, 1.0), vectors(-0.3, 0.02), vectors(BIAS, MAX)), max_size=6),
    st.floats(0.001, 1.0),
)
def test_lengths_keep_the_rate_limit_except_to_relieve_a_muscle_that_pulls_too_hard(commands, rate):
    guard, before = SafetyFilter(ROBOT, Settings(rate_limit=rate)), None
    for desired, length, limit in commands:
        pull = np.full(COUNT, BIAS)
        if before is not None:  # muscle stiffness control obeys the last command
            pull += np.maximum(0.0, ROBOT.stiffness * (length - before))
        # What two readings of three say is believed.
        for _ in range(2):
            now = Muscles(length.copy(), pull, COLD)
            sent = step(guard, Command(LENGTH, desired), now, limit).value
            if before is None:
                before = unchanging(ROBOT, LENGTH, now).value
            assert (sent - before >= -rate * DT - 1e-12).all()
            last, before = before, sent
        demanded = BIAS + np.maximum(0.0, ROBOT.stiffness * (length - sent))
        tense = pull > ROBOT.tension.limit
        assert (demanded <= limit + 1e-6)[tense].all()
        # Paying out faster is what the tension limit may do, and nothing else.
        slow = ~tense | (demanded < limit - 1e-6)
        assert ((sent - last)[slow] <= rate * DT + 1e-12).all()


def test_wrong_lengths_without_a_matching_tension_pay_out_at_the_rate_limit():
    guard = SafetyFilter(ROBOT, Settings())
    held = unchanging(ROBOT, LENGTH, muscles())
    before = [step(guard, held).value for _ in range(3)][-1]
    for _ in range(5):
        sent = step(guard, held, muscles(0.06)).value
        assert (sent - before <= Settings().rate_limit * DT + 1e-12).all()
        before = sent


@pytest.mark.parametrize('glitch', [2.0, 1e308, -1e308])
def test_one_wrong_reading_does_not_pay_a_muscle_out(glitch):
    settings = Settings()
    guard = SafetyFilter(ROBOT, settings)
    desired = Command(LENGTH, np.full(COUNT, -0.01))
    before = [step(guard, desired).value for _ in range(30)][-1]
    for length in (0.0, glitch, 0.0, 0.0):
        sent = step(guard, desired, muscles(length)).value
        assert np.abs(sent - before).max() <= settings.rate_limit * DT + 1e-12
        before = sent


def test_a_wrong_length_sensor_pays_out_to_the_longest_length_of_the_muscle_at_most():
    guard = SafetyFilter(ROBOT, Settings())
    for _ in range(10):
        sent = step(guard, unchanging(ROBOT, LENGTH, muscles()), muscles(5.0)).value
    theta = ROBOT.random_postures(2000, np.random.default_rng(3))
    assert (sent <= ROBOT.routes.relative_lengths(theta).max(axis=0) + 1.1 * LENGTH_MARGIN).all()


@given(st.lists(st.tuples(vectors(-100.0, 900.0), vectors(BIAS, MAX)), max_size=6))
def test_tensions_stay_within_bias_and_limit_and_rise_no_faster_than_the_lengths_would(commands):
    settings = Settings()
    guard, before = SafetyFilter(ROBOT, settings), np.full(COUNT, BIAS)
    for desired, limit in commands:
        sent = step(guard, Command(TENSION, desired), limit=limit).value
        assert (sent >= BIAS).all()
        assert (sent <= limit).all()
        assert (sent - before <= ROBOT.stiffness * settings.rate_limit * DT + 1e-9).all()
        before = sent


@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize('kind', [LENGTH, TENSION])
def test_a_command_that_is_not_finite_stops_the_arm_and_the_last_one_stays(kind, value):
    guard = SafetyFilter(ROBOT, Settings())
    good = step(guard, unchanging(ROBOT, kind, muscles()))
    bad = good.value.copy()
    bad[2] = value
    sent = step(guard, Command(kind, bad))
    assert np.isfinite(sent.value).all()
    if np.isnan(value):
        assert 'not finite' in guard.cause
        np.testing.assert_array_equal(sent.value, good.value)


def test_a_stop_holds_then_pays_out_to_the_measured_length_and_keeps_commanding():
    settings = Settings(hold_time=0.1, rate_limit=0.1)
    guard = SafetyFilter(ROBOT, settings)
    guard.command = Command(LENGTH, np.full(COUNT, -0.012))
    guard.stop('first')
    guard.stop('second')
    assert guard.cause == 'first'
    sent = [step(guard, None).value[0] for _ in range(60)]
    assert sent[8] == -0.012
    assert np.diff(sent).max() <= 0.001 + 1e-12
    assert np.diff(sent).min() >= 0.0
    assert sent[-1] == 0.0  # MSC pulls with T_bias where command and length are equal


def test_a_stop_with_stale_lengths_pays_out_to_the_longest_length_of_the_muscle():
    guard = SafetyFilter(ROBOT, Settings(hold_time=0.0))
    guard.command = Command(LENGTH, np.full(COUNT, -0.05))
    guard.stop('muscle_states are old')
    for _ in range(1000):
        sent = step(guard, None, muscles(-0.05), fresh=False).value
    theta = ROBOT.random_postures(500, np.random.default_rng(3))
    assert (sent > ROBOT.routes.relative_lengths(theta).max(axis=0) - 0.01).all()


def test_a_stop_under_tension_commands_holds_and_then_lowers_tension_to_the_bias():
    guard = SafetyFilter(ROBOT, Settings(hold_time=0.1))
    guard.command = Command(TENSION, np.full(COUNT, 120.0))
    guard.stop('asked')
    sent = [step(guard, None).value[0] for _ in range(60)]
    assert sent[8] == 120.0
    assert -np.diff(sent).min() <= ROBOT.stiffness[0] * 0.1 * DT + 1e-9
    assert sent[-1] == BIAS


@given(vectors(0.0, MAX), vectors(-0.2, 0.2))
def test_the_unchanging_command_demands_the_present_tension(tension, length):
    now = Muscles(length, tension, COLD)
    sent = unchanging(ROBOT, LENGTH, now).value
    pull = BIAS + np.maximum(0.0, ROBOT.stiffness * (length - sent))
    np.testing.assert_allclose(pull, np.maximum(tension, BIAS))
    np.testing.assert_array_equal(unchanging(ROBOT, TENSION, now).value, np.maximum(tension, BIAS))
