# SPDX-License-Identifier: Apache-2.0
"""Checks of single entries of a YAML file; every complaint names the file and the entry."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.files import read_yaml


class EntryReader:
    """Checks entries of one muscles.yaml; every complaint names the file and the entry."""

    def __init__(self, file: Path) -> None:
        """Check entries of one file."""
        self.file = file

    def document(self) -> object:
        """Return the parsed file."""
        return read_yaml(self.file, refusal)

    def fail(self, entry: str, problem: str) -> RobotDescriptionError:
        """Return the error that says what is wrong with an entry."""
        return RobotDescriptionError(f'{self.file}: {entry}: {problem}')

    def mapping(self, value: object, entry: str, legal: tuple[str, ...]) -> dict[str, Any]:
        """Return a mapping that has legal keys only."""
        if not isinstance(value, dict):
            raise self.fail(entry, f'expected a mapping with keys {listed(legal)}, got {value!r}')
        for key in value:
            if key not in legal:
                raise self.fail(entry, f'unknown key {key!r}; legal keys: {listed(legal)}')
        return value

    def required(self, mapping: dict[str, Any], key: str, entry: str) -> Any:
        """Return the value of a key that must be there."""
        if mapping.get(key) is None:
            raise self.fail(entry, f'key {key!r} is missing')
        return mapping[key]

    def sequence(self, value: object, entry: str, at_least: int, of_what: str) -> list[Any]:
        """Return a list of at least so many things."""
        if not isinstance(value, list) or len(value) < at_least:
            count = f'{len(value)} given' if isinstance(value, list) else f'got {value!r}'
            raise self.fail(entry, f'expected a list of at least {at_least} {of_what}, {count}')
        return value

    def number(self, value: object, entry: str, positive: bool = False) -> float:
        """Return a finite number."""
        result = math.nan
        if isinstance(value, int | float) and not isinstance(value, bool):
            # An integer too long for a float overflows; no such number means anything here.
            result = float(value) if abs(value) < 1e300 else math.inf
        if not math.isfinite(result):
            hint = ' (YAML reads 1e5 as text; write 1.0e+5)' if isinstance(value, str) else ''
            raise self.fail(entry, f'expected a finite number, got {value!r}{hint}')
        if positive and result <= 0.0:
            raise self.fail(entry, f'expected a number > 0, got {result:g}')
        return result

    def name(self, value: object, entry: str) -> str:
        """Return a text that is not empty."""
        if not isinstance(value, str) or not value.strip():
            raise self.fail(entry, f'expected a name, got {value!r}')
        return value

    def unique(self, names: list[str], entry: str) -> tuple[str, ...]:
        """Return names of which none is written twice."""
        for name, count in Counter(names).items():
            if count > 1:
                raise self.fail(entry, f'{name!r} is listed twice; names must be unique')
        return tuple(names)


def listed(names: tuple[str, ...] | list[str]) -> str:
    """Return names as they stand in a message."""
    return ', '.join(names)


def refusal(file: Path, problem: str) -> RobotDescriptionError:
    """Return the error that says what is wrong with a file of a robot directory."""
    remedy = 'a robot directory holds robot.urdf and muscles.yaml'
    return RobotDescriptionError(f'{file}: {problem}; {remedy}')
