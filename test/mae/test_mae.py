# SPDX-License-Identifier: Apache-2.0


import numpy as np
import pytest
import torch

from musculoskeletal_ae.mae.network import from_mae
from musculoskeletal_ae.mae.training import random_states
from musculoskeletal_ae.mae.units import LENGTH_SCALE, Mask, State
from musculoskeletal_ae.paper.control import muscle_jacobian


@pytest.fixture
def states(robot):
    return random_states(robot, 12, np.random.default_rng(0), robot.tension.max)


def test_one_scaled_unit_is_a_radian_200_newton_and_100_millimetres():
    state = State(np.array([1.0]), np.array([200.0, 200.0]), np.array([0.1, 0.1]))
    np.testing.assert_allclose(state.scaled(), np.ones(5))


@pytest.mark.parametrize('index', range(3))
def test_numpy_agrees_with_torch(mae, states, index):
    scaled = states.scaled()
    mask = list(Mask)[index]
    with torch.no_grad():
        expected = from_mae(mae)(
            torch.tensor(scaled, dtype=torch.float32), torch.full((len(scaled),), index)
        )
    z = mae.encode(mask, *states)
    np.testing.assert_allclose(mae.decode_scaled(z), expected.numpy(), atol=1e-5)
    np.testing.assert_allclose(mae.decode(z).scaled(), expected.numpy(), atol=1e-5)


@pytest.mark.parametrize('mask', Mask)
def test_masked_input_is_ignored(mae, states, mask):
    hidden = [
        part if observed else np.full_like(part, np.nan)
        for part, observed in zip(states, mask.value)
    ]
    absent = [part if observed else None for part, observed in zip(states, mask.value)]
    expected = mae.encode(mask, *states)
    np.testing.assert_array_equal(mae.encode(mask, *hidden), expected)
    np.testing.assert_array_equal(mae.encode(mask, *absent), expected)


@pytest.mark.parametrize('mask', Mask)
def test_missing_input_is_refused(mae, mask):
    with pytest.raises(ValueError, match=mask.name):
        mae.encode(mask)


def test_the_latent_state_has_as_many_entries_as_joints_and_muscles(mae, states):
    assert mae.encode(Mask.THETA_TENSION, *states).shape == (12, 2 + 6)


def test_single_state_gives_what_the_batch_gives(mae, states):
    batch = mae.estimate(states.tension, states.length)
    for i in range(12):
        single = mae.estimate(states.tension[i], states.length[i])
        for one, many in zip(single, batch, strict=True):
            # The sums are rounded relative to their largest terms, so 5 N are as inexact as 500 N.
            np.testing.assert_allclose(one, many[i], rtol=0, atol=1e-5 * np.abs(many).max())


def test_estimate_is_decoded_encoding_of_tension_and_length(mae, states):
    expected = mae.decode(mae.encode(Mask.TENSION_LENGTH, None, states.tension, states.length))
    for got, want in zip(mae.estimate(states.tension, states.length), expected, strict=True):
        np.testing.assert_array_equal(got, want)


def test_inputs_stay_as_they_were(mae, states):
    before = [part.copy() for part in states]
    mae.muscle_jacobian(states.theta, states.tension)
    z = mae.encode(Mask.THETA_LENGTH, *states)
    kept = z.copy()
    mae.decode(z), mae.decode_scaled.with_pullback(z)[1](np.ones((12, 14)))
    np.testing.assert_array_equal(z, kept)
    for part, copy in zip(states, before, strict=True):
        np.testing.assert_array_equal(part, copy)


def test_the_decoders_pullback_is_that_of_autograd_in_double_precision(mae, states):
    z = mae.encode(Mask.TENSION_LENGTH, *states)
    y, pullback = mae.decode_scaled.with_pullback(z)
    np.testing.assert_allclose(y, mae.decode_scaled(z), atol=1e-5)
    gradient = np.random.default_rng(1).normal(size=(12, 14))
    leaf = torch.tensor(z, requires_grad=True)
    exact = torch.autograd.grad(from_mae(mae).double().decode(leaf), leaf, torch.tensor(gradient))
    np.testing.assert_allclose(pullback(gradient), exact[0].numpy(), atol=1e-5)


def exact_jacobian(mae, states):
    """Return the exact derivatives ∂l/∂θ of the network's lengths, shape (12, 6, 2).

    Autograd computes them in double precision, through the pass from θ and T to l.
    """
    theta = torch.tensor(states.theta, requires_grad=True)
    rest = torch.tensor(states.scaled()[:, 2:])
    mask = torch.full((12,), list(Mask).index(Mask.THETA_TENSION))
    lengths = from_mae(mae).double()(torch.cat([theta, rest], dim=1), mask)[:, -6:] / LENGTH_SCALE
    rows = [torch.autograd.grad(lengths[:, m].sum(), theta, retain_graph=True) for m in range(6)]
    return np.stack([row.numpy() for (row,) in rows], axis=1)


def test_the_lengths_pullback_of_a_tension_is_its_torque(mae, states):
    theta, tension, _ = states
    length, pullback = mae.lengths_with_pullback(theta, tension)
    np.testing.assert_allclose(length, mae.lengths(theta, tension), atol=1e-6)
    torque = np.einsum('nmd,nm->nd', exact_jacobian(mae, states), tension)
    np.testing.assert_allclose(pullback(tension), torque, atol=1e-3)


def test_muscle_jacobian_is_the_limit_of_the_papers_difference(mae, states):
    analytic = mae.muscle_jacobian(states.theta, states.tension)
    assert analytic.shape == (12, 6, 2)
    np.testing.assert_allclose(analytic, exact_jacobian(mae, states), atol=1e-6)
    coarse, finer = (
        np.abs(muscle_jacobian(mae, states.theta, states.tension, h) - analytic).max()
        for h in (0.03, 0.01)
    )
    assert 0.0 < finer < 0.5 * coarse < 0.05
    np.testing.assert_allclose(
        mae.muscle_jacobian(states.theta[0], states.tension[0]), analytic[0], atol=1e-6
    )
