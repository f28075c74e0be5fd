# SPDX-License-Identifier: Apache-2.0
"""Rest, friction, novelty, the budgeted store, the gate."""

from dataclasses import replace

import numpy as np
import pytest

from musculoskeletal_ae.learning.calibration import Reservoir
from musculoskeletal_ae.learning.rest import (
    HOLE,
    MARGIN,
    RestCollector,
    RestDetector,
)
from musculoskeletal_ae.learning.samples import Sample, SampleStore
from musculoskeletal_ae.learning.settings import DEFAULT
from musculoskeletal_ae.robot.kinematics import RACK

DT = 0.01
SLIDES = np.array([1.0, RACK])  # what counts as a radian where the second of two joints slides


def reading(theta, length):
    return Sample(np.broadcast_to(theta, 2), np.full(6, 50.0), np.full(6, length), np.zeros(6))


def run(detector, seconds, theta=lambda _: 0.0, length=lambda _: 0.0, measured=lambda _: True):
    found = []
    for n in range(round(seconds / DT)):
        angle = theta(n * DT) if measured(n) else np.nan
        rest = detector.step(reading(angle, length(n * DT)), DT)
        if rest is not None:
            found.append(rest)
    return found


def each_some(t, still=True):
    """Return θ as two nodes publish it by turns, each for one joint."""
    angles = np.array([0.3, 0.3 if still else 0.3 + 0.05 * t])
    angles[round(t / 0.01) % 2] = np.nan
    return angles


def test_joint_angles_published_by_two_nodes_are_averaged():
    (found, *_) = run(RestDetector(DEFAULT), 3.5, each_some)
    np.testing.assert_allclose(found.theta, [0.3, 0.3])
    assert run(RestDetector(DEFAULT), 3.5, lambda t: each_some(t, still=False)) == []


def test_a_still_arm_gives_its_mean_once_a_second():
    found = run(RestDetector(DEFAULT), 3.5, lambda _: 0.3, lambda _: 0.01)
    assert len(found) == 3
    np.testing.assert_allclose(found[0].theta, 0.3)
    np.testing.assert_allclose(found[0].length, 0.01)


def test_a_moving_joint_or_tendon_is_no_rest():
    assert run(RestDetector(DEFAULT), 3.0, theta=lambda t: 0.05 * t) == []
    assert run(RestDetector(DEFAULT), 3.0, length=lambda t: 0.01 * t) == []


@pytest.mark.parametrize('before', [0.1, 0.7, 3.0, 12.3])
def test_a_rest_does_not_depend_on_what_was_before_it(before):
    def theta(t):  # moves, rests from 0.5 s to 1.4 s, and moves
        return max(0.0, 0.5 - t) + max(0.0, t - 1.4)

    def rest(detector, before):
        (found,) = run(detector, before + 3.0, *[lambda t: theta(t - before)] * 2)
        return found

    used = RestDetector(DEFAULT)
    for _ in range(2):
        found, expected = rest(used, before), rest(RestDetector(DEFAULT), 0.0)
        np.testing.assert_allclose(found.length, expected.length, atol=1e-9)
        used.reset()


def test_a_prismatic_joint_at_a_centimetre_a_second_is_no_rest():
    assert run(RestDetector(DEFAULT), 3.0, theta=lambda t: 0.01 * t)
    assert run(RestDetector(DEFAULT, radian=SLIDES), 3.0, theta=lambda t: 0.01 * t) == []


def test_a_rest_that_ends_early_still_counts():
    found = run(RestDetector(DEFAULT), 2.0, theta=lambda t: max(0.0, t - 0.6))
    assert len(found) == 1
    np.testing.assert_allclose(found[0].theta, 0.0, atol=0.01)


def test_sparse_noisy_angles_of_a_camera_are_averaged():
    rng = np.random.default_rng(0)
    found = run(
        RestDetector(DEFAULT),
        10.0,
        theta=lambda _: 0.5 + 0.02 * rng.standard_normal(),
        measured=lambda n: n % 3 == 0,
    )
    assert len(found) >= 5
    errors = [f.theta[0] - 0.5 for f in found]
    assert np.std(errors) < 0.01


@pytest.mark.parametrize(
    ('rate', 'rest_time'),
    [(1.0, 0.3), (18.9, 0.3), (100.0, 0.0)],
)
def test_rest_is_detected_at_any_message_rate_and_rest_time(rate, rest_time):
    detector = RestDetector(replace(DEFAULT, rest_time=rest_time))
    found = [detector.step(reading(0.3, 0.01), 1.0 / rate) for _ in range(round(13.0 * rate))]
    assert any(rest is not None for rest in found)
    detector.reset()
    moving = [
        detector.step(reading(0.05 * n / rate, 0.01), 1.0 / rate) for n in range(round(13.0 * rate))
    ]
    assert all(rest is None for rest in moving)


def test_rest_is_detected_with_rare_joint_angles():
    assert len(run(RestDetector(DEFAULT), 10.0, measured=lambda n: n % 20 == 0)) >= 5
    assert (
        run(RestDetector(DEFAULT), 10.0, lambda t: 0.05 * t, measured=lambda n: n % 20 == 0) == []
    )


def test_without_a_least_distance_every_different_sample_is_new():
    zero = replace(DEFAULT, new_joint_distance=0.0, new_tension_distance=0.0)
    store, rng = SampleStore(zero), np.random.default_rng(0)
    for _ in range(20):
        sample = Sample(rng.uniform(size=2), rng.uniform(30.0, 60.0, 6), np.zeros(6), np.zeros(6))
        assert store.is_new(sample)
        store.add(sample)
        assert not store.is_new(sample)


def test_no_rest_without_joint_angles():
    assert run(RestDetector(DEFAULT), 3.0, measured=lambda _: False) == []


def at(*theta):
    return Sample(np.array(theta, dtype=float), np.full(1, 50.0), np.zeros(1), np.zeros(1))


def test_the_store_takes_only_new_postures_and_tensions():
    store = SampleStore()
    store.add(at(0.0, 0.0))
    assert not store.is_new(at(0.04, -0.04))
    assert store.is_new(at(0.06, 0.0))
    assert store.is_new(at(0.0, 0.0)._replace(tension=np.array([61.0])))


def test_3_mm_of_a_prismatic_joint_are_a_new_posture():
    store = SampleStore(radian=SLIDES)
    store.add(at(0.0, 0.0))
    assert not store.is_new(at(0.04, 0.0025))
    assert store.is_new(at(0.0, 0.0035))


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


@pytest.fixture
def healthy():
    return Reservoir(6)


@pytest.fixture
def collector(arm26, healthy):
    return RestCollector(arm26, DEFAULT, healthy)


def middle(robot):
    """Return θ, T, l in the middle of the joint limits."""
    theta, tension = 0.5 * (robot.lower + robot.upper), np.full(6, 60.0)
    return theta, tension, robot.muscle_lengths(theta, tension)


def rests_at(collector, arm26, theta, seconds, tension=60.0):
    pull = np.full(6, tension)
    length = arm26.muscle_lengths(theta, pull)
    rests = []
    for _ in range(round(seconds / DT)):
        rests += collector.step(pull, length, DT, theta)
    return rests


def test_a_rest_counts_after_the_margin(collector, arm26):
    theta, _, _ = middle(arm26)
    assert rests_at(collector, arm26, theta, MARGIN) == []
    (rest, *_) = rests_at(collector, arm26, theta, 1.5)
    np.testing.assert_allclose(rest.theta, theta)


def test_samples_shortly_before_an_anomaly_are_not_learned(collector, arm26, healthy):
    theta, _, _ = middle(arm26)
    rests_at(collector, arm26, theta, 2.0)
    collector.set_anomaly(True)
    assert rests_at(collector, arm26, theta, 10.0) == []
    assert collector.rejected['anomaly'] > 5
    observed = healthy.time
    collector.set_anomaly(False)
    assert rests_at(collector, arm26, theta, MARGIN) == []
    assert len(rests_at(collector, arm26, theta, MARGIN + 1.5)) >= 1
    assert healthy.time > observed


def test_implausible_readings_are_rejected_by_reason(collector, arm26):
    assert rests_at(collector, arm26, arm26.upper + 1.0, 5.0) == []
    assert rests_at(collector, arm26, arm26.upper, 5.0, tension=1000.0) == []
    assert set(collector.rejected) == {
        'θ far outside the joint limits',
        'tension beyond the maximum',
    }


def test_a_glitch_is_rejected_from_rests_and_healthy_messages(collector, arm26, healthy):
    theta, pull, length = middle(arm26)
    rests = []
    for n in range(800):
        glitch = n in (300, 500)
        rests += collector.step(pull, length + (0.5 if glitch else 0.0), DT, theta)
    assert collector.rejected['length beyond what the joints allow'] == 2
    for rest in rests:
        np.testing.assert_allclose(rest.length, length)
    assert np.ptp(healthy.healthy().messages, axis=0).max() < 1e-6


def test_the_direction_of_friction_is_unknown_after_a_gap_in_the_stream(collector, arm26):
    theta, pull, length = middle(arm26)
    for n in range(50):  # wound in, so that friction has a direction
        collector.step(pull, length + 0.01 - 0.0002 * n, DT, theta)
    rest, *_ = rests_at(collector, arm26, theta, 1.0 + MARGIN + 0.1)
    assert (rest.direction > 0.5).all()
    collector.step(pull, length, HOLE + 1.0, theta)
    *_, rest = rests_at(collector, arm26, theta, 2.0 + MARGIN)
    assert (rest.direction == 0.0).all()
