# SPDX-License-Identifier: Apache-2.0
"""False readings of joint sensors in a recording are found, and no right ones are lost."""

import numpy as np
import pytest

from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.joint_series import judge_series


@pytest.fixture(scope='module')
def robot():
    return Robot.load('musashi_left_arm')


def motion(robot, seconds=60.0, rate=20.0):
    """Return times and postures of an arm that moves through the middle of its joint ranges."""
    time = np.arange(0.0, seconds, 1.0 / rate)
    middle, half = 0.5 * (robot.lower + robot.upper), 0.5 * (robot.upper - robot.lower)
    speed = np.linspace(0.3, 0.9, robot.joint_count)
    return time, middle + 0.6 * half * np.sin(speed * time[:, None] + np.arange(robot.joint_count))


def interleaved(time, theta, others, rate):
    """Return the motion beside a second publisher, and which messages are those of the latter."""
    extra = np.arange(time[0] + 1.0, time[-1], 1.0 / rate)
    all_times = np.concatenate([time, extra])
    order = np.argsort(all_times, kind='stable')
    rows = np.concatenate([theta, np.tile(others, (len(extra), 1))])[order]
    return all_times[order], rows, (order >= len(time))


def false_readings(kind, robot):
    """Return times, postures, and which messages are false, of a spoiled recording."""
    time, theta = motion(robot)
    if kind == 'a second publisher of zeros':
        return interleaved(time, theta, 0.0 * theta[0], 50.0)
    if kind == 'a second publisher of the middle of the ranges':
        return interleaved(time, theta, 0.5 * (robot.lower + robot.upper), 10.0)
    is_false = np.zeros(len(time), dtype=bool)
    if kind == 'every second message zero':
        is_false[1::2] = True
    elif kind == 'bursts of zeros':
        for begin in (10.0, 25.0, 45.0):
            is_false |= (begin <= time) & (time < begin + 3.0)
    elif kind == 'one burst of zeros':
        is_false = (time >= 20.0) & (time < 23.0)
    elif kind == 'single readings of −π':
        is_false[100::200] = True
    theta[is_false] = -np.pi if '−π' in kind else 0.0
    return time, theta, is_false


@pytest.mark.parametrize(
    'kind',
    [
        'a second publisher of zeros',
        'a second publisher of the middle of the ranges',
        'every second message zero',
        'bursts of zeros',
        'one burst of zeros',
        'single readings of −π',
    ],
)
def test_plausible_but_false_angles_are_left_out_and_their_share_is_stated(kind, robot):
    time, theta, is_false = false_readings(kind, robot)
    judged = judge_series(robot, time, theta)
    assert np.isnan(judged.theta[is_false]).all()
    np.testing.assert_array_equal(judged.theta[~is_false], theta[~is_false])
    assert judged.share == pytest.approx(is_false.mean())
    assert f'{100.0 * judged.share:.3g} % of the {len(time)} messages' in judged.text
    assert (' -3.14 rad' if '−π' in kind else ' rad') in judged.text
    assert judged.is_fault == (is_false.mean() > 0.01)
    assert 'stop a second program that publishes joint_states' in judged.advice


def test_failed_reads_of_one_sensor_leave_the_others_alone(robot):
    time, theta = motion(robot)
    is_false = np.random.default_rng(0).random(len(time)) < 0.1
    j = int(np.abs(theta).min(axis=0).argmax())  # the joint that stays furthest from 0
    theta[is_false, j] = 0.0
    judged = judge_series(robot, time, theta)
    others = np.arange(robot.joint_count) != j
    np.testing.assert_array_equal(judged.theta[:, others], theta[:, others])
    assert np.isnan(judged.theta[is_false, j]).all()
    assert np.isfinite(judged.theta[~is_false, j]).all()
    assert robot.joints[j] in judged.text


@pytest.mark.parametrize('kind', ['moves', 'rests without noise', 'slips', 'coarse sensors'])
def test_right_readings_are_all_used(kind, robot):
    time, theta = motion(robot)
    if kind == 'rests without noise':
        theta[100:400] = theta[100]
        theta[400:] = theta[100] + theta[400:] - theta[400]
    elif kind == 'coarse sensors':
        theta = np.round(theta, 2)
    elif kind == 'slips':  # the level changes once, and is then the level of this sensor
        theta[600:, 3] += 0.4
    judged = judge_series(robot, time, theta)
    used = np.isfinite(judged.theta).mean()
    assert used > (0.99 if kind == 'slips' else 0.9999)
    assert not judged.is_fault, judged.text


@pytest.mark.parametrize('factor', [180.0 / np.pi, -1.0])
def test_a_wrong_unit_or_sign_is_left_to_the_comparison_with_the_lengths(factor, robot):
    time, theta = motion(robot)
    judged = judge_series(robot, time, factor * theta)
    np.testing.assert_array_equal(judged.theta, factor * theta)
    assert not judged.text


@pytest.mark.parametrize('turns', [-1, 1, 2])
def test_whole_turns_of_an_encoder_are_subtracted_and_named(turns, robot):
    time, theta = motion(robot)
    read = theta.copy()
    read[:, 3] += 2.0 * np.pi * turns
    judged = judge_series(robot, time, read)
    np.testing.assert_allclose(judged.theta, theta, atol=1e-12)
    assert judged.is_fault and robot.joints[3] in judged.text
    assert 'subtract the whole turns' in judged.advice and 'second program' not in judged.advice


def test_encoders_that_wrap_around_at_zero_are_used_without_the_jumps(robot):
    time, theta = motion(robot)
    judged = judge_series(robot, time, np.mod(theta, 2.0 * np.pi))
    np.testing.assert_allclose(judged.theta, theta, atol=1e-12)
    assert judged.is_fault and 'subtract the whole turns' in judged.advice
