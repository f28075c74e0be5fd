# SPDX-License-Identifier: Apache-2.0
"""The body state: length offsets, isolated muscles and the anomaly as one immutable value.

The estimator owns the body state. After each change, it publishes the whole state on the latched
topic `body_state`, with a number that rises (`generation`). All other nodes use the newest message,
which contains everything that they need: they combine it with no other message. Before the first
message, they assume a healthy body.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.exceptions import MessageError

UNKNOWN = 1.0  # give an offset that nothing has determined this standard deviation [m]
MOST_OFFSET = 10.0  # reject a body state with a larger offset of a length sensor than this [m]
ROWS = 6  # expect this many rows in a message on `body_state` (`BodyState.of_rows`)


class Trust(IntEnum):
    """Whether the length offset of a muscle may be used, as published in `body_state`.

    The estimator decides this in `estimation/lengths/length_trust.py`, and all other nodes follow
    it.
    """

    KNOWN = 0
    UNKNOWN = 1  # not determined since the start, or being determined by a length calibration
    REVOKED = 2  # was known until the estimator found a fault that makes it unreliable


class Anomaly(IntEnum):
    """State of the estimator's newest finding, that is, of the newest fault that it has detected.

    It is published in `body_state`. A restarted estimator does not know earlier findings, and
    therefore reports NONE. Only ENDED lets an arm that was stopped for a verification move again.
    """

    NONE = 0  # no finding since the estimator was started
    FOUND = 1  # the finding is latched, and the arm is to stop
    VERIFYING = 2  # as FOUND; the suspect is isolated, and is wound in to verify the fault
    ENDED = 3  # the anomaly was ended by a verification or by `estimator/reset`


#: treat an anomaly as present in these states, in which the arm is to stop
PRESENT = frozenset({Anomaly.FOUND, Anomaly.VERIFYING})


@dataclass(frozen=True, eq=False)
class LengthOffsets:
    """Length offsets, which are subtracted from sensor values, and whether they may be trusted.

    Attributes:
        offset: Offset of each length sensor [m], (M,).
        deviation: Standard deviation of each offset [m], (M,). It does not change when the offset
            is revoked.
        trust: Value of `Trust` for each offset, (M,).
    """

    offset: Array
    deviation: Array
    trust: Ints

    @classmethod
    def of(
        cls, offset: Array, deviation: Array | float, trust: Trust = Trust.KNOWN
    ) -> LengthOffsets:
        """Return offsets [m], (M,), that are trusted equally; `deviation` [m] may be a number."""
        shape = offset.shape
        return cls(offset, np.broadcast_to(deviation, shape), np.full(shape, trust, dtype=int))

    @classmethod
    def none(cls, muscle_count: int) -> LengthOffsets:
        """Return no offsets: all are 0 and exactly known, as with absolute sensors."""
        return cls.of(np.zeros(muscle_count), 0.0)

    @classmethod
    def unknown(cls, muscle_count: int) -> LengthOffsets:
        """Return unknown offsets: they are 0 until something determines them."""
        return cls.of(np.zeros(muscle_count), UNKNOWN, Trust.UNKNOWN)

    def __eq__(self, other: object) -> bool:
        """Return whether all offsets, standard deviations and trusts are equal."""
        return isinstance(other, LengthOffsets) and np.array_equal(self.rows, other.rows)

    __hash__ = None  # type: ignore[assignment]

    @cached_property
    def rows(self) -> Array:
        """Offset [m], standard deviation [m] and trust of each muscle, (3, M)."""
        return np.stack([self.offset, self.deviation, self.trust.astype(float)])

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
        """Indices of the muscles whose offsets the estimator has revoked."""
        return tuple(np.flatnonzero(self.trust == Trust.REVOKED).tolist())


@dataclass(frozen=True)
class BodyState:
    """Length offsets, isolated muscles and the anomaly, as all nodes use them.

    Attributes:
        offsets: Length offsets of all muscles.
        isolated: Indices of the isolated muscles, in ascending order.
        anomaly: State of the newest finding.
        suspect: Index of the muscle that the newest finding names; None before the first finding.
        generation: Number of the state. The estimator raises it with each change, and never uses a
            number again, even after a restart. 0 stands for the assumption that every node starts
            with: a healthy body whose length offsets are zero.
    """

    offsets: LengthOffsets
    isolated: tuple[int, ...] = ()
    anomaly: Anomaly = Anomaly.NONE
    suspect: int | None = None
    generation: int = 0

    @classmethod
    def healthy(cls, muscle_count: int) -> BodyState:
        """Return the state with known offsets of zero, no isolated muscle and no anomaly."""
        return cls(LengthOffsets.none(muscle_count))

    @classmethod
    def of_rows(cls, rows: Array) -> BodyState:
        """Return the state that a message on `body_state` describes, (6, M).

        Its rows are offset, standard deviation and trust of each length, whether the muscle is
        isolated, the anomaly that concerns it, and the generation.

        Raises:
            MessageError: If a value is illegal.
        """
        offset, deviation, trust, isolated, anomaly, generation = rows
        _check(rows)
        suspects = np.flatnonzero(anomaly)
        return cls(
            LengthOffsets(offset, deviation, trust.astype(int)),
            tuple(np.flatnonzero(isolated).tolist()),
            Anomaly(int(anomaly.max())),
            int(suspects[0]) if len(suspects) else None,
            int(generation[0]),
        )

    @cached_property
    def rows(self) -> Array:
        """Rows of the message on `body_state` that describes this state, (6, M)."""
        anomaly = np.zeros(self.muscle_count)
        if self.suspect is not None:
            anomaly[self.suspect] = self.anomaly
        generation = np.full(self.muscle_count, float(self.generation))
        return np.stack([*self.offsets.rows, ~self.used, anomaly, generation])

    @property
    def muscle_count(self) -> int:
        """Number of muscles M."""
        return len(self.offsets.offset)

    @cached_property
    def used(self) -> Bools:
        """Which muscles are not isolated, (M,)."""
        return ~np.isin(np.arange(self.muscle_count), self.isolated)

    @cached_property
    def suspected(self) -> Bools:
        """Which muscle is the suspect of a present anomaly, (M,)."""
        return self.has_anomaly & (np.arange(self.muscle_count) == self.suspect)

    @property
    def has_anomaly(self) -> bool:
        """Whether an anomaly is present. If so, the arm is stopped."""
        return self.anomaly in PRESENT

    def with_isolated(self, muscles: Iterable[int]) -> BodyState:
        """Return the state in which exactly the muscles with these indices are isolated."""
        isolated = tuple(sorted({int(muscle) for muscle in muscles}))
        return self if isolated == self.isolated else replace(self, isolated=isolated)

    def with_offsets(self, offsets: LengthOffsets) -> BodyState:
        """Return the state with other length offsets."""
        return replace(self, offsets=offsets)

    @property
    def verified(self) -> int | None:
        """Index of the suspect that is being verified, or None."""
        return self.suspect if self.anomaly is Anomaly.VERIFYING else None

    def with_anomaly(self, anomaly: Anomaly, suspect: int | None = None) -> BodyState:
        """Return the state with another anomaly.

        Args:
            anomaly: State of the newest finding.
            suspect: Index of the muscle that this finding names; None if there is no finding.
        """
        return replace(self, anomaly=anomaly, suspect=suspect)


def _check(rows: Array) -> None:
    """Check the content of a message on `body_state`.

    Raises:
        MessageError: If a value is illegal.
    """
    offset, deviation, trust, isolated, anomaly, generation = rows
    is_verified = anomaly == Anomaly.VERIFYING
    is_legal = (
        np.abs(offset).max() <= MOST_OFFSET
        and deviation.min() >= 0.0
        and np.isin(trust, list(Trust)).all()
        and np.isin(isolated, (0.0, 1.0)).all()
        and np.isin(anomaly, list(Anomaly)).all()
        and np.count_nonzero(anomaly) <= 1
        and isolated[is_verified].all()
        and (generation == generation[0]).all()
        and generation[0] >= 0.0
        and generation[0] == round(generation[0])
    )
    if not is_legal:

        def values(kind: type[IntEnum]) -> str:
            return ', '.join(f'{each:d}' for each in kind)

        legal = (
            f'offset within ±{MOST_OFFSET:g} m; standard deviation >= 0; trust {values(Trust)}; '
            f'isolated 0 or 1; anomaly {values(Anomaly)}, other than 0 for at most one muscle, and '
            f'{Anomaly.VERIFYING:d} only for an isolated muscle; generation a whole number >= 0, '
            'the same for all muscles'
        )
        raise MessageError('impossible body state', f'expected {legal}, got {rows.tolist()}')
