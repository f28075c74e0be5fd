# SPDX-License-Identifier: Apache-2.0
"""Generates `doc/reference/stops.md` from the modes (`supervisor`) and the causes (`stops`).

python -m musculoskeletal_ae.control.stops_page > doc/reference/stops.md
"""

from collections.abc import Iterable

from musculoskeletal_ae import remedy
from musculoskeletal_ae.control import stops, supervisor

INTRODUCTION = """\
# Why the arm stops, and how to continue

This page is generated from the code: `python -m musculoskeletal_ae.control.stops_page > \
doc/reference/stops.md`.

The controller reports a *mode*. While the arm is *running*, the mode states what the arm does: \
{activities}. Otherwise the mode is one of {states}. Programs should compare these identifiers and \
the identifiers of the causes. The latched topic `controller_mode` contains the mode. If there is \
a stop cause, it follows the mode, as in `stopped:operator_stop`. The values `mode` and `stop \
cause` of the controller in `/diagnostics` contain the same identifiers.

## Modes

```mermaid
{diagram}
```

## Causes

The table names the action with which each cause stops the arm:

- `hold` keeps the last command, because the cause may clear. After `hold_time`, it does the same \
as `release`.
- `release` keeps the last command for `hold_time` in any case. Then it pays out all muscles until \
each exerts T_bias. Modules that follow positions are paid out until their measured tension is \
T_bias, or by `release` of muscles.yaml where no tension is known.
- `release at once` does not wait for `hold_time`.

If several causes begin together, the first one in this table is reported.

{table}

## Steps of remedies

The value `remedy` in `/diagnostics` is a sentence for people. The value \
`remedy steps` lists the identifiers of its steps, in order. While an anomaly is present, these \
causes need no steps of their own, because they usually follow from it: {consequences}. Their \
steps are advised if these causes outlast the anomaly.

{steps}
"""


def page() -> str:
    """Return the page as Markdown."""
    states = [state.value for state in supervisor.StopState]
    states.remove(supervisor.StopState.RUNNING.value)
    return INTRODUCTION.format(
        activities=_listed(activity.value for activity in supervisor.Activity),
        states=_listed(states),
        diagram=supervisor.diagram(),
        table=stops.table(),
        consequences=_listed(
            cause.identifier for cause in stops.StopCause if cause in stops.CONSEQUENCES
        ),
        steps=remedy.table(),
    )


def _listed(identifiers: Iterable[str]) -> str:
    return ', '.join(f'`{identifier}`' for identifier in identifiers)


if __name__ == '__main__':
    print(page(), end='')
