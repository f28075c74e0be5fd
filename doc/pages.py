# SPDX-License-Identifier: Apache-2.0
"""The tables of conditions, stop causes and steps of remedies, for the pages that `make` writes."""

from collections.abc import Iterable

from musculoskeletal_ae.conditions import ConditionKind, stop_causes
from musculoskeletal_ae.control import status, supervisor
from musculoskeletal_ae.remedy import Step

STOPS = """\
# Why the arm stops, and how to continue

`python doc/make.py` writes this page from the code.

The controller reports a *mode*. While the arm is *running*, the mode states what the arm does: \
{activities}. Otherwise the mode is one of {states}. Programs should compare these identifiers and \
the identifiers of the causes. The latched topic `controller_mode` contains the mode. If there is \
a stop cause, it follows the mode, as in `stopped:operator_stop`. The values `mode` and `stop \
cause` of the controller in `/diagnostics` contain the same identifiers, and its `conditions` list \
every cause that keeps the arm stopped.

## Modes

```mermaid
{diagram}
```

## Causes

The table names the action with which each cause stops the arm:

- `hold` keeps the last command, because the cause may clear. After `hold_time`, it pays \
out the muscles as `release` does.
- `release` keeps the last command for `hold_time` in any case. Then it pays out all muscles until \
each exerts T_bias. Modules that follow positions are paid out until their measured tension is \
T_bias, or by `release` of muscles.yaml where no tension is known.
- `release at once` does not wait for `hold_time`.

If several causes begin together, the first one in this table is reported.

{table}

## Steps of remedies

Each condition on `/diagnostics` lists the identifiers of its steps \
([Diagnostics](diagnostics.md)). Some causes follow from others, and need no steps of their own \
while these are present, except for the reset:

{consequences}

{steps}
"""


def stops() -> str:
    """Return the page on modes, stop causes and steps."""
    states = [state.value for state in supervisor.StopState]
    states.remove(supervisor.StopState.RUNNING.value)
    causes = [
        (
            f'`{kind.identifier}`',
            kind.when,
            kind.action.name.lower().replace('_', ' '),
            kind.clears.value,
            _sentence(kind.steps),
        )
        for kind in stop_causes()
    ]
    return STOPS.format(
        activities=_listed(activity.value for activity in supervisor.Activity),
        states=_listed(states),
        diagram=supervisor.diagram(),
        table=_table(('cause', 'condition', 'action', 'ends', 'remedy'), causes),
        consequences='\n'.join(
            f'- from `{first.identifier}`: {_listed(kind.identifier for kind in others)}'
            for first, others in status.CONSEQUENCES.items()
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
    """Return the table of all conditions."""
    rows = [
        (f'`{kind.identifier}`', kind.owner, kind.level, kind.when, _consequence(kind),
         _sentence(kind.steps))
        for kind in ConditionKind
    ]  # fmt: skip
    heads = ('identifier', 'reported by', 'level', 'present when', 'consequence', 'remedy')
    return _table(heads, rows)


def _consequence(kind: ConditionKind) -> str:
    """Return what a node does about a condition, besides reporting it."""
    parts = []
    if kind.stop is not None:
        parts.append('[stops the arm](stops.md)')
    if kind.reaction is not None:
        parts.append(f'the estimator {kind.reaction}')
    if kind.revokes is not None:
        parts.append(f'revokes length offsets: {kind.revokes.value}')
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
