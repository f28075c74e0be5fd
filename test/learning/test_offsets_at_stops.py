# SPDX-License-Identifier: Apache-2.0
"""Offsets of joint sensors, estimated from the stops of the joints."""

import numpy as np
import pytest

from musculoskeletal_ae.body_model.sensor_offsets import ROUGH_OFFSET, STOP_SPREAD, sensor_zeros

LOWER, UPPER = np.array([-0.4, -1.5, -0.8]), np.array([1.2, 0.1, 0.8])
TRUE = np.array([0.05, -0.04, 0.0])  # offsets of the joint sensors [rad], which are to be found


def rests(count: int = 150, beyond: float = 0.3, seed: int = 0) -> np.ndarray:
    """Return true θ [rad] (N, D) of an arm with stops at its limits."""
    rng = np.random.default_rng(seed)
    theta = rng.uniform(LOWER - beyond, UPPER + beyond, (count, len(LOWER)))
    give = 0.003 * rng.exponential(size=theta.shape)
    return np.clip(theta, LOWER - give, UPPER + give)


def within(margin: float) -> np.ndarray:
    """Return true θ [rad] of an arm that keeps a distance from its limits."""
    return np.random.default_rng(3).uniform(LOWER + margin, UPPER - margin, (150, 3))


def estimated_zeros(read) -> tuple[np.ndarray, np.ndarray]:
    return sensor_zeros(read, LOWER, UPPER)


@pytest.mark.parametrize('seed', range(5))
def test_readings_at_the_stops_give_the_joint_sensor_offsets(seed):
    noise = 0.002 * np.random.default_rng(9).standard_normal((150, 3))
    zero, spread = estimated_zeros(rests(seed=seed) + TRUE + noise)
    assert zero == pytest.approx(TRUE, abs=STOP_SPREAD)
    assert (spread < 0.5 * ROUGH_OFFSET).all()


def test_a_sensor_without_offset_is_not_corrected():
    zero, _ = estimated_zeros(rests())
    assert zero == pytest.approx(np.zeros(3), abs=0.005)


def test_joints_that_never_reach_a_stop_give_no_offset():
    zero, spread = estimated_zeros(within(0.1) + TRUE)
    assert zero == pytest.approx(np.zeros(3), abs=0.003)
    assert (spread > 0.5 * ROUGH_OFFSET).all()


@pytest.mark.parametrize('count', [20, 60, 200])
def test_a_few_readings_close_together_are_no_stop(count):
    rng = np.random.default_rng(4)
    for _ in range(10):
        zero, _ = estimated_zeros(rng.uniform(LOWER, UPPER, (count, 3)))
        assert np.linalg.norm(zero) < 2.0 * STOP_SPREAD


def test_one_posture_held_near_a_limit_is_no_stop():
    theta = within(0.1)
    held = LOWER + 0.04 + 0.001 * np.random.default_rng(1).standard_normal((40, 3))
    zero, _ = estimated_zeros(np.vstack([theta, held]))
    assert zero == pytest.approx(np.zeros(3), abs=0.005)


def test_a_joint_parked_near_a_limit_while_others_move_is_no_stop():
    theta = within(0.1)
    theta[50:] = LOWER + 0.04 + 0.001 * theta[50:] * [1, 0, 0] + within(0.1)[50:] * [0, 1, 1]
    zero, _ = estimated_zeros(theta)
    assert zero[0] == pytest.approx(0.0, abs=0.005)


def test_limits_that_stop_nothing_are_not_taken_for_stops():
    rng = np.random.default_rng(2)
    theta = rng.uniform(LOWER - 0.1, UPPER + 0.1, (150, 3))
    zero, _ = estimated_zeros(theta)
    assert zero == pytest.approx(np.zeros(3), abs=STOP_SPREAD)


def test_a_joint_without_sensor_has_no_offset():
    read = rests() + TRUE
    read[:, 1] = np.nan
    zero, spread = estimated_zeros(read)
    assert zero == pytest.approx(TRUE * [1, 0, 1], abs=STOP_SPREAD)
    assert np.isfinite(spread).all()
    read[:] = np.nan
    assert estimated_zeros(read[:0])[0] == pytest.approx(np.zeros(3))
