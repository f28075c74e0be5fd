# SPDX-License-Identifier: Apache-2.0
"""The reaction to a finding depends on its kind and on the parameter `on_anomaly`."""

import pytest

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.finding import Finding
from musculoskeletal_ae.estimation.isolation import ACQUITTALS, WITHIN, SuspectHandling
from musculoskeletal_ae.estimation.suspect_verification import Outcome, VerificationVerdict

DISTANCE = Finding(1, ConditionKind.RESIDUAL_DISTANCE, 'd = 9')


@pytest.fixture
def suspects(robot):
    handling = SuspectHandling(robot)
    handling.isolates = True
    return handling


@pytest.mark.parametrize(
    ('kind', 'on_anomaly', 'latched', 'isolated', 'verified'),
    [
        (ConditionKind.SLACK_TENDON, 'stop', True, (), False),
        (ConditionKind.SLACK_TENDON, 'isolate', True, (2,), True),
        (ConditionKind.LENGTH_JUMP, 'stop', True, (), False),
        (ConditionKind.LENGTH_JUMP, 'isolate', True, (2,), True),
        (ConditionKind.VALUES_MISSING, 'stop', False, (), False),
        (ConditionKind.VALUES_MISSING, 'isolate', False, (2,), False),
        (ConditionKind.SENSOR_SATURATED, 'stop', True, (), False),
        (ConditionKind.SENSOR_SATURATED, 'isolate', False, (2,), False),
    ],
)
def test_the_consequences_of_each_finding(suspects, kind, on_anomaly, latched, isolated, verified):
    suspects.isolates = on_anomaly == 'isolate'
    assert suspects.take(Finding(2, kind, ''), (), 0.0) == isolated
    assert (suspects.finding is not None) == latched
    assert (suspects.verification is not None) == verified


def test_the_first_finding_stays_latched(suspects, robot):
    isolated = suspects.take(DISTANCE, (), 0.0)
    assert (
        suspects.take(Finding(3, ConditionKind.MODULE_NOT_FOLLOWING, ''), isolated, 1.0) == isolated
    )
    assert suspects.finding is DISTANCE
    assert suspects.cause == f'{robot.muscles[1]}: d = 9'


@pytest.mark.parametrize(
    'kind',
    [ConditionKind.RESIDUAL_DISTANCE, ConditionKind.SLACK_TENDON, ConditionKind.SENSOR_FROZEN],
)
@pytest.mark.parametrize(
    'jump',
    [
        Finding(1, ConditionKind.LENGTH_JUMP, ''),  # of the suspect
        Finding(2, ConditionKind.LENGTH_JUMP, ''),
        Finding(1, ConditionKind.LENGTHS_JUMPED, ''),
    ],
)
def test_only_a_jump_of_the_suspect_alone_is_explained_by_its_repair(suspects, kind, jump):
    suspects.isolates = False
    finding = Finding(1, kind, '')
    suspects.take(finding, (), 0.0)
    is_repair = jump == Finding(1, ConditionKind.LENGTH_JUMP, '')
    assert suspects.explains(jump) == is_repair


def test_a_repair_of_a_muscle_that_may_be_faulty_instead_explains_its_jump_as_well(suspects):
    suspects.take(Finding(1, ConditionKind.RESIDUAL_DISTANCE, 'd = 9', (3,)), (), 0.0)
    assert suspects.explains(Finding(3, ConditionKind.LENGTH_JUMP, ''))
    assert not suspects.explains(Finding(2, ConditionKind.LENGTH_JUMP, ''))


def test_the_fault_of_an_isolated_muscle_is_known_until_the_muscle_is_restored(suspects):
    isolated = suspects.take(DISTANCE, (), 0.0)
    isolated = suspects.conclude(VerificationVerdict(Outcome.RUPTURED), isolated, 1.0)
    isolated = suspects.take(Finding(2, ConditionKind.VALUES_MISSING, ''), isolated, 2.0)
    outcomes = {muscle: fault.outcome for muscle, fault in suspects.faults.items()}
    assert outcomes == {1: Outcome.RUPTURED, 2: Outcome.VALUES_MISSING}
    suspects.on_isolated([2])
    assert set(suspects.faults) == {2}


@pytest.mark.parametrize('outcome', Outcome)
def test_only_a_healthy_suspect_is_restored_and_either_way_the_anomaly_is_over(suspects, outcome):
    isolated = suspects.take(DISTANCE, (4,), 0.0)
    isolated = suspects.conclude(VerificationVerdict(outcome), isolated, 1.0)
    assert (1 in isolated) == (outcome is not Outcome.HEALTHY)
    assert 4 in isolated
    assert suspects.finding is suspects.verification is None
    assert suspects.last_verdict == (1, VerificationVerdict(outcome))


@pytest.mark.parametrize(('later', 'isolates'), [(1.0, False), (WITHIN, True)])
def test_after_several_healthy_suspects_the_arm_stays_stopped_for_a_while(
    suspects, later, isolates
):
    for _ in range(ACQUITTALS):
        isolated = suspects.take(DISTANCE, (), 0.0)
        assert isolated == (1,)
        suspects.conclude(VerificationVerdict(Outcome.HEALTHY), isolated, 0.0)
    assert (suspects.take(DISTANCE, (), later) == (1,)) == isolates
    assert suspects.finding is DISTANCE
