# SPDX-License-Identifier: Apache-2.0
"""Exploration in the three steps of the paper, at holdable postures."""

from itertools import islice

import numpy as np
import pytest
from robots import read_muscles, write_muscles, write_robot

from musculoskeletal_ae.control.settings import Settings, Setup
from musculoskeletal_ae.emulator.kin.individual import Individual
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.motion.exploration import Exploration
from musculoskeletal_ae.motion.explored_postures import explored_posture, holdable_postures
from musculoskeletal_ae.presets.registry import PRESETS
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension

ROBOT = Robot.load('arm26')
BIAS, LIMIT = ROBOT.tension.bias, ROBOT.tension.limit


def steps(seed, count, preset='paper'):
    return list(islice(Exploration(Setup(ROBOT, Settings(preset=preset)), seed), count))


def test_a_cycle_is_first_second_and_first_at_one_posture_with_other_tensions():
    one, two, three, other = steps(0, 4)
    assert [(s.method, s.duration) for s in (one, two, three)] == [
        ('first', 5.0),
        ('second', 2.0),
        ('first', 3.0),
    ]
    np.testing.assert_array_equal(one.theta, two.theta)
    np.testing.assert_array_equal(one.theta, three.theta)
    assert np.abs(other.theta - one.theta).max() > 0.0
    np.testing.assert_array_equal(one.tension, np.full(ROBOT.muscle_count, BIAS))
    assert ((three.tension >= BIAS) & (three.tension <= LIMIT)).all()
    assert np.ptp(three.tension) > 0.0


@pytest.mark.parametrize('preset', PRESETS)
def test_every_explored_posture_can_be_held_and_lies_within_the_joint_limits(preset):
    for step in steps(1, 90, preset)[1::3]:
        assert ((step.theta >= ROBOT.lower) & (step.theta <= ROBOT.upper)).all()
        assert ((step.tension >= BIAS - 1e-6) & (step.tension <= LIMIT + 1e-6)).all()
        held = -ROBOT.routes.muscle_jacobian(step.theta).T @ step.tension
        np.testing.assert_allclose(held, ROBOT.kinematics.holding_torque(step.theta), atol=1e-6)


def test_joints_are_sent_to_their_limits_at_the_given_rate_and_pressed_there():
    asked = steps(2, 300, 'default')[2::3]
    way = np.array([(s.theta == ROBOT.upper) * 1.0 - (s.theta == ROBOT.lower) for s in asked])
    # The tolerance is large, because only 200 targets were drawn, and postures at joint limits are
    # less often holdable than others.
    assert 0.12 < np.abs(way).mean() < 0.38
    assert {*np.unique(way)} == {-1.0, 0.0, 1.0}
    mean = 0.5 * (BIAS + LIMIT)
    for step, side in zip(asked, way):
        if np.abs(side).sum() == 1.0:
            jacobian = ROBOT.routes.muscle_jacobian(step.theta)
            assert ((step.tension >= BIAS) & (step.tension <= LIMIT)).all()
            # The tensions press the joint towards its limit more than equal tensions would.
            assert side @ (jacobian.T @ (mean - step.tension)) > 0.0
    never = steps(2, 300)
    assert not any(((s.theta == ROBOT.upper) | (s.theta == ROBOT.lower)).any() for s in never)


def test_holdable_postures_are_held_by_their_tensions_on_an_individual_too():
    individual = Individual(ROBOT, 1)
    postures = ROBOT.random_postures(50, np.random.default_rng(0))
    for theta, tension in holdable_postures(ROBOT, postures, 5, individual.muscle_jacobian):
        exerted = -individual.muscle_jacobian(theta[None])[0].T @ tension
        np.testing.assert_allclose(exerted, ROBOT.kinematics.holding_torque(theta), atol=1e-6)
        assert ((tension > BIAS - 1e-6) & (tension < LIMIT + 1e-6)).all()
        holding_tension(ROBOT, theta)  # raises if the geometric model cannot hold the posture


def test_a_seed_determines_the_stream_of_exploration():
    one, again, other = (steps(seed, 9) for seed in (3, 3, 4))
    for a, b in zip(one, again):
        np.testing.assert_array_equal(a.theta, b.theta)
        np.testing.assert_array_equal(a.tension, b.tension)
    assert not np.array_equal(one[0].theta, other[0].theta)


def test_an_arm_that_holds_hardly_any_posture_leans_on_its_stops(tmp_path):
    # Without a muscle that lifts, only the lower stop of the joint `lift` holds the arm.
    document = read_muscles(write_robot(tmp_path))
    robot = Robot.load(tmp_path)
    arms = robot.routes.muscle_jacobian(robot.random_postures(50, np.random.default_rng(0)))
    lift = robot.joints.index('lift')
    needed = robot.kinematics.holding_torque(robot.random_postures(50, np.random.default_rng(0)))
    lifts = (-arms[:, :, lift] * np.sign(needed[:, None, lift])).mean(axis=0) > 0.0
    document['muscles'] = [m for m, is_up in zip(document['muscles'], lifts) if not is_up]
    weak = Robot.load(write_muscles(tmp_path, document))
    rng = np.random.default_rng(1)
    theta, tension = explored_posture(weak, lambda: weak.random_postures(1, rng)[0])
    torque = weak.kinematics.holding_torque(theta)
    missing = torque + weak.routes.muscle_jacobian(theta).T @ tension
    is_low, is_high = theta < weak.lower + 2e-3, theta > weak.upper - 2e-3
    # What muscles do not exert, a stop does: it pushes back from a limit.
    tolerance = 2e-3 * np.abs(torque).max()
    assert np.all(np.abs(missing[~is_low & ~is_high]) < tolerance)
    assert np.all(missing[is_low] > -tolerance)
    assert np.all(missing[is_high] < tolerance)
    assert np.all((tension >= weak.tension.bias - 1e-9) & (tension <= weak.tension.limit + 1e-9))


def test_an_arm_that_holds_no_posture_is_refused_with_a_remedy(tmp_path):
    robot = Robot.load(write_robot(tmp_path, tension={'bias': 30.0, 'limit': 30.001}))
    with pytest.raises(RobotDescriptionError, match='run check_robot'):
        next(iter(Exploration(Setup(robot, Settings()), 0)))
