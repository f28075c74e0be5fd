# SPDX-License-Identifier: Apache-2.0
"""Length offsets as a message of muscle_length_zeros."""

import numpy as np
import pytest

from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.signals.body_state import LengthOffsets, Trust

M = 3
ROWS = LengthOffsets(
    np.array([0.05, -0.02, 0.0]), np.array([1e-3, 0.0, 1.0]), np.array([0, 2, 1]), 1_764_000_000_000
).rows


def test_a_message_carries_offsets_deviations_trust_and_generation():
    offsets = LengthOffsets.of_rows(ROWS)
    np.testing.assert_array_equal(offsets.rows, ROWS)
    assert offsets.generation == 1_764_000_000_000
    assert (offsets.not_known, offsets.revoked) == ((1, 2), (1,))
    assert not offsets.known


@pytest.mark.parametrize(
    ('row', 'value'),
    [
        pytest.param(0, 1e17, id='offset'),
        pytest.param(1, -1e-3, id='deviation'),
        pytest.param(2, 3.0, id='trust'),
        pytest.param(2, 0.5, id='trust between two'),
        pytest.param(3, 7.0, id='two generations'),
    ],
)
def test_impossible_rows_are_refused_with_the_legal_values(row, value):
    rows = ROWS.copy()
    rows[row, 1] = value
    with pytest.raises(MessageError, match='impossible offsets: expected offsets within'):
        LengthOffsets.of_rows(rows)


@pytest.mark.parametrize('generation', [-1.0, 0.5])
def test_a_generation_is_a_whole_number(generation):
    rows = ROWS.copy()
    rows[3] = generation
    with pytest.raises(MessageError, match='whole number'):
        LengthOffsets.of_rows(rows)


def test_offsets_without_a_statement_are_the_assumption_that_every_node_starts_with():
    assumed = LengthOffsets.none(M)
    assert assumed.known
    assert assumed.generation == 0
    assert (LengthOffsets.unknown(M).trust == Trust.UNKNOWN).all()
