# SPDX-License-Identifier: Apache-2.0
"""The supervisor: decides what the arm does, when it stops and when it may continue.

The *activity* is what the arm does, or will do after a stop. The *stop state* determines whether
the arm may do this. `TRANSITIONS` is the complete table of changes of the stop state; no other code
changes it. Activity and stop state together give the mode that users see. In addition, the
supervisor remembers whether an exploration was interrupted or refused, and the causes of the
present stop.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

from musculoskeletal_ae.conditions import Clears, Condition, ConditionKind
from musculoskeletal_ae.remedy_steps import Step

RESUME = 0.2  # let a paused arm continue once no cause has been present for this time [s]


class Activity(Enum):
    """What the arm does when nothing stops it."""

    IDLE = 'idle'  # the arm has no target yet
    HOLDING = 'holding'
    MOVING = 'moving'  # the arm follows a trajectory
    EXPLORING = 'exploring'
    CALIBRATING = 'calibrating'  # exploring gently while the length offsets are unknown
    TORQUE = 'torque'  # the arm is controlled by commanded tensions (method `tension`)
    #: the arm is guided by hand, and only its weight is compensated (method `float`)
    GRAVITY_COMPENSATION = 'gravity_compensation'


class StopState(Enum):
    """Whether the arm may move; the values appear as modes in the public interface."""

    RUNNING = 'running'
    PAUSED = 'paused'  # stopped by an auto-recoverable cause
    STOPPED = 'stopped'  # stopped until a reset, or until the verification of a suspect begins
    VERIFYING = 'verifying'  # stopped; a suspect muscle is wound in
    RESUMING = 'resuming'  # the suspect is verified; the arm continues once no cause is present


class Event(Enum):
    """Events that change the stop state; their values are the labels in `diagram`."""

    CLEARING_CAUSE = 'an auto-recoverable cause'
    LATCHING_CAUSE = 'any other cause'
    CLEARED = 'no cause for 0.2 s'
    RELEASED = 'hold_time is over and the arm is released'
    SUSPECT = 'the estimator checks whether a suspect muscle is faulty'
    NOT_VERIFIED = (
        'the estimator has ended or checks no muscle, or another stop cause needs a reset'
    )
    VERIFIED = 'the check has ended the anomaly, and no stop cause needs a reset'
    NOTHING_PRESENT = 'no cause is present'
    RESET = 'controller/reset without a cause present'


#: the activity after a latched stop, for each activity that the stop ends
AFTER_A_STOP = {
    Activity.MOVING: Activity.HOLDING,
    Activity.EXPLORING: Activity.IDLE,
    Activity.CALIBRATING: Activity.IDLE,
}

_S, _E = StopState, Event
#: the complete table (state, event) → state; any other combination has no effect
TRANSITIONS: dict[tuple[StopState, Event], StopState] = {
    (_S.RUNNING, _E.CLEARING_CAUSE): _S.PAUSED,
    (_S.RUNNING, _E.LATCHING_CAUSE): _S.STOPPED,
    (_S.PAUSED, _E.LATCHING_CAUSE): _S.STOPPED,
    (_S.PAUSED, _E.RELEASED): _S.STOPPED,
    (_S.PAUSED, _E.CLEARED): _S.RUNNING,
    (_S.PAUSED, _E.RESET): _S.RUNNING,
    (_S.STOPPED, _E.SUSPECT): _S.VERIFYING,
    (_S.STOPPED, _E.RESET): _S.RUNNING,
    (_S.VERIFYING, _E.NOT_VERIFIED): _S.STOPPED,
    (_S.VERIFYING, _E.VERIFIED): _S.RESUMING,
    (_S.VERIFYING, _E.RESET): _S.RUNNING,
    (_S.RESUMING, _E.LATCHING_CAUSE): _S.STOPPED,
    (_S.RESUMING, _E.NOTHING_PRESENT): _S.RUNNING,
    (_S.RESUMING, _E.RESET): _S.RUNNING,
}


class Supervisor:
    """Manages the activity and the stop state of one arm.

    Attributes:
        activity: What the arm does, or will do after a stop.
        explored: Whether a latched stop has interrupted an exploration that will resume if a
            verification ends the stop. A request or a reset sets this to False.
        awaits_exploration: Whether an exploration is still to be started, because a latched stop
            has ended it or because it was refused at the start. A request sets this to False.
        state: The stop state.
        condition: The reported stop cause; None while running.
    """

    def __init__(self) -> None:
        self.activity, self.explored = Activity.IDLE, False
        self.awaits_exploration = False
        self.state = StopState.RUNNING
        self.condition: Condition | None = None
        #: the latching causes since the stop began, with their newest details
        self._causes: dict[ConditionKind, Condition] = {}
        self._clear_for = 0.0  # time for which no cause of the stop has been present [s]

    @property
    def mode(self) -> str:
        """The identifier of the activity while the arm is running, otherwise of the stop state."""
        return (self.activity if self.state is StopState.RUNNING else self.state).value

    @property
    def is_running(self) -> bool:
        """Whether the activity may command the arm."""
        return self.state is StopState.RUNNING

    @property
    def is_latched(self) -> bool:
        """Whether the arm is in a latched stop, which only a reset or a verification ends."""
        return self.state in (StopState.STOPPED, StopState.VERIFYING, StopState.RESUMING)

    @property
    def may_wind_suspect(self) -> bool:
        """Whether a suspect may be wound in to verify its fault; never after an operator's stop."""
        return self.state is StopState.VERIFYING and ConditionKind.OPERATOR not in self._causes

    @property
    def releases_at_once(self) -> bool:
        """Whether a cause of the present stop demands to release the arm without delay."""
        reported = () if self.condition is None else (self.condition.kind,)
        return any(kind.releases_at_once for kind in (*self._causes, *reported))

    @property
    def will_resume_exploring(self) -> bool:
        """Whether an interrupted exploration goes on by itself when this stop has ended."""
        return self.explored and self.ends_by_itself

    @property
    def ends_by_itself(self) -> bool:
        """Whether this latched stop ends without a reset, when the verification has ended."""
        return self.state is StopState.RESUMING or (
            self.state is StopState.VERIFYING and self._is_verifiable
        )

    @property
    def _is_verifiable(self) -> bool:
        return all(kind.clears is Clears.VERIFICATION for kind in self._causes)

    def causes(self, present: Sequence[Condition]) -> list[Condition]:
        """Return all causes of the present stop: those that began it, and those that keep it.

        A cause that is not present any more keeps the stop if only a reset ends it. Its remedy is
        then the reset alone, unless it was a single event.

        Args:
            present: The causes that are present, with their newest details.
        """
        if self.condition is None:
            return []
        causes = {self.condition.kind: self.condition}
        causes |= {kind: each for kind, each in self._causes.items() if kind.clears is Clears.RESET}
        ended = {
            kind: each._replace(steps=(Step.RESET_CONTROLLER,))
            for kind, each in causes.items()
            if kind.stop is not None and not kind.stop.is_event
        }
        return list({**causes, **ended, **{each.kind: each for each in present}}.values())

    @property
    def explores(self) -> bool:
        """Whether the arm explores, or will continue to explore after a pause."""
        return self.activity in (Activity.EXPLORING, Activity.CALIBRATING)

    # -- activity -------------------------------------------------------------------------------

    def on_request(self, activity: Activity) -> None:
        """Change the activity; during a stop, the change takes effect after the stop.

        After a latched stop, the arm may move to its last target and hold it, but must not start
        an exploration or a trajectory by itself. Requests for these activities during such a stop
        are therefore replaced according to `AFTER_A_STOP`. A request during a stop also prevents
        an interrupted exploration from resuming.
        """
        if self.is_latched:
            activity = AFTER_A_STOP.get(activity, activity)
        self.activity, self.explored = activity, False
        self.awaits_exploration = False

    def on_offsets(self, known: bool) -> None:
        """Adapt the activity when the length offsets become `known`, or unknown.

        While the offsets are unknown, the arm can only explore gently. A motion to a target ends,
        because its trajectory was planned with the previous offsets.
        """
        if not known and self.activity is Activity.EXPLORING:
            self.activity = Activity.CALIBRATING
        elif known and self.activity is Activity.CALIBRATING:
            self.activity = Activity.EXPLORING
        elif self.activity is Activity.MOVING:
            self.activity = Activity.HOLDING

    def on_arrival(self) -> None:
        """Switch to holding at the end of a trajectory."""
        if self.activity is Activity.MOVING:
            self.activity = Activity.HOLDING

    # -- stops ----------------------------------------------------------------------------------

    def on_event(self, condition: Condition) -> None:
        """Stop because of a single event, such as a call of controller/stop."""
        self._take([condition])

    def on_conditions(self, present: Sequence[Condition], elapsed: float, released: bool) -> None:
        """Update the stop state from all causes that are present.

        Args:
            present: The causes with their details, in the order of `ConditionKind`.
            elapsed: Time since the last call [s].
            released: Whether `hold_time` is over and the arm is released.
        """
        if present:
            self._clear_for = 0.0
            self._take(present)
        else:
            self._clear_for += elapsed
            self._fire(Event.NOTHING_PRESENT)
            if self._clear_for > RESUME:
                self._fire(Event.CLEARED)
        if released:
            self._fire(Event.RELEASED)

    def on_suspect(self, is_verified: bool) -> None:
        """Start or abandon the verification of a suspect muscle.

        `on_verified` ends a verification that is complete.

        Args:
            is_verified: True if the estimator verifies a suspect. False if it does not although it
                has ended no anomaly, or if estimates are missing: the estimator may then have
                restarted, and would no longer have a suspect.
        """
        self._fire(Event.SUSPECT if is_verified else Event.NOT_VERIFIED)

    def on_verified(self) -> None:
        """Resume if a verification has ended the anomaly and no cause needs a reset."""
        self._fire(Event.VERIFIED if self._is_verifiable else Event.NOT_VERIFIED)

    def on_reset(self, present: Sequence[Condition]) -> Condition | None:
        """End the stop, and return None; if a cause is still present, return the first one instead.

        In this case, the stop does not end.
        """
        if present:
            return present[0]
        self.explored = False
        self._fire(Event.RESET)
        return None

    def _take(self, conditions: Sequence[Condition]) -> None:
        latching = [each for each in conditions if each.kind.clears is not Clears.CONDITION]
        if not latching:
            if self.is_running:
                self.condition = conditions[0]
            self._fire(Event.CLEARING_CAUSE)
            return
        if not self.is_latched:
            self.condition = latching[0]
            self._causes.clear()
        self._causes |= {each.kind: each for each in latching}
        self._fire(Event.LATCHING_CAUSE)

    def _fire(self, event: Event) -> None:
        before, was_latched = self.state, self.is_latched
        self.state = TRANSITIONS.get((before, event), before)
        if self.state is before:
            return
        if self.state is StopState.RUNNING:
            resumed = before is StopState.RESUMING and self.explored
            self.condition, self.explored = None, False
            self._causes.clear()
            if resumed:
                self.activity, self.awaits_exploration = Activity.EXPLORING, False
        elif self.is_latched and not was_latched:
            self.explored = self.explores
            self.awaits_exploration = self.awaits_exploration or self.explores
            self.activity = AFTER_A_STOP.get(self.activity, self.activity)
            if self.condition is not None:  # an auto-recoverable cause has become latched
                self._causes[self.condition.kind] = self.condition


def diagram() -> str:
    """Return the stop states and their transitions as a Mermaid diagram."""
    lines = ['stateDiagram-v2', '    [*] --> running']
    for (source, event), target in TRANSITIONS.items():
        lines.append(f'    {source.value} --> {target.value}: {event.value}')
    return '\n'.join(lines)
