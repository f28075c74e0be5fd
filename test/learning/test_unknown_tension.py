# SPDX-License-Identifier: Apache-2.0
"""Learning from lengths and joint angles only: unknown tensions give no torque balance."""

import numpy as np
from robots import with_modules

from musculoskeletal_ae.body_model.body_fit import BodyFit
from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.body_model.observations import Observations
from musculoskeletal_ae.body_model.synthetic import synthetic_samples
from musculoskeletal_ae.emulator.kin.individual import Individual
from musculoskeletal_ae.mae.units import scale_vector
from musculoskeletal_ae.robot.robot import Robot

ROBOT = Robot(
    with_modules(Robot.load('arm26').description, actuation='position', tension_source='none')
)


def test_a_body_is_fitted_to_lengths_whatever_torque_the_assumed_tension_would_give():
    true, rng = Individual(ROBOT, 3), np.random.default_rng(0)
    tension = np.tile(ROBOT.actuation.assumed_tension, (60, 1))
    theta = ROBOT.random_postures(60, rng)
    # The true tensions differ from the assumed ones. Neither of them balances the arm's weight.
    length = true.muscle_lengths(theta, tension * rng.uniform(0.8, 1.2, tension.shape))
    known, still = np.ones(tension.shape, dtype=bool), np.zeros(tension.shape)
    fit = BodyFit(ROBOT, None)
    before = np.abs(fit.body.lengths(theta, tension, still)[0] - length).mean()
    fitted = fit.fit(Observations(theta, tension, length, still, known), theta)
    # The joint sensors alone determine the postures.
    np.testing.assert_allclose(fitted.theta, theta, atol=0.02)
    held_out = ROBOT.random_postures(200, rng)
    assumed = np.tile(ROBOT.actuation.assumed_tension, (200, 1))
    after = np.abs(
        fit.body.lengths(held_out, assumed, 0.0 * assumed)[0]
        - true.muscle_lengths(held_out, assumed)
    ).mean()
    assert after < 0.4 * before


def test_a_network_learns_mostly_the_tensions_that_it_will_get():
    noise, rng = np.zeros(ROBOT.muscle_count), np.random.default_rng(0)
    data = synthetic_samples(CalibratedBody(ROBOT), noise, 1000, rng)
    first, last = ROBOT.joint_count, ROBOT.joint_count + ROBOT.muscle_count
    tension = (data.entered / scale_vector(ROBOT.joint_count, ROBOT.muscle_count))[:, first:last]
    is_assumed = np.isclose(tension, ROBOT.actuation.assumed_tension).all(axis=1)
    assert 0.4 < is_assumed.mean() < 0.6  # the others show how tensions change the lengths
