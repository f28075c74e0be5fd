# SPDX-License-Identifier: Apache-2.0
"""Numbers as text beside the limits that they exceed."""

import math

import pytest

from musculoskeletal_ae.report import distinct


@pytest.mark.parametrize(
    ('value', 'limits', 'texts'),
    [
        (1.0, (2.0,), ('1', '2')),
        (1.5708, (1.57,), ('1.571', '1.57')),
        (0.52360001, (-1.2217, 0.5236), ('0.52360001', '-1.2217', '0.5236')),
        (math.nextafter(1000.0, 2000.0), (1000.0,), ('1000.0000000000001', '1000')),
        (3.0, (3.0,), ('3', '3')),
        (math.inf, (1.0,), ('inf', '1')),
    ],
)
def test_a_value_and_its_limit_have_enough_digits_to_differ(value, limits, texts):
    assert distinct(value, *limits) == texts
