# SPDX-License-Identifier: Apache-2.0
"""Expected differences between a real arm and its geometric model."""

from types import SimpleNamespace

import numpy as np

from musculoskeletal_ae.robot.model_errors import (
    ATTACHMENT,
    SHAPE_FACTOR,
    SMOOTH,
    attachment_spread,
    length_variances,
)
from musculoskeletal_ae.robot.robot import Robot


def test_the_variance_of_lengths_is_that_of_arms_with_displaced_route_points():
    robot, rng = Robot.load('arm26'), np.random.default_rng(0)
    routes, tree = robot.routes, robot.kinematics.tree
    theta = robot.random_postures(20, rng)

    def lengths(point):
        at_theta, at_zero = (tree.joint_poses(rows) for rows in (theta, 0.0 * theta[:1]))
        return routes.moved(at_theta, point)[0] - routes.moved(at_zero, point)[0]

    shape, nominal = routes.point.shape, lengths(routes.point)
    drawn = [lengths(routes.point + ATTACHMENT * rng.normal(size=shape)) for _ in range(400)]
    by_points = np.square(drawn - nominal).mean(axis=0)
    expected = SHAPE_FACTOR**2 * (by_points + SMOOTH**2)
    np.testing.assert_allclose(length_variances(robot, theta), expected, rtol=0.3)
    assert length_variances(robot, 0.0 * theta)[0, 0] == SHAPE_FACTOR**2 * SMOOTH**2


def test_points_of_muscles_with_short_moment_arms_are_expected_to_deviate_less():
    arms = np.array([0.04, 0.01, 0.005, 0.0])
    finger = SimpleNamespace(routes=SimpleNamespace(typical_arms=arms))
    spread = attachment_spread(finger)
    assert spread[0] == ATTACHMENT
    assert (spread[1:3] < 0.5 * arms[1:3]).all()
    assert spread[3] > 0.0  # a muscle that crosses no joint can be fitted as well
    for name in ('arm26', 'musashi_left_arm', 'musashi_upper_body'):
        assert (attachment_spread(Robot.load(name)) == ATTACHMENT).all()
