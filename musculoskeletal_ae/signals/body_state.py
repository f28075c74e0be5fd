# SPDX-License-Identifier: Apache-2.0
"""The body state: isolated muscles and length offsets as one immutable value.

The estimator owns the body state and publishes it on the latched topics `isolated_muscles` and
`muscle_length_zeros`. The nodes that use muscle states receive it. Every change creates a new
object with the next version number.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.exceptions import MessageError

#: Standard deviation of an offset that nothing has determined [m]. Offsets that are constructed
#: without a trust count as known if their standard deviation is smaller.
UNKNOWN = 1.0
MOST_OFFSET = 10.0  # reject messages with a larger offset of a length sensor [m]
ROWS = 4  # number of rows in a message on `muscle_length_zeros`


class Trust(IntEnum):
    """Whether the length offset of a muscle may be used, as published in `muscle_length_zeros`.

    The estimator decides this in `estimation/lengths/length_trust.py`, and all other nodes follow
    it.
    """

    KNOWN = 0
    UNKNOWN = 1  # not determined since the start, or being determined by a length calibration
    REVOKED = 2  # was known until a finding of the estimator contradicted it


@dataclass(frozen=True)
class LengthOffsets:
    """Length offsets, which are subtracted from sensor values, and whether they may be trusted.

    Attributes:
        offset: o [m], (M,).
        deviation: Standard deviation of o [m], (M,). An offset that was revoked keeps the one that
            it had.
        trust: Value of `Trust` for each muscle, (M,).
        generation: Number of the estimator's decision. The estimator raises it whenever it changes
            or confirms an offset, and never uses a number again, even after a restart. 0 stands for
            the assumption that every node starts with: the offsets are zero.
    """

    offset: Array
    deviation: Array
    trust: Ints = field(default_factory=lambda: np.zeros(0, dtype=int))
    generation: int = 0

    def __post_init__(self) -> None:
        """Complete a missing trust."""
        if len(self.trust) != len(self.offset):
            is_known = self.deviation < UNKNOWN
            object.__setattr__(self, 'trust', np.where(is_known, Trust.KNOWN, Trust.UNKNOWN))

    @classmethod
    def none(cls, muscle_count: int) -> LengthOffsets:
        """Return exactly known offsets of zero."""
        return cls(np.zeros(muscle_count), np.zeros(muscle_count))

    @classmethod
    def unknown(cls, muscle_count: int) -> LengthOffsets:
        """Return unknown offsets."""
        return cls(np.zeros(muscle_count), np.full(muscle_count, UNKNOWN))

    @classmethod
    def of_rows(cls, rows: Array) -> LengthOffsets:
        """Return the offsets of a message: offset, standard deviation, trust, generation, (4, M).

        Raises:
            MessageError: If a value is illegal.
        """
        offset, deviation, trust, generation = rows
        is_legal = (
            np.abs(offset).max() <= MOST_OFFSET
            and deviation.min() >= 0.0
            and np.isin(trust, list(Trust)).all()
            and (generation == generation[0]).all()
            and generation[0] >= 0.0
            and generation[0] == round(generation[0])
        )
        if not is_legal:
            legal = (
                f'offsets within ±{MOST_OFFSET:g} m, standard deviations >= 0, a trust of '
                f'{", ".join(f"{each:d}" for each in Trust)}, and the same whole number >= 0 as '
                'the generation of all muscles'
            )
            raise MessageError('impossible offsets', f'expected {legal}, got {rows.tolist()}')
        return cls(offset, deviation, trust.astype(int), int(generation[0]))

    @property
    def rows(self) -> Array:
        """The content of a message on `muscle_length_zeros`, (4, M)."""
        generation = np.full(len(self.offset), float(self.generation))
        return np.stack([self.offset, self.deviation, self.trust.astype(float), generation])

    @cached_property
    def known(self) -> bool:
        """Whether the offsets of all muscles are known."""
        return not self.not_known

    @cached_property
    def not_known(self) -> tuple[int, ...]:
        """Indices of the muscles whose offsets are unknown or revoked."""
        return tuple(np.flatnonzero(self.trust != Trust.KNOWN).tolist())

    @cached_property
    def revoked(self) -> tuple[int, ...]:
        """Indices of the muscles whose offsets a finding has revoked."""
        return tuple(np.flatnonzero(self.trust == Trust.REVOKED).tolist())


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
