# SPDX-License-Identifier: Apache-2.0
"""Every reason to stop the arm, declared once: condition, action, end, text and remedy.

The page on stops in the documentation is generated from this table. Clients compare
`StopCause.identifier`, which is stable; the texts are for people.
"""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import NamedTuple


class Action(IntEnum):
    """What the arm does in a stop; of several stops the most severe action wins."""

    #: keep the last command; if the stop outlasts `hold_time`, release
    HOLD = 1
    #: keep the last command for `hold_time`, then pay out until every muscle is at T_bias
    RELEASE = 2
    #: pay out at once, until every muscle is at T_bias
    RELEASE_AT_ONCE = 3


class Clears(Enum):
    """What ends a stop."""

    #: the condition clears before the arm is released; afterwards only a reset
    CONDITION = 'when the condition clears within hold_time, else on controller/reset'
    #: the estimator has verified the suspect muscle, or a reset
    VERIFICATION = 'when a verification of the suspect muscle ends, else on controller/reset'
    #: a reset by the operator
    RESET = 'on controller/reset'


class Declaration(NamedTuple):
    """What is declared of a stop cause."""

    condition: str  # when it holds
    action: Action
    clears: Clears
    text: str  # what happened, for people
    remedy: str  # what to do, in the order in which to do it


RESET = 'call controller/reset'
REPAIR = 'repair the muscle; call estimator/reset'
ZERO = 'call estimator/zero'
EXPLORE = 'controller/explore explores again'


class StopCause(Enum):
    """Every reason to stop; the value is the stable identifier. Declared by severity."""

    def __init__(self, identifier: str, declaration: Declaration) -> None:
        self.identifier = identifier
        self.condition, self.action, self.clears, self.text, self.remedy = declaration

    OPERATOR = (
        'operator_stop',
        Declaration(
            'controller/stop was called',
            Action.RELEASE,
            Clears.RESET,
            'controller/stop was called',
            RESET,
        ),
    )
    CONTROL_FAULT = (
        'control_fault',
        Declaration(
            'an exception escaped the computation of a command',
            Action.RELEASE,
            Clears.RESET,
            'fault of control',
            f'report the log; {RESET}',
        ),
    )
    COMMAND_NOT_FINITE = (
        'command_not_finite',
        Declaration(
            'a computed command contains NaN or infinity',
            Action.RELEASE,
            Clears.RESET,
            'the computed command is not finite',
            f'report the log; {RESET}',
        ),
    )
    UNFIT_CHECKPOINT = (
        'unfit_checkpoint',
        Declaration(
            'a checkpoint was published that does not fit the robot',
            Action.RELEASE,
            Clears.RESET,
            'unfit checkpoint',
            f'stop whoever publishes accepted_checkpoint of another robot; {RESET}',
        ),
    )
    NO_CHECKPOINT = (
        'no_checkpoint',
        Declaration(
            'no network has been accepted',
            Action.RELEASE,
            Clears.RESET,
            'no checkpoint',
            f'set the parameter checkpoint, or start the learner; {RESET}',
        ),
    )
    ANOMALY = (
        'anomaly_detected',
        Declaration(
            'anomaly_detected is true',
            Action.RELEASE,
            Clears.VERIFICATION,
            'anomaly detected',
            f'{REPAIR}; {RESET}',
        ),
    )
    LENGTH_OFFSETS_REVOKED = (
        'length_offsets_revoked',
        Declaration(
            'lengths jumped or disagree with joint sensors; their offsets are not found yet',
            Action.RELEASE,
            Clears.RESET,
            'the lengths cannot be relied on',
            f'call estimator/zero; {RESET}; {EXPLORE}, gently until the offsets are found',
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
            f'end the node that does not belong to this arm; {RESET}',
        ),
    )
    IMPLAUSIBLE_MUSCLE_STATES = (
        'implausible_muscle_states',
        Declaration(
            'muscle_states were implausible for 0.1 s',
            Action.RELEASE,
            Clears.VERIFICATION,
            'muscle_states are implausible',
            f'check the sensor that is named, or call estimator/zero if lengths are off; {RESET}',
        ),
    )
    IMPLAUSIBLE_ESTIMATE = (
        'implausible_estimate',
        Declaration(
            'estimated_joint_states were implausible for 0.1 s',
            Action.RELEASE,
            Clears.VERIFICATION,
            'the estimate is implausible',
            f'check length offsets and checkpoint (estimator/zero); {RESET}',
        ),
    )
    OVERLOAD = (
        'overload',
        Declaration(
            'a tension is above 1.1 × tension.limit for 0.2 s although its muscle is paid out',
            Action.RELEASE_AT_ONCE,
            Clears.VERIFICATION,
            'overload',
            f'free the arm; {RESET}',
        ),
    )
    OVERHEATED = (
        'overheated',
        Declaration(
            'a winding is 20 °C above temperature_limit, or all are so hot that none may pull',
            Action.RELEASE,
            Clears.RESET,
            'overheated',
            f'wait until all windings are below temperature_limit; {RESET}',
        ),
    )
    STALE_MUSCLE_STATES = (
        'stale_muscle_states',
        Declaration(
            'muscle_states are older than max_age',
            Action.HOLD,
            Clears.CONDITION,
            'muscle_states are too old',
            f'check that the driver runs; {RESET}',
        ),
    )
    STALE_ESTIMATE = (
        'stale_estimate',
        Declaration(
            'estimated_joint_states are older than max_age',
            Action.HOLD,
            Clears.CONDITION,
            'estimated_joint_states are too old',
            f'check that the estimator runs; {RESET}',
        ),
    )


class Condition(NamedTuple):
    """A reason to stop that is present, with its details: values and names."""

    cause: StopCause
    detail: str = ''

    def __str__(self) -> str:
        return f'{self.cause.text}: {self.detail}' if self.detail else self.cause.text


def table() -> str:
    """Return the table of stop causes as Markdown."""
    rows = ['| cause | condition | action | ends | remedy |', '|---|---|---|---|---|']
    for cause in StopCause:
        action = cause.action.name.lower().replace('_', ' ')
        rows.append(
            f'| `{cause.identifier}` | {cause.condition} | {action} | {cause.clears.value} '
            f'| {cause.remedy} |'
        )
    return '\n'.join(rows)
