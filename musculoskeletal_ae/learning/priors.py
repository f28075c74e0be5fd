# SPDX-License-Identifier: Apache-2.0
"""What is known of a body before any sample: physical spreads round the geometric model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.body import Layout
from musculoskeletal_ae.learning.posture_model import PostureModel
from musculoskeletal_ae.learning.stops import sensor_zeros

# For prismatic joints, [rad] below are times RACK [m].
#: What the body does not know is common to all samples. Therefore they count as no more than these
#: in what they say of an offset; and torque and stops of joints that no sensor reads, in how much
#: all that leaves open.
ALIKE = 10.0
SENSOR = 0.002  # σ_y of a joint sensor [rad]
SMALL = 1e-6  # [rad], least σ_y


@dataclass(frozen=True)
class Prior:
    """How much a body differs from its geometric model (one standard deviation each)."""

    attachment: float = 0.007  # each coordinate of each route point [m]
    elastic: float = 0.2  # logarithm of each elastic constant
    friction: float = 0.05  # relative tension loss along the route, around its mean
    friction_mean: float = 0.05
    offset: float = 0.001  # zero of the length sensor [m]
    creep: float = 1e-5  # of a wire, from one sample to the next [m]
    smooth: float = 0.002  # the residual model [m]

    def spread(self, layout: Layout) -> Array:
        """Return s of every parameter of a muscle."""
        spread = np.empty(layout.size)
        spread[layout.attachment] = self.attachment
        spread[layout.elastic] = self.elastic
        spread[layout.friction] = self.friction
        spread[layout.offset], spread[layout.creep] = self.offset, self.creep
        spread[layout.rest] = self.smooth
        return spread

    def mean(self, layout: Layout) -> Array:
        """Return the prior mean of every parameter of a muscle."""
        mean = np.zeros(layout.size)
        mean[layout.friction] = self.friction_mean
        return mean


PRIOR = Prior()
#: of a muscle that was replaced or re-wired, around what it was before
REOPENED = Prior(attachment=0.004, elastic=0.3, offset=0.03, smooth=0.001)


class MusclePrior(NamedTuple):
    """Mean w̄ and spread s of the parameters of one muscle, (P,) each."""

    mean: Array
    spread: Array


@dataclass
class GroupPrior:
    """What is known before the samples, and how far each sensor is to be trusted.

    Attributes:
        mean: w̄, (W,).
        precision: 1/s², (W,).
        zero: z̄ [rad], (D,).
        zero_precision: 1/s_z², (D,).
        angle_precision: 1/σ_y², 0 where nothing was read, (N, D).
        repeated: How many readings of a joint sensor count as one, (D,).
        unread: How many samples count as one for a joint that no sensor reads, (D,).
    """

    mean: Array
    precision: Array
    zero: Array
    zero_precision: Array
    angle_precision: Array
    repeated: Array
    unread: Array

    @classmethod
    def of(cls, model: PostureModel, mean: list[Array], spread: list[Array]) -> GroupPrior:
        """Return that of a group; `mean` and `spread` are those of its muscles."""
        observed, robot, by_sensor = model.observed, model.body.robot, model.by_sensor
        radian = robot.kinematics.radian
        angle_spread = np.where(by_sensor, SENSOR * radian, observed.spread)
        repeated = np.maximum(1.0, by_sensor.sum(axis=0) / ALIKE)
        readings = np.where(by_sensor, observed.theta, np.nan)
        zero, zero_spread = sensor_zeros(readings, robot.lower, robot.upper, radian)
        return cls(
            mean=np.concatenate(mean),
            precision=np.concatenate([1.0 / each**2 for each in spread]),
            zero=zero,
            zero_precision=repeated / zero_spread**2,
            angle_precision=np.where(
                model.is_read, 1.0 / np.maximum(angle_spread, SMALL) ** 2, 0.0
            ),
            repeated=repeated,
            unread=np.maximum(1.0, (~by_sensor).sum(axis=0) / ALIKE),
        )

    def deviation(self, parameters: list[Array]) -> Array:
        """Return w̄ − w, (W,)."""
        return self.mean - np.concatenate(parameters)
