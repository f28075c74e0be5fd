# SPDX-License-Identifier: Apache-2.0
"""Status reports for /diagnostics and for people, and numbers as readable text."""

from __future__ import annotations

import math
import os
from typing import NamedTuple

from musculoskeletal_ae.conditions import Condition, Level, ordered, remedy_of, worst
from musculoskeletal_ae.remedy_steps import Step

MOST_DIGITS = 17  # number of significant digits with which every double is printed uniquely
_UNITS_OF_TIME = {'years': 365.25 * 86400.0, 'days': 86400.0, 'h': 3600.0, 'min': 60.0}
#: values of `state` in the reports of a replay
WAITING, PLAYING, PAUSED, END_OF_RECORDING = 'waiting', 'playing', 'paused', 'end_of_recording'
#: key in the last report of a replay whose value names nodes that may have missed messages
NOT_WAITED_FOR = 'nodes not waited for'


class Report(NamedTuple):
    """Status of a component.

    Attributes:
        doing: What the component does, in a few words; '' if a condition states it.
        values: Named values, as texts.
        conditions: All conditions that are present.
    """

    doing: str
    values: dict[str, str]
    conditions: tuple[Condition, ...] = ()

    @property
    def level(self) -> Level:
        """Level of the most urgent condition; 'ok' if no condition is present."""
        return worst(self.conditions)

    @property
    def message(self) -> str:
        """Activity of the component, and the texts of all warnings and errors.

        If there is neither, the message consists of the remaining conditions, of level 'ok'.
        """
        texts = [each.text for each in ordered(self.conditions) if each.level != 'ok']
        shown = filter(None, [self.doing, *texts])
        return '; '.join(shown) or '; '.join(each.text for each in self.conditions)

    @property
    def steps(self) -> tuple[Step, ...]:
        """The steps that end all conditions, in order."""
        return remedy_of(self.conditions)


def load_text() -> str:
    """Return the load of this computer in the last minute, such as "5 on 2 cores"."""
    return f'{os.getloadavg()[0]:.0f} on {os.cpu_count()} cores'


def is_overloaded() -> bool:
    """Return whether at least twice as many processes want to run as there are cores."""
    return os.getloadavg()[0] >= 2.0 * (os.cpu_count() or 1)


def overload_note() -> str:
    """Return that this computer is overloaded, with its load; '' if it is not overloaded.

    Add the note to the text of a fault to which an overload may have contributed. The overload need
    not be the cause: a node may also have ended for another reason.
    """
    return f'this computer is overloaded (load {load_text()})' if is_overloaded() else ''


def with_load(text: str) -> str:
    """Return a text with the load of this computer in parentheses if it is overloaded."""
    note = overload_note()
    return f'{text} ({note})' if note else text


def whole(value: float, unit: str = '') -> str:
    """Return a value, rounded to a whole number, with its unit; "–" for NaN (unknown)."""
    return '–' if math.isnan(value) else f'{value:.0f} {unit}'.rstrip()


def duration(seconds: float) -> str:
    """Return a duration in the unit in which it is easiest to read, such as "1.5 h"."""
    for unit, length in _UNITS_OF_TIME.items():
        if seconds >= 2.0 * length:
            return f'{seconds / length:.1f} {unit}'
    return f'{seconds:.3f} s' if seconds < 1.0 else f'{seconds:.1f} s'


def distinct(value: float, *limits: float, digits: int = 3) -> tuple[str, ...]:
    """Return a value and its limits as texts with enough digits to tell them apart.

    The texts are rounded to `digits` significant digits or more. Equal numbers give equal texts.
    """
    numbers = [float(number) for number in (value, *limits)]
    for precision in range(digits, MOST_DIGITS + 1):
        texts = tuple(f'{number:.{precision}g}' for number in numbers)
        if all(text != texts[0] or limit == numbers[0] for text, limit in zip(texts, numbers)):
            break
    return texts
