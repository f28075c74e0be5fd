# SPDX-License-Identifier: Apache-2.0
"""Checkpoint validation accepts a network only if it explains the arm.

The module `network_attacks` defines the bad networks.
"""

import re
from collections import deque
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from network_attacks import ATTACKS, CONSISTENT, ON_MESSAGES
from robots import DRUM_ENDS, behind_a_drum

from musculoskeletal_ae.estimation.detectors.residual_distance import DISTANCE
from musculoskeletal_ae.estimation.network_validation import detector_check
from musculoskeletal_ae.estimation.network_validation.message_errors import FLOOR
from musculoskeletal_ae.estimation.network_validation.posture_check import LIMITS
from musculoskeletal_ae.estimation.network_validation.validator import (
    DETECTION_DELAY,
    PROOF,
    CheckpointValidator,
)
from musculoskeletal_ae.exceptions import GateError
from musculoskeletal_ae.learning.detector_calibration import Healthy, calibrate
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.presets.registry import PRESETS
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import Anomaly, BodyState

ROBOT = Robot.load('arm26')
HEALTHY = BodyState.healthy(ROBOT.muscle_count)
FAULTY = HEALTHY.with_anomaly(Anomaly.FOUND, 0)
STILL = np.zeros(ROBOT.muscle_count)  # direction of sliding of tendons that have not slid


def body(count=60, seed=0):
    """Return tensions and lengths of random postures of an arm.

    Every length is 3 mm longer than that of the geometric model.
    """
    rng = np.random.default_rng(seed)
    theta = ROBOT.random_postures(count, rng)
    tension = rng.uniform(30.0, 150.0, (count, ROBOT.muscle_count))
    return tension, ROBOT.muscle_lengths(theta, tension) + 0.003


def send_healthy_messages(gate, start=0.0):
    """Send a validator six seconds of messages of a healthy arm; return the time at the end [s]."""
    for k, (tension, length) in enumerate(zip(*body(), strict=True)):
        gate.message(tension, length, STILL, start + 0.1 * k)
    return start + 6.0


def calibrated(mae):
    observed = (*body(500, 1), np.zeros((500, ROBOT.muscle_count)))
    healthy = Healthy(np.hstack(observed).astype(np.float32), 100.0, 50)
    return replace(mae, anomaly=calibrate(mae, healthy, 50))


@pytest.mark.parametrize('preset', PRESETS)
def test_trained_networks_pass_with_and_without_messages(trained, preset):
    gate = CheckpointValidator(ROBOT)
    gate.check(trained[preset])
    gate.take(trained[preset], 0.0)
    send_healthy_messages(gate)
    gate.check(trained[preset])
    for other in trained.values():
        gate.check(other)
    gate.check(calibrated(trained[preset]))


@pytest.mark.parametrize('attack', ATTACKS)
@pytest.mark.parametrize('preset', PRESETS)
def test_a_bad_network_is_refused_without_any_message_and_the_error_names_figure_and_limit(
    trained, preset, attack
):
    with pytest.raises(GateError, match=r'from the geometric model, limit') as refusal:
        CheckpointValidator(ROBOT).check(ATTACKS[attack](trained[preset]))
    assert any(f'limit {limit:g}' in str(refusal.value) for limit in LIMITS.values())


class RestoringAll:
    """A network that reproduces every state exactly, with wrong muscle lengths.

    The series elastic elements stretch `softness` times as far as those of the model, and every
    length has the offset `offset` [m].
    """

    def __init__(self, softness, offset=0.0):
        self.softness, self.offset = softness, offset

    def lengths(self, theta, tension):
        relative = ROBOT.routes.relative_lengths(theta)
        elongation = relative - ROBOT.muscle_lengths(theta, tension)
        return relative - self.softness * elongation + self.offset

    def encode(self, _mask, theta, tension, length):
        return theta, tension, length

    def decode(self, state):
        return state

    def muscle_jacobian(self, theta, _tension):
        return ROBOT.routes.muscle_jacobian(theta)


@pytest.mark.parametrize('softness', [0.3, 1.0, 4.0])
def test_muscles_of_another_softness_pass_and_lengths_with_an_offset_do_not(softness):
    def length_error(mae):
        return dict(filter(None, CheckpointValidator(ROBOT).postures.errors(mae)))['l by ①']

    assert length_error(RestoringAll(softness)).max() < 0.1
    for offset in (-0.08, 0.08):
        assert length_error(RestoringAll(softness, offset)).min() > LIMITS['l by ①']


def test_a_refusal_names_the_muscle_whose_lengths_jump(tmp_path):
    arms = {name: behind_a_drum(tmp_path / name, end) for name, end in DRUM_ENDS.items()}
    for name, robot in arms.items():
        with pytest.raises(GateError) as refusal:
            CheckpointValidator(robot).check(initial_mae(robot, steps=1))
        reported = 'no network can represent lengths that jump'
        assert (reported in str(refusal.value)) == (name == 'jumps')
    assert re.search(r': straightener \(\d+ mm\); `check_robot` prints', str(refusal.value))


def test_a_network_is_validated_in_many_steps_and_refused_at_the_last(trained):
    gate, mae = CheckpointValidator(ROBOT), calibrated(trained['default'])
    gate.take(mae, 0.0)
    send_healthy_messages(gate)
    whole = sum(1 for _ in gate.trial(mae))
    assert whole > 20
    trial = gate.trial(ATTACKS['weights × 1.5'](mae))
    assert len([*islice(trial, whole)]) == whole
    with pytest.raises(GateError, match='limit'):
        deque(trial)


@pytest.mark.parametrize('attack', ON_MESSAGES)
def test_a_network_that_the_geometric_model_accepts_is_refused_by_own_messages(trained, attack):
    gate, mae = CheckpointValidator(ROBOT), calibrated(trained['default'])
    gate.take(mae, 0.0)
    bad = ON_MESSAGES[attack](mae)
    gate.check(bad)
    send_healthy_messages(gate)
    with pytest.raises(GateError, match=r'recent messages|ruptured muscle'):
        gate.check(bad)


def test_a_detector_with_too_high_or_too_low_threshold_is_refused(trained):
    gate, mae = CheckpointValidator(ROBOT), calibrated(trained['default'])
    send_healthy_messages(gate)
    gate.check(mae)
    for times, reported in (
        (100.0, 'with a ruptured muscle'),
        (0.01, 'on recent messages'),
        (0.0, 'on recent messages'),
    ):
        thresholds = {DISTANCE: times * mae.anomaly.thresholds[DISTANCE]}
        with pytest.raises(GateError, match=reported):
            gate.check(replace(mae, anomaly=replace(mae.anomaly, thresholds=thresholds)))


def test_an_anomaly_soon_after_a_new_network_brings_the_proven_one_back(trained):
    gate, old, new = CheckpointValidator(ROBOT), trained['default'], trained['paper']
    gate.take(old, 0.0)
    gate.take(new, 100.0)
    gate.follow(FAULTY, 100.0 + 0.6 * PROOF)
    assert gate.mae is old
    gate.follow(FAULTY, 108.0)
    gate.follow(HEALTHY, 120.0)
    assert gate.mae is old
    gate.take(new, 130.0)
    gate.follow(FAULTY, 130.0 + 1.1 * PROOF)
    assert gate.mae is new


def test_messages_just_before_and_during_an_anomaly_do_not_count_as_healthy(trained):
    gate = CheckpointValidator(ROBOT)
    gate.follow(HEALTHY, 0.0)
    end = send_healthy_messages(gate)
    before = gate.message_errors(trained['default'])
    tension, length = body()
    for k in range(15):
        gate.message(tension[k], length[k] + 0.2, STILL, end + 0.1 * k)
    gate.follow(FAULTY, end + 0.75 * DETECTION_DELAY)
    for k in range(30):
        gate.message(tension[k], length[k] + 0.2, STILL, end + 2.0 + 0.1 * k)
    after = gate.message_errors(trained['default'])
    for name in before:
        assert after[name].max() < 2.0 * before[name].max() + 1e-3


def test_the_first_network_is_accepted_although_the_body_differs_from_the_model(trained):
    gate = CheckpointValidator(ROBOT)
    for k, (tension, length) in enumerate(zip(*body(), strict=True)):
        gate.message(tension, length + 0.2 * np.array([1, -1, 1, -1, 1, -1]), STILL, 0.1 * k)
    errors = gate.message_errors(trained['default'])
    assert any(errors[name].max() > FLOOR[name] for name in FLOOR)
    gate.check(trained['default'])


def test_only_the_network_in_use_needs_no_decision(trained):
    gate, mae = CheckpointValidator(ROBOT), trained['default']
    assert not gate.is_in_use(mae)
    gate.take(mae, 0.0)
    assert gate.is_in_use(calibrated(mae).without((2,)))
    assert not gate.is_in_use(replace(mae, version=mae.version + 1))
    assert not gate.is_in_use(replace(trained['paper'], version=mae.version))


def test_many_unproven_networks_leave_the_first_one_to_roll_back_to(trained):
    gate, first = CheckpointValidator(ROBOT), trained['paper']
    gate.take(first, 0.0)
    for _ in range(60):  # without messages between them, no network is proven
        gate.take(trained['default'], 0.0)
    gate.follow(FAULTY, 0.0)
    assert gate.mae is first


def send_messages_of_the_model(gate, measures):
    """Send the messages of an arm that is identical to its model; return their θ, T and l.

    `gate` is the validator that receives them. With `measures`, the messages contain the angles of
    joint sensors.
    """
    rng = np.random.default_rng(0)
    theta = ROBOT.random_postures(60, rng)
    tension = rng.uniform(30.0, 150.0, (60, ROBOT.muscle_count))
    length = ROBOT.muscle_lengths(theta, tension)
    for k in range(60):
        gate.message(tension[k], length[k], STILL, 0.1 * k, theta[k] if measures else None)
    return theta, tension, length


@pytest.mark.parametrize('attack', CONSISTENT)
@pytest.mark.parametrize('measures', [True, False])
def test_a_consistent_but_wrong_network_is_refused(trained, attack, measures):
    gate, mae = CheckpointValidator(ROBOT), trained['default']
    gate.take(mae, 0.0)
    send_messages_of_the_model(gate, measures)
    with pytest.raises(GateError, match='limit'):
        gate.check(CONSISTENT[attack](mae))


@pytest.mark.parametrize('measures', [True, False])
def test_a_network_that_moves_the_posture_by_as_much_as_learning_does_is_accepted(
    trained, measures
):
    gate, mae = CheckpointValidator(ROBOT), trained['default']
    gate.take(_turned(mae, 0.3), 0.0)  # θ by the network in use is wrong by 0.3 rad
    send_messages_of_the_model(gate, measures)
    gate.check(mae)


def test_joint_sensors_decide_how_far_a_network_may_move_the_posture(trained):
    mae = trained['default']
    learned = replace(_turned(mae, 0.6), covariance=np.eye(ROBOT.joint_count))
    for measures in (True, False):
        gate = CheckpointValidator(ROBOT)
        gate.take(learned, 0.0)
        send_messages_of_the_model(gate, measures)
        compared = gate.agreement(mae)[0]
        assert ((compared.error <= compared.limit).all()) == measures
    gate.check(mae, is_chosen=True)


@pytest.mark.parametrize('measures', [True, False])
def test_a_chosen_network_that_fits_worse_is_used_and_called_so(trained, measures):
    gate, mae = CheckpointValidator(ROBOT), trained['default']
    learned = replace(mae, covariance=np.eye(ROBOT.joint_count))

    def choose(network):
        gate.take(learned, 0.0)
        gate.choose(network, 1.0)
        return gate.unsuitable_because

    assert choose(_turned(mae, 0.2)) == ''  # nothing is known yet
    send_messages_of_the_model(gate, measures)
    weight, bias = mae.decoder[-1]
    off = replace(mae, decoder=(*mae.decoder[:-1], (weight, bias + 0.3 * np.eye(len(bias))[-1])))
    other = _turned(mae, 0.2) if measures else off  # without sensors, a wrong length tells
    assert ('from the sensor' if measures else 'error of the length of') in choose(other)
    assert choose(replace(learned, version=9)) == ''


def test_decisions_are_told_and_an_anomaly_rejects_the_network_accepted_shortly_before(trained):
    used = []
    gate = CheckpointValidator(ROBOT, lambda mae: used.append(mae.version) or mae)
    told = []
    gate.accepted = lambda mae: told.append(('accepted', mae.version))
    gate.rejected = lambda mae, reason: told.append(('rejected', mae.version, reason))
    first = trained['default']
    gate.follow(HEALTHY, 0.0)
    deque(gate.propose(replace(first, version=1), lambda: 0.0))
    deque(gate.propose(replace(first, version=1), lambda: 1.0))  # it is in use already
    deque(gate.propose(replace(first, version=2), lambda: 20.0))
    with pytest.raises(GateError):
        deque(gate.propose(replace(_turned(first, 3.0), version=3), lambda: 21.0))
    gate.follow(FAULTY, 22.0)
    assert gate.mae.version == 1
    assert used == [1, 2, 1]
    assert [each[:2] for each in told] == [
        ('accepted', 1),
        ('accepted', 2),
        ('rejected', 3),
        ('accepted', 1),
        ('rejected', 2),
    ]
    assert 'soon after' in told[-1][2]


def test_a_network_without_a_calibrated_detector_takes_over_with_that_in_use(trained):
    gate, mae = CheckpointValidator(ROBOT), trained['default']
    gate.take(calibrated(mae), 0.0)
    end = send_healthy_messages(gate)
    kept = gate.with_detector(mae, end)
    assert kept.anomaly.calibrated
    healthy, *ruptured = detector_check.measures(kept, gate.messages, ())
    assert healthy < 1.0
    assert max(ruptured) > 1.0
    own = calibrated(trained['paper'])
    assert gate.with_detector(own, end) is own


def test_the_inherited_detector_ignores_only_the_repaired_muscle(trained):
    gate, mae = CheckpointValidator(ROBOT), trained['default']
    gate.take(calibrated(mae), 0.0)
    end = send_healthy_messages(gate)
    gate.declare_repaired([2], end)
    kept = gate.with_detector(mae, end + 1.0)
    assert kept.anomaly.calibrated
    # Another network without a detector takes over, long after the repair.
    gate.take(kept, end + 1.0)
    again = gate.with_detector(mae, end + 1e4)
    _, *ruptured = detector_check.measures(again, gate.messages, ())
    assert max(ruptured) > 1.0
    changed = np.zeros((1, 2 * ROBOT.muscle_count))
    distances = []
    for muscle in (2, 3):
        error = changed.copy()
        error[0, muscle] = 1.0
        distances.append(float(again.anomaly.distances(error + again.anomaly.mean)[0]))
    assert distances[0] < 0.2 < 5.0 < distances[1]


def _turned(mae, angle):
    """Return a network whose estimate of every joint is too high by an angle [rad]."""
    mean = mae.mean.copy()
    mean[: len(mae.joints)] += angle
    return replace(mae, mean=mean)
