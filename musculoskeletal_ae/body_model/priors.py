# SPDX-License-Identifier: Apache-2.0
"""Priors of the body's parameters: physical spreads around the geometric model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.body_model.calibrated_body import Layout
from musculoskeletal_ae.body_model.posture_model import PostureModel
from musculoskeletal_ae.body_model.sensor_offsets import sensor_zeros
from musculoskeletal_ae.robot.model_errors import ATTACHMENT, ELASTIC
from musculoskeletal_ae.signals.friction import DRIVE_FRICTION_MEAN, DRIVE_SPREAD

#: Weigh all samples together as at most this many independent ones, because they share the errors
#: of the body model. This applies to joint-sensor offsets, springs of the joints, constants of
#: motor currents, and joints without a sensor (torque and stops).
INDEPENDENT_SAMPLES = 10.0
SENSOR_NOISE = 0.002  # expect readings of a joint sensor to have this standard deviation [rad]
LEAST_ANGLE_NOISE = 1e-6  # assume at least this standard deviation of a measured angle [rad]


@dataclass(frozen=True)
class Prior:
    """Means and standard deviations σ of the differences between a body and its geometric model."""

    attachment: float = ATTACHMENT  # largest σ of each coordinate of each route point [m]
    elastic: float = ELASTIC  # σ of the logarithm of each elastic constant
    friction: float = 0.05  # σ of the tendon friction μ around `friction_mean`
    friction_mean: float = 0.05  # mean of the tendon friction μ
    offset: float = 0.001  # σ of the offset of the length sensor [m]
    creep: float = 1e-5  # σ of the creep of a tendon from one sample to the next [m]
    #: σ of the logarithm of a motor current's scale, and of its offset and drive friction as shares
    #: of T_limit
    drive: tuple[float, float, float] = DRIVE_SPREAD
    #: mean of the drive friction as a share of T_limit
    drive_friction_mean: float = DRIVE_FRICTION_MEAN

    def spread(self, layout: Layout, attachment: float) -> Array:
        """Return the prior spread s of every parameter of a muscle.

        Args:
            layout: The muscle's parameters.
            attachment: σ of its route points, from `attachment_spread` [m].
        """
        spread = np.empty(layout.size)
        spread[layout.attachment] = min(self.attachment, attachment)
        spread[layout.elastic] = self.elastic
        spread[layout.friction] = self.friction
        spread[layout.offset], spread[layout.creep] = self.offset, self.creep
        spread[layout.drive] = self.drive[: layout.drive.stop - layout.drive.start]
        return spread

    def mean(self, layout: Layout) -> Array:
        """Return the prior mean of every parameter of a muscle."""
        mean = np.zeros(layout.size)
        mean[layout.friction] = self.friction_mean
        mean[layout.drive][2:] = self.drive_friction_mean
        return mean


PRIOR = Prior()  # expect a body to differ this much from its geometric model
#: expect a replaced muscle or tendon to differ this much from its earlier parameters
REOPENED = Prior(attachment=0.004, elastic=0.3, offset=0.03)


class MusclePrior(NamedTuple):
    """Mean w̄ and spread s of the parameters of one muscle, (P,) each."""

    mean: Array
    spread: Array


@dataclass
class GroupPrior:
    """Prior of one group, and the accuracy of its joint sensors.

    Attributes:
        mean: Prior means w̄ of the parameters of all muscles, (W,).
        precision: Inverse squares of their prior spreads, 1/s², (W,).
        zero: Prior means z̄ of the joint-sensor offsets [rad], (D,).
        zero_precision: Inverse squares of their prior spreads, 1/s_z² [1/rad²], (D,).
        angle_precision: Inverse variances of the measured angles, 1/σ_y² [1/rad²], (N, D); 0 where
            the angle was not measured.
        repeated: Number of readings of a joint sensor that together have the weight of a single
            independent one, (D,).
        unread: Number of samples that together have the weight of a single independent one, for a
            joint without a sensor, (D,).
        spring_precision: Inverse squares of the prior spreads of the springs' corrections, 1/s_e²:
            first of α of all S joints with springs, then of β, (2S,).
    """

    mean: Array
    precision: Array
    zero: Array
    zero_precision: Array
    angle_precision: Array
    repeated: Array
    unread: Array
    spring_precision: Array

    @classmethod
    def of(cls, model: PostureModel, muscles: list[MusclePrior]) -> GroupPrior:
        """Return the prior of a group, with the priors of its muscles."""
        observed, robot, by_sensor = model.observed, model.body.robot, model.by_sensor
        angle_spread = np.where(by_sensor, SENSOR_NOISE, observed.spread)
        repeated = np.maximum(1.0, by_sensor.sum(axis=0) / INDEPENDENT_SAMPLES)
        readings = np.where(by_sensor, observed.theta, np.nan)
        zero, zero_spread = sensor_zeros(readings, robot.lower, robot.upper)
        repeated_samples = max(1.0, len(readings) / INDEPENDENT_SAMPLES)
        return cls(
            mean=np.concatenate([prior.mean for prior in muscles]),
            precision=np.concatenate([1.0 / prior.spread**2 for prior in muscles]),
            zero=zero,
            zero_precision=repeated / zero_spread**2,
            angle_precision=np.where(
                model.is_read, 1.0 / np.maximum(angle_spread, LEAST_ANGLE_NOISE) ** 2, 0.0
            ),
            repeated=repeated,
            unread=np.maximum(1.0, (~by_sensor).sum(axis=0) / INDEPENDENT_SAMPLES),
            spring_precision=repeated_samples / model.spring_spread.ravel() ** 2,
        )

    def deviation(self, parameters: list[Array]) -> Array:
        """Return the difference w̄ − w between the prior mean and given parameters, (W,)."""
        return self.mean - np.concatenate(parameters)
