# SPDX-License-Identifier: Apache-2.0
"""The true routes: wrapping against geometry, Jacobian against differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from musculoskeletal_ae.emulator.individual import NOMINAL, Individual, Spread
from musculoskeletal_ae.emulator.wrapping import segment_length
from musculoskeletal_ae.robot.robot import Robot


def wire(start, end, radius):
    """Return length and pulls of a wire past a ball at the origin."""
    leave, arrive = np.zeros(3), np.zeros(3)
    ends = np.array(start, float), np.array(end, float)
    return segment_length(*ends, np.zeros(3), radius, leave, arrive), leave, arrive


@pytest.mark.parametrize(
    ('start', 'end', 'expected'),
    [
        ([1.0, -0.5, 0.0], [1.0, 0.5, 0.0], 1.0),  # misses the ball
        ([1.0, -0.5, 0.0], [-1.0, -0.5, 0.0], 2.0),  # just touches it
        # straight at the centre: two tangents and an arc
        ([1, 0, 0], [-1, 0, 0], 2 * np.sqrt(0.75) + 0.5 * (np.pi - 2 * np.arccos(0.5))),
    ],
)
def test_a_wire_is_straight_or_two_tangents_and_an_arc(start, end, expected):
    assert wire(start, end, 0.5)[0] == pytest.approx(expected)


point = st.tuples(*[st.floats(-0.3, 0.3)] * 3)


@given(point, point, st.floats(0.001, 0.1))
def test_wrapping_never_shortens_and_pulls_with_unit_force(start, end, radius):
    straight = np.linalg.norm(np.subtract(end, start))
    value, leave, arrive = wire(start, end, radius)
    assert value >= straight - 1e-9
    if straight > 1e-6:
        assert np.linalg.norm(leave) == pytest.approx(1.0, abs=1e-4)
        assert np.linalg.norm(arrive) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize('name', ['arm26', 'musashi_left_arm'])
def test_true_jacobian_is_the_derivative_of_true_lengths(name):
    robot = Robot.load(name)
    body = Individual(robot, 3, Spread(wrap=0.9))
    theta = robot.random_postures(20, np.random.default_rng(0))
    jacobian = body.muscle_jacobian(theta)
    step = 1e-6
    for joint in range(robot.joint_count):
        shift = step * np.eye(robot.joint_count)[joint]
        up, down = body.absolute_lengths(theta + shift), body.absolute_lengths(theta - shift)
        # A posture within `step` of touching a bone has no derivative there: allow one in twenty.
        error = np.abs((up - down) / (2 * step) - jacobian[:, :, joint]).max(axis=1)
        assert np.sum(error > 1e-6) <= 1


def test_the_nominal_body_is_the_geometric_model():
    robot = Robot.load('musashi_left_arm')
    body = Individual(robot, 0, NOMINAL)
    rng = np.random.default_rng(1)
    theta = robot.random_postures(50, rng)
    tension = rng.uniform(0.0, 500.0, (50, robot.muscle_count))
    expected = robot.muscle_lengths(theta, tension)
    np.testing.assert_allclose(body.muscle_lengths(theta, tension), expected, atol=1e-12)
    np.testing.assert_allclose(
        body.muscle_jacobian(theta), robot.routes.muscle_jacobian(theta), atol=1e-9
    )


def test_a_seed_is_one_individual_and_another_seed_is_another():
    robot = Robot.load('arm26')
    theta = robot.random_postures(5, np.random.default_rng(0))
    one, same, other = (Individual(robot, s).absolute_lengths(theta) for s in (4, 4, 5))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 1e-3
    assert np.abs(one - robot.routes.absolute_lengths(theta)).max() > 1e-3
