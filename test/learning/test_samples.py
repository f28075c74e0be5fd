# SPDX-License-Identifier: Apache-2.0
"""Rest detection, friction, novelty, the store with its budget, and rejected samples."""

from contextlib import suppress

import numpy as np
import pytest
from readings import reading as message

from musculoskeletal_ae.body_model.observations import Sample
from musculoskeletal_ae.estimation.finding import DETECTION_DELAY
from musculoskeletal_ae.learning.collector import SampleCollector
from musculoskeletal_ae.learning.detector_calibration import Reservoir
from musculoskeletal_ae.learning.rest import RestDetector
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.signals.body_state import Anomaly, LengthOffsets
from musculoskeletal_ae.signals.muscle_stream import RejectionError
from musculoskeletal_ae.signals.reading_limits import LIMITS

DT = 0.01


def reading(theta, length):
    return Sample(np.broadcast_to(theta, 2), np.full(6, 50.0), np.full(6, length), np.zeros(6))


def run(detector, seconds, theta=lambda _: 0.0, length=lambda _: 0.0, measured=lambda _: True):
    rests = []
    for n in range(round(seconds / DT)):
        angle = theta(n * DT) if measured(n) else np.nan
        rest = detector.step(reading(angle, length(n * DT)), DT)
        if rest is not None:
            rests.append(rest)
    return rests


def each_some(t, still=True):
    """Return the readings of two joint sensors at the time `t` [s], one of which is NaN.

    The sensors take turns, as if two nodes published one joint each. With `still`, the joints do
    not move.
    """
    angles = np.array([0.3, 0.3 if still else 0.3 + 0.05 * t])
    angles[round(t / 0.01) % 2] = np.nan
    return angles


def test_joint_angles_published_by_two_nodes_are_averaged():
    (rest_sample, *_) = run(RestDetector(), 3.5, each_some)
    np.testing.assert_allclose(rest_sample.theta, [0.3, 0.3])
    assert run(RestDetector(), 3.5, lambda t: each_some(t, still=False)) == []


def test_a_still_arm_gives_its_mean_once_a_second():
    rest_sample = run(RestDetector(), 3.5, lambda _: 0.3, lambda _: 0.01)
    assert len(rest_sample) == 3
    np.testing.assert_allclose(rest_sample[0].theta, 0.3)
    np.testing.assert_allclose(rest_sample[0].length, 0.01)


def test_a_moving_joint_or_tendon_is_no_rest():
    assert run(RestDetector(), 3.0, theta=lambda t: 0.05 * t) == []
    assert run(RestDetector(), 3.0, length=lambda t: 0.01 * t) == []


@pytest.mark.parametrize('before', [0.1, 0.7, 3.0, 12.3])
def test_a_rest_does_not_depend_on_what_was_before_it(before):
    # Both joints move, rest from 0.5 s to 1.4 s, and move again.
    def theta(t):
        return max(0.0, 0.5 - t) + max(0.0, t - 1.4)

    def rest(detector, before):
        (rest_sample,) = run(detector, before + 3.0, *[lambda t: theta(t - before)] * 2)
        return rest_sample

    used = RestDetector()
    for _ in range(2):
        rest_sample, expected = rest(used, before), rest(RestDetector(), 0.0)
        np.testing.assert_allclose(rest_sample.length, expected.length, atol=1e-9)
        used.reset()


def test_a_rest_that_ends_early_still_counts():
    rests = run(RestDetector(), 2.0, theta=lambda t: max(0.0, t - 0.6))
    assert len(rests) == 1
    np.testing.assert_allclose(rests[0].theta, 0.0, atol=0.01)


def test_sparse_noisy_angles_of_a_camera_are_averaged():
    rng = np.random.default_rng(0)
    rests = run(
        RestDetector(),
        10.0,
        theta=lambda _: 0.5 + 0.02 * rng.standard_normal(),
        measured=lambda n: n % 3 == 0,
    )
    assert len(rests) >= 5
    errors = [f.theta[0] - 0.5 for f in rests]
    assert np.std(errors) < 0.01


@pytest.mark.parametrize('rate', [1.0, 18.9, 100.0])
def test_rest_is_detected_at_any_message_rate(rate):
    detector = RestDetector()
    rests = [detector.step(reading(0.3, 0.01), 1.0 / rate) for _ in range(round(13.0 * rate))]
    assert any(rest is not None for rest in rests)
    detector.reset()
    moving = [
        detector.step(reading(0.05 * n / rate, 0.01), 1.0 / rate) for n in range(round(13.0 * rate))
    ]
    assert all(rest is None for rest in moving)


def test_rest_is_detected_with_rare_joint_angles():
    assert len(run(RestDetector(), 10.0, measured=lambda n: n % 20 == 0)) >= 5
    assert run(RestDetector(), 10.0, lambda t: 0.05 * t, measured=lambda n: n % 20 == 0) == []


def test_no_rest_without_joint_angles():
    assert run(RestDetector(), 3.0, measured=lambda _: False) == []


def at(*theta):
    return Sample(np.array(theta, dtype=float), np.full(1, 50.0), np.zeros(1), np.zeros(1))


def test_the_store_takes_only_new_postures_and_tensions():
    store = SampleStore()
    store.add(at(0.0, 0.0))
    assert not store.is_new(at(0.04, -0.04))
    assert store.is_new(at(0.06, 0.0))
    assert store.is_new(at(0.0, 0.0)._replace(tension=np.array([61.0])))


def unmeasured(length, posture=(np.nan, np.nan)):
    return at(*posture)._replace(length=np.array([length]))


def test_postures_are_new_after_a_rest_without_joint_angles():
    store = SampleStore()
    store.add(unmeasured(0.0))
    for angle in np.linspace(0.1, 1.0, 10):
        measured = at(angle, 0.0)._replace(length=np.array([0.04 * angle]))
        assert store.is_new(measured)
        store.add(measured)
        assert not store.is_new(measured)
        assert not store.is_new(unmeasured(0.04 * angle))
    assert store.is_new(unmeasured(0.08))
    assert store.is_new(unmeasured(0.04, (1.0, 0.3)))


def test_a_sample_is_new_if_it_has_an_angle_that_a_similar_one_lacks():
    store = SampleStore()
    store.add(unmeasured(0.0, (0.2, np.nan)))
    assert not store.is_new(unmeasured(0.0, (0.2, np.nan)))
    assert store.is_new(unmeasured(0.0, (0.2, 0.0)))


def test_a_full_store_keeps_a_posture_whose_lengths_differ_from_those_without_joint_angles():
    store, rng = SampleStore(capacity=20), np.random.default_rng(0)
    far = at(0.0, 0.0)._replace(length=np.array([0.05]))
    store.add(far)
    for length in rng.uniform(-0.01, 0.01, 100):
        store.add(unmeasured(length))
    assert any(sample is far for sample in store.samples)


def test_a_full_store_keeps_the_newest_and_its_coverage():
    store, rng = SampleStore(capacity=20), np.random.default_rng(0)
    corners = [at(x, y) for x in (-1.0, 1.0) for y in (-1.0, 1.0)]
    for corner in corners:
        store.add(corner)
    for _ in range(500):
        newest = at(*rng.uniform(-0.2, 0.2, 2))
        store.add(newest)
        assert len(store) <= 20
        assert store.samples[-1] is newest
    kept = [tuple(s.theta) for s in store.samples]
    assert all(tuple(c.theta) in kept for c in corners)
    assert store.accepted == 504


def test_samples_that_were_held_back_return_to_their_places():
    store = SampleStore()
    store.offset = np.zeros(1)
    for number in range(3):
        store.add(at(number, 0.0), time=10.0 * number)
    store.hold(12.0)
    assert [sample.theta[0] for sample in store.samples] == [0.0, 2.0]
    store.use_offset(np.zeros(1))
    assert [sample.theta[0] for sample in store.samples] == [0.0, 1.0, 2.0]


class Messages:
    """Sends messages of an arm to a collector, on a simulated clock."""

    def __init__(self, robot):
        self.robot, self.time = robot, 0.0
        self.collector = SampleCollector(robot, SampleStore(), Reservoir(6))

    def send(self, theta, pull, length, dt=DT):
        """Send one message to the collector; return the new samples."""
        self.time += dt
        self.collector.joints(self.time, theta)
        with suppress(RejectionError):  # the collector counts it
            paired = self.collector.take(self.time, message([length, pull, np.full(6, np.nan)]))
            return [] if paired is None else self.collector.collect(paired)
        return []

    def rest(self, theta, seconds, tension=60.0, dt=DT):
        """Send messages of an arm that rests for some seconds, the first one after `dt` seconds.

        Returns:
            The new samples.
        """
        pull = np.full(6, tension)
        length = self.robot.muscle_lengths(theta, pull)
        samples = self.send(theta, pull, length, dt)
        for _ in range(round(seconds / DT)):
            samples += self.send(theta, pull, length)
        return samples


@pytest.fixture
def messages(arm26):
    return Messages(arm26)


def middle(robot):
    """Return θ, T, l in the middle of the joint limits."""
    theta, tension = 0.5 * (robot.lower + robot.upper), np.full(6, 60.0)
    return theta, tension, robot.muscle_lengths(theta, tension)


def test_a_rest_counts_after_the_margin(messages, arm26):
    theta, _, _ = middle(arm26)
    assert messages.rest(theta, DETECTION_DELAY) == []
    (sample,) = messages.rest(theta, 1.5)
    np.testing.assert_allclose(sample.theta, theta)


def test_samples_shortly_before_an_anomaly_are_not_learned(messages, arm26):
    theta, _, _ = middle(arm26)
    collector = messages.collector
    messages.rest(theta, 2.0)
    collector.use_body(collector.body.with_anomaly(Anomaly.FOUND, 0))
    assert messages.rest(theta, 10.0) == []
    assert collector.rejected['anomaly'] > 5
    observed = collector.healthy.time
    collector.use_body(collector.body.with_anomaly(Anomaly.ENDED, 0))
    assert messages.rest(theta, DETECTION_DELAY) == []
    assert len(messages.rest(theta, DETECTION_DELAY + 1.5)) == 1
    assert collector.healthy.time > observed


def test_implausible_readings_are_rejected_by_reason(messages, arm26):
    assert messages.rest(arm26.upper, 5.0, tension=1000.0) == []
    far = arm26.upper + np.array([1.0, 0.0])
    for sample in messages.rest(far, 5.0):
        assert np.isnan(sample.theta[0])
        assert sample.theta[1] == pytest.approx(arm26.upper[1])
    assert messages.collector.rejected['tension beyond the maximum']


def test_a_glitch_is_rejected_from_rests_and_healthy_messages(messages, arm26):
    theta, pull, length = middle(arm26)
    samples = []
    for n in range(800):
        glitch = n in (300, 500)
        samples += messages.send(theta, pull, length + (0.5 if glitch else 0.0))
    assert messages.collector.rejected['length beyond what the joints allow'] == 2
    (sample,) = samples
    np.testing.assert_allclose(sample.length, length)
    assert np.ptp(messages.collector.healthy.healthy().messages, axis=0).max() < 1e-6


def test_the_direction_of_friction_is_unknown_after_a_gap_in_the_stream(messages, arm26):
    theta, pull, length = middle(arm26)
    for n in range(50):  # wind in all muscles, so that the direction of friction is known
        messages.send(theta, pull, length + 0.01 - 0.0002 * n)
    (sample,) = messages.rest(theta, 1.0 + DETECTION_DELAY + 0.1)
    assert (sample.direction > 0.5).all()
    (sample,) = messages.rest(theta, 2.0 + DETECTION_DELAY, tension=80.0, dt=LIMITS.pause + 1.0)
    assert (sample.direction == 0.0).all()


def test_a_sample_describes_the_muscles_that_were_not_isolated_when_it_was_taken(messages, arm26):
    theta, _, _ = middle(arm26)
    collector = messages.collector
    stored = collector.samples.stored
    (healthy,) = messages.rest(theta, 2.0 + DETECTION_DELAY)
    assert stored[-1].sample is healthy and stored[-1].known.all()
    body = collector.body.with_isolated([2])
    collector.use_body(body)
    (isolated,) = messages.rest(theta, 2.0 + DETECTION_DELAY, tension=80.0)
    assert np.flatnonzero(~stored[-1].known).tolist() == [2]
    assert isolated.length[2] == isolated.tension[2] == 0.0
    offsets = LengthOffsets.of(np.full(6, 0.003), np.zeros(6))
    body = body.with_isolated([]).with_offsets(offsets)
    collector.use_body(body)
    (moved,) = messages.rest(theta, 2.0 + DETECTION_DELAY, tension=100.0)
    assert stored[-1].known.all()
    pull = np.full(6, 100.0)
    np.testing.assert_allclose(moved.length, arm26.muscle_lengths(theta, pull) - 0.003)
