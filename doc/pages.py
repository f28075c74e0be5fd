# SPDX-License-Identifier: Apache-2.0
"""The tables of conditions, stop causes and steps of remedies, for the pages that `make` writes."""

from collections.abc import Iterable

from musculoskeletal_ae.conditions import (
    ConditionKind,
    stop_causes,
)
from musculoskeletal_ae.control import controller_status, supervisor
from musculoskeletal_ae.control.supervisor import Activity, StopState
from musculoskeletal_ae.remedy_steps import Step

STOPS = """\
# Why the arm stops, and how to continue

The controller reports a *mode*. While the arm is *running*, the mode states what the arm does: \
{activities}. Otherwise, it is one of {states}. Programs compare these identifiers and those of \
the causes. The latched topic `controller_mode` contains the mode and, after a colon, the cause \
that began the stop, as in `stopped:operator_stop`. In `/diagnostics`, the values `mode` and \
`stop cause` of the controller repeat both, and `conditions` lists every cause that keeps the arm \
stopped. [Recover from faults](../howto/recover_from_faults.md) has the commands.

## Modes

```mermaid
{diagram}
```

{modes}

## Causes

A stop keeps the last command for `hold_time`. Then it pays out all muscles until each exerts \
T_bias. Modules that follow positions are paid out until their measured tension is T_bias, or by \
`release` of muscles.yaml where no tension is known. Only {at_once} does not wait for `hold_time`.

Most causes last until `controller/reset`. The column *ends earlier* names those that also end by \
themselves: by default, these are only short interruptions of readings or estimates. With \
`on_anomaly: isolate`, a verification of a muscle ends those that the fault of this muscle caused. \
[Findings](diagnostics.md#conditions) of the estimator that stop the arm lead to the cause \
`anomaly_detected`. \
If several causes begin together, the first one in this table is reported. Each remedy ends with \
`controller/reset`.

{table}

## Steps of remedies

Each condition on `/diagnostics` lists the identifiers of its steps \
([Diagnostics](diagnostics.md)). Some causes follow from others, and need no steps of their own \
while these are present, except for the reset:

{consequences}

If several conditions are present, take each step once, in the order of its *place*: 0 removes a \
cause, 1 calls estimator or learner, 2 resets the controller, 3 moves the arm, 4 learns again.

{steps}

`python doc/make.py` writes this page from the code.
"""

#: what the arm does in each mode
MODES = {
    Activity.IDLE: 'has no target yet',
    Activity.HOLDING: 'holds its target. A method that follows no trajectory (`geometric`, '
    '`first`, `second`, `tension`; `proposed` of preset `paper`) has this mode also on the way',
    Activity.MOVING: 'follows a trajectory',
    Activity.EXPLORING: 'moves to random postures',
    Activity.CALIBRATING: 'explores gently, because length offsets are unknown',
    Activity.GRAVITY_COMPENSATION: 'is guided by hand, and only its weight is compensated '
    '(`method: float`)',
    StopState.PAUSED: 'keeps the last command, and continues when readings and estimates return',
    StopState.STOPPED: 'is stopped until `controller/reset`, or until a suspect muscle is verified',
    StopState.VERIFYING: 'is stopped; a suspect muscle is wound in',
    StopState.RESUMING: 'is stopped; the muscle is verified, and the arm continues when no cause '
    'is present',
}


def stops() -> str:
    """Return the page on modes, stop causes and steps."""
    states = [state for state in StopState if state is not StopState.RUNNING]
    causes = [
        (
            f'`{kind.identifier}`',
            kind.when,
            kind.clears.value,
            _sentence(step for step in kind.steps if step is not Step.RESET_CONTROLLER),
        )
        for kind in stop_causes()
    ]
    return STOPS.format(
        activities=_listed(activity.value for activity in Activity),
        states=_listed(state.value for state in states),
        modes=_table(
            ('mode', 'the arm'),
            [(f'`{mode.value}`', MODES[mode]) for mode in (*Activity, *states)],
        ),
        at_once=_listed(kind.identifier for kind in stop_causes() if kind.releases_at_once),
        diagram=supervisor.diagram(),
        table=_table(('cause', 'condition', 'ends earlier', 'remedy'), causes),
        consequences='\n'.join(
            f'- from `{first.identifier}`: {_listed(kind.identifier for kind in others)}'
            for first, others in controller_status.CONSEQUENCES.items()
        ),
        steps=_table(
            ('place', 'identifier', 'step'),
            [
                (str(step.place), f'`{step.identifier}`', step.text)
                for step in sorted(Step, key=lambda step: step.place)
            ],
        ),
    )


def conditions() -> str:
    """Return the table of all conditions, except those that only the page on stops lists."""
    rows = [
        (f'`{kind.identifier}`', kind.owner, kind.level, kind.when, _consequence(kind),
         _listed(step.identifier for step in kind.steps) or '–')
        for kind in ConditionKind if kind.stop is None or kind.owner != 'controller'
    ]  # fmt: skip
    heads = ('identifier', 'reported by', 'level', 'present when', 'reaction', 'steps')
    return _table(heads, rows)


def _consequence(kind: ConditionKind) -> str:
    """Return what a node does about a condition, besides reporting it."""
    parts = []
    if kind.stop is not None:
        parts.append('[stops](stops.md)')
    if kind.reaction is not None:
        parts.append(kind.reaction.value)
    if kind.revokes is not None:
        parts.append(kind.revokes.value)
    return '; '.join(parts) or '–'


def _sentence(steps: Iterable[Step]) -> str:
    return '; '.join(step.text for step in steps) or '–'


def _listed(identifiers: Iterable[str]) -> str:
    return ', '.join(f'`{identifier}`' for identifier in identifiers)


def _table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table."""
    names = tuple(heads)
    lines = [f'| {" | ".join(line)} |' for line in (names, *rows)]
    return '\n'.join([lines[0], '|---' * len(names) + '|', *lines[1:]])
