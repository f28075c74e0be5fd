# SPDX-License-Identifier: Apache-2.0
"""Which muscles are isolated and what the length offsets are, as one immutable value.

The estimator owns the body state and publishes it on the latched topics `isolated_muscles` and
`muscle_length_zeros`. Every other node receives it and passes it on. A change makes a new value
with the next version; no object is changed in place.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools

UNKNOWN = 1.0  # [m] standard deviation of a length offset that is being searched for
SUSPECT = 2.0  # [m] the same of an offset that was known, and that a finding has revoked
KNOWN = 0.05  # [m] largest standard deviation of an offset that counts as known


@dataclass(frozen=True)
class LengthOffsets:
    """By how much every length sensor reads too much, and how well that is known."""

    offset: Array  # o [m], (M,)
    deviation: Array  # standard deviation [m], (M,)

    @classmethod
    def none(cls, muscle_count: int) -> LengthOffsets:
        """Return offsets of zero that are known exactly."""
        return cls(np.zeros(muscle_count), np.zeros(muscle_count))

    @classmethod
    def unknown(cls, muscle_count: int) -> LengthOffsets:
        """Return offsets of which nothing is known."""
        return cls(np.zeros(muscle_count), np.full(muscle_count, UNKNOWN))

    @cached_property
    def known(self) -> bool:
        """Whether the lengths of all muscles can be relied on."""
        return bool((self.deviation < KNOWN).all())

    @cached_property
    def is_suspect(self) -> bool:
        """Whether a finding has revoked offsets that were known."""
        return bool((self.deviation >= SUSPECT).any())

    def revoked(self) -> LengthOffsets:
        """Return the same offsets, which are not relied on until they are found anew."""
        return LengthOffsets(self.offset, np.full(len(self.offset), SUSPECT))


@dataclass(frozen=True)
class BodyState:
    """The state of the body that all nodes agree on.

    Attributes:
        offsets: Length offsets of all muscles.
        isolated: Positions (in T and l) of the muscles that are not used, in ascending order.
        version: Counts the changes; a higher one is newer.
    """

    offsets: LengthOffsets
    isolated: tuple[int, ...] = ()
    version: int = 0

    @classmethod
    def healthy(cls, muscle_count: int) -> BodyState:
        """Return the state of a body with known offsets of zero and no isolated muscle."""
        return cls(LengthOffsets.none(muscle_count))

    @property
    def muscle_count(self) -> int:
        """The number of muscles M."""
        return len(self.offsets.offset)

    @cached_property
    def used(self) -> Bools:
        """Which muscles are used, (M,)."""
        return ~np.isin(np.arange(self.muscle_count), self.isolated)

    def with_isolated(self, muscles: Iterable[int]) -> BodyState:
        """Return the state in which exactly these muscles are isolated."""
        isolated = tuple(sorted({int(muscle) for muscle in muscles}))
        if isolated == self.isolated:
            return self
        return replace(self, isolated=isolated, version=self.version + 1)

    def with_offsets(self, offsets: LengthOffsets) -> BodyState:
        """Return the state with other length offsets."""
        return replace(self, offsets=offsets, version=self.version + 1)
