# SPDX-License-Identifier: Apache-2.0
"""An arm that rests away from its target does not claim to hold it."""

import numpy as np
import pytest
from control_bench import REST, Bench

from musculoskeletal_ae.control.holding import AWAY, CARRIED, LASTING, POSSIBLE_CAUSES

SELDOM = 0.05


def resting(away, **chosen):
    """Return a bench whose arm rests `away` [rad] from its target, after the motion."""
    bench = Bench(**chosen)
    bench.dt = SELDOM
    bench.theta = REST
    bench.step()
    bench.target(REST + away)
    bench.step(round(2.0 / SELDOM))
    return bench


@pytest.mark.parametrize('chosen', [{'target_duration': 0.2}, {'method': 'first'}])
def test_an_arm_away_from_its_target_is_reported_with_joint_distance_and_causes(chosen):
    bench = resting(np.array([0.0, 1.4 * AWAY]), first_duration=0.5, **chosen)
    report = bench.report()
    assert report.level == 'ok' and report.values['distance from the target'].startswith('elbow')
    bench.step(round(1.2 * LASTING / SELDOM))
    report = bench.report()
    assert report.level == 'warn' and report.doing == 'holding'
    assert 'not at its target: elbow 0.70 rad away' in report.message
    assert POSSIBLE_CAUSES in report.message
    bench.theta = REST + np.array([0.0, 1.4 * AWAY])
    bench.step()
    assert bench.report().level == 'ok'


def test_an_arm_that_is_carried_away_from_where_it_rested_is_reported():
    bench = resting(np.array([0.0, 0.1]), target_duration=0.2)
    bench.theta = REST + np.array([0.0, -0.9 * CARRIED])
    bench.step(round(1.2 * LASTING / SELDOM))
    assert bench.report().message == 'holding'
    bench.theta = REST + np.array([0.0, -1.1 * CARRIED])
    bench.step(round(1.2 * LASTING / SELDOM))
    assert 'not at its target: elbow 0.37 rad away' in bench.report().message
    bench.target(bench.theta)
    bench.step(round(2.0 * LASTING / SELDOM))
    assert bench.report().message == 'holding'


def test_an_arm_may_rest_further_from_its_target_than_it_did_after_an_earlier_motion():
    bench = resting(np.array([0.0, 0.01]), target_duration=0.2)
    bench.target(REST + np.array([0.0, 1.4 * CARRIED]))
    bench.step(round(2.0 * LASTING / SELDOM))
    assert bench.report().message == 'holding'


def test_friction_and_wanted_torques_are_no_reason_to_warn():
    bench = resting(np.array([0.0, 0.9 * AWAY]), target_duration=0.2)
    bench.step(round(1.2 * LASTING / SELDOM))
    assert bench.report().message == 'holding'
    bench.target(REST + 1.4 * AWAY, effort=(1.0, 0.0))
    bench.step(round(2.0 * LASTING / SELDOM))
    assert 'not at its target' not in bench.report().message


def test_a_new_target_begins_a_new_distance_with_tension_commands_as_well():
    bench = resting(np.array([0.0, 0.01]), method='tension')
    bench.target(REST + np.array([0.0, 0.01 + 1.2 * CARRIED]))
    bench.step(round(2.0 * LASTING / SELDOM))
    assert 'not at its target' not in bench.report().message
