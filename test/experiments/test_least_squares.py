# SPDX-License-Identifier: Apache-2.0
"""Least squares finds the posture of any body whose model it has."""

import numpy as np
import pytest

from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.emulator.kin.individual import Individual
from musculoskeletal_ae.experiments.least_squares import (
    nominal,
    on_calibrated_body,
    oracle,
    oracle_errors,
)
from musculoskeletal_ae.experiments.recording import Recording
from musculoskeletal_ae.robot.robot import Robot

COUNT = 50


@pytest.fixture(
    scope='module',
    params=['arm26', pytest.param('musashi_left_arm', marks=pytest.mark.thorough)],
)
def robot(request):
    return Robot.load(request.param)


def body(robot, name):
    """Return an estimator and the exact lengths of its body."""
    if name == 'true':
        individual = Individual(robot, 3)
        return oracle(robot, individual), individual.muscle_lengths
    if name == 'learned':
        fitted = CalibratedBody(robot)
        for parameters in fitted.parameters:
            parameters += 1e-3 * np.random.default_rng(0).standard_normal(len(parameters))

        def lengths(theta, tension):
            return fitted.lengths(theta, tension, np.zeros_like(tension))[0]

        return on_calibrated_body(robot, fitted), lengths
    return nominal(robot), robot.muscle_lengths


@pytest.mark.parametrize('name', ['true', 'learned', 'geometric'])
def test_least_squares_is_exact_on_its_own_body(robot, name):
    rng = np.random.default_rng(1)
    estimator, lengths = body(robot, name)
    # Draw postures near mid-range, where the search starts. At the joint limits, θ would be
    # clipped.
    middle, half = 0.5 * (robot.lower + robot.upper), 0.25 * (robot.upper - robot.lower)
    theta = middle + half * rng.uniform(-1.0, 1.0, (COUNT, robot.joint_count))
    tension = rng.uniform(30.0, 130.0, (COUNT, robot.muscle_count))
    estimate = estimator.estimate(tension, lengths(theta, tension))
    assert np.linalg.norm(estimate - theta, axis=1).max() < 1e-3


def test_the_jacobian_of_the_learned_body_is_its_slope(robot):
    theta = robot.random_postures(5, np.random.default_rng(0))
    geometric = on_calibrated_body(robot, CalibratedBody(robot)).muscle_jacobian(theta)
    np.testing.assert_allclose(geometric, robot.routes.muscle_jacobian(theta), atol=1e-4)


def test_the_oracle_without_friction_errs_only_by_its_sensors(robot):
    """The sensor errors in this test are 3 mm of hysteresis in the lengths."""
    rng = np.random.default_rng(2)
    individual = Individual(robot, 0)
    theta = robot.random_postures(10 * COUNT, rng)
    tension = rng.uniform(30.0, 130.0, (len(theta), robot.muscle_count))
    hysteresis = 3e-3 * rng.choice([-1.0, 1.0], tension.shape)
    length = individual.muscle_lengths(theta, tension) + hysteresis
    recording = Recording(theta, theta, length, tension, length)
    errors = oracle_errors(EmulatedArm(robot, 0), 0, recording)
    assert errors['sensor_rad'] < 0.5 * errors['oracle_rad']
