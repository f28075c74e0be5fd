# SPDX-License-Identifier: Apache-2.0
"""The transition table of stops and modes."""

import hypothesis.strategies as st
import pytest
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from musculoskeletal_ae.conditions import Clears, ConditionKind, stop_causes
from musculoskeletal_ae.control.supervisor import (
    RESUME,
    TRANSITIONS,
    Activity,
    Event,
    StopState,
    Supervisor,
)
from musculoskeletal_ae.signals.body_state import Anomaly

ANOMALY, OPERATOR = ConditionKind.ANOMALY.condition(), ConditionKind.OPERATOR.condition()
STALE = ConditionKind.STALE_MUSCLE_STATES.condition()
STEP = 0.01  # time step [s]


def exploring():
    supervisor = Supervisor()
    supervisor.on_request(Activity.EXPLORING)
    return supervisor


def wait(supervisor, *present, seconds=2 * RESUME, released=False):
    for _ in range(round(seconds / STEP)):
        supervisor.on_conditions(present, STEP, released)


def test_old_data_that_comes_back_before_the_release_only_pauses_the_arm():
    supervisor = exploring()
    wait(supervisor, STALE)
    assert supervisor.mode == 'paused' and supervisor.condition == STALE
    wait(supervisor)
    assert supervisor.mode == 'exploring' and supervisor.condition is None


def test_old_data_that_outlasts_the_hold_time_stops_the_arm_until_a_reset():
    supervisor = exploring()
    wait(supervisor, STALE)
    wait(supervisor, STALE, released=True)
    wait(supervisor, seconds=10.0)
    assert supervisor.mode == 'stopped'
    assert supervisor.on_reset([]) is None
    assert supervisor.mode == 'idle'  # there is no target to hold, because the arm explored


def test_a_reset_is_refused_with_the_cause_that_is_present():
    supervisor = exploring()
    wait(supervisor, ANOMALY)
    assert supervisor.on_reset([ANOMALY]) == ANOMALY
    assert supervisor.mode == 'stopped'


def test_the_arm_explores_again_once_the_suspect_is_verified():
    supervisor = exploring()
    wait(supervisor, ANOMALY)
    supervisor.on_anomaly(Anomaly.VERIFYING)
    assert supervisor.mode == 'verifying'
    supervisor.on_anomaly(Anomaly.ENDED)
    assert not supervisor.lacks_exploration
    wait(supervisor)
    assert supervisor.mode == 'exploring' and not supervisor.lacks_exploration


def test_an_anomaly_that_is_still_present_after_the_verification_stops_the_arm_again():
    supervisor = exploring()
    wait(supervisor, ANOMALY)
    supervisor.on_anomaly(Anomaly.VERIFYING)
    supervisor.on_anomaly(Anomaly.ENDED)
    wait(supervisor, ANOMALY, seconds=STEP)
    wait(supervisor)
    assert supervisor.mode == 'stopped' and supervisor.lacks_exploration


@pytest.mark.parametrize('cause', stop_causes())
def test_a_stop_by_an_event_lasts_until_a_reset_whatever_its_cause(cause):
    supervisor = exploring()
    supervisor.on_event(cause.condition())
    wait(supervisor, seconds=10.0)
    assert supervisor.mode == 'stopped' and supervisor.condition.kind is cause
    assert supervisor.lacks_exploration
    assert supervisor.on_reset([]) is None
    assert supervisor.mode == 'idle' and supervisor.lacks_exploration


@pytest.mark.parametrize('cause', [each for each in stop_causes() if each.clears is Clears.RESET])
def test_a_verification_does_not_end_a_stop_that_needs_a_reset(cause):
    supervisor = exploring()
    wait(supervisor, ANOMALY)
    supervisor.on_anomaly(Anomaly.VERIFYING)
    supervisor.on_event(cause.condition())
    supervisor.on_anomaly(Anomaly.ENDED)
    wait(supervisor, seconds=10.0)
    assert supervisor.mode == 'stopped'


def test_a_target_during_a_stop_is_held_after_it_and_exploration_does_not_come_back():
    supervisor = exploring()
    wait(supervisor, ANOMALY)
    supervisor.on_anomaly(Anomaly.VERIFYING)
    supervisor.on_request(Activity.HOLDING)
    supervisor.on_anomaly(Anomaly.ENDED)
    wait(supervisor)
    assert supervisor.mode == 'holding'


class Arm(RuleBasedStateMachine):
    """Random sequences of events, with invariants that must hold after each of them."""

    def __init__(self):
        super().__init__()
        self.supervisor = Supervisor()
        self.present = []
        self.before = StopState.RUNNING
        self.latched_by = set()  # causes since the stop began that do not end by themselves
        self.may_start = self.may_explore = True

    @rule(activity=st.sampled_from(list(Activity)))
    def request(self, activity):
        self.before = self.supervisor.state
        self.supervisor.on_request(activity)
        self.may_start, self.may_explore = False, True

    @rule(causes=st.lists(st.sampled_from(stop_causes()), max_size=3))
    def conditions(self, causes):
        self.present = [cause.condition() for cause in causes]

    @rule(released=st.booleans(), steps=st.integers(1, 40))
    def time_passes(self, released, steps):
        for _ in range(steps):
            self.before = self.supervisor.state
            self.note(c for c in self.present if c.kind.clears is not Clears.CONDITION)
            self.supervisor.on_conditions(self.present, STEP, released)
            self.may_start = not self.present and self.before in (
                StopState.PAUSED,
                StopState.RESUMING,
            )
            self.check()

    @rule(cause=st.sampled_from(stop_causes()))
    def event(self, cause):
        self.before = self.supervisor.state
        self.note([cause.condition()])
        self.supervisor.on_event(cause.condition())
        self.may_start = False

    @rule(known=st.booleans())
    def offsets(self, known):
        self.before = self.supervisor.state
        self.supervisor.on_offsets(known)
        self.may_start = False

    @rule(anomaly=st.sampled_from(list(Anomaly)))
    def anomaly(self, anomaly):
        self.before = self.supervisor.state
        self.supervisor.on_anomaly(anomaly)
        self.may_start = False

    @rule()
    def reset(self):
        self.before = self.supervisor.state
        was_latched = self.supervisor.is_latched
        refused = self.supervisor.on_reset(self.present)
        assert (refused is None) == (not self.present)
        self.may_start = not self.present
        if was_latched and refused is None:
            self.may_explore = False

    def note(self, conditions):
        if self.supervisor.is_running:
            self.latched_by.clear()
        self.latched_by |= {condition.kind for condition in conditions}

    @invariant()
    def check(self):
        supervisor = self.supervisor
        started = supervisor.is_running and self.before is not StopState.RUNNING
        # Only legal events end a stop. Without a reset, a stop ends (RESUMING) only if each of its
        # latching causes ends by a verification.
        assert not started or self.may_start
        if supervisor.state is StopState.RESUMING:
            assert all(c.clears is Clears.VERIFICATION for c in self.latched_by)
        # There is a cause exactly while the arm is stopped, and every cause has a remedy.
        assert (supervisor.condition is None) == supervisor.is_running
        assert supervisor.is_running or supervisor.condition.steps
        # After the reset of a latched stop, an exploration needs a new request.
        assert self.may_explore or not supervisor.explores


TestArm = Arm.TestCase
# 4000 random events
TestArm.settings = settings(max_examples=80, stateful_step_count=50, deadline=None)


@pytest.mark.thorough
class TestArmForLong(Arm.TestCase):
    """200 000 random events."""

    settings = settings(max_examples=2000, stateful_step_count=100, deadline=None)


def test_the_table_names_every_state_and_event():
    sources = {source for source, _ in TRANSITIONS}
    assert sources == set(StopState) == {*TRANSITIONS.values()}
    assert {event for _, event in TRANSITIONS} == set(Event)
