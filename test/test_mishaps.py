# SPDX-License-Identifier: Apache-2.0
"""Checks how `bench mishaps` judges statements and plays the operator."""

import json

import numpy as np
import pytest

from bench import mishaps
from bench.lab import Lab
from bench.mishap_kinds import MISHAPS, NAMES, Case, Mishap
from bench.statements import Statement, named, statements, troubles
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.robot.robot import Robot

ROBOT = Robot.load('arm26')
BICEPS, TRICEPS = ROBOT.muscles[0], ROBOT.muscles[1]
OF_BICEPS = Case('', lambda _: None, (BICEPS,))
RUPTURE = NAMES['tendon ruptures under load']


def said(identifier: str, *subjects: str, text: str = '') -> Statement:
    return Statement('estimator', identifier, 'error', text, (), frozenset(subjects))


def test_a_statement_about_another_muscle_is_false():
    assert mishaps.judge(said('slack_tendon', BICEPS), RUPTURE, OF_BICEPS) == 'true'
    assert mishaps.judge(said('slack_tendon', TRICEPS), RUPTURE, OF_BICEPS) == 'false'


def test_consequences_are_allowed_and_other_claims_are_false():
    assert mishaps.judge(said('anomaly_detected'), RUPTURE, OF_BICEPS) == 'allowed'
    assert mishaps.judge(said('implausible_estimate'), RUPTURE, OF_BICEPS) == 'allowed'
    assert mishaps.judge(said('overheated'), RUPTURE, OF_BICEPS) == 'false'


def test_a_text_recognizes_a_condition_with_an_unknown_identifier():
    kind = Mishap('', lambda *_: OF_BICEPS, says='exchang')
    text = f'{BICEPS} and {TRICEPS} are exchanged'
    assert mishaps.judge(said('new', BICEPS, TRICEPS, text=text), kind, OF_BICEPS) == 'true'


def test_a_true_statement_names_what_is_concerned():
    assert mishaps.judge(said('slack_tendon'), RUPTURE, OF_BICEPS) == 'allowed'


def test_muscles_and_joints_are_named_by_whole_words():
    assert named(ROBOT, f'anomaly of {BICEPS}: it is slack') == {BICEPS}
    assert named(ROBOT, f'{BICEPS}_long and {ROBOT.joints[0]}') == {ROBOT.joints[0]}


def test_names_of_mishaps_are_unique_and_at_least_30_need_a_statement():
    assert len(NAMES) == len(MISHAPS)
    assert sum(not mishap.is_harmless for mishap in MISHAPS) >= 30


@pytest.fixture(scope='module')
def exploring(trained):
    lab = Lab(EmulatedArm(ROBOT, 0), trained['default'], 0)
    lab.run(1.0)
    lab.controller.explore(True)
    lab.run(4.0)
    return lab


def test_a_healthy_arm_states_nothing(exploring):
    assert exploring.rejected_networks == []
    found = statements(exploring.estimator, exploring.controller, exploring.learner, exploring.now)
    assert troubles(found) == [] and exploring.controller.supervisor.explores


def test_a_rupture_is_stated_mended_by_advice_and_ends_well(exploring, tmp_path, capfd):
    file = tmp_path / 'kin_0.jsonl'
    at = exploring.now
    mishaps.play_forked(exploring, RUPTURE, file, 0, 'kin', 0.3)
    assert exploring.now == at  # the laboratory itself goes on without the mishap
    (result,) = mishaps.results(tmp_path)
    assert capfd.readouterr().err == ''
    assert result['true after'] is not None and result['mended by advice']
    assert 'repair_muscle' in result['steps'] and result['peak'] > 0.0
    assert result['detail'] in result['true']
    assert f'| {RUPTURE.name} | ' in mishaps.page([result], ['kin'])


def test_the_table_counts_only_cases_that_need_a_statement():
    common = {
        'false': {}, 'well': True, 'error before': 0.1, 'error after': 0.2, 'peak': 1.0,
        'reality': 'kin', 'seed': 0,
    }  # fmt: skip
    cases = [
        {**common, 'needs statement': True, 'true after': 3.0},
        {**common, 'needs statement': True, 'true after': None},
        {**common, 'needs statement': False, 'true after': None, 'well': False},
    ]
    assert mishaps.row(cases)[:4] == ['1/2', 'never', '0', '2/3']
    soon, false, well = mishaps.totals(cases)
    assert (soon, false) == (50.0, 0) and well == pytest.approx(200.0 / 3.0)
    assert json.dumps(np.float64(well))
