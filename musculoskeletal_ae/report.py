# SPDX-License-Identifier: Apache-2.0
"""What a part of the system says of itself, for people and for /diagnostics."""

import math
from typing import Literal, NamedTuple

MOST_DIGITS = 17  # that a double has
Level = Literal['ok', 'warn', 'error']


class Report(NamedTuple):
    """How it is, in one line and in named values."""

    level: Level
    message: str
    values: dict[str, str]


def whole(value: float, unit: str = '') -> str:
    """Return a whole number and its unit for people to read, or that it is not known: NaN."""
    return '–' if math.isnan(value) else f'{value:.0f} {unit}'.rstrip()


def distinct(value: float, *limits: float, digits: int = 3) -> tuple[str, ...]:
    """Return a value and the limits that it is compared with, in as many digits as tell them apart.

    At least `digits` significant ones. Numbers that are equal are written alike.
    """
    numbers = [float(number) for number in (value, *limits)]
    for precision in range(digits, MOST_DIGITS + 1):
        texts = tuple(f'{number:.{precision}g}' for number in numbers)
        if all(text != texts[0] or limit == numbers[0] for text, limit in zip(texts, numbers)):
            break
    return texts
