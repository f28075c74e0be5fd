# SPDX-License-Identifier: Apache-2.0
"""A network without error, as if it had learned the geometric model perfectly."""

from typing import Any

import numpy as np

from musculoskeletal_ae.signals.friction import Transmission


class ExactMae:
    """The methods of a `Mae` that control uses, computed from the geometric model."""

    def __init__(self, robot: Any) -> None:
        self.robot = robot
        self.friction = np.zeros(robot.muscle_count)
        self.transmission = Transmission(self.friction)
        self.preset, self.version = 'default', 0
        self.elasticity = self.touch = self.covariance = None
        self.offset = 0.0  # error of every length [m], by which tests tell networks apart
        self.fail: Exception | None = None

    def lengths(self, theta, tension):
        if self.fail:
            raise self.fail
        return self.robot.muscle_lengths(theta, tension) + self.offset

    def muscle_jacobian(self, theta, tension):
        slope = self.robot.series_elastic.length_slope(tension)[..., None]
        return self.robot.routes.muscle_jacobian(theta) * (1.0 - slope)

    def lengths_with_pullback(self, theta, tension):
        jacobian = self.muscle_jacobian(theta, tension)
        return self.lengths(theta, tension), lambda g: np.einsum('nm,nmd->nd', g, jacobian)


def rest_readings(robot, theta, tension=None):
    """Return noiseless (l, T) of the geometric model at rest."""
    tension = np.full(robot.muscle_count, robot.tension.bias) if tension is None else tension
    return robot.muscle_lengths(theta, tension), tension
