# SPDX-License-Identifier: Apache-2.0
"""What a part of the system says of itself, for people and for /diagnostics."""

from __future__ import annotations

from typing import Literal, NamedTuple

Level = Literal['ok', 'warn', 'error']


class Report(NamedTuple):
    """How it is, in one line and in named values."""

    level: Level
    message: str
    values: dict[str, str]
