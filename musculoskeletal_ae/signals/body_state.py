# SPDX-License-Identifier: Apache-2.0
"""The body state: isolated muscles and length offsets as one immutable value.

The estimator owns the body state and publishes it on the latched topics `isolated_muscles` and
`muscle_length_zeros`. The nodes that use muscle states receive it. Every change creates a new
object with the next version number.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools

UNKNOWN = 1.0  # standard deviation of an unknown length offset [m]
SUSPECT = 2.0  # standard deviation of a length offset that a fault has revoked [m]
KNOWN = 0.05  # standard deviation below which a length offset counts as known [m]

#: standard deviation that a length offset gains when it is confirmed after a repair [m]
CONFIRMED = 0.01


@dataclass(frozen=True)
class LengthOffsets:
    """Length offsets, which are subtracted from sensor values, and their uncertainty."""

    offset: Array  # o [m], (M,)
    deviation: Array  # standard deviation [m], (M,)

    @classmethod
    def none(cls, muscle_count: int) -> LengthOffsets:
        """Return exactly known offsets of zero."""
        return cls(np.zeros(muscle_count), np.zeros(muscle_count))

    @classmethod
    def unknown(cls, muscle_count: int) -> LengthOffsets:
        """Return unknown offsets."""
        return cls(np.zeros(muscle_count), np.full(muscle_count, UNKNOWN))

    @cached_property
    def known(self) -> bool:
        """Whether the offsets of all muscles are known."""
        return bool((self.deviation < KNOWN).all())

    @cached_property
    def is_suspect(self) -> bool:
        """Whether a fault has revoked known offsets."""
        return bool((self.deviation >= SUSPECT).any())

    @property
    def suspect(self) -> tuple[int, ...]:
        """Indices of the muscles whose offsets a fault has revoked."""
        return tuple(np.flatnonzero(self.deviation >= SUSPECT).tolist())

    def confirmed(self, muscle: int) -> LengthOffsets:
        """Return the same offsets after the offset of one muscle was confirmed.

        The standard deviation of this offset grows, because the repair may have changed the offset
        slightly.
        """
        deviation = self.deviation.copy()
        deviation[muscle] = min(np.hypot(deviation[muscle], CONFIRMED), 0.9 * KNOWN)
        return LengthOffsets(self.offset, deviation)

    def revoked(self, muscles: Iterable[int] | None = None) -> LengthOffsets:
        """Return the same offsets; those of some muscles are marked as suspect.

        They remain suspect until the next length calibration.

        Args:
            muscles: Indices of these muscles; None for all muscles.
        """
        deviation = self.deviation.copy()
        deviation[range(len(deviation)) if muscles is None else list(muscles)] = SUSPECT
        return LengthOffsets(self.offset, deviation)


@dataclass(frozen=True)
class BodyState:
    """Isolated muscles and length offsets, as all nodes use them.

    Attributes:
        offsets: Length offsets of all muscles.
        isolated: Indices of the isolated muscles, in ascending order.
        version: Number of changes so far.
    """

    offsets: LengthOffsets
    isolated: tuple[int, ...] = ()
    version: int = 0

    @classmethod
    def healthy(cls, muscle_count: int) -> BodyState:
        """Return the state with known offsets of zero and no isolated muscle."""
        return cls(LengthOffsets.none(muscle_count))

    @property
    def muscle_count(self) -> int:
        """Number of muscles M."""
        return len(self.offsets.offset)

    @cached_property
    def used(self) -> Bools:
        """Which muscles are not isolated, (M,)."""
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
