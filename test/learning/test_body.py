# SPDX-License-Identifier: Apache-2.0
"""The calibrated body and its fit."""

from dataclasses import replace

import numpy as np
import pytest

from learning.conftest import drawn_body
from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.body_model.fit import fit_body, fit_to_network
from musculoskeletal_ae.body_model.remainder import Remainder
from musculoskeletal_ae.mae.residuals import TouchStatistics
from musculoskeletal_ae.robot.robot import Robot


def rms(body, theta, tension, length):
    return float(np.sqrt(np.mean((body.lengths(theta, tension, 0 * tension)[0] - length) ** 2)))


def test_a_body_without_corrections_is_the_geometric_model(arm26):
    rng = np.random.default_rng(0)
    theta, tension = arm26.random_postures(50, rng), rng.uniform(0.0, 300.0, (50, 6))
    (length,) = CalibratedBody(arm26).lengths(theta, tension, np.zeros((50, 6)))
    np.testing.assert_allclose(length, arm26.muscle_lengths(theta, tension), atol=1e-12)


def test_a_limb_alone_has_the_same_lengths_as_in_the_whole_body():
    robot, rng = Robot.load('musashi_upper_body'), np.random.default_rng(0)
    body = drawn_body(robot, 3, seed=1, scale=1.0)
    body.remainder = Remainder(robot.muscle_count)
    theta, tension = robot.random_postures(5, rng), rng.uniform(0.0, 300.0, (5, robot.muscle_count))
    (length,) = body.lengths(theta, tension, 0.0 * tension)
    for joints, muscles in robot.groups[1:]:
        limb = body.limb(np.array(joints), np.array(muscles))
        pull = tension[:, muscles]
        (alone,) = limb.lengths(theta[:, joints], pull, 0.0 * pull)
        np.testing.assert_allclose(alone, length[:, muscles], atol=1e-12)
        assert limb.robot.muscles == tuple(robot.muscles[m] for m in muscles)


@pytest.mark.parametrize('m', range(6))
def test_the_linearisation_is_the_derivative(other_body, arm26, m):
    rng = np.random.default_rng(m)
    theta, tension = arm26.random_postures(5, rng), rng.uniform(20.0, 200.0, 5)
    direction = rng.uniform(-1.0, 1.0, 5)
    body = CalibratedBody(arm26, [p.copy() for p in other_body.parameters])
    poses = body.poses(theta)
    _, jacobian = body.linearised(poses, tension, direction, m)
    step = 1e-6
    for k in range(body.layouts[m].size):
        at = body.parameters[m][k]
        values = []
        for sign in (1.0, -1.0):
            body.parameters[m][k] = at + sign * step
            values.append(body.linearised(poses, tension, direction, m)[0])
        body.parameters[m][k] = at
        slope = (values[0] - values[1]) / (2.0 * step)
        np.testing.assert_allclose(jacobian[:, k], slope, atol=1e-6)


def test_twenty_samples_leave_a_third_of_the_difference_to_the_geometric_model(arm26, stage):
    states = stage.states(300)
    nominal, body = CalibratedBody(arm26), CalibratedBody(arm26)
    fit_body(body, stage.store(20).observations())
    assert rms(body, *states) < rms(nominal, *states) / 3.0


def test_bad_samples_do_not_poison_the_fit(arm26, stage):
    store = stage.store(60)
    clean = CalibratedBody(arm26)
    fit_body(clean, store.observations())
    for n in range(0, 60, 10):
        each = store.stored[n]
        bad = each.sample._replace(length=each.sample.length + 0.05)
        store.stored[n] = each._replace(sample=bad)
    poisoned = CalibratedBody(arm26)
    fit = fit_body(poisoned, store.observations())
    states = stage.states(300)
    assert rms(poisoned, *states) < 1.5 * rms(clean, *states)
    assert (fit.weight[::10] < 0.1).all()


def test_tendons_that_creep_are_followed_without_limit(arm26, stage):
    creep = 1e-5 * np.array([1.0, 1.0, 1.0, -1.0, 0.5, 0.0])
    still = stage.observations(100)
    age = np.linspace(2000.0, 0.0, 100)  # number of samples that were taken later
    theta, tension, length = stage.states(300)
    body, spared = CalibratedBody(arm26), CalibratedBody(arm26)
    crept = still.length + (2000.0 - age)[:, None] * creep
    fit_body(body, replace(still, length=crept, age=age))
    fit_body(spared, still)
    rates = [p[at.creep] for p, at in zip(body.parameters, body.layouts, strict=True)]
    np.testing.assert_allclose(rates, creep, atol=2e-7)
    now = theta, tension, length + 2000 * creep
    assert rms(body, *now) < 1.5 * rms(spared, theta, tension, length)


def test_samples_without_known_muscles_change_nothing(arm26, stage):
    observations = stage.store(1).observations()
    nothing = observations[:]
    nothing.known[:] = False
    body = CalibratedBody(arm26)
    fit_body(body, nothing)
    states = stage.states(50)
    np.testing.assert_allclose(
        body.lengths(states[0], states[1], np.zeros((50, 6)))[0],
        arm26.muscle_lengths(states[0], states[1]),
        atol=1e-12,
    )


def test_a_body_begins_with_the_tendon_friction_of_its_network(arm26, initial):
    friction = np.linspace(0.0, 0.4, 6)
    statistics = TouchStatistics(friction, np.ones(2))
    for touch, known in ((None, np.full(6, 0.05)), (statistics, friction)):
        body = CalibratedBody(arm26)
        fit_to_network(body, replace(initial, touch=touch))
        np.testing.assert_allclose(body.frictions(), known, atol=1e-3)


def test_a_relearned_muscle_takes_a_new_offset_and_the_others_keep_theirs(arm26, stage):
    store = stage.store(60)
    body = CalibratedBody(arm26)
    fit_body(body, store.observations())
    states = stage.states(100)
    (known,) = body.lengths(states[0], states[1], np.zeros((100, 6)))
    store.forget(2)
    for _ in range(3):
        sample = stage.sample()
        shift = 0.01 * (np.arange(6) == 2)
        store.add(sample._replace(length=sample.length + shift))
    fit_body(body, store.observations())
    (predicted,) = body.lengths(states[0], states[1], np.zeros((100, 6)))
    # Over 24 drawn bodies, the error of this offset had a standard deviation of 0.2 mm.
    assert abs((predicted - known)[:, 2].mean() - 0.01) < 0.001
    np.testing.assert_allclose(predicted[:, 0], known[:, 0], atol=5e-4)


def test_a_muscle_without_samples_gets_a_large_noise(arm26, stage):
    store = stage.store(30)
    known = fit_body(CalibratedBody(arm26), store.observations()).noise
    store.forget(1)
    forgotten = fit_body(CalibratedBody(arm26), store.observations()).noise
    for _ in range(10):
        store.add(stage.sample())
    again = fit_body(CalibratedBody(arm26), store.observations()).noise
    others = np.arange(arm26.muscle_count) != 1
    # The noise of the other muscles changes a little, because all muscles of a group are fitted
    # together. Over drawn bodies the change was at most 2 %.
    np.testing.assert_allclose(forgotten[others], known[others], rtol=0.06)
    assert forgotten[1] > 10.0 * known[1]
    assert known[1] < again[1] < 0.5 * forgotten[1]
