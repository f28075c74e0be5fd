# SPDX-License-Identifier: Apache-2.0
"""A stopped arm is held and then released; no muscle is wound in."""

import numpy as np
from control_bench import sample
from robots import with_modules

from musculoskeletal_ae.control.limiter import CommandLimiter
from musculoskeletal_ae.control.settings import Settings, Setup
from musculoskeletal_ae.control.stop_commands import SafeStop
from musculoskeletal_ae.motion.activities import LENGTH, TENSION, Command
from musculoskeletal_ae.robot.robot import Robot

ROBOT = Robot.load('arm26')
COUNT, BIAS = ROBOT.muscle_count, ROBOT.tension.bias[0]
DT = 0.01


def stopped(last, settings, now, steps, is_fresh=True):
    """Return the commands (N, M) of the `steps` steps of a stop that follows the command `last`."""
    limiter = CommandLimiter(Setup(ROBOT, settings))
    limiter.command = last
    stop, sent = SafeStop(Setup(ROBOT, settings), limiter), []
    for _ in range(steps):
        desired = stop.step(now, DT, is_fresh, suspect=None)
        sent.append(limiter.limit(desired, now, ROBOT.tension.max, DT).value)
    return np.array(sent)


def test_it_holds_then_pays_out_to_the_measured_length_and_keeps_commanding():
    settings = Settings(hold_time=0.1, rate_limit=0.1)
    sent = stopped(Command(LENGTH, np.full(COUNT, -0.012)), settings, sample(0.0, BIAS), 60)[:, 0]
    assert sent[8] == -0.012
    assert np.diff(sent).max() <= 0.001 + 1e-12
    assert np.diff(sent).min() >= 0.0
    assert sent[-1] == 0.0  # the commanded length is the measured one, so MSC exerts only T_bias


def test_with_stale_lengths_it_pays_out_to_the_longest_length_of_the_muscle():
    last = Command(LENGTH, np.full(COUNT, -0.05))
    sent = stopped(last, Settings(hold_time=0.0), sample(-0.05, BIAS), 1000, is_fresh=False)
    theta = ROBOT.random_postures(500, np.random.default_rng(3))
    assert (sent[-1] > ROBOT.routes.relative_lengths(theta).max(axis=0) - 0.01).all()


def test_under_tension_commands_it_holds_and_then_lowers_tension_to_the_bias():
    last = Command(TENSION, np.full(COUNT, 120.0))
    sent = stopped(last, Settings(hold_time=0.1), sample(0.0, 120.0), 60)[:, 0]
    assert sent[8] == 120.0
    assert -np.diff(sent).min() <= ROBOT.stiffness[0] * 0.1 * DT + 1e-9
    assert sent[-1] == BIAS


def test_with_stale_lengths_and_unknown_offsets_it_pays_out_until_the_muscles_are_slack():
    setup = Setup(ROBOT, Settings(hold_time=0.0))
    limiter, now = CommandLimiter(setup), sample(5.0, BIAS)
    theta = ROBOT.random_postures(500, np.random.default_rng(3))
    limiter.offsets_known, limiter.command = False, Command(LENGTH, np.full(COUNT, 4.95))
    stop = SafeStop(setup, limiter)
    for _ in range(6000):
        desired = stop.step(now, DT, is_fresh=False, suspect=None)
        sent = limiter.limit(desired, now, ROBOT.tension.max, DT).value
    paid_out = sent - 5.0
    span = np.ptp(ROBOT.routes.relative_lengths(theta), axis=0)
    assert (paid_out > span - 0.01).all() and (paid_out < 0.5).all()


def test_without_tensions_it_pays_out_by_release_although_the_offsets_change_meanwhile():
    modules = {'actuation': 'position', 'tension_source': 'none'}
    robot = Robot(with_modules(ROBOT.description, **modules))
    setup, length, offset = Setup(robot, Settings(hold_time=0.0)), np.zeros(COUNT), 0.05
    limiter = CommandLimiter(setup)
    stop, now = SafeStop(setup, limiter), sample(0.0, 0.0, robot)
    limiter.command = Command(LENGTH, length)
    for n in range(600):
        if n == 300:
            limiter.shift(np.full(COUNT, offset))
            stop.shift(np.full(COUNT, offset))
            now = now.shifted(np.full(COUNT, offset))
        desired = stop.step(now, DT, is_fresh=True, suspect=None)
        sent = limiter.limit(desired, now, robot.tension.max, DT).value
        if n == 299:
            before = sent
    np.testing.assert_allclose(sent, before - offset, atol=1e-9)
    assert (before > 0.0).all()
