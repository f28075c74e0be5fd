# SPDX-License-Identifier: Apache-2.0
"""The supervisor: decides what the arm does, when it stops and when it may continue.

The *activity* is what the arm does, or will do after a stop. The *stop state* determines whether
the arm may do this. `TRANSITIONS` is the complete table of changes of the stop state; no other code
changes it. Activity and stop state together give the mode that users see. In addition, the
supervisor remembers whether an exploration is still to be started, and the causes of the present
stop.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

from musculoskeletal_ae.conditions import Clears, Condition, ConditionKind
from musculoskeletal_ae.remedy_steps import Step
from musculoskeletal_ae.signals.body_state import Anomaly

RESUME = 0.2  # let a paused arm continue once no cause has been present for this time [s]
#: If an auto-recoverable cause, such as stale data, has been present for this time during a stop
#: [s], only a reset ends the stop, because somebody may have begun to work at the arm. A
#: verification may still end a stop in which a length has jumped, which makes data stale for 1 s.
LASTING = 3.0


class Activity(Enum):
    """What the arm does when nothing stops it."""

    IDLE = 'idle'  # the arm has no target yet
    HOLDING = 'holding'  # the control method moves the arm to its target and holds it there
    MOVING = 'moving'  # the arm follows a trajectory
    EXPLORING = 'exploring'
    CALIBRATING = 'calibrating'  # exploring gently while the length offsets are unknown
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
    NOT_VERIFIED = 'the estimator checks no muscle, or another stop cause needs a reset'
    VERIFIED = 'the check has ended the anomaly, and no stop cause needs a reset'
    NOTHING_PRESENT = 'no cause is present'
    RESET = 'controller/reset without a cause present'


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
        awaits_exploration: Whether an exploration is still to be started, because a reset has
            ended it or because it was refused at the start. A request sets this to False.
        state: The stop state.
    """

    def __init__(self) -> None:
        self.activity = Activity.IDLE
        self.awaits_exploration = False
        self.state = StopState.RUNNING
        #: the cause of a pause, or all causes that have latched the present stop with their newest
        #: details; empty while running
        self._causes: dict[ConditionKind, Condition] = {}
        self._clear_for = 0.0  # time for which no cause of the stop has been present [s]
        #: time for which an auto-recoverable cause has been present during a latched stop [s]
        self._lasting_for = 0.0

    @property
    def mode(self) -> str:
        """The identifier of the activity while the arm is running, otherwise of the stop state."""
        return (self.activity if self.state is StopState.RUNNING else self.state).value

    @property
    def condition(self) -> Condition | None:
        """The reported stop cause, which is the first one of the stop; None while running."""
        return next(iter(self._causes.values()), None)

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
        return any(kind.releases_at_once for kind in self._causes)

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
        """Whether the arm explores, or did so when the present stop began."""
        return self.activity in (Activity.EXPLORING, Activity.CALIBRATING)

    @property
    def lacks_exploration(self) -> bool:
        """Whether the arm explores only after a new request, although it should explore."""
        is_ended = self.is_latched and self.explores and not self.ends_by_itself
        return self.awaits_exploration or is_ended

    # -- activity -------------------------------------------------------------------------------

    def on_request(self, activity: Activity) -> None:
        """Change the activity; during a stop, the change takes effect after the stop."""
        self.activity, self.awaits_exploration = activity, False

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
        """Latch a stop because of an event, such as a call of controller/stop."""
        self._latch([condition])

    def on_conditions(self, present: Sequence[Condition], elapsed: float, released: bool) -> None:
        """Update the stop state from all causes that are present.

        Args:
            present: The causes with their details, in the order of `ConditionKind`.
            elapsed: Time since the last call [s].
            released: Whether `hold_time` is over and the arm is released.
        """
        latching = [each for each in present if each.kind.clears is not Clears.CONDITION]
        lasts = self.is_latched and len(latching) < len(present)
        self._lasting_for = self._lasting_for + elapsed if lasts else 0.0
        if self._lasting_for > LASTING:
            latching = list(present)
        if latching:
            self._latch(latching)
        elif present:
            if self.is_running:
                self._causes = {present[0].kind: present[0]}
            self._fire(Event.CLEARING_CAUSE)
        if present:
            self._clear_for = 0.0
        else:
            self._clear_for += elapsed
            self._fire(Event.NOTHING_PRESENT)
            if self._clear_for > RESUME:
                self._fire(Event.CLEARED)
        if released:
            self._fire(Event.RELEASED)

    def on_anomaly(self, anomaly: Anomaly) -> None:
        """Begin, complete or abandon the verification of a suspect muscle.

        If a verification has ended the anomaly, the arm resumes, unless a cause needs a reset. A
        restarted estimator publishes that there is no anomaly, so that the verification is
        abandoned.
        """
        if anomaly is Anomaly.VERIFYING:
            self._fire(Event.SUSPECT)
        elif anomaly is Anomaly.ENDED and self._is_verifiable:
            self._fire(Event.VERIFIED)
        else:
            self._fire(Event.NOT_VERIFIED)

    def on_reset(self, present: Sequence[Condition]) -> Condition | None:
        """End the stop, and return None; if a cause is still present, return the first one instead.

        In this case, the stop does not end. After the reset of a latched stop, the arm may move to
        its last target and hold it, but explores only after a new request.
        """
        if present:
            return present[0]
        if self.is_latched and self.explores:
            self.activity, self.awaits_exploration = Activity.IDLE, True
        self._fire(Event.RESET)
        return None

    def _latch(self, conditions: Sequence[Condition]) -> None:
        if not self.is_latched:  # the cause of a pause does not latch the stop
            self._causes.clear()
        self._causes |= {each.kind: each for each in conditions}
        self._fire(Event.LATCHING_CAUSE)

    def _fire(self, event: Event) -> None:
        self.state = TRANSITIONS.get((self.state, event), self.state)
        if self.is_running:
            self._causes.clear()


def diagram() -> str:
    """Return the stop states and their transitions as a Mermaid diagram."""
    lines = ['stateDiagram-v2', '    [*] --> running']
    for (source, event), target in TRANSITIONS.items():
        lines.append(f'    {source.value} --> {target.value}: {event.value}')
    return '\n'.join(lines)
