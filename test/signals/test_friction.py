# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from musculoskeletal_ae.signals.friction import FrictionDirection, directions

DT = 0.01


def test_friction_acts_against_the_last_sliding_and_ignores_noise():
    friction, rng = FrictionDirection(), np.random.default_rng(0)
    length = 0.0
    for speed, expected in ((-0.02, 1.0), (0.0, 1.0), (0.02, -1.0), (0.0, -1.0)):
        for _ in range(100):
            length += speed * DT
            direction = friction.step(np.array([length]) + 1e-4 * rng.standard_normal(1))
        assert direction[0] * expected > 0.6


@pytest.mark.parametrize(('distance', 'most'), [(0.0003, 0.24), (0.0005, 0.15)])
def test_small_sliding_is_followed_through_noise(distance, most):
    rng, off, s = np.random.default_rng(0), [], 0.0
    moves = rng.uniform(-0.001, 0.001, 100)
    slid = np.concatenate([[*np.full(50, move / 50), *np.zeros(100)] for move in moves])
    read = np.cumsum(slid) + 1e-4 * rng.standard_normal(slid.shape)
    for moved, direction in zip(slid, directions(read[:, None])[:, 0], strict=True):
        way = -np.sign(moved)
        s = way + (s - way) * np.exp(-abs(moved) / distance)
        off.append(direction - s)
    # Measured: 0.19 and 0.11 for the two distances. A model of friction as a spring with a limited
    # force would have 0.28 and 0.19.
    assert np.sqrt(np.mean(np.square(off))) < most


@given(st.floats(-0.02, 0.02), st.sampled_from([-1.0, 1.0]))
def test_one_wrong_reading_does_not_reverse_friction(error, way):
    friction, slide = FrictionDirection(), np.arange(0.0, 0.01, 2e-4)
    for length in way * np.array([*slide, 0.01, 0.01 + error, *np.full(20, 0.01)]):
        direction = friction.step(np.array([length]))
    assert way * direction[0] < -0.5


@given(st.lists(st.floats(-0.1, 0.1), min_size=1, max_size=50))
def test_the_direction_of_friction_stays_within_one(lengths):
    friction = FrictionDirection()
    for length in lengths:
        assert np.abs(friction.step(np.array([length]))).max() <= 1.0 + 1e-9
