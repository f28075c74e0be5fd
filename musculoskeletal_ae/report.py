# SPDX-License-Identifier: Apache-2.0
"""What a part of the system says of itself, for people and for /diagnostics."""

import math
from typing import Literal, NamedTuple

Level = Literal['ok', 'warn', 'error']


class Report(NamedTuple):
    """How it is, in one line and in named values."""

    level: Level
    message: str
    values: dict[str, str]


def whole(value: float, unit: str = '') -> str:
    """Return a whole number and its unit for people to read, or that it is not known: NaN."""
    return '–' if math.isnan(value) else f'{value:.0f} {unit}'.rstrip()
