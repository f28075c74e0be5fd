# SPDX-License-Identifier: Apache-2.0
"""The lines of the results table: the paper's number, ours with both presets, bound and aim."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

#: result.json of every experiment that was run, by name
Results = Mapping[str, Mapping[str, Any]]

NOTHING = '–'


class Row(NamedTuple):
    """One quantity. Keys are paths into result.json, parts joined by dots.

    Attributes:
        experiment: Whose result.json.
        quantity: What it is, with its unit.
        printed: What the paper says, on Musashi.
        paper: Key of the value with preset paper, or ''.
        default: Key of the value with the preset of the run.
        bound: Key of what nothing can beat, or ''.
        aim: Highest value aimed at (lowest, if `more_is_better`), or None.
        digits: Decimals shown.
        more_is_better: Whether the aim is a lower limit.
        worst: Whether the worst individual is shown instead of the mean.
    """

    experiment: str
    quantity: str
    printed: str
    paper: str
    default: str
    bound: str = ''
    aim: float | None = None
    digits: int = 3
    more_is_better: bool = False
    worst: bool = False


ROWS = (
    Row('online_learning', 'estimate, held-out motion, before learning [rad]', '0.414',
        'paper_before_rad', 'before_rad', 'oracle_rad'),
    Row('online_learning', 'estimate, held-out motion, after learning [rad]', '0.186',
        'paper_after_rad', 'after_rad', 'oracle_rad', 0.10),
    Row('online_learning', 'error while exploring, exponential fit, start [rad]', '0.324',
        'paper_fit_start_rad', 'fit_start_rad'),
    Row('online_learning', 'error while exploring, exponential fit, end [rad]', '0.154',
        'paper_fit_end_rad', 'fit_end_rad'),
    Row('online_learning', 'samples at rest until the error is halved', NOTHING,
        'paper_samples_to_halve', 'samples_to_halve', digits=0),
    Row('estimation', 'estimate after learning, 3.6 kg in the hand [rad]', '≈ 0.186',
        '', 'after_payload_rad', '', 0.10),
    Row('estimation', 'time until a cut muscle is noticed, slowest muscle [s]', NOTHING,
        '', 'detection_worst_s', '', 0.5, 2, worst=True),
    Row('estimation', 'cut muscle named rightly [share]', NOTHING,
        '', 'named_share', '', 0.9, 2, more_is_better=True),
    Row('estimation', 'false alarms in the healthy time', NOTHING,
        '', 'false_alarms', '', 0.0, 0),
    Row('estimation', 'AUROC of the detector', NOTHING, '', 'auroc', '', None, 4),
    Row('control', '`proposed`, distance from θ_eval [rad]', 'as `second`',
        'proposed_paper.error_rad', 'proposed.error_rad', '', 0.06),
    Row('control', '`proposed`, ‖T‖ [N]', 'below `first`, `second`',
        'proposed_paper.tension_n', 'proposed.tension_n', 'qp_bound_n', digits=0),
    Row('control', '`proposed`, ‖T‖ beside the QP bound [ratio]', NOTHING,
        'proposed_paper.tension_to_bound', 'proposed.tension_to_bound', '', 1.1, 2),
    Row('simulation', 'simulator, joint angles, before learning [rad]', '0.335',
        'paper_before_rad', 'before_rad', 'frictionless_rad'),
    Row('simulation', 'simulator, joint angles, after learning [rad]', '0.162',
        'paper_after_rad', 'after_rad', 'frictionless_rad', 0.10),
    Row('simulation', 'simulator, tensions, before learning [N]', '105',
        'paper_before_n', 'before_n', 'frictionless_n', digits=0),
    Row('simulation', 'simulator, tensions, after learning [N]', '92.2',
        'paper_after_n', 'after_n', 'frictionless_n', 40.0, 0),
)  # fmt: skip


def value(results: Results, row: Row, key: str) -> float | None:
    """Return a number of the table, or None if it was not measured."""
    result = results.get(row.experiment)
    if result is None or not key:
        return None
    if row.worst:
        found = [_at(each, key) for each in result['seeds'].values()]
        known = [number for number in found if number is not None]
        return (min if row.more_is_better else max)(known) if known else None
    return _at(result, key)


def _at(result: Mapping[str, Any], key: str) -> float | None:
    found: Any = result
    for part in key.split('.'):
        if not isinstance(found, Mapping) or part not in found:
            return None
        found = found[part]
    return float(found)


def shown(number: float | None, digits: int) -> str:
    """Return a number as the tables have it."""
    return NOTHING if number is None else f'{number:.{digits}f}'


def missed_by(results: Results, row: Row) -> float | None:
    """Return by how much an aim is missed, 0 or less if it is met; None without aim or number."""
    number = value(results, row, row.default)
    if row.aim is None or number is None:
        return None
    return row.aim - number if row.more_is_better else number - row.aim


def aim(row: Row) -> str:
    """Return the aim as the tables have it."""
    if row.aim is None:
        return NOTHING
    return f'{"≥" if row.more_is_better else "≤"} {row.aim:g}' if row.aim else '0'


def verdict(results: Results, row: Row) -> str:
    """Return whether the aim is met, and by how much it is missed otherwise."""
    missed = missed_by(results, row)
    if missed is None:
        return ''
    return 'met' if missed <= 0.0 else f'missed by {shown(missed, row.digits)}'
