# SPDX-License-Identifier: Apache-2.0
"""Finds the slowest moments of a recording in which the arm never rests, as samples.

A muscle length depends on θ and T alone, l = f(θ) − e(T), also in motion: weight and inertia act on
it only through T. What differs from rest is that the readings of a message may be from different
times. With a skew δ between the readings of joints and muscles, the error of a sample is

    l − l(θ, T) ≈ G(θ) θ̇ δ,

so it grows with the speed. Therefore only the slowest moment of each PERIOD becomes a sample, the
mean of its readings. A rest, if there is one, is the slowest moment.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.body_model.observations import NOTHING, Sample
from musculoskeletal_ae.learning.samples import MOMENT_ARM

PERIOD = 1.0  # learn the slowest moment of each interval of this duration [s]
MOMENT = 0.1  # average the readings of a moment over this duration [s]
LEAST_READINGS = 3  # average at least this many readings of a moment, from which its speed follows
LONGEST_GAP = 0.3  # discard the readings before a gap longer than this [s]


class SlowMoments:
    """Turns the readings of a moving arm into samples, with the interface of `RestDetector`."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Reset the detector: discard all readings, for example after a jump of the clock."""
        self._time = 0.0  # time of the newest reading since the start of the period [s]
        self._readings: list[tuple[float, Sample]] = []  # times and readings of the present moment
        #: speed [rad/s] and mean of the slowest moment of this period so far
        self._slowest: tuple[float, Sample] | None = None

    def step(self, reading: Sample, dt: float) -> Sample | None:
        """Add a reading; return the slowest moment when a period ends, otherwise None.

        Args:
            reading: The reading, with NaN for unmeasured θ.
            dt: Time since the previous reading [s].
        """
        if dt > LONGEST_GAP:
            self.reset()
        self._time += dt
        self._readings.append((self._time, reading))
        began = self._readings[0][0]
        if self._time - began >= MOMENT - 1e-9 and len(self._readings) >= LEAST_READINGS:
            self._end_moment()
        if self._time < PERIOD or self._slowest is None:
            return None
        _, sample = self._slowest
        self._time, self._slowest, self._readings = 0.0, None, []
        return sample

    def _end_moment(self) -> None:
        times = np.array([time for time, _ in self._readings])
        newest = self._readings[-1][1]
        theta, tension, length, direction = (
            np.array(part) for part in [*zip(*(reading for _, reading in self._readings))][:4]
        )
        self._readings = []
        known = np.isfinite(theta)
        whole = known.all(axis=0)
        # A joint that only some of the readings contain has no mean at the middle of the moment.
        if not whole.any() or (known.any(axis=0) & ~whole).any():
            return
        by_joints = np.linalg.norm(_rate(times, theta[:, whole]))
        by_muscles = np.abs(_rate(times, length)).max() / MOMENT_ARM
        speed = float(max(by_joints, by_muscles))
        if self._slowest is None or speed < self._slowest[0]:
            mean = newest._replace(
                theta=theta.mean(axis=0),
                tension=tension.mean(axis=0),
                length=length.mean(axis=0),
                direction=direction.mean(axis=0),
                gravity=NOTHING,  # an accelerometer of a moving arm does not show gravity
            )
            self._slowest = speed, mean


def _rate(times: Array, values: Array) -> Array:
    """Return the slope of each column of readings by least squares [1/s]."""
    away = times - times.mean()
    slope: Array = away @ values / (away @ away)
    return slope
