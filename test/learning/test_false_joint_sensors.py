# SPDX-License-Identifier: Apache-2.0
"""The learner does not learn from joint sensors that the estimator doubts."""

import numpy as np
import pytest

from musculoskeletal_ae.learning.sample_history import JointHistory
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.signals.joint_trust_message import JointTrust, SensorTrust


def trust(elbow, since=np.nan):
    return JointTrust((SensorTrust.TRUSTED, elbow), np.array([np.nan, since]), np.zeros(2))


@pytest.fixture
def taught(stage):
    """Return ten samples, taken in ten seconds, and their history."""
    samples = SampleStore()
    history = JointHistory(samples, 2)
    for now in range(1, 11):
        samples.add(stage.sample(), time=float(now))
    return samples, history


def elbows(samples):
    return np.array([sample.theta[1] for sample in samples.samples])


def test_readings_of_the_doubtful_time_are_given_up_for_good_if_the_sensor_is_mended(taught):
    samples, history = taught
    before = elbows(samples)
    assert history.use(trust(SensorTrust.DOUBTED, 6.0)) == (1,)
    for _ in range(2):
        assert (elbows(samples)[:5] == before[:5]).all()
        assert np.isnan(elbows(samples)[5:]).all()
        assert np.isfinite([sample.theta[0] for sample in samples.samples]).all()
        history.use(trust(SensorTrust.TRUSTED, 6.0))
    assert np.isnan(elbows(samples)[5:]).all()


def test_readings_of_the_doubtful_time_come_back_if_the_user_confirms_them(taught):
    samples, history = taught
    before = elbows(samples)
    history.use(trust(SensorTrust.DOUBTED, 6.0))
    history.use(trust(SensorTrust.CONFIRMED, 6.0))
    assert (elbows(samples) == before).all()


def test_readings_during_impossible_ones_are_given_up_even_if_the_sensor_was_confirmed(taught):
    samples, history = taught
    history.use(trust(SensorTrust.CONFIRMED, 2.0))
    assert history.use(trust(SensorTrust.IMPOSSIBLE, 6.0)) == (1,)
    history.use(trust(SensorTrust.CONFIRMED, 6.0))
    assert np.isnan(elbows(samples)[5:]).all()
    assert np.isfinite(elbows(samples)[:5]).all()


def test_a_trust_survives_its_message():
    sent = trust(SensorTrust.DOUBTED, 90.0)
    received = JointTrust.from_rows(sent.rows(100.0), 1e9)
    assert received.trust == sent.trust
    assert received.since[1] == pytest.approx(1e9 - 10.0)
    assert np.isnan(received.since[0])
