# SPDX-License-Identifier: Apache-2.0
"""Joint trajectories: interpolation, slowing, replacement and cancellation."""

from contextlib import nullcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from robots import write_robot

from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.messages.message_reading import TrajectoryPoints
from musculoskeletal_ae.motion.trajectory import Setpoint, Trajectory
from musculoskeletal_ae.robot.robot import Robot

ROBOT = Robot.load('arm26')
MIDDLE, REACH = 0.5 * (ROBOT.lower + ROBOT.upper), 0.5 * (ROBOT.upper - ROBOT.lower)
BOTH = np.array([0, 1])

shares = st.floats(-0.3, 0.3)
rows = st.lists(
    st.tuples(st.floats(0.5, 2.0), shares, shares, shares, shares, shares, shares),
    min_size=1,
    max_size=4,
)


def made(rows, order):
    """Return the points of a trajectory within the joint limits, and the trajectory through them.

    The points state positions and `order` derivatives: none, velocities, or accelerations as well.
    """
    table = np.array(rows)
    position = MIDDLE + REACH * table[:, 1:3]
    given_values = [0.3 * table[:, 3:5], table[:, 5:7]][:order] + [None] * (2 - order)
    points = TrajectoryPoints(BOTH, np.cumsum(table[:, 0]), position, *given_values)
    return points, Trajectory.through(Setpoint.resting(MIDDLE), points)


@hypothesis_settings(max_examples=40)
@given(rows, st.integers(0, 2), st.floats(1.0, 5.0))
def test_a_slowed_trajectory_passes_its_points_with_scaled_derivatives(rows, order, slower):
    points, trajectory = made(rows, order)
    trajectory = trajectory.scaled(slower)
    assert trajectory.duration == pytest.approx(slower * points.time[-1])
    at = trajectory.sample(slower * points.time * (1.0 - 1e-12))
    np.testing.assert_allclose(at.theta, points.position, atol=1e-6)
    if order > 0:
        np.testing.assert_allclose(at.velocity, points.velocity / slower, atol=1e-6)
    if order > 1:
        np.testing.assert_allclose(at.acceleration, points.acceleration / slower**2, atol=1e-4)
    np.testing.assert_array_equal(trajectory.sample(0.0).theta, MIDDLE)
    np.testing.assert_allclose(trajectory.sample(1e3).theta, points.position[-1])
    assert not trajectory.sample(1e3).velocity.any()
    time, theta = trajectory.path
    np.testing.assert_allclose(theta, trajectory.sample(time).theta, atol=1e-9)


def test_points_at_nearly_the_same_time_are_refused():
    # The last interval is too short for double precision at such large times [s].
    time = np.array([0.001, 3e5, 3e5 + 1e-9])
    points = TrajectoryPoints(BOTH, time, np.array([MIDDLE, MIDDLE, MIDDLE + REACH]), None, None)
    with pytest.raises(MessageError, match='points too close in time'):
        Trajectory.through(Setpoint.resting(MIDDLE), points)


@hypothesis_settings(max_examples=40)
@given(rows, st.integers(0, 2), st.floats(0.01, 0.99))
def test_velocity_and_acceleration_are_the_derivatives(rows, order, share):
    _, trajectory = made(rows, order)
    time, step = share * trajectory.duration, 1e-4
    if np.abs(trajectory.time - time).min() < 2 * step:
        return
    before, at, after = (trajectory.sample(time + d) for d in (-step, 0.0, step))
    slope = (after.theta - before.theta) / (2.0 * step)
    bend = (after.theta - 2.0 * at.theta + before.theta) / step**2
    np.testing.assert_allclose(slope, at.velocity, atol=1e-5)
    np.testing.assert_allclose(bend, at.acceleration, atol=1e-2, rtol=1e-3)


@hypothesis_settings(max_examples=40)
@given(rows, st.integers(0, 2))
def test_as_many_derivatives_are_continuous_as_the_points_have(rows, order):
    _, trajectory = made(rows, order)
    for time in trajectory.time[1:-1]:
        before, after = trajectory.sample(time - 1e-9), trajectory.sample(time + 1e-9)
        for part in range(order + 1):
            np.testing.assert_allclose(before[part], after[part], atol=1e-5)


def test_from_rest_to_rest_is_the_motion_of_least_jerk():
    trajectory = Trajectory.to(Setpoint.resting(MIDDLE), MIDDLE + 0.1, 2.0)
    u = np.linspace(0.0, 0.999, 9)[:, None]
    expected = MIDDLE + 0.1 * u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    np.testing.assert_allclose(trajectory.sample(2.0 * u[:, 0]).theta, expected, atol=1e-12)


def test_joints_not_named_stay_and_points_in_the_past_are_left_out():
    points = TrajectoryPoints(
        np.array([1]),
        np.array([0.0, 1.0, 2.0]),
        MIDDLE[1] + np.array([[0.5], [0.2], [0.1]]),
        None,
        None,
    )
    trajectory = Trajectory.through(Setpoint.resting(MIDDLE), points, passed=1.5)
    assert trajectory.duration == pytest.approx(0.5)
    np.testing.assert_allclose(trajectory.sample(0.5).theta, MIDDLE + [0.0, 0.1])
    np.testing.assert_allclose(trajectory.sample(0.25).theta, MIDDLE + [0.0, 0.05])
    with pytest.raises(MessageError, match='all points have passed'):
        Trajectory.through(Setpoint.resting(MIDDLE), points, passed=2.0)


def test_a_point_at_time_zero_is_approached_at_once():
    points = TrajectoryPoints(BOTH, np.array([0.0]), MIDDLE[None] + 0.1, None, None)
    trajectory = Trajectory.through(Setpoint.resting(MIDDLE), points)
    assert 0.0 < trajectory.duration < 0.02
    np.testing.assert_allclose(trajectory.end, MIDDLE + 0.1)
    with pytest.raises(MessageError, match=r'all points have passed.*0\.3 s ago'):
        Trajectory.through(Setpoint.resting(MIDDLE), points, passed=0.3)


def test_a_curve_that_leaves_the_joint_limits_between_its_points_is_refused():
    fast = np.array([[30.0, 0.0], [0.0, 0.0]])
    points = TrajectoryPoints(BOTH, np.array([0.5, 1.0]), np.array([MIDDLE, MIDDLE]), fast, None)
    with pytest.raises(MessageError, match='leaves the joint limits'):
        Trajectory.through(Setpoint.resting(MIDDLE), points).check(ROBOT)


@pytest.mark.parametrize('late', [0.0, 500.0])
def test_a_curve_that_leaves_the_joint_limits_briefly_in_a_long_trajectory_is_refused(late):
    time, rates = late + np.array([0.6, 1.6, 2.0, 5.0]), np.zeros((4, 2))
    rates[1] = 8.0
    points = TrajectoryPoints(BOTH, time, np.tile(MIDDLE, (4, 1)), rates, None)
    with pytest.raises(MessageError, match='leaves the joint limits'):
        Trajectory.through(Setpoint.resting(MIDDLE), points).check(ROBOT)


@pytest.mark.filterwarnings('ignore::RuntimeWarning')
def test_a_curve_whose_values_overflow_is_refused():
    rates = np.array([[1e308, 0.0], [0.0, 0.0]])
    points = TrajectoryPoints(BOTH, np.array([10.0, 20.0]), np.array([MIDDLE, MIDDLE]), rates, None)
    with pytest.raises(MessageError, match='the curve is not finite'):
        Trajectory.through(Setpoint.resting(MIDDLE), points).check(ROBOT)


def test_a_refusal_for_a_prismatic_joint_is_in_metres(tmp_path):
    robot = Robot.load(write_robot(tmp_path, slider=True))
    start, still = 0.5 * (robot.lower + robot.upper), np.zeros((1, 4))
    for off, reported in ((0.001, None), (0.01, 'wrist exceeds its limits by 0.01 m')):
        end = np.append(start[:3], robot.upper[3] + off / 0.06)
        points = TrajectoryPoints(np.arange(4), np.ones(1), end[None], still, None)
        trajectory = Trajectory.through(Setpoint.resting(start), points)
        with pytest.raises(MessageError, match=reported) if reported else nullcontext():
            trajectory.check(robot)


def test_stopping_comes_to_rest_from_any_motion_within_the_limits():
    start = Setpoint(ROBOT.upper - 0.05, np.array([2.0, -1.0]), np.array([3.0, 0.0]))
    trajectory = Trajectory.stopping(start, ROBOT)
    begun = trajectory.sample(0.0)
    for part, expected in zip(begun, start):
        np.testing.assert_allclose(part, expected, atol=1e-9)
    assert (trajectory.end <= ROBOT.upper).all()
    assert not trajectory.sample(trajectory.duration).velocity.any()


def test_a_motion_that_comes_to_rest_only_gets_slower():
    start = Setpoint(MIDDLE, np.array([0.6, -0.4]), np.zeros(2))
    trajectory = Trajectory.stopping(start, ROBOT)
    speed = np.abs(trajectory.sample(np.linspace(0.0, trajectory.duration, 50)).velocity)
    assert (np.diff(speed, axis=0) <= 1e-9).all()
