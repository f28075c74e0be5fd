# SPDX-License-Identifier: Apache-2.0
"""Declares every stop cause with its condition, action, clear condition, text and remedy.

The reference page on stops is generated from this table. Programs compare the stable
`StopCause.identifier`; the texts are for users.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from enum import Enum, IntEnum
from itertools import chain
from typing import NamedTuple

from musculoskeletal_ae.remedy import REPAIR, Step, sentence


class Action(IntEnum):
    """Action of a stop; if several causes are present, the most severe action applies."""

    #: keep the last command, because the cause may clear; after `hold_time`, the same as RELEASE
    HOLD = 1
    #: keep the last command for `hold_time` in any case, then pay out every muscle to T_bias
    RELEASE = 2
    #: pay out at once until every muscle is at T_bias
    RELEASE_AT_ONCE = 3


class Clears(Enum):
    """How a stop ends."""

    #: auto-recoverable until the arm is released; afterwards only by a reset
    CONDITION = 'when the condition clears within hold_time, else on controller/reset'
    #: by the estimator's verification of the suspect muscle, or by a reset
    VERIFICATION = 'when a verification of the suspect muscle ends, else on controller/reset'
    #: only by a reset
    RESET = 'on controller/reset'


class Declaration(NamedTuple):
    """Declaration of a stop cause."""

    condition: str  # when the cause is present
    action: Action
    clears: Clears
    text: str  # what happened, for users
    steps: tuple[Step, ...]  # the remedy


#: steps that come after all others in a remedy for several causes
LAST = Step.RESET_CONTROLLER, Step.EXPLORE_GENTLY


class StopCause(Enum):
    """All stop causes, each with an identifier for programs and a `Declaration`.

    The declaration states when a cause is present, what the controller does, how the stop ends, and
    what users are told. If several causes begin together, the one that is listed first here is
    reported.
    """

    def __init__(self, identifier: str, declaration: Declaration) -> None:
        self.identifier = identifier
        self.condition, self.action, self.clears, self.text, self.steps = declaration

    @property
    def remedy(self) -> str:
        """The remedy as a text for users."""
        return sentence(self.steps)

    OPERATOR = (
        'operator_stop',
        Declaration(
            'controller/stop was called',
            Action.RELEASE,
            Clears.RESET,
            'controller/stop was called',
            (Step.RESET_CONTROLLER,),
        ),
    )
    RESTARTED = (
        'restarted',
        Declaration(
            'the previous controller of this arm was killed or has crashed while it commanded the '
            'arm',
            Action.RELEASE,
            Clears.RESET,
            'the previous controller did not end properly',
            (Step.RESET_CONTROLLER,),
        ),
    )
    CONTROL_FAULT = (
        'control_fault',
        Declaration(
            'an exception escaped the computation of a command',
            Action.RELEASE,
            Clears.RESET,
            'internal error of the controller',
            (Step.REPORT_LOG, Step.RESET_CONTROLLER),
        ),
    )
    COMMAND_NOT_FINITE = (
        'command_not_finite',
        Declaration(
            'a computed command contains NaN or infinity',
            Action.RELEASE,
            Clears.RESET,
            'the computed command is not finite',
            (Step.REPORT_LOG, Step.RESET_CONTROLLER),
        ),
    )
    UNFIT_CHECKPOINT = (
        'unfit_checkpoint',
        Declaration(
            'a checkpoint was published that does not fit the robot',
            Action.RELEASE,
            Clears.RESET,
            'unfit checkpoint',
            (Step.STOP_OTHER_ROBOT, Step.RESET_CONTROLLER),
        ),
    )
    NO_CHECKPOINT = (
        'no_checkpoint',
        Declaration(
            'no network has been accepted',
            Action.RELEASE,
            Clears.RESET,
            'no checkpoint',
            (Step.PROVIDE_CHECKPOINT, Step.RESET_CONTROLLER),
        ),
    )
    ANOMALY = (
        'anomaly_detected',
        Declaration(
            'anomaly_detected is true',
            Action.RELEASE,
            Clears.VERIFICATION,
            'anomaly detected',
            (*REPAIR, Step.RESET_CONTROLLER),
        ),
    )
    LENGTH_OFFSETS_REVOKED = (
        'length_offsets_revoked',
        Declaration(
            'lengths jumped or disagree with joint sensors, and are not calibrated again yet',
            Action.RELEASE,
            Clears.RESET,
            'the lengths are unreliable',
            (Step.CALIBRATE_LENGTHS, Step.RESET_CONTROLLER, Step.EXPLORE_GENTLY),
        ),
    )
    SECOND_PUBLISHER = (
        'second_publisher',
        Declaration(
            'another node publishes a topic of the driver, the estimator, the learner or the '
            'controller',
            Action.RELEASE,
            Clears.RESET,
            'several publishers',
            (Step.STOP_SECOND_PUBLISHER, Step.RESET_CONTROLLER),
        ),
    )
    IMPLAUSIBLE_MUSCLE_STATES = (
        'implausible_muscle_states',
        Declaration(
            'muscle_states were implausible for 0.1 s',
            Action.RELEASE,
            Clears.VERIFICATION,
            'muscle_states are implausible',
            (Step.CHECK_SENSOR, Step.RESET_CONTROLLER),
        ),
    )
    IMPLAUSIBLE_ESTIMATE = (
        'implausible_estimate',
        Declaration(
            'estimated_joint_states were implausible for 0.1 s',
            Action.RELEASE,
            Clears.VERIFICATION,
            'the estimate is implausible',
            (Step.CHECK_CHECKPOINT, Step.CALIBRATE_LENGTHS, Step.RESET_CONTROLLER),
        ),
    )
    OVERLOAD = (
        'overload',
        Declaration(
            'a tension is above 1.1 × tension.limit for 0.2 s although its muscle is paid out',
            Action.RELEASE_AT_ONCE,
            Clears.VERIFICATION,
            'overload',
            (Step.FREE_ARM, Step.RESET_CONTROLLER),
        ),
    )
    OVERHEATED = (
        'overheated',
        Declaration(
            'a winding is 20 °C above temperature_limit, or heat limits all muscles to T_bias',
            Action.RELEASE,
            Clears.RESET,
            'overheated',
            (Step.WAIT_UNTIL_COOL, Step.RESET_CONTROLLER),
        ),
    )
    STALE_MUSCLE_STATES = (
        'stale_muscle_states',
        Declaration(
            'muscle_states are older than max_age',
            Action.HOLD,
            Clears.CONDITION,
            'muscle_states are too old',
            (Step.CHECK_DRIVER, Step.RESET_CONTROLLER),
        ),
    )
    STALE_ESTIMATE = (
        'stale_estimate',
        Declaration(
            'estimated_joint_states are older than max_age',
            Action.HOLD,
            Clears.CONDITION,
            'estimated_joint_states are too old',
            (Step.CHECK_ESTIMATOR, Step.RESET_CONTROLLER),
        ),
    )


STOP_CAUSES = 'stop causes'  # key of a value in /diagnostics
#: causes that follow from an anomaly: a faulty muscle makes estimates implausible, implausible
#: estimates are rejected, and the repair of the muscle makes its length jump
CONSEQUENCES = frozenset(
    {
        StopCause.IMPLAUSIBLE_MUSCLE_STATES,
        StopCause.IMPLAUSIBLE_ESTIMATE,
        StopCause.STALE_ESTIMATE,
    }
)


class Condition(NamedTuple):
    """A stop cause that is present, with details such as values and names."""

    cause: StopCause
    detail: str = ''

    def __str__(self) -> str:
        return f'{self.cause.text}: {self.detail}' if self.detail else self.cause.text


def remedy_of(
    causes: Iterable[StopCause],
    explored: bool,
    of_finding: Iterable[Step] = REPAIR,
    settled: Collection[StopCause] = (),
) -> list[Step]:
    """Return the steps by which a user ends all the given stop causes, each step once.

    The reset comes after the other steps; only an exploration comes after the reset.

    Args:
        causes: The causes; the steps are returned in the order of the causes.
        explored: Whether to add a step that starts the exploration again, because the arm was
            exploring when it stopped.
        of_finding: Steps that remedy the faults which the estimator has found. They are the
            remedy of the cause `ANOMALY`, before the reset.
        settled: Causes that need only a reset, for example those in `CONSEQUENCES` while an anomaly
            is present, because the anomaly has caused them.
    """
    special: dict[StopCause, tuple[Step, ...]] = {
        StopCause.ANOMALY: (*of_finding, Step.RESET_CONTROLLER)
    }
    special |= dict.fromkeys(settled, (Step.RESET_CONTROLLER,))
    remedies = (special.get(cause, cause.steps) for cause in causes)
    steps = sorted(dict.fromkeys(chain.from_iterable(remedies)), key=lambda step: step in LAST)
    return [*steps, Step.EXPLORE] if explored and Step.EXPLORE_GENTLY not in steps else steps


def parse(value: str) -> list[StopCause]:
    """Return the causes that a comma-separated list of identifiers names.

    The value `stop causes` of the controller's status is such a list. Unknown identifiers are
    ignored.
    """
    causes = {cause.identifier: cause for cause in StopCause}
    return [causes[name] for name in value.split(', ') if name in causes]


def table() -> str:
    """Return the stop causes as a Markdown table."""
    rows = ['| cause | condition | action | ends | remedy |', '|---|---|---|---|---|']
    for cause in StopCause:
        action = cause.action.name.lower().replace('_', ' ')
        rows.append(
            f'| `{cause.identifier}` | {cause.condition} | {action} | {cause.clears.value} '
            f'| {cause.remedy} |'
        )
    return '\n'.join(rows)
