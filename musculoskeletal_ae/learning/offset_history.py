# SPDX-License-Identifier: Apache-2.0
"""Which samples were taken under which length offsets, and what becomes of those under wrong ones.

A finding may revoke the offsets: the lengths have jumped, or disagree with the joint sensors. It
comes some time after the fault. Therefore the samples of the last seconds are held back until the
offsets have been found anew:

    found as they were       the finding was false, and the samples are put back
    found to be others       the samples are dropped: nobody knows which of them are wrong

Offsets may also turn out to have been wrong all the time, as of a calibration that was misled or of
a stranger. That is certain if others are found although no length has jumped and no messages were
missed: the modules cannot have lost their count. The samples taken under the wrong offsets are
corrected then.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.offset_check import SAME
from musculoskeletal_ae.learning.samples import SampleStore, StoredSample
from musculoskeletal_ae.signals.limits import LIMITS

HELD = 5.0  # [s] before a finding in which samples may have been taken under wrong offsets
#: [m] that a muscle module's count cannot jump unseen between two messages
SEEN = LIMITS.step + LIMITS.speed * LIMITS.longest_step


class OffsetHistory:
    """Watches the samples of one store.

    Attributes:
        dropped: How many samples were dropped with revoked offsets.
        corrected: How many were corrected.
    """

    def __init__(self, samples: SampleStore, offset: Array) -> None:
        """Begin with offsets [m] (M,)."""
        self._samples, self._offset = samples, offset
        #: number of the first sample since when all are under the present offsets
        self._first = samples.accepted + 1
        self._recent: deque[tuple[float, int]] = deque()  # when they were taken [s], and numbers
        self._held: list[StoredSample] = []
        self._is_revoked = False
        self._is_continuous = True  # whether the modules have kept their count since `_first`
        self.dropped = self.corrected = 0

    def accepted(self, now: float) -> None:
        """Note that the newest sample of the store was taken at `now` [s]."""
        self._recent.append((now, self._samples.accepted))
        while self._recent and not 0.0 <= now - self._recent[0][0] <= HELD:
            self._recent.popleft()

    def interrupt(self) -> None:
        """Note that the modules may have lost their count."""
        self._is_continuous = False

    def revoke(self, now: float) -> None:
        """Note at `now` [s] that a finding has revoked the offsets; hold back what is recent."""
        if not self._is_revoked:
            recent = {number for at, number in self._recent if 0.0 <= now - at <= HELD}
            self._held += self._samples.take_out(recent)
        self._is_revoked = True

    def use(self, offset: Array) -> None:
        """Go by offsets [m] (M,) that are believed."""
        change = self._offset - offset
        size = float(np.abs(change).max())
        if size <= SAME:
            self._samples.put_back(self._held)
        else:
            self.dropped += len(self._held)
            if self._is_continuous and not self._is_revoked and size > SEEN:
                self.corrected += self._samples.lengthen(change, self._first)
            else:
                self._first = self._samples.accepted + 1
        self._held = []
        if size > SAME or self._is_revoked:
            self._recent.clear()
            self._is_continuous = True
        self._offset, self._is_revoked = offset, False
