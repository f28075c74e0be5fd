# SPDX-License-Identifier: Apache-2.0
"""How the tables of remedies try one: the situation is refused, and the advice ends it."""

import re
from collections.abc import Callable
from typing import Any

import pytest

from musculoskeletal_ae.exceptions import MusculoskeletalError

Mend = Callable[[re.Match[str]], Any]


def check_remedy(
    use: Callable[[Any], object],
    bad: Any,
    advice: str,
    *mends: Any,
    error: type[BaseException] = MusculoskeletalError,
) -> None:
    """Check that `use(bad)` is refused with an advice, and that following it helps.

    Args:
        use: What the user does, with a value.
        bad: The value that is refused.
        advice: Regular expression that the message has to contain.
        mends: The ways that the advice offers, each a value or a function that makes it from the
            match of `advice`. `use` has to accept each of these values.
        error: Type of the refusal.
    """
    with pytest.raises(error) as refused:
        use(bad)
    match = re.search(advice, str(refused.value), re.DOTALL)
    assert match, str(refused.value)
    assert mends
    for mend in mends:
        use(mend(match) if callable(mend) else mend)


def listed(match: re.Match[str]) -> list[str]:
    """Return the members of the legal set that the first group of an advice states."""
    return re.split(r', | or ', match[1])


def each_listed(match: re.Match[str]) -> str:
    """Return the first member of the legal set of an advice."""
    return listed(match)[0]
