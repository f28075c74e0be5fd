# SPDX-License-Identifier: Apache-2.0
"""Samples of an arm that never rests."""

import numpy as np

from musculoskeletal_ae.body_model.observations import Sample
from musculoskeletal_ae.learning.slow_moments import MOMENT, SlowMoments


def samples(time, theta):
    """Return the samples of a motion of one joint, whose muscle follows it by 40 mm/rad."""
    found = SlowMoments()
    steps = np.diff(time, prepend=time[0])
    for at, dt in zip(theta, steps, strict=True):
        angle = np.array([at])
        reading = Sample(angle, np.array([50.0]), -0.04 * angle, np.zeros(1))
        if (sample := found.step(reading, dt)) is not None:
            yield sample


def test_the_slowest_moment_of_each_second_is_a_sample():
    time = 0.01 * np.arange(1000)
    theta = np.cos(np.pi * time)  # turns back at each full second
    found = [*samples(time, theta)]
    assert len(found) in (9, 10)
    for sample in found:
        assert abs(abs(sample.theta[0]) - 1.0) < 0.5 * (np.pi * MOMENT) ** 2
        assert np.isclose(sample.length[0], -0.04 * sample.theta[0])


def test_a_rest_is_the_slowest_moment():
    time = 0.01 * np.arange(1000)
    theta = np.interp(time % 2.0, [0.0, 1.0, 1.3, 2.0], [0.0, 1.0, 1.0, 0.0])
    near = [sample.theta[0] for sample in samples(time, theta)]
    assert sum(value > 0.99 for value in near) >= 4


def test_moments_do_not_extend_over_a_gap():
    time = np.concatenate([0.01 * np.arange(300), 5.0 + 0.01 * np.arange(300)])
    theta = np.where(time < 4.0, 0.1 * time, 2.0 + 0.1 * (time - 5.0))
    values = np.array([sample.theta[0] for sample in samples(time, theta)])
    assert ((values < 0.31) | (values > 1.99)).all()


def test_readings_before_a_gap_are_not_averaged_with_those_after_it():
    for before in range(301, 312):  # 11 consecutive counts, because an average is over 11 readings
        time = np.concatenate([0.01 * np.arange(before), 5.0 + 0.01 * np.arange(300)])
        theta = np.where(time < 4.0, time, time - 1.0)  # slower in the gap than elsewhere
        values = np.array([sample.theta[0] for sample in samples(time, theta)])
        assert ((values < 0.01 * before) | (values >= 4.0)).all()
