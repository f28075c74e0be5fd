# SPDX-License-Identifier: Apache-2.0
"""A suspect is isolated at once, and its response to winding in determines the verdict."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from readings import reading

from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.estimation.suspect_verification import (
    LONGEST,
    PATIENCE,
    Outcome,
    Verification,
)
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.motion.activities import msc_compensation
from musculoskeletal_ae.remedy_steps import REPAIR
from musculoskeletal_ae.signals.muscle_stream import RejectionError
from musculoskeletal_ae.signals.reading_limits import LIMITS

BIAS, STIFFNESS, DT = 30.0, 1e4, 0.01
NOISE = np.random.default_rng(0).normal(0.0, 1.0, (400, 2)) * [1.0, 1e-4]


def verdict(tension, length, likely=0.0):
    """Return the outcome of a verification that winds in the suspect by 3 mm after 1.5 s.

    Args:
        tension: Computes the measured tension from the demanded tension [N] and noise.
        length: Computes the measured length [m] from the number of the message and noise.
        likely: Length that the other muscles predict for the suspect [m].
    """
    watched = Verification(BIAS, STIFFNESS)
    for n, (shake, stir) in enumerate(NOISE):
        command = -min(max(0.0, (n - 150) * 0.0002), 0.003)
        demand = BIAS + max(0.0, -STIFFNESS * command)
        pull, wound = tension(demand, shake), length(n, stir)
        if result := watched.step(pull, wound, command, likely, DT):
            return result
    raise AssertionError('the verification ended without an outcome')


def follows(demand, shake):
    return demand + shake


def still(_, stir):
    return stir


@pytest.mark.parametrize(
    ('tension', 'length', 'likely', 'expected'),
    [
        (follows, still, 0.004, Outcome.HEALTHY),
        (lambda _, __: 0.0, lambda _, stir: -0.15 + stir, 0.0, Outcome.RUPTURED),
        (lambda _, __: 0.0, lambda n, stir: stir - 0.0002 * n, -0.05, Outcome.RUPTURED),
        (lambda _, __: 0.0, still, 0.0, Outcome.TENSION_SENSOR_FROZEN),
        (lambda _, shake: 0.2 * shake, still, 0.0, Outcome.JAMMED),
        (lambda _, shake: BIAS + 15.0 + shake, still, 0.0, Outcome.JAMMED),
        (lambda _, __: 71.0, still, 0.0, Outcome.TENSION_SENSOR_FROZEN),
        (follows, lambda _, __: 0.0, 0.03, Outcome.LENGTH_SENSOR_FROZEN),
        (lambda _, shake: BIAS + shake, lambda _, stir: 0.05 + stir, 0.0,
         Outcome.LENGTH_SENSOR_OFFSET),
        (lambda _, shake: BIAS - 12.0 + shake, still, 0.0, Outcome.JAMMED),
    ],
)  # fmt: skip
def test_verification_recognises_the_fault_by_the_response_to_winding_in(
    tension, length, likely, expected
):
    assert verdict(tension, length, likely).outcome is expected


def test_the_verdict_states_the_offset_of_a_length_sensor_in_millimetres():
    off = verdict(lambda _, shake: BIAS + shake, lambda _, stir: 0.05 + stir)
    assert str(off) == 'its length sensor has an offset of 50 mm'


def test_a_suspect_that_is_not_wound_in_stays_isolated():
    watched = Verification(BIAS, STIFFNESS)
    answers = [watched.step(0.0, 0.0, None, 0.0, DT) for _ in range(round(PATIENCE / DT) + 5)]
    assert answers[-1].outcome is Outcome.NOT_WOUND_IN
    assert not any(answers[: round(PATIENCE / DT) - 5])


class Loop:
    """An estimator with `on_anomaly: isolate`, stepped with messages and commands of the test."""

    def __init__(self, robot, mae, healthy):
        self.core, self.now = Estimator(robot), 100.0
        # The healthy modules follow this command.
        self.command = healthy.length + msc_compensation(robot, healthy.tension)
        self.core.use(mae)
        self.core.suspects.isolates = True
        self.rng, self.length = np.random.default_rng(0), healthy.length

    def step(self, message, times=1):
        """Process a message `times` times, while its lengths change as fast as is plausible."""
        for _ in range(times):
            self.now += DT
            self.core.commanded(self.now, length=self.command)
            shake, stir = self.rng.normal(0.0, 1.0, (2, 6))
            tension = np.where(message.tension > 0.0, message.tension + shake, 0.0)
            way = message.length - self.length
            self.length = self.length + np.clip(way, -LIMITS.step, LIMITS.step)
            states = np.array([self.length + 1e-4 * stir, tension, np.full(6, 25.0)])
            self.core.take(reading(states), self.now, self.now)


@pytest.fixture
def loop(robot, calibrated, healthy):
    wide = replace(calibrated.anomaly, thresholds={'distance': 60.0})
    return Loop(robot, replace(calibrated, anomaly=wide), healthy)


@pytest.fixture
def cut(slack):
    """Return a message in which muscle 2 has ruptured, after its module has wound in 20 cm."""
    return slack._replace(length=slack.length - 0.2 * (np.arange(6) == 2))


def test_a_ruptured_muscle_is_isolated_at_once_and_stays_isolated(loop, robot, healthy, cut):
    loop.step(healthy, 30)
    loop.step(cut, 20)
    assert loop.core.cause.startswith(robot.muscles[2])
    assert loop.core.body.isolated == loop.core.mae.isolated == (2,)
    assert robot.isolated == ()  # other objects use this robot too, so it must not change
    (finding,) = loop.core.conditions(loop.now)
    assert finding.identifier in ('residual_distance', 'slack_tendon') and not finding.steps
    assert finding.subjects == (robot.muscles[2],) and 'ends by itself' in finding.text
    loop.command[2] -= 0.003
    loop.step(cut, 100)
    assert loop.core.cause == ''
    assert loop.core.suspects.last_verification == f'{robot.muscles[2]}: ruptured'
    assert loop.core.body.isolated == (2,)
    before = loop.core.mae.estimate(*cut).theta
    loop.step(cut, 300)  # an isolated muscle does not raise the anomaly again
    assert loop.core.cause == ''
    np.testing.assert_array_equal(loop.core.mae.estimate(*healthy._replace(length=cut.length)).theta,
                                  before)  # fmt: skip
    report = loop.core.report(loop.now)
    assert report.level == 'warn'
    (isolated,) = report.conditions
    assert isolated.identifier == 'muscle_isolated' and isolated.subjects == (robot.muscles[2],)
    assert isolated.text == f'a muscle is isolated and not used: {robot.muscles[2]} (ruptured)'
    assert report.values['last outcome'] == 'ruptured'
    loop.step(healthy, 30)  # the muscle is repaired
    loop.core.isolate(())
    loop.step(healthy, 10)
    assert loop.core.mae.isolated == ()


def test_the_report_names_the_muscles_without_which_the_posture_would_be_undetermined(loop, robot):
    loop.core.isolate([0])
    (alone,) = loop.core.report(loop.now).conditions
    assert alone.identifier == 'muscle_isolated'
    loop.core.isolate(range(robot.muscle_count - 2))
    *isolated, needed = loop.core.report(loop.now).conditions
    assert {each.identifier for each in isolated} == {'muscle_isolated'}
    assert needed.identifier == 'muscle_needed'
    assert needed.subjects == robot.muscles[-2:]  # one length cannot determine two joints
    for muscle in robot.muscles[-2:]:
        assert f'{muscle} (' in needed.text


def test_a_healthy_suspect_is_restored_but_a_third_anomaly_is_latched(loop, healthy, wound):
    for count in range(3):
        loop.command = healthy.length - (healthy.tension - 30.0) / 1e4
        loop.step(healthy, 30)
        loop.step(wound, 8)
        assert loop.core.cause
        if count == 2:
            break
        assert len(loop.core.body.isolated) == 1
        (suspect,) = loop.core.body.isolated
        loop.step(healthy, 10)
        wound_in = 0.0015 * (np.arange(6) == suspect)
        loop.command = loop.command - wound_in
        loop.step(healthy._replace(tension=healthy.tension + 1e4 * wound_in), 100)
        assert loop.core.suspects.last_verdict[1].outcome is Outcome.HEALTHY
        assert loop.core.body.isolated == ()
        assert loop.core.cause == ''
    # The third finding isolates no muscle. It is latched, as with `on_anomaly: stop`.
    assert loop.core.body.isolated == ()
    loop.step(healthy, 300)
    assert loop.core.cause


def test_on_anomaly_stop_is_the_default_and_isolates_no_muscle(robot, calibrated, healthy, cut):
    loop = Loop(robot, calibrated, healthy)
    loop.core.suspects.isolates = False
    loop.step(cut, 300)
    assert loop.core.cause
    assert loop.core.body.isolated == ()


@pytest.mark.parametrize('service', ['reset', 'isolate'])
def test_a_verification_is_ended_only_by_isolating_its_suspect(loop, healthy, cut, service):
    loop.step(healthy, 30)
    loop.step(cut, 20)
    loop.step(healthy, 20)  # the muscle seems healthy, but it has not been wound in
    with pytest.raises(MusculoskeletalError, match=f'verified.*within 10 s.*{service} again'):
        loop.core.reset(isolating=[5] if service == 'isolate' else [])
    assert loop.core.body.isolated == (2,)
    assert loop.core.body.verified == 2
    loop.core.reset(isolating=[2])
    assert loop.core.body.isolated == (2,)
    assert loop.core.cause == ''


def test_a_reset_during_its_verification_does_not_accept_a_length_that_has_jumped(
    robot, calibrated, healthy
):
    quiet = replace(calibrated.anomaly, thresholds={'distance': 1e6})
    loop = Loop(robot, replace(calibrated, anomaly=quiet), healthy)
    loop.step(healthy, 30)
    loop.length = healthy.length + 0.05 * (np.arange(6) == 3)
    jumped = healthy._replace(length=loop.length)
    while loop.core.body.verified is None:
        with suppress(RejectionError):
            loop.step(jumped)
    with pytest.raises(MusculoskeletalError, match='is being verified'):
        loop.core.reset()
    loop.step(jumped, 10)
    loop.command = loop.command - 0.0015 * (np.arange(6) == 3)
    loop.step(jumped, 100)
    assert loop.core.suspects.last_verdict[1].outcome is Outcome.LENGTH_SENSOR_OFFSET
    assert loop.core.body.isolated == (3,)


def test_without_a_verification_the_report_names_the_remedy(loop, healthy, cut):
    loop.core.suspects.isolates = False
    loop.step(healthy, 30)
    loop.step(cut, 20)
    report = loop.core.report(loop.now)
    assert report.steps == REPAIR


def test_a_suspect_cannot_be_restored_during_its_verification_which_always_ends(loop, healthy, cut):
    loop.step(healthy, 30)
    loop.step(cut, 20)
    (suspect,) = loop.core.body.isolated
    for _ in range(round(LONGEST / DT / 10)):
        if loop.core.cause == '':
            break
        with pytest.raises(MusculoskeletalError, match=r'is being verified.*within 10 s; wait'):
            loop.core.restore([suspect])
        assert loop.core.body.isolated == (suspect,)
        loop.step(healthy, 10)
    assert loop.core.cause == ''
    loop.core.restore([suspect])
    assert loop.core.body.isolated == ()
    loop.step(healthy, 100)
    assert loop.core.cause == ''


def test_another_muscle_can_be_restored_during_a_verification(loop, healthy, cut):
    loop.step(healthy, 30)
    loop.core.isolate([5])
    loop.step(cut, 20)
    loop.core.restore([5])
    assert loop.core.body.isolated == (2,)
    assert loop.core.suspects.verification is not None


def test_an_anomaly_without_a_verification_always_has_a_remedy(loop, healthy, cut):
    loop.step(healthy, 30)
    loop.step(cut, 20)
    assert not loop.core.report(loop.now).steps
    loop.core.isolate(())  # the suspect is in use again, without a verdict
    assert loop.core.report(loop.now).steps == REPAIR


def test_a_sensor_that_stands_still_while_the_arm_moves_is_detected(robot, calibrated, healthy):
    rng, frozen = np.random.default_rng(0), 3
    quiet = replace(calibrated.anomaly, thresholds={'distance': 1e6})
    for broken, share in ((False, 0.0), (True, 1.0)):
        core = Estimator(robot)
        core.use(replace(calibrated, anomaly=quiet))
        for n in range(400):
            theta = 0.5 * (robot.lower + robot.upper) + 0.5 * np.sin(0.01 * n)
            noise = 1e-4 * rng.standard_normal(6)
            length = robot.muscle_lengths(theta, healthy.tension) + noise
            length[frozen] -= share * (length[frozen] - healthy.length[frozen])
            tension = healthy.tension + rng.standard_normal(6)
            core.take(reading([length, tension, np.full(6, 25.0)]), n * DT, n * DT)
        assert bool(core.cause) == broken
    stays = 'reading stays exactly the same while the arm moves'
    assert core.cause == f'{robot.muscles[frozen]}: its length {stays}'


def test_a_tension_reading_that_freezes_at_the_bias_is_detected_if_it_had_noise_before(
    robot, calibrated, healthy
):
    rng, frozen = np.random.default_rng(0), 3
    core = Estimator(robot)
    core.use(replace(calibrated, anomaly=replace(calibrated.anomaly, thresholds={})))
    for n in range(1600):
        theta = 0.5 * (robot.lower + robot.upper) + 0.5 * np.sin(0.01 * n)
        length = robot.muscle_lengths(theta, healthy.tension) + 1e-4 * rng.standard_normal(6)
        tension = robot.tension.bias + rng.standard_normal(6)
        if n >= 1200:
            tension[frozen] = robot.tension.bias[frozen] + 0.5
        core.take(reading([length, tension, np.full(6, 25.0)]), n * DT, n * DT)
        assert n >= 1200 or not core.cause
    stays = 'reading stays exactly the same while the arm moves'
    assert core.cause == f'{robot.muscles[frozen]}: its tension {stays}'


def test_a_tension_that_stays_exactly_at_the_bias_is_no_sensor_fault(robot, calibrated, healthy):
    # A simulated module without sensor noise reads exactly T_bias as long as l_target > l.
    rng, paid_out = np.random.default_rng(0), 3
    core = Estimator(robot)
    quiet = replace(calibrated.anomaly, thresholds={'distance': 1e6})
    core.use(replace(calibrated, anomaly=quiet))
    for n in range(400):
        theta = 0.5 * (robot.lower + robot.upper) + 0.5 * np.sin(0.01 * n)
        tension = healthy.tension + rng.standard_normal(6)
        tension[paid_out] = robot.tension.bias[paid_out]
        length = robot.muscle_lengths(theta, tension) + 1e-4 * rng.standard_normal(6)
        core.take(reading([length, tension, np.full(6, 25.0)]), n * DT, n * DT)
    assert core.cause == ''


@pytest.mark.parametrize(('on_anomaly', 'suspected'), [('isolate', True), ('stop', False)])
def test_a_muscle_whose_length_jumps_is_isolated_as_a_suspect_if_suspects_are_isolated(
    robot, calibrated, healthy, on_anomaly, suspected
):
    quiet = replace(calibrated.anomaly, thresholds={'distance': 1e6})
    core, jumped, rejected = Estimator(robot), 3, 0
    core.use(replace(calibrated, anomaly=quiet))
    core.suspects.isolates = on_anomaly == 'isolate'
    rng = np.random.default_rng(0)
    for n in range(round((LIMITS.settled + 0.5) / DT)):
        length = healthy.length + 1e-4 * rng.standard_normal(6)
        length[jumped] += 0.05 * (n >= 20)
        tension = healthy.tension + rng.standard_normal(6)
        try:
            core.take(reading([length, tension, np.full(6, 25.0)]), n * DT, n * DT)
        except RejectionError:
            rejected += 1
    assert rejected > 50
    assert core.body.isolated == ((jumped,) if suspected else ())
    assert core.cause
    assert bool(core.body.offsets.revoked) != suspected


@pytest.mark.parametrize('scale', [1.0, 0.1])
def test_a_jam_is_recognised_in_a_weak_muscle_as_in_a_strong_one(scale):
    # The tension of the jammed muscle stays at T_bias, although three times T_bias is demanded.
    watched = Verification(scale * BIAS, scale * STIFFNESS)
    for n, (shake, stir) in enumerate(NOISE):
        command = -min(max(0.0, (n - 150) * 0.0004), 0.006)
        result = watched.step(scale * (BIAS + shake), stir, command, 0.0, DT)
        if result:
            break
    assert result.outcome is Outcome.JAMMED
