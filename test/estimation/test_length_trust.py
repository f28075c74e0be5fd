# SPDX-License-Identifier: Apache-2.0
"""Evidence becomes trust in length offsets in one place."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.lengths.length_trust import (
    UNSURE,
    Evidence,
    LengthTrust,
)
from musculoskeletal_ae.signals.body_state import LengthOffsets, Trust

M = 4
FOUND = LengthOffsets.of(np.linspace(-0.08, 0.08, M), np.full(M, 1e-3))
REVOKING = [kind for kind in ConditionKind if kind.revokes is not None]
TAKEN = [evidence for evidence in Evidence if evidence is not Evidence.ASSUMED] + REVOKING
CALIBRATIONS = {*UNSURE, Evidence.CALIBRATED}
MUSCLES = st.none() | st.sets(st.integers(0, M - 1))


def calibrated():
    trust = LengthTrust(M)
    trust.take(Evidence.CALIBRATING, found=FOUND)
    trust.take(Evidence.CALIBRATED)
    return trust


@pytest.mark.parametrize('kind', REVOKING)
def test_a_revoked_offset_states_the_finding_that_revoked_it(kind):
    trust = calibrated()
    trust.take(kind, [2])
    assert trust.doubts == {f'revoked because {kind.text}': (2,)}


@given(st.lists(st.tuples(st.sampled_from(TAKEN), MUSCLES)))
def test_only_a_calibration_ends_a_revocation(events):
    trust = calibrated()
    trust.take(ConditionKind.LENGTH_JUMP, [2])
    revoked = True
    for evidence, muscles in events:
        concerns = muscles is None or 2 in muscles
        trust.take(evidence, muscles)
        revoked &= not (concerns and evidence in CALIBRATIONS)
        if revoked:
            assert trust.offsets.trust[2] == Trust.REVOKED
            assert trust.evidence[2] is ConditionKind.LENGTH_JUMP
            assert 2 in trust.doubts['revoked because the length of a muscle has jumped']


@given(st.lists(st.tuples(st.sampled_from(TAKEN), MUSCLES)))
def test_offsets_are_replaced_exactly_when_something_that_is_published_changes(events):
    trust = calibrated()
    for evidence, muscles in events:
        before = trust.offsets
        has_changed = trust.take(evidence, muscles)
        assert has_changed == (trust.offsets is not before)
        assert (trust.offsets != before) == has_changed


def test_a_revoked_offset_keeps_its_value_and_its_deviation():
    trust = calibrated()
    before = trust.offsets
    trust.take(ConditionKind.LENGTHS_DISAGREE)
    assert trust.offsets.revoked == tuple(range(M))
    np.testing.assert_array_equal(trust.offsets.rows[:2], before.rows[:2])


def test_an_offset_that_moved_in_a_repair_stays_known_until_the_next_calibration():
    trust = calibrated()
    before = trust.offsets
    for evidence in (Evidence.MOVED, Evidence.CHECKED):
        assert not trust.take(evidence, [1])
    assert trust.offsets is before
    assert trust.offsets.known
    assert np.flatnonzero(~trust.is_certain).tolist() == [1]


@pytest.mark.parametrize('evidence', [Evidence.RESTARTED, Evidence.NOT_CALIBRATED])
def test_offsets_that_are_unknown_at_the_start_stay_unknown_until_a_calibration(evidence):
    trust = LengthTrust(M)
    trust.take(evidence, found=LengthOffsets.of(FOUND.offset, np.ones(M)))
    for other in (ConditionKind.LENGTH_JUMP, Evidence.MOVED):
        trust.take(other)
        assert trust.offsets.not_known == tuple(range(M))
    trust.take(Evidence.CALIBRATED, found=FOUND)
    assert trust.offsets.known
