# SPDX-License-Identifier: Apache-2.0
"""Status reports for /diagnostics and for people, and numbers as readable text."""

import math
import os
from typing import Literal, NamedTuple

MOST_DIGITS = 17  # significant digits that identify a double
#: key in /diagnostics that tells what a component waits for, and the values of this key if the
#: component waits for the end of an anomaly, for known length offsets, or for muscle_states
WAITS_FOR, ANOMALY, LENGTH_OFFSETS = 'waits for', 'anomaly', 'length_offsets'
MUSCLE_STATES = 'muscle_states'
#: values of `state` in the reports of a replay
WAITING, PLAYING, PAUSED, END_OF_RECORDING = 'waiting', 'playing', 'paused', 'end_of_recording'
#: key in the last report of a replay: names of nodes that may have missed messages
NOT_WAITED_FOR = 'nodes not waited for'
OVERLOADED = 'this computer is overloaded'
Level = Literal['ok', 'warn', 'error']


class Report(NamedTuple):
    """Status of a component: level, one line of text and named values."""

    level: Level
    message: str
    values: dict[str, str]

    def with_warning(self, warning: str) -> 'Report':
        """Return a report with one more warning; a report of an error is returned unchanged."""
        if self.level == 'error':
            return self
        return Report('warn', f'{self.message}; {warning}', self.values)


def load_text() -> str:
    """Return the load of this computer in the last minute, such as "5 on 2 cores"."""
    return f'{os.getloadavg()[0]:.0f} on {os.cpu_count()} cores'


def is_overloaded() -> bool:
    """Return whether at least twice as many processes want to run as there are cores."""
    return os.getloadavg()[0] >= 2.0 * (os.cpu_count() or 1)


def overload_text() -> str:
    """Return that this computer is overloaded, with its load; '' if it is not overloaded."""
    return f'{OVERLOADED} (load {load_text()})' if is_overloaded() else ''


def overload_advice() -> str:
    """Return that this computer is overloaded, and what to do; '' if it is not overloaded."""
    text = overload_text()
    return f'{text}; stop other programs' if text else ''


def whole(value: float, unit: str = '') -> str:
    """Return a value, rounded to a whole number, with its unit; "–" for NaN (unknown)."""
    return '–' if math.isnan(value) else f'{value:.0f} {unit}'.rstrip()


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
