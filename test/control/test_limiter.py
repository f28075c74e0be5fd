# SPDX-License-Identifier: Apache-2.0
"""Every published command is finite, and within the limits of rate and tension."""

from dataclasses import replace

import numpy as np
import pytest
from control_bench import sample
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from musculoskeletal_ae.arrays import median_of_rows
from musculoskeletal_ae.control.limiter import CommandLimiter
from musculoskeletal_ae.control.settings import Settings, Setup
from musculoskeletal_ae.motion.activities import LENGTH, TENSION, Command, unchanging
from musculoskeletal_ae.robot.model_errors import LARGEST
from musculoskeletal_ae.robot.robot import Robot

ROBOT = Robot.load('arm26')
COUNT, BIAS, MAX = ROBOT.muscle_count, ROBOT.tension.bias[0], ROBOT.tension.max[0]
LIMIT = np.full(COUNT, MAX)
DT = 0.01
VALUES = st.floats(-1e3, 1e3) | st.sampled_from([np.nan, -np.inf])


@given(st.integers(1, 6).flatmap(lambda rows: arrays(float, (rows, 3), elements=VALUES)))
@pytest.mark.filterwarnings('ignore:invalid value')
def test_median_of_rows_agrees_with_numpy(rows):
    np.testing.assert_array_equal(median_of_rows(rows), np.median(rows, axis=0))


def vectors(low, high):
    return st.lists(st.floats(low, high), min_size=COUNT, max_size=COUNT).map(np.array)


@hypothesis_settings(max_examples=40)
@given(
    st.lists(st.tuples(vectors(-1.0, 1.0), vectors(-0.3, 0.02), vectors(BIAS, MAX)), max_size=6),
    st.floats(0.001, 1.0),
)
def test_lengths_keep_the_rate_limit_except_to_relieve_a_muscle_that_pulls_too_hard(commands, rate):
    limiter, before = CommandLimiter(Setup(ROBOT, Settings(rate_limit=rate))), None
    for desired, length, limit in commands:
        pull = np.full(COUNT, BIAS)
        if before is not None:  # tensions follow from the last command by muscle stiffness control
            pull += np.maximum(0.0, ROBOT.stiffness * (length - before))
        now = sample(length, pull)
        if before is None:
            before = limiter.last(LENGTH, now).value
        sent = limiter.limit(Command(LENGTH, desired), now, limit, DT).value
        assert (sent - before >= -rate * DT - 1e-12).all()
        demanded = BIAS + np.maximum(0.0, ROBOT.stiffness * (length - sent))
        tense = pull > ROBOT.tension.limit
        assert (demanded <= np.minimum(limit, ROBOT.tension.limit) + 1e-6)[tense].all()
        # A muscle above its tension limit may be paid out faster than the rate limit allows, but
        # not beyond its measured length.
        assert ((sent - before)[~tense] <= rate * DT + 1e-12).all()
        assert (sent <= np.maximum(before + rate * DT, length) + 1e-12).all()
        before = sent


def test_the_lead_of_a_winding_muscle_demands_more_only_while_its_tension_is_below_the_limit():
    lead, desired = 0.01, Command(LENGTH, np.full(COUNT, -1.0))
    limit = ROBOT.tension.limit

    def demanded(tension, lead):
        limiter, now = CommandLimiter(Setup(ROBOT, Settings(rate_limit=1.0))), sample(0.0, tension)
        for _ in range(10):  # long enough for the rate limit
            sent = limiter.limit(desired, now, LIMIT, DT, lead).value
        return BIAS + ROBOT.stiffness * -sent

    np.testing.assert_allclose(demanded(BIAS, 0.0), limit)
    np.testing.assert_allclose(demanded(BIAS, lead), limit + ROBOT.stiffness * lead)
    assert (demanded(limit + 1.0, lead) <= limit).all()


@pytest.mark.parametrize(('spread', 'lower'), [(15.0, 30.0), (1e3, np.inf)])
@pytest.mark.parametrize('kind', [LENGTH, TENSION])
def test_an_uncertain_tension_lowers_its_limit_by_two_spreads_but_not_below_the_bias(
    kind, spread, lower
):
    limiter = CommandLimiter(Setup(ROBOT, Settings(rate_limit=1.0)))
    now = replace(sample(0.0, BIAS), tension_spread=spread)
    desired = Command(kind, np.full(COUNT, -1.0 if kind == LENGTH else MAX))
    for _ in range(10):  # long enough for the rate limit
        sent = limiter.limit(desired, now, LIMIT, DT).value
    demanded = sent if kind == TENSION else BIAS + ROBOT.stiffness * -sent
    np.testing.assert_allclose(demanded, np.maximum(ROBOT.tension.limit - lower, BIAS))


def test_the_tension_of_a_restored_muscle_rises_at_the_rate_limit():
    setup, now = Setup(ROBOT, Settings()), sample(0.0, BIAS)
    limiter, wanted = CommandLimiter(setup), Command(TENSION, np.full(COUNT, 2.0 * BIAS))
    limiter.limit(wanted, now, LIMIT, DT)
    setup.robot = ROBOT.without([0])
    for _ in range(30):
        before = limiter.limit(Command(TENSION, np.zeros(COUNT)), now, LIMIT, DT).value
    assert before[0] < BIAS
    setup.robot = ROBOT
    largest = limiter.largest_change(TENSION, DT)
    for _ in range(30):
        sent = limiter.limit(wanted, now, LIMIT, DT).value
        assert (sent - before <= largest + 1e-9).all()
        before = sent
    np.testing.assert_allclose(before, 2.0 * BIAS)


def test_wrong_lengths_without_a_matching_tension_pay_out_at_the_rate_limit():
    limiter, now = CommandLimiter(Setup(ROBOT, Settings())), sample(0.0, BIAS)
    held = unchanging(ROBOT, LENGTH, now)
    before = limiter.limit(held, now, LIMIT, DT).value
    for _ in range(5):
        sent = limiter.limit(held, sample(0.06, BIAS), LIMIT, DT).value
        assert (sent - before <= Settings().rate_limit * DT + 1e-12).all()
        before = sent


def test_a_wrong_length_sensor_pays_out_to_the_longest_length_of_the_muscle_at_most():
    limiter = CommandLimiter(Setup(ROBOT, Settings()))
    for _ in range(10):
        held = unchanging(ROBOT, LENGTH, sample(0.0, BIAS))
        sent = limiter.limit(held, sample(5.0, BIAS), LIMIT, DT).value
    theta = ROBOT.random_postures(2000, np.random.default_rng(3))
    assert (sent <= ROBOT.routes.relative_lengths(theta).max(axis=0) + 1.1 * LARGEST).all()


@hypothesis_settings(max_examples=40)
@given(st.lists(st.tuples(vectors(-100.0, 900.0), vectors(BIAS, MAX)), max_size=6))
def test_tensions_stay_within_bias_and_limit_and_rise_no_faster_than_the_lengths_would(commands):
    settings = Settings()
    limiter, before = CommandLimiter(Setup(ROBOT, settings)), np.full(COUNT, BIAS)
    for desired, limit in commands:
        sent = limiter.limit(Command(TENSION, desired), sample(0.0, BIAS), limit, DT).value
        assert (sent >= BIAS).all()
        assert (sent <= limit).all()
        assert (sent - before <= ROBOT.stiffness * settings.rate_limit * DT + 1e-9).all()
        before = sent


@hypothesis_settings(max_examples=40)
@given(
    st.lists(
        st.tuples(st.booleans(), vectors(-0.1, 0.1), vectors(BIAS, MAX)), min_size=2, max_size=15
    )
)
def test_across_changes_between_lengths_and_tensions_no_demand_and_no_length_makes_a_step(wanted):
    setup, now = Setup(ROBOT, Settings()), sample(0.0, BIAS)
    limiter, rate = CommandLimiter(setup), setup.settings.rate_limit
    demand, last_length, elapsed = np.full(COUNT, BIAS), None, 0.0
    for by_length, length, tension in wanted:
        desired = Command(LENGTH, length) if by_length else Command(TENSION, tension)
        sent = limiter.limit(desired, now, LIMIT, DT).value
        elapsed += DT
        before, demand = demand, ROBOT.actuation.demanded(now.length, sent) if by_length else sent
        assert (demand - before <= ROBOT.stiffness * rate * DT + 1e-6).all()
        if by_length:
            if last_length is not None:
                assert (np.abs(sent - last_length) <= rate * elapsed + 1e-9).all()
            last_length, elapsed = sent, 0.0


def test_a_length_after_a_pause_between_tensions_is_near_the_last_published_length():
    limiter, settings, now = CommandLimiter(Setup(ROBOT, Settings())), Settings(), sample(0.0, BIAS)
    for _ in range(300):  # slack
        last = limiter.limit(Command(LENGTH, np.full(COUNT, 0.1)), now, LIMIT, DT).value
    limiter.limit(Command(TENSION, ROBOT.tension.bias), now, LIMIT, DT)
    limiter.restart(now, may_pull_harder=False)
    sent = limiter.limit(Command(LENGTH, np.full(COUNT, -0.1)), now, LIMIT, DT).value
    assert (last - sent <= settings.rate_limit * 2 * DT + 1e-9).all()


@pytest.mark.parametrize('kind', [LENGTH, TENSION])
def test_a_command_that_is_not_finite_is_not_published_and_the_last_one_stays(kind):
    limiter, now = CommandLimiter(Setup(ROBOT, Settings())), sample(0.0, BIAS)
    good = limiter.limit(unchanging(ROBOT, kind, now), now, LIMIT, DT)
    bad = good.value.copy()
    bad[2] = np.nan
    assert limiter.limit(Command(kind, bad), now, LIMIT, DT) is None
    assert limiter.command is good


@given(vectors(0.0, MAX), vectors(-0.2, 0.2))
def test_the_unchanging_command_demands_the_present_tension(tension, length):
    now = sample(length, tension)
    sent = unchanging(ROBOT, LENGTH, now).value
    pull = BIAS + np.maximum(0.0, ROBOT.stiffness * (length - sent))
    np.testing.assert_allclose(pull, np.maximum(tension, BIAS))
    np.testing.assert_array_equal(unchanging(ROBOT, TENSION, now).value, np.maximum(tension, BIAS))


@pytest.mark.parametrize('rate', [0.1, 0.005])
def test_lengths_after_tensions_demand_no_step_although_the_arm_was_led_elsewhere(rate):
    limiter = CommandLimiter(Setup(ROBOT, Settings(rate_limit=rate)))
    ends = ROBOT.routes.relative_lengths(np.array([[-0.3, -1.0], [0.6, -0.2]]))
    limiter.limit(Command(LENGTH, ends[0]), sample(ends[0], BIAS), LIMIT, DT)
    for share in np.linspace(0.0, 1.0, 200):
        now = sample((1.0 - share) * ends[0] + share * ends[1], BIAS)
        limiter.limit(Command(TENSION, ROBOT.tension.bias), now, LIMIT, DT)
    sent = limiter.limit(Command(LENGTH, now.length), now, LIMIT, DT).value
    most = BIAS + ROBOT.stiffness * rate * DT + 1e-6
    assert (ROBOT.actuation.demanded(now.length, sent) <= most).all()
