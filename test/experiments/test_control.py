# SPDX-License-Identifier: Apache-2.0
"""The paper's control protocol on an arm that equals its model: errors and tensions."""

import numpy as np
import pytest
from nominal_body import nominal_arm

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.experiments import control
from musculoskeletal_ae.experiments.control import METHODS, Durations, protocol
from musculoskeletal_ae.experiments.recording import ClosedLoop

DURATIONS = Durations(start=1.0, end=3.5, first=2.0, second=1.0)


@pytest.fixture(scope='module')
def ended(arm26, trained):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(control, 'METHODS', {name: METHODS[name] for name in ('first', 'proposed')})
        return protocol(nominal_arm(arm26), trained, seed=0, count=1, durations=DURATIONS)


def test_proposed_is_nearer_than_first_and_needs_about_the_bound(ended):
    error = {name: np.linalg.norm(offset) for name, offset in ended.offset.items()}
    assert error['proposed'] < 0.1
    assert error['proposed'] < error['first']
    assert ended.tension['proposed'].mean() == pytest.approx(ended.bound.mean(), rel=0.15)


def test_a_posture_at_the_target_needs_the_bound(ended):
    """If the arm ends near its target, the least tensions for the two postures are about equal."""
    assert ended.bound_there['proposed'].item() == pytest.approx(ended.bound.item(), rel=0.1)


def test_a_stop_under_one_method_leaves_the_others_measured(arm26, trained, monkeypatch):
    target = ClosedLoop.target

    def stopping(loop, theta):
        target(loop, theta)
        if loop.core.settings.method == 'geometric':
            loop.core.stop(ConditionKind.OPERATOR)

    methods = ('geometric', 'first')
    monkeypatch.setattr(ClosedLoop, 'target', stopping)
    monkeypatch.setattr(control, 'METHODS', dict.fromkeys(methods, ''))
    ended = protocol(nominal_arm(arm26), trained, seed=0, count=1, durations=DURATIONS)
    assert ended.stops == {name: int(name == 'geometric') for name in methods}
    assert all(np.isfinite(offset).all() for offset in ended.offset.values())
