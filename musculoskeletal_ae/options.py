# SPDX-License-Identifier: Apache-2.0
"""Types of command-line options; argparse puts the option before what they say."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable


def whole(low: int, high: int) -> Callable[[str], int]:
    """Return a type for whole numbers within [low, high]."""

    def convert(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f'{text!r}: expected {low} to {high}')
        return value

    return convert


seed = whole(0, 2**63 - 1)


def seeds(text: str) -> tuple[int, ...]:
    """Return the different seeds of a list separated by commas."""
    try:
        values = tuple(int(part) for part in text.split(','))
    except ValueError:
        values = (-1,)
    if min(values) < 0 or len(set(values)) < len(values):
        raise argparse.ArgumentTypeError(f'{text!r}: expected different whole numbers, as in 0,1,2')
    return values


def positive(text: str) -> float:
    """Return a positive, finite number."""
    value = not_negative(text)
    if value == 0:
        raise argparse.ArgumentTypeError(f'{text!r} is not a number above 0')
    return value


def not_negative(text: str) -> float:
    """Return a finite number that is not negative."""
    return _number(text, f'{text!r} is not a number of at least 0', 0.0, sys.float_info.max)


def minutes(text: str) -> float:
    """Return minutes of robot time."""
    return _number(text, f'{text!r}: expected 0.2 to 600', 0.2, 600.0)


def _number(text: str, problem: str, low: float, high: float) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(problem)
    return value
