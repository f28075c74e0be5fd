# SPDX-License-Identifier: Apache-2.0
"""The script of grasps and ruptures, and the counting of alarms and scores."""

import numpy as np
import pytest

from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.experiments.detection import (
    CARRYING,
    LATEST_RUPTURE,
    PAYLOAD,
    RUPTURE_TIME,
    SLOT,
    DetectorOutput,
    GraspAndRupture,
    alarm_starts,
    auroc,
    detection,
    grasp_and_release,
)
from musculoskeletal_ae.experiments.recording import record


class Fake:
    """A stand-in for an arm with equal tensions: records when a script changes it, and how."""

    def __init__(self, robot, tension):
        self.time, self.done, self.off = 0.0, [], []
        self.tension = np.full(robot.muscle_count, tension)

    def set_payload(self, mass):
        self.done.append((self.time, mass))

    def set_faults(self, lines):
        self.done.append((self.time, tuple(line.removeprefix('rupture:') for line in lines)))

    def follow(self, script, duration):
        for tick in range(round(duration / 0.01)):
            self.time = 0.01 * tick
            off = script(self, self.time)
            self.off.append(np.zeros(len(self.tension), dtype=bool) if off is None else off)


def test_the_script_grasps_midway_and_ruptures_and_mends_every_muscle_once(arm26):
    plan = GraspAndRupture(arm26, 4.0, seed=0)
    arm = Fake(arm26, arm26.tension.bias + 2.0 * CARRYING)
    arm.follow(plan, plan.duration)
    assert [time for time, what in arm.done if what == PAYLOAD] == [2.0]
    cuts = [what for what in arm.done if isinstance(what[1], tuple)]
    assert sorted(names[0] for _, names in cuts if names) == sorted(arm26.muscles)
    assert plan.carried.all()
    assert plan.order[0] == 1  # the muscle that the paper deactivates
    for (cut, names), (mended, none) in zip(cuts[::2], cuts[1::2], strict=True):
        assert names and not none
        assert mended - cut == pytest.approx(RUPTURE_TIME, abs=0.02)
        assert (cut - 4.0) // SLOT == (mended - 4.0) // SLOT


@pytest.mark.parametrize(('slot', 'latest'), [(SLOT, LATEST_RUPTURE), (10.0, 4.0)])
def test_a_muscle_that_never_carries_tension_is_ruptured_at_the_end_of_its_slot(
    arm26, slot, latest
):
    plan = GraspAndRupture(arm26, 4.0, seed=0, slot=slot)
    Fake(arm26, arm26.tension.bias).follow(plan, plan.duration)
    assert not plan.carried.any()
    np.testing.assert_allclose((plan.rupture - 4.0) % slot, latest, atol=0.011)
    # If no muscle carried tension, all ruptures count instead of none.
    assert plan.counted == list(range(arm26.muscle_count))


def test_a_shortened_script_ruptures_only_the_first_muscles(arm26):
    plan = GraspAndRupture(arm26, 4.0, seed=0, most=2, slot=10.0)
    arm = Fake(arm26, arm26.tension.bias + 2.0 * CARRYING)
    arm.follow(plan, plan.duration)
    assert plan.order == plan.muscles == plan.counted == [1, 2]
    ruptured = [what[0] for _, what in arm.done if isinstance(what, tuple) and what]
    assert ruptured == [arm26.muscles[m] for m in plan.order]
    assert plan.duration == 4.0 + 2 * 10.0
    for slot, rupture in zip((4.0, 14.0), plan.rupture[plan.order], strict=True):
        assert slot < rupture < slot + 10.0 - RUPTURE_TIME


def test_a_switched_off_muscle_is_not_ruptured_but_commanded_no_tension(arm26):
    plan = GraspAndRupture(arm26, 4.0, seed=0, switched_off=True)
    arm = Fake(arm26, arm26.tension.bias + 2.0 * CARRYING)
    arm.follow(plan, plan.duration)
    assert not any(what for _, what in arm.done if isinstance(what, tuple))
    off = np.array(arm.off)
    np.testing.assert_allclose(0.01 * off.sum(axis=0), RUPTURE_TIME, atol=0.02)
    assert off.sum(axis=1).max() == 1


def test_a_switched_off_muscle_of_the_arm_goes_slack_and_the_others_hold(arm26, trained):
    def script(_, time):
        return np.arange(6) == 1 if time >= 6.0 else None

    taken = record(EmulatedArm(arm26, 3), trained['default'], 7, 7.0, script)
    before, after = taken.tension[590:600], taken.tension[690:700]
    assert after[:, 1].max() < 0.1 * arm26.tension.bias[1] < before[:, 1].min()
    others = np.arange(6) != 1
    assert (after[:, others] > 0.5 * arm26.tension.bias[others]).all()
    assert np.abs(taken.length[-1] - taken.length[599]).max() < 0.05  # no muscle is wound in


def test_the_payload_changes_every_minute(arm26):
    arm = Fake(arm26, 0.0)
    arm.follow(grasp_and_release, 181.0)
    assert arm.done == [(0.0, 0.0), (60.0, PAYLOAD), (120.0, 0.0), (180.0, PAYLOAD)]


def test_only_an_alarm_that_begins_after_the_rupture_counts_as_detection(arm26, trained):
    plan = GraspAndRupture(arm26, 4.0, seed=0)
    count, muscles = round(plan.duration / 0.01), arm26.muscle_count
    plan.rupture, plan.carried = 4.0 + SLOT * np.arange(muscles) + 1.0, np.ones(muscles, dtype=bool)
    alarm, suspect = np.zeros(count, dtype=bool), np.zeros(count, dtype=int)
    starts = np.round(plan.rupture / 0.01).astype(int)
    alarm[starts[0] + 9 : starts[0] + 20] = True  # detected after 0.1 s, with the right muscle
    alarm[starts[1] + 19 : starts[1] + 30] = True  # detected after 0.2 s, with the wrong muscle
    alarm[starts[2] - 50 : starts[2] + 400] = True  # this alarm began before the rupture
    observed = DetectorOutput(np.zeros((count, 2)), alarm, alarm, suspect, alarm)
    well = DetectorOutput(*(np.zeros(5, dtype=bool) for _ in range(5)))
    numbers = detection(arm26, plan, observed, well, trained['default'])
    cuts = list(numbers['cuts'].values())
    assert [cut['detected'] for cut in cuts[:3]] == [True, True, False]
    assert [cut['named'] for cut in cuts[:3]] == [True, False, False]
    assert [cut['detection_s'] for cut in cuts[:3]] == pytest.approx([0.1, 0.2, RUPTURE_TIME])
    assert numbers['detected_share'] == pytest.approx(2.0 / muscles)
    assert numbers['false_alarms'] == 0 and numbers['false_alarms_beside_cuts'] == 1


def test_auroc_is_the_share_of_correctly_ordered_pairs():
    assert auroc(np.array([0.0, 1.0]), np.array([2.0, 3.0])) == 1.0
    assert auroc(np.array([2.0, 3.0]), np.array([0.0, 1.0])) == 0.0
    assert auroc(np.array([1.0, 3.0]), np.array([2.0])) == 0.5
    assert auroc(np.array([1.0]), np.array([1.0])) == 0.5


def test_alarms_are_counted_when_they_begin():
    assert alarm_starts(np.array([True, True, False, True, False, False, True, True])).sum() == 3
    assert not alarm_starts(np.zeros(5, dtype=bool)).any()
    assert not alarm_starts(np.zeros(0, dtype=bool)).any()
