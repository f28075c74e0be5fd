# SPDX-License-Identifier: Apache-2.0
"""Entries of muscles.yaml; every complaint names the file and the entry."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

from musculoskeletal_ae.exceptions import RobotDescriptionError, printable

LARGEST = 1e8  # [SI units] of any number
LONGEST_NAME = 200
MOST_ITEMS = 1000  # of any list: muscles, points of a route, joints


class Entry:
    """A value of a YAML file, of any type until a method has checked it, and where it stands."""

    def __init__(self, file: Path, value: Any, where: str, inside: str | None = None) -> None:
        """Keep a value; `inside` stands before the names of its own entries."""
        self.file, self.value, self.where = file, value, where
        self._inside = f'{where}.' if inside is None else inside

    def fail(self, problem: str) -> RobotDescriptionError:
        """Return the error that says what is wrong with this entry."""
        return RobotDescriptionError(f'{self.file}: {self.where}: {problem}')

    def called(self, name: str) -> Entry:
        """Return the same entry under a name that people know it by."""
        return Entry(self.file, self.value, name, f'{name}: ')

    def mapping(self, *legal: str) -> Entry:
        """Return this mapping, all of whose keys are legal."""
        keys = ', '.join(legal)
        if not isinstance(self.value, dict):
            raise self.fail(f'expected a mapping with keys {keys}, got {self.value!r}')
        for key in self.value:
            if key not in legal:
                raise self.fail(f'unknown key {key!r}; legal keys: {keys}')
        return self

    def get(self, key: str, default: Any = None) -> Entry:
        """Return the entry of a key, with a default where it is left out."""
        return Entry(self.file, self.value.get(key, default), f'{self._inside}{key}')

    def __getitem__(self, key: str) -> Entry:
        if self.value.get(key) is None:
            raise self.fail(f'key {key!r} is missing')
        return self.get(key)

    def items(self, at_least: int, of_what: str) -> list[Entry]:
        """Return the entries of a list of at least so many things."""
        value = self.value
        if isinstance(value, list) and len(value) > MOST_ITEMS:
            raise self.fail(f'expected at most {MOST_ITEMS} {of_what}, {len(value)} given')
        if not isinstance(value, list) or len(value) < at_least:
            count = f'{len(value)} given' if isinstance(value, list) else f'got {value!r}'
            raise self.fail(f'expected a list of at least {at_least} {of_what}, {count}')
        return [Entry(self.file, item, f'{self.where}[{i}]') for i, item in enumerate(value)]

    def number(self, above: float = -math.inf, least: float = -math.inf) -> float:
        """Return a finite number above one bound and at least another."""
        value, result = self.value, math.nan
        if isinstance(value, int | float) and not isinstance(value, bool):
            # An integer too long for a float overflows; no such number means anything here.
            result = float(value) if abs(value) <= LARGEST else math.inf
        if not math.isfinite(result):
            hint = ' (YAML reads 1e5 as text; write 1.0e+5)' if isinstance(value, str) else ''
            raise self.fail(f'expected a finite number up to {LARGEST:g}, got {value!r}{hint}')
        if result <= above or result < least:
            bound = f'> {above:g}' if result <= above else f'>= {least:g}'
            raise self.fail(f'expected a number {bound}, got {result:g}')
        return result

    def name(self) -> str:
        """Return a text that is not empty."""
        if not isinstance(self.value, str) or not self.value.strip():
            raise self.fail(f'expected a name, got {self.value!r}')
        if len(self.value) > LONGEST_NAME or printable(self.value) != self.value:
            raise self.fail(f'expected up to {LONGEST_NAME} characters that can be printed')
        return self.value

    def unique(self, names: list[str]) -> tuple[str, ...]:
        """Return the names in this entry, none of which may be there twice."""
        for name, count in Counter(names).items():
            if count > 1:
                raise self.fail(f'{name!r} is listed twice; names must be unique')
        return tuple(names)


def refusal(file: Path, problem: str) -> RobotDescriptionError:
    """Return the error that says what is wrong with a file of a robot directory."""
    remedy = 'a robot directory holds robot.urdf and muscles.yaml'
    return RobotDescriptionError(f'{file}: {problem}; {remedy}')
