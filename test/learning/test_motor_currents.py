# SPDX-License-Identifier: Apache-2.0
"""Scale, offset and drive friction of motor currents are learned from rests."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from robots import with_modules

from musculoskeletal_ae.body_model.body_fit import BodyFit
from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.body_model.covariance import drive_covariance, estimate_covariance
from musculoskeletal_ae.body_model.fit import fit_to_network
from musculoskeletal_ae.body_model.observations import Observations, Sample
from musculoskeletal_ae.control.limiter import CONFIDENCE
from musculoskeletal_ae.emulator.kin.individual import Individual
from musculoskeletal_ae.exceptions import CheckpointError, StateError
from musculoskeletal_ae.learning import state_format
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.residuals import TouchStatistics
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension
from musculoskeletal_ae.signals.friction import Transmission

SENSORS = Robot.load('arm26')
ROBOT = Robot(with_modules(SENSORS.description, 'position', 'current'))
COUNT = ROBOT.muscle_count
LIMIT = ROBOT.tension.limit


def rests(count, seed):
    """Return rest samples of an individual with motor currents instead of tension sensors.

    Returns:
        The samples with noise, the true bone-side tensions, and the true transmission, which
        converts between currents and tensions.
    """
    rng, true = np.random.default_rng(seed), Individual(ROBOT, seed)
    drive = np.array(
        [
            rng.normal(0.0, 0.15, COUNT),
            rng.normal(0.0, 0.02, COUNT) * LIMIT,
            rng.uniform(0.05, 0.15, COUNT) * LIMIT,
        ]
    )
    transmission = Transmission(true.tendon_friction, drive)
    theta = ROBOT.random_postures(count, rng)
    jacobian = true.muscle_jacobian(theta)
    held, end = ROBOT.kinematics.weight_torque(theta), np.empty((count, COUNT))
    for n in range(count):
        wanted = rng.uniform(0.1, 0.6, COUNT) * LIMIT
        end[n] = least_tension(jacobian[n], held[n], ROBOT.tension.bias, LIMIT, wanted)[0]
    direction = rng.choice([-1.0, 1.0], end.shape)
    motor = end * np.exp(true.tendon_friction * direction)
    read = transmission.reading(motor, direction) + rng.normal(0.0, 0.2, end.shape)
    length = true.muscle_lengths(theta, end) + rng.normal(0.0, 2e-5, end.shape)
    known = np.ones(end.shape, dtype=bool)
    return Observations(theta, read, length, direction, known), end, transmission


@pytest.mark.parametrize('seed', [0, 1])
def test_tensions_of_currents_are_recovered_from_rests(seed):
    observed, _, true = rests(120, seed)
    fit = BodyFit(ROBOT, None)
    body = fit.fit(observed, observed.theta) and fit.body
    held_out, held_end, _ = rests(100, seed)
    before = np.abs(held_out.tension - held_end).mean()
    after = np.abs(body.transmission.end(held_out.tension, held_out.direction) - held_end).mean()
    assert after < 0.4 * before
    error = np.abs(body.drive[2] - true.drive[2]).mean()  # error of the drive friction [N]
    assert error < 0.5 * np.abs(0.08 * LIMIT - true.drive[2]).mean() + 0.01 * LIMIT.mean()


def test_the_covariance_of_the_estimate_has_no_error_from_known_constants_of_currents():
    tension = np.random.default_rng(0).uniform(0.1, 0.6, (50, COUNT)) * LIMIT
    # The posterior is so narrow that all drawn bodies are alike.
    sizes = sum(layout.size for layout in CalibratedBody(ROBOT).layouts) + ROBOT.joint_count
    root = [(np.arange(COUNT), 1e9 * np.eye(sizes))]
    fit = SimpleNamespace(noise=np.full(COUNT, 1e-4), root=root)

    def lengths_as_angles(_, length):
        return SimpleNamespace(theta=length[:, : ROBOT.joint_count])

    mae, covariances = SimpleNamespace(estimate=lengths_as_angles), []
    for gain, offset in ((0.0, 0.0), (0.5, 0.05)):
        body = CalibratedBody(ROBOT)
        for layout, parameters in zip(body.layouts, body.parameters, strict=True):
            parameters[layout.drive] = gain, offset, 0.0
        covariances.append(estimate_covariance(mae, body, fit, tension, 0, None))
    np.testing.assert_allclose(covariances[1], covariances[0], rtol=1e-6)


@pytest.mark.parametrize('count', [0, 20, 120])
def test_the_uncertainty_of_tensions_of_currents_covers_their_errors(count):
    errors = []
    for seed in range(3):
        transmission = Transmission.unknown(LIMIT)
        if count:
            observed, _, _ = rests(count, seed)
            fit = BodyFit(ROBOT, None)
            result = fit.fit(observed, observed.theta)
            covariance = drive_covariance(fit.body, result)
            transmission = replace(fit.body.transmission, drive_covariance=covariance)
        held_out, held_end, true = rests(30, seed)
        motor = held_end * np.exp(true.friction * held_out.direction)
        for read, direction, tension in zip(held_out.tension, held_out.direction, motor):
            spread = transmission.spread(read, direction)
            errors.append((tension - transmission.motor(read, direction)) / spread)
    assert (np.array(errors) < CONFIDENCE).mean() > 0.95
    assert np.std(errors) > 0.2  # an excessive uncertainty would cover all errors trivially


def test_derivatives_by_the_drive_are_those_of_the_length():
    observed, _, _ = rests(20, 3)
    body = CalibratedBody(ROBOT)
    rng = np.random.default_rng(0)
    for parameters, layout in zip(body.parameters, body.layouts, strict=True):
        parameters[layout.drive] = rng.normal(0.0, 0.05, 3)
    poses, m, step = body.poses(observed.theta), 2, 1e-6
    at = body.layouts[m].drive

    def lengths():
        column = observed.tension[:, m], observed.direction[:, m]
        return body.linearised(poses, *column, m, np.zeros(20))

    _, jacobian = lengths()
    for k in range(at.start, at.stop):
        body.parameters[m][k] += step
        above, _ = lengths()
        body.parameters[m][k] -= 2.0 * step
        below, _ = lengths()
        body.parameters[m][k] += step
        np.testing.assert_allclose(jacobian[:, k], (above - below) / (2 * step), atol=1e-6)


def test_a_checkpoint_carries_the_transmission_and_fits_only_motor_currents(trained):
    drive = np.array([[0.1], [3.0], [15.0]]) * np.ones(COUNT)
    uncertain = Transmission.unknown(LIMIT).drive_covariance
    touch = TouchStatistics(np.full(COUNT, 0.05), np.ones(2), 90.0, drive, uncertain)
    data = checkpoint.to_bytes(replace(trained['default'], touch=touch))
    mae = checkpoint.from_bytes(data, ROBOT)
    np.testing.assert_array_equal(mae.transmission.drive, drive)
    np.testing.assert_array_equal(mae.transmission.drive_covariance, uncertain)
    negative = checkpoint.to_bytes(
        replace(trained['default'], touch=replace(touch, drive_covariance=-uncertain))
    )
    with pytest.raises(CheckpointError, match=r'drive_covariance .* eigenvalues .* 0 or more'):
        checkpoint.from_bytes(negative)
    with pytest.raises(CheckpointError, match=r'learned with motor currents .* sensor'):
        checkpoint.from_bytes(data, SENSORS)
    body = CalibratedBody(ROBOT)
    fit_to_network(body, mae)  # a learner on another machine continues from this network
    np.testing.assert_allclose(body.drive, drive, rtol=1e-3)
    excessive = replace(touch, drive=drive + np.array([[9.0], [0.0], [0.0]]))
    wrong = checkpoint.to_bytes(replace(trained['default'], touch=excessive))
    with pytest.raises(CheckpointError, match=r'touch\.drive has a gain of'):
        checkpoint.from_bytes(wrong)


def test_samples_of_tension_sensors_are_not_mixed_with_motor_currents():
    store = SampleStore()
    quiet = np.zeros(COUNT)
    store.add(Sample(np.zeros(2), quiet, quiet, quiet))
    data = state_format.to_bytes(state_format.collect(SENSORS, store, None))
    state_format.from_bytes(data, SENSORS)
    with pytest.raises(StateError, match="tension_source 'sensor'; this robot has 'current'"):
        state_format.from_bytes(data, ROBOT)
