# SPDX-License-Identifier: Apache-2.0
"""When modules lose their length offsets, nothing uses the lengths until a calibration."""

from contextlib import suppress
from copy import deepcopy

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from readings import reading

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.estimation.lengths.length_trust import Evidence
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.remedy_steps import REPAIR, Step, sentence
from musculoskeletal_ae.signals.body_state import Anomaly
from musculoskeletal_ae.signals.muscle_stream import RejectionError

DT = 0.02
SIGNS = np.array([1.0, 0.9, -0.8, -0.9, 0.9, -1.0])
SEVERAL = 0.05 * SIGNS
ONE = 0.06 * (np.arange(6) == 2)


class MovingArm:
    """An estimator and a moving model arm, whose lengths and joint sensors may have offsets."""

    def __init__(self, robot, mae, on_anomaly='stop'):
        self.robot, self.core, self.time = robot, Estimator(robot), 0.0
        self.core.use(mae)
        self.core.suspects.isolates = on_anomaly == 'isolate'
        self.rng = np.random.default_rng(0)
        self.off, self.joint_off = np.zeros(robot.muscle_count), np.zeros(robot.joint_count)
        self.tension = robot.tension.bias + 20.0
        self.tense = np.ones(robot.muscle_count)  # 0 for a tendon without tension
        self.order = np.arange(robot.muscle_count)  # muscle that each column of the readings shows
        self.sign = np.ones(robot.muscle_count)  # of each column of lengths
        self.misread = 0.0  # added to the readings of the tensions [N]
        self.posture = None  # θ of an arm that stands still [rad], or None

    def go(self, seconds, sensors=True):
        for _ in range(round(seconds / DT)):
            self.time += DT
            middle = 0.5 * (self.robot.lower + self.robot.upper)
            span = 0.25 * (self.robot.upper - self.robot.lower)
            theta = middle + span * np.sin([0.5 * self.time, 0.7 * self.time])
            theta = theta if self.posture is None else self.posture
            tension = self.tension + self.rng.standard_normal(len(self.tension))
            tension *= self.tense
            length = self.robot.muscle_lengths(theta, tension) + self.off
            length += 1e-4 * self.rng.standard_normal(len(length))
            if sensors:
                self.core.joints(theta + self.joint_off, self.time)
            length = length * self.sign
            states = np.array([length, tension + self.misread, np.full_like(length, 25.0)])
            with suppress(RejectionError):
                self.core.take(reading(states[:, self.order]), self.time, self.time)

    @property
    def kind(self):
        finding = self.core.suspects.finding
        return None if finding is None else finding.kind

    @property
    def offsets(self):
        return self.core.body.offsets


@pytest.fixture(scope='module')
def moved_once(robot, mae):
    arm = MovingArm(robot, mae)
    arm.go(8.0)
    return arm


@pytest.fixture
def moved(moved_once):
    """Return an arm that has moved for 8 s, so that the usual lengths are known."""
    return deepcopy(moved_once)


@pytest.fixture(scope='module')
def ruptured_once(moved_once):
    arm = deepcopy(moved_once)
    arm.tense = 1.0 - np.eye(6)[2]
    for wound in np.linspace(0.0, 0.2, 50):
        arm.off = -wound * np.eye(6)[2]
        arm.go(0.04)
    arm.go(1.5)
    return arm


@pytest.fixture(params=[True, False], ids=['joint sensors', 'no joint sensors'])
def ruptured(request, ruptured_once):
    """Return an arm whose estimator has latched the rupture of muscle 2.

    The module has wound in the ruptured tendon. The joint sensors, if any, continue to measure.
    """
    arm = deepcopy(ruptured_once)
    arm.has_sensors = request.param
    return arm


@pytest.mark.parametrize(
    ('jump', 'on_anomaly', 'kind'),
    [
        (SEVERAL, 'stop', ConditionKind.LENGTHS_JUMPED),
        (SEVERAL, 'isolate', ConditionKind.LENGTHS_JUMPED),
        (ONE, 'stop', ConditionKind.LENGTH_JUMP),
    ],
)
def test_a_jump_of_lengths_revokes_the_offsets_until_a_calibration(
    robot, mae, jump, on_anomaly, kind
):
    arm = MovingArm(robot, mae, on_anomaly=on_anomaly)
    arm.go(2.0, sensors=False)
    arm.off = jump
    arm.go(2.0, sensors=False)
    assert arm.kind is kind
    assert arm.offsets.revoked
    assert arm.core.body.isolated == ()
    with pytest.raises(MusculoskeletalError, match='estimator/zero'):
        arm.core.reset()
    assert Step.CALIBRATE_LENGTHS in arm.core.report(arm.time).steps
    arm.core.calibrate_lengths()
    assert arm.kind is None
    assert not arm.offsets.revoked
    assert not arm.offsets.known


def test_after_a_jump_of_one_length_only_its_offset_is_calibrated(robot, mae):
    arm = MovingArm(robot, mae)
    arm.go(2.0)
    arm.off = ONE
    arm.go(2.0)
    assert arm.offsets.revoked == (2,)
    arm.core.calibrate_lengths()
    arm.go(30.0)
    assert arm.offsets.known
    assert_array_equal(np.flatnonzero(arm.offsets.offset), [2])
    assert arm.offsets.offset[2] == pytest.approx(ONE[2], abs=2e-3)


def test_a_second_jump_before_the_calibration_revokes_this_offset_as_well(robot, mae):
    arm = MovingArm(robot, mae)
    arm.go(2.0)
    arm.off = ONE
    arm.go(2.0)
    arm.off = ONE + 0.06 * np.eye(6)[4]
    arm.go(2.0)
    assert arm.offsets.revoked == (2, 4)
    arm.core.calibrate_lengths()
    arm.go(30.0)
    np.testing.assert_allclose(arm.offsets.offset, arm.off, atol=2e-3)


def test_offsets_that_the_readings_contradict_are_calibrated_as_well(robot, mae):
    arm = MovingArm(robot, mae)
    arm.go(2.0)
    arm.off = ONE + 0.02 * np.eye(6)[4]  # the smaller change alone is no jump
    arm.go(2.0)
    assert arm.offsets.revoked == (2,)
    arm.core.calibrate_lengths()
    arm.go(25.0)
    assert 'contradict' in arm.core.calibration.progress
    arm.go(35.0)
    assert arm.offsets.known
    np.testing.assert_allclose(arm.offsets.offset, arm.off, atol=2e-3)


def isolated_and_calibrated(robot, mae):
    """Return an arm whose offsets were calibrated while muscle 5 was isolated, as it still is."""
    arm = MovingArm(robot, mae)
    arm.go(2.0)
    arm.core.isolate([5])
    arm.core.calibrate_lengths()
    arm.go(25.0)
    assert arm.offsets.known
    return arm


def test_beside_an_isolated_muscle_a_requested_calibration_determines_all_offsets(robot, mae):
    arm = isolated_and_calibrated(robot, mae)
    arm.off = 0.009 * np.eye(6)[4]
    arm.core.calibrate_lengths()
    arm.go(25.0)
    assert arm.offsets.offset[4] == pytest.approx(0.009, abs=2e-3)


def test_an_isolated_muscle_with_another_zero_can_be_calibrated_and_restored(robot, mae):
    arm = isolated_and_calibrated(robot, mae)
    arm.core.isolate([2, 5])
    arm.off = 0.12 * np.eye(6)[2]
    arm.go(2.0)
    with pytest.raises(MusculoskeletalError, match='estimator/zero'):
        arm.core.restore([2])
    arm.core.calibrate_lengths()
    arm.go(25.0)
    arm.core.restore([2])
    arm.core.calibrate_lengths()
    arm.go(25.0)
    assert arm.offsets.known
    assert arm.offsets.offset[2] == pytest.approx(0.12, abs=2e-3)


def test_a_muscle_that_is_restored_during_a_calibration_is_calibrated_as_well(robot, mae):
    arm = MovingArm(robot, mae)
    arm.go(2.0)
    arm.core.isolate([4])
    arm.off = 0.008 * np.eye(6)[4]
    arm.go(2.0)
    arm.off = arm.off + ONE
    arm.go(2.0)
    arm.core.calibrate_lengths()
    arm.go(3.0)
    arm.core.restore([4])
    arm.go(30.0)
    assert arm.offsets.known
    np.testing.assert_allclose(arm.offsets.offset, arm.off, atol=2e-3)


@pytest.mark.parametrize('pair', [(0, 2), pytest.param((1, 4), marks=pytest.mark.thorough)])
def test_exchanged_muscles_are_named_instead_of_lost_offsets(robot, calibrated, pair):
    arm = MovingArm(robot, calibrated)
    arm.go(10.0, sensors=False)
    assert arm.kind is None
    arm.order[list(pair)] = arm.order[list(reversed(pair))]
    arm.go(10.0, sensors=False)
    assert arm.kind is ConditionKind.MUSCLES_EXCHANGED, arm.core.cause
    first, second = (robot.muscles[m] for m in pair)
    assert f'the readings of {first} and {second} are exchanged' in arm.core.cause
    assert arm.core.remedy == (Step.CORRECT_WIRING, Step.CALIBRATE_LENGTHS)
    assert arm.offsets.revoked


@pytest.mark.parametrize(
    ('is_exchange', 'offset'), [(True, 0.0), (False, 0.0), (True, 0.1), (False, 0.03)]
)
def test_a_driver_that_returns_with_another_order_or_sign_is_named(robot, mae, is_exchange, offset):
    arm = MovingArm(robot, mae)
    arm.posture = robot.lower + 0.2 * (robot.upper - robot.lower)
    arm.off[:] = offset
    if offset:
        arm.core.calibrate_lengths(tuple(arm.posture))
        arm.go(5.0, sensors=False)
        assert arm.offsets.known and arm.kind is None
    arm.go(2.0, sensors=False)
    length = arm.core.sample.length_read
    longest = int(np.abs(length).argmax())
    other = int(np.abs(length - length[longest]).argmax())
    arm.time += 1.0  # the driver restarts
    if is_exchange:
        arm.order[[longest, other]] = other, longest
    else:
        arm.sign[longest] = -1.0
    arm.misread = 1e4 if offset else 0.0  # with offsets, the first message is also unusable
    arm.go(DT, sensors=False)
    arm.misread = 0.0
    arm.go(2.0, sensors=False)
    assert arm.kind is ConditionKind.MUSCLES_EXCHANGED, arm.core.cause
    assert robot.muscles[longest] in arm.core.cause
    assert ('exchanged' if is_exchange else 'wrong sign') in arm.core.cause
    assert Step.CORRECT_WIRING in arm.core.remedy


def test_a_wrong_sign_after_a_restart_is_named_even_if_the_length_was_near_zero(robot, calibrated):
    arm = MovingArm(robot, calibrated)
    arm.go(10.0, sensors=False)
    muscle = 1
    while not 0.004 < abs(arm.core.sample.length_read[muscle]) < 0.009:
        arm.go(DT, sensors=False)
    arm.time += 0.4  # the driver restarts
    arm.sign[muscle] = -1.0
    arm.go(4.0, sensors=False)
    assert arm.kind is ConditionKind.MUSCLES_EXCHANGED, arm.core.cause
    assert f'the length of {robot.muscles[muscle]} has the wrong sign' in arm.core.cause


def test_a_jump_of_two_lengths_that_no_exchange_explains_is_one_of_lost_offsets(robot, calibrated):
    arm = MovingArm(robot, calibrated)
    arm.go(10.0, sensors=False)
    arm.off = SEVERAL * (np.arange(6) < 2)
    arm.go(2.0, sensors=False)
    assert arm.kind is ConditionKind.LENGTHS_JUMPED


def test_lengths_that_a_restarted_driver_counts_from_zero_have_lost_their_offsets(
    robot, calibrated
):
    arm = MovingArm(robot, calibrated)
    arm.posture = robot.lower + 0.3 * (robot.upper - robot.lower)
    arm.go(10.0, sensors=False)
    arm.time += 1.0  # the driver restarts
    arm.off = arm.off - arm.core.sample.length_read
    arm.go(4.0, sensors=False)
    assert arm.kind is ConditionKind.LENGTHS_JUMPED, arm.core.cause
    assert arm.offsets.revoked


def test_a_jump_without_a_network_is_not_forgotten(robot, mae):
    arm = MovingArm(robot, mae)
    arm.core = Estimator(robot)
    arm.go(1.0)
    arm.off = SEVERAL
    arm.go(2.0)
    assert arm.offsets.revoked


def test_without_a_network_a_jump_of_one_length_is_not_verified_but_revokes_its_offset(robot, mae):
    arm = MovingArm(robot, mae)
    arm.core = Estimator(robot)
    arm.core.suspects.isolates = True
    arm.go(1.0)
    arm.off = ONE
    arm.go(2.0)
    assert arm.core.body.anomaly is Anomaly.FOUND
    assert arm.core.body.isolated == ()
    assert arm.offsets.revoked == (2,)
    arm.core.use(mae)
    arm.core.calibrate_lengths()
    assert arm.kind is None


def test_a_jump_during_the_length_calibration_begins_it_again(robot, mae):
    arm = MovingArm(robot, mae)
    arm.core.calibrate_lengths()
    arm.go(3.0)
    before = arm.core.calibration
    arm.off = SEVERAL
    arm.go(2.0)
    assert arm.core.calibration is not before
    assert 'a length jumped' in arm.core.calibration.progress


@pytest.mark.parametrize('jump', [0.05 * np.eye(6)[2], SEVERAL], ids=['50 mm', 'all muscles'])
@pytest.mark.parametrize('is_undone', [True, False], ids=['undone', 'lasting'])
def test_joint_sensors_that_nearly_agree_do_not_replace_the_calibration_after_a_jump(
    moved, jump, is_undone
):
    """The limits for networks that have not learned tolerate an error of 60 mm of one length."""
    moved.off = jump
    moved.go(2.0)
    assert moved.core.body.anomaly is Anomaly.FOUND
    if is_undone:
        moved.off = np.zeros(6)
    moved.go(3.0)
    with pytest.raises(MusculoskeletalError, match='estimator/zero'):
        moved.core.reset()
    assert moved.offsets.revoked
    moved.core.calibrate_lengths()
    assert moved.core.body.anomaly is Anomaly.ENDED
    assert moved.kind is None


def test_a_tendon_that_ruptured_while_messages_were_lost_is_not_calibrated_away(robot, mae):
    arm = MovingArm(robot, mae)
    arm.go(2.0)
    arm.time += 1.2
    arm.tense, arm.off = 1.0 - np.eye(6)[2], -0.2 * np.eye(6)[2]
    for _ in range(100):
        arm.core.commanded(arm.time, tension=arm.tension)
        arm.go(DT)
    assert arm.kind is ConditionKind.LENGTH_JUMP
    with pytest.raises(MusculoskeletalError, match='no tension'):
        arm.core.calibrate_lengths()
    assert arm.kind is ConditionKind.LENGTH_JUMP


def test_lengths_that_drift_are_found_by_joint_sensors(moved):
    for share in np.linspace(0.0, 1.0, 50):
        moved.off = 0.06 * share * SIGNS
        moved.go(0.1)
    moved.go(2.0)
    assert moved.kind is ConditionKind.LENGTHS_DISAGREE
    assert moved.offsets.revoked


def test_lengths_that_are_off_at_the_start_are_found_by_joint_sensors(robot, mae):
    arm = MovingArm(robot, mae)
    arm.off = 2.0 * SEVERAL
    arm.go(4.0)
    assert arm.kind is ConditionKind.LENGTHS_DISAGREE


def test_a_ruptured_tendon_is_not_taken_for_a_wrong_length_while_no_commands_arrive(
    ruptured_once,
):
    """The module winds in the ruptured tendon, and the finding names only this muscle."""
    assert ruptured_once.kind is ConditionKind.SLACK_TENDON
    assert ruptured_once.core.suspects.finding.muscle == 2
    assert 'repair' in ruptured_once.core.advice
    assert ruptured_once.offsets.known


def repair(arm, zero=0.0):
    arm.off, arm.tense = zero * np.eye(6)[2], np.ones(6)
    arm.go(2.5, sensors=arm.has_sensors)


def test_the_repair_of_a_suspect_keeps_the_offsets(ruptured):
    before = ruptured.offsets
    repair(ruptured)
    assert ruptured.core.trust.evidence[2] is Evidence.MOVED
    assert ruptured.kind is ConditionKind.SLACK_TENDON
    assert ruptured.core.advice == sentence(REPAIR)
    assert ruptured.offsets is before
    ruptured.core.reset()
    # The next damage of this muscle is not taken for this repair.
    assert ruptured.core.trust.evidence[2] is Evidence.CHECKED
    ruptured.go(3.0, sensors=ruptured.has_sensors)
    assert ruptured.kind is None
    assert ruptured.offsets.known
    assert ruptured.offsets is before


@pytest.mark.parametrize('jump', [SEVERAL, 0.1 * np.eye(6)[4]])
def test_a_jump_of_another_muscle_during_a_repair_revokes_the_offsets(ruptured, jump):
    repair(ruptured)
    ruptured.off = jump
    ruptured.go(2.0, sensors=ruptured.has_sensors)
    assert ruptured.offsets.revoked
    assert ruptured.core.advice.endswith(Step.CALIBRATE_LENGTHS.text)
    with pytest.raises(MusculoskeletalError, match='estimator/zero'):
        ruptured.core.reset()


@pytest.mark.parametrize('zero', [-0.12, 0.12])
def test_after_a_repair_with_another_zero_the_reset_is_refused_until_a_calibration(ruptured, zero):
    repair(ruptured, zero)
    with pytest.raises(MusculoskeletalError, match=r'(shorter|longer) than.*estimator/zero'):
        ruptured.core.reset()
    assert ruptured.kind is ConditionKind.SLACK_TENDON
    assert ruptured.core.remedy == (Step.CALIBRATE_LENGTHS,)
    ruptured.core.calibrate_lengths()
    assert ruptured.kind is None
    assert ruptured.core.calibration.muscles == (2,)


@pytest.mark.parametrize('ruptured', [True], indirect=True)
def test_joint_sensors_find_a_wrong_zero_after_a_reset_right_after_the_repair(ruptured):
    """Only the joint sensors reveal the error, and the reset comes before they have been read."""
    ruptured.off, ruptured.tense = 0.07 * np.eye(6)[2], np.ones(6)
    while ruptured.core.trust.evidence[2] is not Evidence.MOVED:
        ruptured.go(DT)
    ruptured.core.reset()
    assert ruptured.kind is None
    ruptured.go(3.0)
    assert ruptured.kind is ConditionKind.LENGTH_DISAGREES
    assert ruptured.offsets.revoked == (2,)


def test_a_joint_sensor_that_all_lengths_outvote_is_doubted_and_the_arm_goes_on(moved):
    moved.joint_off = np.array([0.0, 1.0])
    moved.go(8.0)
    assert moved.core.joint_trust.doubted == (1,)
    assert moved.robot.joints[1] in moved.core.report(moved.time).message
    assert moved.kind is None
    assert moved.offsets.known
    moved.joint_off[:] = 0.0
    moved.go(12.0)
    assert moved.core.joint_trust.doubted == ()


def test_a_healthy_arm_with_joint_sensors_is_healthy(moved):
    moved.go(12.0)
    assert moved.kind is None


def conditions_of_joints(arm):
    return {
        each.identifier: each.subjects
        for each in arm.core.conditions(arm.time)
        if each.identifier.startswith('joint_')
    }


def test_a_joint_sensor_that_is_unplugged_is_named_until_it_is_plugged_in_again(moved):
    elbow = moved.robot.joints[1]
    moved.joint_off = np.array([0.0, np.nan])
    moved.go(5.0)
    assert conditions_of_joints(moved) == {'joint_readings_missing': (elbow,)}
    moved.joint_off[:] = 0.0
    moved.go(1.0)
    assert conditions_of_joints(moved) == {}


def test_a_joint_sensor_that_was_removed_is_not_expected_until_it_reports_again(moved):
    elbow = moved.robot.joints[1]
    moved.joint_off = np.array([0.0, np.nan])
    moved.go(5.0)
    assert moved.core.confirm_joint_sensors() == (1,)
    moved.go(5.0)
    assert conditions_of_joints(moved) == {}
    moved.joint_off[:] = 0.0
    moved.go(1.0)
    moved.joint_off = np.array([0.0, np.nan])
    moved.go(5.0)
    assert conditions_of_joints(moved) == {'joint_readings_missing': (elbow,)}


def test_all_joints_are_named_if_their_driver_ends(moved):
    moved.go(5.0, sensors=False)
    assert conditions_of_joints(moved) == {'joint_readings_missing': moved.robot.joints}


def test_a_pause_of_all_messages_is_no_fault_of_the_joint_sensors(moved):
    moved.time += 5.0
    moved.go(0.1, sensors=False)
    assert conditions_of_joints(moved) == {}


def test_joint_sensors_are_not_used_while_a_second_program_publishes_zeros(moved):
    for _ in range(round(3.0 / DT)):
        moved.core.joints(np.zeros(2), moved.time + 0.5 * DT)
        moved.go(DT)
    names = moved.robot.joints
    assert conditions_of_joints(moved) == {'joint_readings_impossible': names}
    assert moved.core.joint_trust.unused == (0, 1)
    assert moved.core.measured is None
    moved.go(2.0)
    assert conditions_of_joints(moved) == {}
    assert moved.core.joint_trust.unused == ()
    assert moved.core.measured is not None


def test_joint_sensors_that_are_dead_decide_nothing(robot, mae):
    arm = MovingArm(robot, mae)
    arm.joint_off = np.full(2, np.nan)
    arm.go(6.0)
    assert arm.kind is None
    assert arm.core.measured is None


def isolated_for(arm, seconds):
    """Return an arm with joint sensors of which muscle 2 has ruptured and is isolated."""
    arm.core.suspects.isolates = True
    arm.core.isolate([2])
    arm.off, arm.tense = -0.2 * np.eye(6)[2], 1.0 - np.eye(6)[2]
    arm.go(seconds)
    return arm


def test_the_length_of_a_muscle_while_it_was_isolated_is_not_usual_for_it(moved):
    arm = isolated_for(moved, 10.0)  # longer than it was in use
    arm.off, arm.tense = np.zeros(6), np.ones(6)
    arm.go(0.5)
    arm.core.restore([2])
    arm.go(4.0)
    assert arm.kind is None
    assert arm.offsets.known


@pytest.mark.parametrize('sensors', [True, False], ids=['joint sensors', 'no joint sensors'])
def test_a_muscle_is_restored_only_after_its_winch_has_come_back(robot, moved, sensors):
    arm = isolated_for(moved, 1.0)
    with pytest.raises(MusculoskeletalError, match=f'{robot.muscles[2]} has no tension|shorter'):
        arm.core.restore([2])
    arm.tense = np.ones(6)  # the tendon is repaired, but the winch has not come back yet
    arm.go(0.5, sensors)
    with pytest.raises(
        MusculoskeletalError,
        match=rf'{robot.muscles[2]} is \d+ mm shorter .*estimator/zero.*estimator/restore again',
    ):
        arm.core.restore([2])
    assert arm.core.body.isolated == (2,)
    assert arm.offsets.known
    for _ in range(20):
        arm.off = arm.off + 0.01 * np.eye(6)[2]
        arm.go(0.04, sensors)
    arm.core.restore([2])
    arm.go(3.0, sensors)
    assert arm.core.body.isolated == ()
    assert arm.kind is None


def test_a_muscle_with_another_length_offset_can_be_restored_after_a_calibration(robot, moved):
    arm = isolated_for(moved, 1.0)
    arm.off, arm.tense = 0.12 * np.eye(6)[2], np.ones(6)
    arm.go(0.5)
    with pytest.raises(MusculoskeletalError, match='longer'):
        arm.core.restore([2])
    arm.posture = 0.5 * (robot.lower + robot.upper)
    arm.core.calibrate_lengths(tuple(arm.posture))
    arm.go(3.0)
    assert arm.offsets.known
    arm.core.restore([2])
    arm.posture = None
    arm.go(3.0)
    assert arm.kind is None


@pytest.mark.parametrize(('on_anomaly', 'isolated'), [('stop', ()), ('isolate', (2,))])
def test_one_wrong_length_revokes_no_other_offset(moved, on_anomaly, isolated):
    moved.core.suspects.isolates = on_anomaly == 'isolate'
    for share in np.linspace(0.0, 1.0, 25):
        moved.off = -0.15 * share * np.eye(6)[2]
        moved.go(0.04)
    while moved.kind is None:
        moved.go(0.1)
        assert moved.time < 20.0
    assert moved.kind is ConditionKind.LENGTH_DISAGREES
    assert moved.core.body.isolated == isolated
    assert moved.offsets.revoked == (() if isolated else (2,))


def test_the_winch_of_a_suspect_that_comes_back_slowly_revokes_nothing(ruptured):
    ruptured.tense = np.ones(6)
    for length in np.linspace(-0.2, 0.0, 50):
        ruptured.off = length * np.eye(6)[2]
        ruptured.go(0.1, sensors=ruptured.has_sensors)
        if length == -0.2:
            with pytest.raises(MusculoskeletalError, match=r'shorter than.*estimator/reset again'):
                ruptured.core.reset()
    assert ruptured.kind is ConditionKind.SLACK_TENDON
    ruptured.core.reset()
    ruptured.go(3.0, sensors=ruptured.has_sensors)
    assert ruptured.kind is None
    assert ruptured.offsets.known


def test_a_reset_right_after_the_jump_of_a_repair_is_refused_until_the_jump_is_over(ruptured):
    ruptured.off, ruptured.tense = np.zeros(6), np.ones(6)
    ruptured.go(0.1, sensors=ruptured.has_sensors)
    with pytest.raises(MusculoskeletalError, match='just jumped'):
        ruptured.core.reset()
    with pytest.raises(MusculoskeletalError, match=r'just jumped.*estimator/zero again'):
        ruptured.core.calibrate_lengths()
    assert ruptured.core.calibration is None
    assert ruptured.offsets.known
    ruptured.go(1.5, sensors=ruptured.has_sensors)
    ruptured.core.reset()
    ruptured.go(3.0, sensors=ruptured.has_sensors)
    assert ruptured.kind is None


def test_a_reset_without_a_repair_is_refused_but_the_suspect_can_be_isolated(ruptured):
    assert ruptured.core.report(ruptured.time).steps == REPAIR
    with pytest.raises(MusculoskeletalError, match=r'no tension|shorter'):
        ruptured.core.reset()
    ruptured.core.reset(isolating=[2])
    ruptured.core.isolate([2])
    ruptured.go(3.0, sensors=ruptured.has_sensors)
    assert ruptured.kind is None


@pytest.mark.parametrize('is_right', [True, False], ids=['right', 'wrong'])
@pytest.mark.parametrize('sensors', [True, False], ids=['joint sensors', 'no joint sensors'])
def test_offsets_of_a_wrongly_stated_posture_are_not_believed_if_joint_sensors_contradict(
    robot, moved, sensors, is_right
):
    moved.off, moved.posture = SEVERAL, 0.5 * (robot.lower + robot.upper)
    stated = moved.posture + (0.02 if is_right else 0.2) * (robot.upper - robot.lower)
    moved.time += 2.0  # the modules and the joint sensors were switched off
    moved.core.clock_jumped_back()
    moved.core.calibrate_lengths(tuple(stated))
    moved.go(4.0, sensors)
    assert moved.offsets.known == (is_right or not sensors)
    assert moved.kind is None
    message = moved.core.report(moved.time).message
    assert ('but its sensor measures' in message) != moved.offsets.known
