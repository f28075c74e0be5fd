# SPDX-License-Identifier: Apache-2.0
"""Faults of position-controlled modules: a rupture is detected, slack is not reported."""

from dataclasses import replace

import numpy as np
import pytest
from exact_mae import rest_readings
from robots import with_modules

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.detectors.module_following import FAULTY, PositionFollowing
from musculoskeletal_ae.estimation.detectors.slack_tendon import DEAD_TIME, StretchedTendon
from musculoskeletal_ae.estimation.suspect_verification import Outcome, Verification
from musculoskeletal_ae.experiments.detection import observe
from musculoskeletal_ae.robot.robot import Robot

DT, THETA, MUSCLE = 0.01, np.array([0.2, -0.9]), 2
ROBOT = Robot(with_modules(Robot.load('arm26').description, actuation='position'))
BIAS = ROBOT.tension.bias
NOISE = np.random.default_rng(0).normal(0.0, 1.0, (600, 2)) * [1.0, 1e-4]


def readings(mae, shorter=0.0):
    """Return lengths and tensions of an arm with one muscle without tension.

    The length of this muscle is that of a slack tendon, minus `shorter` [m].
    """
    length, tension = rest_readings(ROBOT, THETA, np.full(ROBOT.muscle_count, 60.0))
    tension = tension.copy()
    tension[MUSCLE] = 0.0
    length = mae.lengths(THETA, tension)
    length[MUSCLE] -= shorter
    return length, tension


@pytest.mark.parametrize(('shorter', 'is_found'), [(0.06, True), (0.0, False), (-0.02, False)])
def test_only_a_tendon_that_has_to_pull_and_does_not_is_ruptured(mae, shorter, is_found):
    detector = StretchedTendon(ROBOT)
    detector.use(mae)
    length, tension = readings(mae, shorter)
    message = observe(mae, length, tension, tension, DT)
    findings = [detector.step(message) for _ in range(round(1.5 * DEAD_TIME / DT))]
    assert findings[0] is None
    assert (findings[-1] is not None) == is_found
    if is_found:
        assert (findings[-1].muscle, findings[-1].kind) == (MUSCLE, ConditionKind.SLACK_TENDON)


LENGTHS_WRONG = 0.02 * np.array([1, -1, 1, -1, 1, -1])  # errors of the network's lengths [m]


def findings_after_tension(mae, before, after, spread=0.0):
    """Return what the detector finds when muscle MUSCLE loses its tension.

    The muscle has tension for a second, and none in the next. Every length of the arm differs from
    that of the network by 20 mm.

    Args:
        mae: The network, which has not learned the arm.
        before: Tension of MUSCLE in the first second [N].
        after: Additional length of MUSCLE in the next second [m].
        spread: Standard deviation of the tensions [N].
    """
    detector = StretchedTendon(ROBOT)
    detector.use(mae)
    findings = []
    for is_taut in (True, False):
        tension = np.full(ROBOT.muscle_count, 60.0)
        tension[MUSCLE] = before
        length = mae.lengths(THETA, tension) + LENGTHS_WRONG
        if not is_taut:
            tension[MUSCLE] = 0.0
            length[MUSCLE] += after
        message = observe(mae, length, tension, tension, DT)
        message = replace(message, sample=replace(message.sample, tension_spread=spread))
        findings += [detector.step(message) for _ in range(round(2 * DEAD_TIME / DT))]
    return [finding for finding in findings if finding]


def test_a_rupture_under_load_is_found_at_once_although_the_network_has_not_learned(mae):
    findings = findings_after_tension(mae, before=120.0, after=0.0)
    assert {finding.muscle for finding in findings} == {MUSCLE}
    assert len(findings) >= DEAD_TIME / DT


def test_a_tendon_that_is_paid_out_until_it_is_slack_is_healthy(mae):
    stretch = elongation(120.0)
    assert not findings_after_tension(mae, before=120.0, after=stretch)
    assert not findings_after_tension(mae, before=120.0, after=stretch + 0.03)


def test_an_error_of_an_unlearned_network_is_no_stretch(mae):
    # Nothing is known of this tendon, because it has never been taut.
    detector = StretchedTendon(ROBOT)
    detector.use(mae)
    length, tension = readings(mae, shorter=3.1 * elongation(BIAS[MUSCLE]))
    message = observe(mae, length, tension, tension, DT)
    assert not any(detector.step(message) for _ in range(round(2 * DEAD_TIME / DT)))


def test_a_motor_current_that_does_not_exclude_tension_is_no_evidence_of_a_rupture(mae):
    assert findings_after_tension(mae, before=120.0, after=0.0, spread=1.0)
    assert not findings_after_tension(mae, before=120.0, after=0.0, spread=30.0)


def test_tendons_that_do_not_determine_the_posture_are_no_evidence_of_a_rupture(mae):
    detector = StretchedTendon(ROBOT)
    detector.use(mae)
    length, tension = readings(mae, shorter=0.06)
    tension[np.arange(ROBOT.muscle_count) != 0] = 0.0
    message = observe(mae, length, tension, tension, DT)
    assert not any(detector.step(message) for _ in range(round(2 * DEAD_TIME / DT)))


@pytest.mark.parametrize(
    ('behind', 'tension', 'is_found'), [(0.02, 60.0, True), (0.001, 60.0, False),
                                        (0.02, 490.0, False)]
)  # fmt: skip
def test_a_module_that_does_not_go_where_it_is_commanded_does_not_follow(
    mae, behind, tension, is_found
):
    detector = PositionFollowing(ROBOT)
    detector.use(mae)
    length, pull = mae.lengths(THETA, BIAS), BIAS.copy()
    pull[MUSCLE] = tension
    command = length - behind * (np.arange(ROBOT.muscle_count) == MUSCLE)
    message = observe(mae, length, pull, pull, DT, command=command)
    findings = [detector.step(message) for _ in range(round(1.5 * FAULTY / DT))]
    assert (findings[-1] is not None) == is_found


def elongation(tension):
    return float(ROBOT.elongation(np.full(ROBOT.muscle_count, max(tension, 0.0)))[MUSCLE])


def verdict(tension, length, slack):
    """Return the outcome of a verification that winds in the suspect by up to 28 mm after 1.5 s.

    Args:
        tension: Computes the measured tension [N] from the wound length [m] and noise.
        length: Computes the measured length [m] from the commanded length [m] and noise.
        slack: Additional length of the tendon at first, relative to a taut one [m].
    """
    watched = Verification(BIAS[MUSCLE], elongation=elongation)
    for n, (shake, stir) in enumerate(NOISE):
        command = -min(max(0.0, (n - 150) * 0.0002), 0.028)
        pull, wound = tension(-command, shake), length(command, stir)
        # The joints do not move, so the route and the elongation determine the length.
        likely = -slack - elongation(pull)
        if result := watched.step(pull, wound, command, likely, DT):
            return result.outcome
    raise AssertionError('the verification ended without an outcome')


PULLS = np.linspace(0.0, 500.0, 2001)
STRETCHES = np.array([elongation(pull) for pull in PULLS])


def pull_of(stretch):
    return float(np.interp(stretch, STRETCHES, PULLS))


def followed(command, stir):
    return command + stir


@pytest.mark.parametrize(
    ('tension', 'length', 'slack', 'outcome'),
    [
        (lambda wound, shake: pull_of(0.008 + wound) + shake, followed, -0.008, Outcome.HEALTHY),
        # The tendon is slack at first, and is wound in until it is taut.
        (lambda wound, shake: max(pull_of(wound - 0.01) + shake, 0.0), followed, 0.01,
         Outcome.HEALTHY),
        (lambda _, shake: 0.1 * abs(shake), followed, -0.008, Outcome.RUPTURED),
        (lambda _, __: 0.0, followed, 0.005, Outcome.RUPTURED),
        (lambda _, __: 0.0, followed, 0.06, Outcome.TENSION_SENSOR_FROZEN),
        (lambda _, shake: 0.1 * abs(shake), followed, 0.06, Outcome.NOT_WOUND_IN),
        (lambda _, shake: 40.0 + shake, lambda _, stir: stir, -0.01, Outcome.JAMMED),
        (lambda _, __: 71.0, followed, -0.01, Outcome.TENSION_SENSOR_FROZEN),
        (lambda _, shake: 40.0 + shake, followed, -0.01, Outcome.TENSION_SENSOR_FROZEN),
        (lambda wound, shake: pull_of(0.008 + wound) + shake, lambda *_: 0.0, -0.008,
         Outcome.LENGTH_SENSOR_FROZEN),
    ],
)  # fmt: skip
def test_verification_recognises_the_fault_by_the_response_to_winding_in(
    tension, length, slack, outcome
):
    assert verdict(tension, length, slack) is outcome
