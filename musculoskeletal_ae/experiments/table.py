# SPDX-License-Identifier: Apache-2.0
"""The results table: the paper's number, ours with both presets, bound and aim."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from msgspec import Struct

from musculoskeletal_ae.files import read_table

NOTHING = '–'


class Cells(NamedTuple):
    """One line of the table as text."""

    quantity: str
    printed: str
    paper: str
    default: str
    bound: str
    aim: str
    verdict: str  # 'met', by how much the aim is missed, or '' without aim or number


class Row(Struct, frozen=True):
    """One quantity of an experiment; keys are paths into its result.json, parts joined by dots."""

    quantity: str  # with its unit
    default: str  # key of the value with the preset of the run
    printed: str = NOTHING  # in the paper, on Musashi
    paper: str = ''  # key of the value with preset paper
    bound: str = ''  # key of what nothing can beat
    aim: float | None = None  # highest value aimed at; lowest, if `more_is_better`
    digits: int = 3
    more_is_better: bool = False
    worst: bool = False  # show the worst individual instead of the mean

    def number(self, result: Mapping[str, Any], key: str) -> float | None:
        """Return what was measured, or None."""
        if not self.worst or not result:
            return _at(result, key)
        every = [_at(numbers, key) for numbers in result['seeds'].values()]
        known = [number for number in every if number is not None]
        return (min if self.more_is_better else max)(known, default=None)

    def cells(self, result: Mapping[str, Any]) -> Cells:
        """Return the line for a result.json; {} where nothing was measured."""
        numbers = [self.number(result, key) for key in (self.paper, self.default, self.bound)]
        paper, default, bound = (NOTHING if n is None else f'{n:.{self.digits}f}' for n in numbers)
        number, aim, verdict = numbers[1], NOTHING, ''
        if self.aim is not None:
            aim = f'{"≥" if self.more_is_better else "≤"} {self.aim:g}' if self.aim else '0'
            if number is not None:
                missed = self.aim - number if self.more_is_better else number - self.aim
                verdict = 'met' if missed <= 0.0 else f'missed by {missed:.{self.digits}f}'
        return Cells(self.quantity, self.printed, paper, default, bound, aim, verdict)


#: by experiment
ROWS = read_table(__file__, 'table.yaml', dict[str, tuple[Row, ...]])


def _at(result: Mapping[str, Any], key: str) -> float | None:
    value: Any = result
    for part in key.split('.'):
        value = (value or {}).get(part, {})
    return None if value in ({}, None) else float(value)


def individuals(seeds: Sequence[int]) -> str:
    """Return whose numbers these are, such as 'individual 0'."""
    return f'individual{"s" * (len(seeds) > 1)} {", ".join(map(str, seeds))}'


def markdown(about: Mapping[str, Any], lines: Iterable[Cells]) -> str:
    """Return the table as the README has it; `about` is that of a result.json."""
    text = (
        f'{about["robot"]}, emulated {individuals(about["seeds"])}, {about["minutes"]:g} minutes '
        f'of exploration; {NOTHING}: not printed, or nothing to compare. Bound: least squares on '
        'the true body (estimate), the least ‖T‖ that can hold the posture where the arm came to '
        'rest (control), the true body without friction (simulator).\n\n'
        '| | paper, on Musashi | preset `paper` | preset `default` | bound | aim |\n'
        '|---|---|---|---|---|---|'
    )
    for each in lines:
        text += f'\n| {each.quantity} | {each.printed} | {each.paper} | **{each.default}** | '
        text += f'{each.bound} | {", ".join(filter(None, each[-2:]))} |'
    return text
