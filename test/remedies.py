# SPDX-License-Identifier: Apache-2.0
"""How the tables of remedies try one: the situation is refused, and the advice ends it."""

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

from musculoskeletal_ae.exceptions import MusculoskeletalError


class Members:
    """Values made of each member of the legal set that the first group of an advice states."""

    def __init__(self, value: Callable[[str], Any]) -> None:
        self.value = value


def members(value: Callable[[str], Any] = lambda member: member) -> list[Members]:
    """Return the ways of an advice with a legal set: each of its members makes a value."""
    return [Members(value)]


def listed(match: re.Match[str]) -> list[str]:
    """Return the members of the legal set that the first group of an advice states."""
    return re.split(r', | or ', match[1])


def in_file(name: str, old: str, new: str) -> Callable[..., None]:
    """Return an edit of a robot directory that replaces a text in a file once."""

    def edit(directory: Path, _: object = None) -> None:
        file = directory / name
        text = file.read_text()
        assert old in text
        file.write_text(text.replace(old, new, 1))

    return edit


def check_remedy(
    use: Callable[[Any], object],
    bad: Any,
    advice: str,
    ways: Iterable[Any],
    error: type[BaseException] = MusculoskeletalError,
) -> None:
    """Check that `use(bad)` is refused with an advice, and that following the advice helps.

    Args:
        use: What a user does, with a value.
        bad: The value that is refused.
        advice: Regular expression that the message has to contain.
        ways: The ways that the advice offers; `use` has to accept the value of each. A way is a
            value, a function that makes it from the match of `advice`, or `Members`.
        error: Type of the refusal.
    """
    with pytest.raises(error) as refused:
        use(bad)
    match = re.search(advice, str(refused.value), re.DOTALL)
    assert match, str(refused.value)
    values: list[Any] = []
    for way in ways:
        if isinstance(way, Members):
            values += [way.value(member) for member in listed(match)]
        else:
            values.append(way(match) if callable(way) else way)
    assert values
    for value in values:
        use(value)
