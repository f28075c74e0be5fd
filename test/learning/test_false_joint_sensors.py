# SPDX-License-Identifier: Apache-2.0
"""The learner does not learn from joint sensors that the estimator doubts."""

import numpy as np
import pytest

from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.signals.joint_trust_message import JointTrust, SensorTrust


def trust(elbow, since=np.nan):
    return JointTrust((SensorTrust.TRUSTED, elbow), np.array([np.nan, since]), np.zeros(2))


class Taught:
    """A store with ten samples, and the newest trust in the joint sensors."""

    def __init__(self, stage):
        self.samples, self.trust = SampleStore(), JointTrust.full(2)
        self.add(stage)

    def add(self, stage):
        for now in range(1, 11):
            self.samples.add(stage.sample(), time=float(now))

    def use(self, trust):
        before, self.trust = self.trust, trust
        return self.samples.use_trust(before, trust)


@pytest.fixture
def taught(stage):
    """Return ten samples, taken in ten seconds while all sensors were trusted."""
    return Taught(stage)


def elbows(samples):
    return np.array([sample.theta[1] for sample in samples.samples])


def test_readings_of_the_doubtful_time_are_given_up_for_good_if_the_sensor_is_mended(taught):
    samples = taught.samples
    before = elbows(samples)
    assert taught.use(trust(SensorTrust.DOUBTED, 6.0)) == (1,)
    for _ in range(2):
        assert (elbows(samples)[:5] == before[:5]).all()
        assert np.isnan(elbows(samples)[5:]).all()
        assert np.isfinite([sample.theta[0] for sample in samples.samples]).all()
        taught.use(trust(SensorTrust.TRUSTED, 6.0))
    assert np.isnan(elbows(samples)[5:]).all()


def test_readings_of_the_doubtful_time_come_back_if_the_user_confirms_them(taught):
    samples = taught.samples
    before = elbows(samples)
    taught.use(trust(SensorTrust.DOUBTED, 6.0))
    taught.use(trust(SensorTrust.CONFIRMED, 6.0))
    assert (elbows(samples) == before).all()


def test_readings_of_samples_that_were_held_back_come_back_as_well(taught):
    samples = taught.samples
    samples.offset = np.zeros(6)
    before = elbows(samples)
    samples.hold(10.0)
    taught.use(trust(SensorTrust.DOUBTED, 6.0))
    samples.use_offset(np.zeros(6))
    assert np.isnan(elbows(samples)[5:]).all()
    samples.hold(10.0)
    taught.use(trust(SensorTrust.CONFIRMED, 6.0))
    samples.use_offset(np.zeros(6))
    assert (elbows(samples) == before).all()


def test_readings_during_impossible_ones_are_given_up_even_if_the_sensor_was_confirmed(taught):
    samples = taught.samples
    taught.use(trust(SensorTrust.CONFIRMED, 2.0))
    assert taught.use(trust(SensorTrust.IMPOSSIBLE, 6.0)) == (1,)
    taught.use(trust(SensorTrust.CONFIRMED, 6.0))
    assert np.isnan(elbows(samples)[5:]).all()
    assert np.isfinite(elbows(samples)[:5]).all()


def test_angles_of_samples_that_were_cleared_meanwhile_do_not_come_back(taught, stage):
    taught.use(trust(SensorTrust.DOUBTED, 6.0))
    taught.samples.clear()
    taught.add(stage)
    before = elbows(taught.samples)
    taught.use(trust(SensorTrust.CONFIRMED, 6.0))
    assert (elbows(taught.samples) == before).all()


def test_a_trust_survives_its_message():
    sent = trust(SensorTrust.DOUBTED, 90.0)
    received = JointTrust.from_rows(sent.rows(100.0), 1e9)
    assert received.trust == sent.trust
    assert received.since[1] == pytest.approx(1e9 - 10.0)
    assert np.isnan(received.since[0])
