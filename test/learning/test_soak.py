# SPDX-License-Identifier: Apache-2.0
"""Failures that `bench soak` reports."""

import pytest

from bench.soak import failures_of

FLAT = [0.5] * 40


@pytest.mark.parametrize(
    ('worst', 'filled', 'most', 'times', 'expected'),
    [
        (1.1, 300.0, 330.0, FLAT, []),
        (1.3, 300.0, 330.0, FLAT, ['the error']),
        (1.1, 300.0, 400.0, FLAT, ['memory']),
        (1.1, 300.0, 330.0, [*FLAT, *[0.9] * 40], ['an update took']),
        (1.1, 0.0, 0.0, [], []),
    ],
)
def test_error_memory_and_time_are_judged(worst, filled, most, times, expected):
    failures = failures_of(worst, filled, most, times)
    assert len(failures) == len(expected)
    assert all(text.startswith(start) for text, start in zip(failures, expected, strict=True))
