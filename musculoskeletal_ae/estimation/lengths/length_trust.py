# SPDX-License-Identifier: Apache-2.0
"""Decides, for all nodes, which length offsets may be trusted.

Detectors, the length calibration, the joint sensors, the check of a repaired muscle and a restart
provide evidence. The newest evidence on an offset decides whether it is trusted. A finding revokes
offsets if the declaration of its kind says so (`conditions.py`). The estimator publishes the result
on `body_state`, and all other nodes follow it.

    start ── ASSUMED ───────────────────► KNOWN ── a finding that revokes offsets ──► REVOKED
    start ── NOT_CALIBRATED, RESTARTED ─► UNKNOWN ── CALIBRATED ─► KNOWN
    any ──── CALIBRATING ───────────────► UNKNOWN, for the muscles that are calibrated
    KNOWN ── MOVED, then CHECKED ───────► KNOWN, but the next calibration determines it anew

The estimator itself knows that it has restarted, because it saves its offsets (`body_memory`). A
length that has MOVED and was not CHECKED is unknown after a restart.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from enum import Enum

import numpy as np

from musculoskeletal_ae.arrays import Bools
from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.signals.body_state import LengthOffsets, Trust

#: determine an offset anew in the next calibration if its standard deviation is at least this [m]
PRECISE = 0.01


class Evidence(Enum):
    """Evidence on length offsets, apart from findings; the values are texts for users."""

    ASSUMED = 'assumed to be 0'
    NOT_CALIBRATED = 'not calibrated since the start'
    RESTARTED = 'not calibrated since the estimator was restarted'
    CALIBRATING = 'being calibrated'
    CALIBRATED = 'calibrated'
    MOVED = 'changed while the muscle was repaired; not checked yet'
    CHECKED = 'checked after the repair of the muscle'


#: evidence after which an offset is unknown until a calibration has found it
UNSURE = frozenset({Evidence.NOT_CALIBRATED, Evidence.RESTARTED, Evidence.CALIBRATING})
#: evidence that a length has changed in a repair, which leaves the offset known
REPAIRED = frozenset({Evidence.MOVED, Evidence.CHECKED})


class LengthTrust:
    """The length offsets of an arm, with the trust in each of them and the evidence for it.

    Attributes:
        offsets: The offsets and their trust, as the estimator publishes them.
        evidence: For each muscle, the evidence that decided last, or the kind of the finding that
            revoked its offset.
    """

    def __init__(self, muscle_count: int) -> None:
        """Assume that the length sensors are absolute, so that all offsets are zero.

        Args:
            muscle_count: Number of muscles M.
        """
        self.offsets = LengthOffsets.none(muscle_count)
        self.evidence: list[Evidence | ConditionKind] = [Evidence.ASSUMED] * muscle_count

    def take(
        self,
        evidence: Evidence | ConditionKind,
        muscles: Iterable[int] | None = None,
        found: LengthOffsets | None = None,
    ) -> bool:
        """Take new evidence; return whether it has changed an offset or the trust in one.

        Args:
            evidence: The evidence, or the kind of a finding that revokes length offsets.
            muscles: Indices of the muscles that it concerns; None for all muscles.
            found: Offsets and standard deviations that replace the present ones; None to keep them.
        """
        previous, is_finding = self.offsets, isinstance(evidence, ConditionKind)
        concerned = list(range(len(self.evidence)) if muscles is None else muscles)
        if is_finding or evidence in REPAIRED:  # these concern known offsets only
            concerned = [m for m in concerned if previous.trust[m] == Trust.KNOWN]
        for muscle in concerned:
            self.evidence[muscle] = evidence
        rows = previous.rows.copy()
        if found is not None:
            rows[:2, concerned] = found.rows[:2, concerned]
        trust = Trust.UNKNOWN if evidence in UNSURE else Trust.KNOWN
        rows[2, concerned] = Trust.REVOKED if is_finding else trust
        if (rows == previous.rows).all():
            return False
        self.offsets = LengthOffsets(rows[0], rows[1], rows[2].astype(int))
        return True

    @property
    def is_certain(self) -> Bools:
        """Which offsets a calibration leaves as they are, (M,).

        They are known and precise, and their muscle has not been repaired since.
        """
        is_moved = np.array([evidence in REPAIRED for evidence in self.evidence])
        is_precise = self.offsets.deviation < PRECISE
        return (self.offsets.trust == Trust.KNOWN) & is_precise & ~is_moved

    @property
    def after_restart(self) -> LengthOffsets:
        """The offsets as a restarted estimator has to take them.

        It does not know that a length changed in a repair (MOVED) and has to be checked before the
        anomaly ends. The offset of such a muscle is therefore not known to it.
        """
        moved = [m for m, evidence in enumerate(self.evidence) if evidence is Evidence.MOVED]
        if not moved:
            return self.offsets
        trust = self.offsets.trust.copy()
        trust[moved] = Trust.UNKNOWN
        return replace(self.offsets, trust=trust)

    @property
    def doubts(self) -> dict[str, tuple[int, ...]]:
        """Reasons, for users, why length offsets are not known, with the muscles concerned."""
        doubts = dict[str, tuple[int, ...]]()
        for muscle in self.offsets.not_known:
            text = _text(self.evidence[muscle])
            doubts[text] = (*doubts.get(text, ()), muscle)
        return doubts


def _text(evidence: Evidence | ConditionKind) -> str:
    if isinstance(evidence, ConditionKind):
        return f'revoked because {evidence.text}'
    return evidence.value
