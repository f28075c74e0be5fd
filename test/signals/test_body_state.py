# SPDX-License-Identifier: Apache-2.0
"""The body state as a message of `body_state`."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.signals.body_state import (
    PRESENT,
    Anomaly,
    BodyState,
    LengthOffsets,
    Trust,
)

M = 3
OFFSETS = LengthOffsets(
    np.array([0.05, -0.02, 0.0]), np.array([1e-3, 0.0, 1.0]), np.array([0, 2, 1])
)
BODY = BodyState(OFFSETS, (1,), Anomaly.VERIFYING, 1, 1_764_000_000_000)


@given(
    st.sampled_from(Anomaly),
    st.integers(0, M - 1),
    st.sets(st.integers(0, M - 1)),
    st.integers(0, 2**50),
)
def test_a_message_carries_the_whole_body_state(anomaly, suspect, isolated, generation):
    suspect = None if anomaly is Anomaly.NONE else suspect
    if anomaly is Anomaly.VERIFYING:
        isolated |= {suspect}
    body = BodyState(OFFSETS, tuple(sorted(isolated)), anomaly, suspect, generation)
    received = BodyState.of_rows(body.rows)
    assert received == body
    assert received.has_anomaly == (anomaly in PRESENT)
    assert (received.offsets.not_known, received.offsets.revoked) == ((1, 2), (1,))


@pytest.mark.parametrize(
    'change',
    [
        {'generation': 7},
        {'isolated': (0, 1)},
        {'anomaly': Anomaly.FOUND},
        {'offsets': replace(OFFSETS, deviation=np.full(M, 0.5))},
    ],
)
def test_body_states_are_equal_if_all_their_values_are(change):
    assert replace(BODY, offsets=replace(OFFSETS)) == BODY
    assert replace(BODY, **change) != BODY


@pytest.mark.parametrize(
    ('row', 'value'),
    [
        pytest.param(0, 1e17, id='offset'),
        pytest.param(1, -1e-3, id='deviation'),
        pytest.param(2, 3.0, id='trust'),
        pytest.param(2, 0.5, id='trust between two'),
        pytest.param(3, 2.0, id='isolated'),
        pytest.param(3, 0.0, id='a suspect that is verified but used'),
        pytest.param(4, 4.0, id='anomaly'),
        pytest.param(5, 7.0, id='two generations'),
    ],
)
def test_impossible_rows_are_refused_with_the_legal_values(row, value):
    rows = BODY.rows.copy()
    rows[row, 1] = value
    with pytest.raises(MessageError, match='impossible body state: expected offset within'):
        BodyState.of_rows(rows)


def test_one_finding_names_one_muscle():
    rows = BODY.rows.copy()
    rows[4, 0] = Anomaly.FOUND
    with pytest.raises(MessageError, match='other than 0 for at most one muscle'):
        BodyState.of_rows(rows)


@pytest.mark.parametrize('generation', [-1.0, 0.5])
def test_a_generation_is_a_whole_number(generation):
    rows = BODY.rows.copy()
    rows[5] = generation
    with pytest.raises(MessageError, match='whole number'):
        BodyState.of_rows(rows)


def test_every_node_starts_with_the_assumption_of_a_healthy_body():
    assumed = BodyState.healthy(M)
    assert assumed.offsets.known and assumed.used.all() and not assumed.has_anomaly
    assert assumed.generation == 0
    assert (LengthOffsets.unknown(M).trust == Trust.UNKNOWN).all()
