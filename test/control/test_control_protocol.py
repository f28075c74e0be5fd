# SPDX-License-Identifier: Apache-2.0
"""The paper's control protocol on a small arm without mismatch: who comes nearer, and how taut."""

from __future__ import annotations

import numpy as np
import pytest

from bench.control_nominal import nominal_arm, nominal_tables
from musculoskeletal_ae.experiments.control import PROTOCOL, control_protocol
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.robot.robot import Robot


@pytest.fixture(scope='module')
def robot():
    return Robot.load('arm26')


@pytest.fixture(scope='module')
def networks(robot):
    def trained(preset):
        return initial_mae(robot, preset, steps=600).mae

    return trained('default'), trained('paper')


def test_proposed_is_nearer_than_first_and_no_method_beats_the_bound_by_much(robot, networks):
    result = control_protocol(nominal_arm(robot), *networks, seed=0, postures=1, starts=2)
    summary = result.summary()
    assert set(summary) == set(PROTOCOL)
    assert set(summary['first']) == {'error_rad', 'error_var', 'tension_n'}
    assert summary['proposed']['error_rad'] < 0.1
    assert summary['proposed']['error_rad'] < summary['first']['error_rad']
    assert summary['proposed']['tension_n'] == pytest.approx(np.mean(result.qp_bound), rel=0.15)


def test_the_table_of_the_nominal_body_names_every_method(robot, networks):
    table = nominal_tables(robot, *networks, quick=True)
    for word in ('bound', 'proposed, paper', 'second', 'stiffness', 'torque'):
        assert word in table
