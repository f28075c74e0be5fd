# SPDX-License-Identifier: Apache-2.0
"""Errors about a value of a file name its place, the value and the legal values."""

from typing import Annotated, Literal

import pytest
from msgspec import Meta

from musculoskeletal_ae.schema import Strict, convert


class Spring(Strict, frozen=True):
    kind: Literal['soft', 'stiff']
    rate: Annotated[float, Meta(gt=0.0, le=1e8)]

    def __post_init__(self):
        if self.kind == 'soft' and self.rate > 10.0:
            raise ValueError(f'expected a rate up to 10 of a soft spring, got {self.rate:g}')


class File(Strict, frozen=True):
    springs: tuple[Spring, ...]
    gains: dict[Literal['p', 'd'], float] | None = None


GOOD = {'kind': 'soft', 'rate': 2}


def test_a_value_of_the_format_is_read():
    file = convert({'springs': [GOOD]}, File, ValueError)
    assert file.springs == (Spring('soft', 2.0),)


@pytest.mark.parametrize(
    ('value', 'problem'),
    [
        (None, '$: expected object, got null: None'),
        ({}, "$: key 'springs' is missing"),
        ({'springs': [], 'x': 1}, "$: unknown key 'x'; legal keys: springs, gains"),
        ({'springs': [GOOD, {}]}, "$.springs[1]: key 'kind' is missing"),
        (
            {'springs': [{**GOOD, 'kind': 'hard'}]},
            "$.springs[0].kind: expected one of soft, stiff, got 'hard'",
        ),
        (
            {'springs': [{**GOOD, 'rate': float('nan')}]},
            '$.springs[0].rate: expected float > 0.0, got nan',
        ),
        (
            {'springs': [{**GOOD, 'rate': '1e5'}]},
            "$.springs[0].rate: expected float, got str: '1e5' (YAML reads 1e5 as text; write",
        ),
        ({'springs': [{**GOOD, 'rate': 10**5000}]}, '$.springs[0].rate: number out of range'),
        (
            {'springs': [{**GOOD, 'rate': 20}]},
            '$.springs[0]: expected a rate up to 10 of a soft spring, got 20',
        ),
        ({'springs': [], 'gains': {'i': 1.0}}, '$.gains: wrong key: invalid enum value'),
        ({'springs': [], 'gains': {'p': 'x'}}, "$.gains[...]: expected float, got str: {'p': 'x'}"),
    ],
)
def test_a_problem_is_explained_by_place_value_and_what_is_legal(value, problem):
    with pytest.raises(ValueError) as error:  # noqa: PT011 - compared below
        convert(value, File, ValueError)
    assert str(error.value).startswith(problem)
