# SPDX-License-Identifier: Apache-2.0
"""Decides what the arm does, when it stops and when it may go on. Knows nothing about muscles.

Two values say all of it. The *activity* is what the arm does, or will do again after a stop. The
*stop state* says whether it may: `TRANSITIONS` is the complete table of its changes, and no other
code changes it. The mode that users see follows from the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

from musculoskeletal_ae.control.stops import Action, Clears, Condition, StopCause

RESUME = 0.2  # [s] without a cause after which a paused arm goes on


class Activity(Enum):
    """What the arm does when nothing stops it."""

    IDLE = 'idle'  # no target has been given
    HOLDING = 'holding'
    MOVING = 'moving'  # along a trajectory: to a target or a pose, or as one was given
    EXPLORING = 'exploring'
    CALIBRATING = 'calibrating'  # exploring gently while the length offsets are unknown
    TORQUE = 'torque'  # tensions are commanded (method `tension`)
    GRAVITY_COMPENSATION = 'gravity_compensation'  # a hand moves the arm (method `float`)


class StopState(Enum):
    """Whether the arm may move; the values are part of the interface."""

    RUNNING = 'running'
    PAUSED = 'paused'  # for a cause that may clear by itself
    STOPPED = 'stopped'  # latched
    VERIFYING = 'verifying'  # stopped; a suspect muscle is wound in
    RESUMING = 'resuming'  # the suspect is verified; the arm goes on once no cause is present


class Event(Enum):
    """What changes the stop state."""

    CLEARING_CAUSE = 'a cause that may clear by itself'
    LATCHING_CAUSE = 'any other cause'
    CLEARED = 'no cause for 0.2 s'
    RELEASED = 'hold_time is over: the arm is being released'
    SUSPECT = 'the estimator has isolated a suspect muscle'
    SUSPECT_LOST = 'the estimator is gone, and its suspect with it'
    VERIFIED = 'the anomaly ended by verification, and every cause clears by that'
    VERIFIED_IN_VAIN = 'the anomaly ended by verification, and another cause needs a reset'
    NOTHING_PRESENT = 'no cause is present'
    RESET = 'controller/reset without a cause present'


#: activities that a latched stop ends for good, and what the arm does afterwards instead
AFTER_A_STOP = {
    Activity.MOVING: Activity.HOLDING,
    Activity.EXPLORING: Activity.IDLE,
    Activity.CALIBRATING: Activity.IDLE,
}

_S, _E = StopState, Event
#: the complete table: (state, event) → state; any other event leaves the state as it is
TRANSITIONS: dict[tuple[StopState, Event], StopState] = {
    (_S.RUNNING, _E.CLEARING_CAUSE): _S.PAUSED,
    (_S.RUNNING, _E.LATCHING_CAUSE): _S.STOPPED,
    (_S.PAUSED, _E.LATCHING_CAUSE): _S.STOPPED,
    (_S.PAUSED, _E.RELEASED): _S.STOPPED,
    (_S.PAUSED, _E.CLEARED): _S.RUNNING,
    (_S.PAUSED, _E.RESET): _S.RUNNING,
    (_S.STOPPED, _E.SUSPECT): _S.VERIFYING,
    (_S.STOPPED, _E.RESET): _S.RUNNING,
    (_S.VERIFYING, _E.SUSPECT_LOST): _S.STOPPED,
    (_S.VERIFYING, _E.VERIFIED): _S.RESUMING,
    (_S.VERIFYING, _E.VERIFIED_IN_VAIN): _S.STOPPED,
    (_S.VERIFYING, _E.RESET): _S.RUNNING,
    (_S.RESUMING, _E.LATCHING_CAUSE): _S.STOPPED,
    (_S.RESUMING, _E.NOTHING_PRESENT): _S.RUNNING,
    (_S.RESUMING, _E.RESET): _S.RUNNING,
}


class Supervisor:
    """Owns the activity and the stop of one arm.

    Attributes:
        activity: What the arm does, or will do again after a stop.
        state: Whether it may.
        condition: The cause that is shown; None while running.
    """

    def __init__(self) -> None:
        self.activity = Activity.IDLE
        self.state = StopState.RUNNING
        self.condition: Condition | None = None
        self._causes: set[StopCause] = set()  # all latching ones since the stop began
        self._explored = False  # when the stop began
        self._clear_for = 0.0  # [s] without a cause

    @property
    def mode(self) -> str:
        """What the arm does now: the identifier of the activity, or that of the stop state."""
        return (self.activity if self.state is StopState.RUNNING else self.state).value

    @property
    def is_running(self) -> bool:
        """Whether the activity may command anything new."""
        return self.state is StopState.RUNNING

    @property
    def is_latched(self) -> bool:
        """Whether the arm is stopped and does not go on by itself."""
        return self.state in (StopState.STOPPED, StopState.VERIFYING, StopState.RESUMING)

    @property
    def may_wind_suspect(self) -> bool:
        """Whether a suspect muscle may be wound in; an operator's stop outranks that."""
        return self.state is StopState.VERIFYING and StopCause.OPERATOR not in self._causes

    @property
    def action(self) -> Action:
        """What the arm does in this stop: the most severe action of all that caused it."""
        shown = () if self.condition is None else (self.condition.cause,)
        return max((cause.action for cause in (*self._causes, *shown)), default=Action.HOLD)

    @property
    def explores(self) -> bool:
        """Whether random targets are being generated."""
        return self.activity in (Activity.EXPLORING, Activity.CALIBRATING)

    # -- activity -------------------------------------------------------------------------------

    def on_request(self, activity: Activity) -> None:
        """Do something else, during a stop after it.

        The arm does not start to move or explore with the end of a stop: it holds its last target.
        Nor does it explore again after the stop, once something else was requested.
        """
        if self.is_latched:
            activity = AFTER_A_STOP.get(activity, activity)
        self.activity, self._explored = activity, False

    def on_offsets(self, known: bool) -> None:
        """Take whether the length offsets are known; while they are not, explore gently only."""
        if not known and self.activity is Activity.EXPLORING:
            self.activity = Activity.CALIBRATING
        elif known and self.activity is Activity.CALIBRATING:
            self.activity = Activity.EXPLORING
        elif self.activity is Activity.MOVING:
            self.activity = Activity.HOLDING

    def on_arrival(self) -> None:
        """Hold the end of the trajectory that was followed."""
        if self.activity is Activity.MOVING:
            self.activity = Activity.HOLDING

    # -- stops ----------------------------------------------------------------------------------

    def on_event(self, cause: StopCause, detail: str = '') -> None:
        """Stop for something that has happened, such as a call of controller/stop."""
        self._take([Condition(cause, detail)])

    def on_conditions(self, present: Sequence[Condition], elapsed: float, released: bool) -> None:
        """Take all causes that are present now, the most severe first.

        Args:
            present: The causes with their details.
            elapsed: How long the data has been as it is since the last call [s].
            released: Whether the arm was held for `hold_time` and is being released.
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

    def on_suspect(self, is_isolated: bool) -> None:
        """Take that a suspect muscle is isolated and being verified, or that the estimator is gone.

        A suspect that is no longer isolated was found healthy: the verification ends with the
        anomaly.
        """
        self._fire(Event.SUSPECT if is_isolated else Event.SUSPECT_LOST)

    def on_verified(self) -> None:
        """Take that the anomaly is over after a verification."""
        verifiable = all(cause.clears is Clears.VERIFICATION for cause in self._causes)
        self._fire(Event.VERIFIED if verifiable else Event.VERIFIED_IN_VAIN)

    def on_reset(self, present: Sequence[Condition]) -> Condition | None:
        """End the stop, unless a cause is present; return that cause."""
        if present:
            return present[0]
        self._explored = False
        self._fire(Event.RESET)
        return None

    def _take(self, conditions: Sequence[Condition]) -> None:
        latching = [each for each in conditions if each.cause.clears is not Clears.CONDITION]
        if not latching:
            if self.is_running:
                self.condition = conditions[0]
            self._fire(Event.CLEARING_CAUSE)
            return
        if not self.is_latched:
            self.condition = latching[0]
            self._explored = self.explores
            self._causes.clear()
        self._causes |= {each.cause for each in latching}
        self._fire(Event.LATCHING_CAUSE)

    def _fire(self, event: Event) -> None:
        before = self.state
        self.state = TRANSITIONS.get((before, event), before)
        if self.state is before:
            return
        if self.state is StopState.RUNNING:
            resumed = before is StopState.RESUMING and self._explored
            self.condition, self._explored = None, False
            self._causes.clear()
            if resumed:
                self.activity = Activity.EXPLORING
        elif self.is_latched:
            self.activity = AFTER_A_STOP.get(self.activity, self.activity)
            if self.condition is not None:  # one that might have cleared by itself has latched
                self._causes.add(self.condition.cause)


def diagram() -> str:
    """Return the stop states and their transitions as a Mermaid diagram."""
    lines = ['stateDiagram-v2', '    [*] --> running']
    for (source, event), target in TRANSITIONS.items():
        lines.append(f'    {source.value} --> {target.value}: {event.value}')
    return '\n'.join(lines)
