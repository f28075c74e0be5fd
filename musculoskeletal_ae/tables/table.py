# SPDX-License-Identifier: Apache-2.0
"""Readings of an arm in rows, from which its network is trained, whatever file they came from.

The rows are either successive readings, with their times, or resting postures, one in each row. In
successive readings, the learner itself finds the rests, as on a running arm. Rows of a recording
that do not directly follow each other are in different segments (`Table.segments`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.bags.streams import Pairs
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.robot import Robot

#: `Table.split` divides a table into BLOCKS parts of equally many successive rows, and holds out
#: the parts with the numbers HELD_OUT. Single rows between learned ones would be no test, because
#: successive rows resemble each other.
BLOCKS, HELD_OUT = 10, (2, 7)
#: exclude a reading of a motion from the held-out part if a learned reading is closer to it than
#: this [s], so that no rest is in both parts
MARGIN = 1.0


class TableError(MusculoskeletalError):
    """A table or a CSV file cannot be used; the text names the problem and a remedy."""


@dataclass(frozen=True)
class Table:
    """Readings of an arm in N rows.

    Attributes:
        rows: The readings; if each row is a resting posture, its time is the number of the row.
        at_rest: Whether each row is a resting posture; otherwise, rows are successive readings.
        segment: Number of the segment of each row, (N,).
        left_out: Number of unusable rows that were left out, by reason.
    """

    rows: Pairs
    at_rest: bool
    segment: Ints
    left_out: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def of_pairs(cls, pairs: Pairs) -> Table:
        """Return a table of the pairs in a bag: each row is a muscle message with joint angles."""
        return cls(pairs, False, np.zeros(len(pairs.time), dtype=int))

    @classmethod
    def of(
        cls,
        robot: Robot,
        position: ArrayLike,
        length: ArrayLike,
        tension: ArrayLike | None = None,
        time: ArrayLike | None = None,
    ) -> Table:
        """Build a table from arrays.

        Rows without any joint position, and rows in which a length, a measured tension or the time
        is missing, are left out; `left_out` has their number.

        Args:
            robot: The robot, which gives the order of joints and muscles.
            position: Positions of the joints [rad], or [m] for prismatic joints, (N, D); NaN where
                a joint was not measured.
            length: Muscle lengths l [m], (N, M), relative to those at θ = 0 (`without_zeros`).
            tension: Tensions T [N], (N, M), with motor currents converted to tensions; None if
                `tension_source` of muscles.yaml is none.
            time: Time of each row [s], (N,); None if each row is a resting posture.

        Raises:
            TableError: If arrays do not fit the robot or each other, if the times decrease, or if
                no row is usable.
        """
        count = len(np.atleast_1d(np.asarray(length, dtype=float)))
        shapes = {'position': robot.joint_count, 'length': robot.muscle_count}
        arrays = {'position': position, 'length': length}
        if robot.tension_source.is_known:
            if tension is None:
                raise TableError(
                    'the tensions are missing; add them, or set `tension_source: none` and '
                    '`actuation: position` in muscles.yaml if the robot does not measure them'
                )
            arrays['tension'], shapes['tension'] = tension, robot.muscle_count
        values = {}
        for name, array in arrays.items():
            values[name] = np.array(array, dtype=float)
            if values[name].shape != (count, shapes[name]):
                raise TableError(
                    f'{name} has the shape {values[name].shape}; expected {count, shapes[name]}: '
                    f'one row for each row of the lengths, and one column for each '
                    f'{"joint" if name == "position" else "muscle"} of muscles.yaml'
                )
        when = np.arange(count, dtype=float) if time is None else np.array(time, dtype=float)
        if when.shape != (count,):
            raise TableError(f'time has the shape {when.shape}; expected {(count,)}')
        for array in (*values.values(), when):
            array[~np.isfinite(array)] = np.nan
        left_out, usable = {}, np.ones(count, dtype=bool)
        gaps = {name: np.isnan(array) for name, array in values.items()}
        nowhere = np.zeros((count, 1), dtype=bool)
        for reason, missing in (
            ('a length is missing', gaps['length'].any(axis=1)),
            ('a tension is missing', gaps.get('tension', nowhere).any(axis=1)),
            ('the time is missing', np.isnan(when)),
            ('no joint position is known', gaps['position'].all(axis=1)),
        ):
            if (lost := missing & usable).any():
                left_out[reason] = int(lost.sum())
                usable &= ~missing
        if not usable.any():
            why = ', '.join(f'{reason}: {n} rows' for reason, n in left_out.items())
            raise TableError(
                f'no row is usable ({why or "the table is empty"}); a usable row has all lengths '
                'and tensions, and at least one joint position'
            )
        when = when[usable] - (0.0 if time is None else when[usable][0])
        if (back := np.flatnonzero(np.diff(when) < 0.0)).size:
            row = int(np.flatnonzero(usable)[back[0]]) + 1
            raise TableError(
                f'the time decreases by {when[back[0]] - when[back[0] + 1]:g} s after row {row}; '
                'sort the rows by time, and put each recording into a file of its own'
            )
        length = values['length'][usable]
        rows = Pairs(
            when,
            robot.units.to_theta(values['position'][usable]),
            length,
            values['tension'][usable]
            if 'tension' in values
            else np.tile(robot.actuation.assumed_tension, (len(length), 1)),
            np.full(length.shape, -1),
        )
        return cls(rows, time is None, np.zeros(len(length), dtype=int), left_out)

    def __len__(self) -> int:
        return len(self.rows.time)

    def segments(self) -> Iterator[Pairs]:
        """Yield the readings of each segment: rows that directly follow each other."""
        for number in np.unique(self.segment):
            yield self.rows.at(self.segment == number)

    def split(self) -> tuple[Table, Table]:
        """Return one table to learn from, and one that is held out to measure the error.

        Whole blocks of successive rows are held out, a fifth of all rows (see `BLOCKS`).

        Raises:
            TableError: If there are fewer rows than blocks.
        """
        if len(self) < BLOCKS:
            raise TableError(
                f'{len(self)} usable rows; at least {BLOCKS} are needed to hold some of them out. '
                'Record more postures, or hold out another file with --hold-out'
            )
        block = np.arange(len(self)) * BLOCKS // len(self)
        is_held_out = np.isin(block, HELD_OUT)
        segment = np.cumsum(np.diff(is_held_out, prepend=is_held_out[:1]))
        held_out = is_held_out.copy()
        if not self.at_rest:
            time, learned = self.rows.time, self.rows.time[~is_held_out]
            after = np.searchsorted(learned, time).clip(1, len(learned) - 1)
            nearest = np.abs(learned[np.stack([after - 1, after])] - time).min(axis=0)
            held_out &= nearest > MARGIN
            if not held_out.any():
                raise TableError(
                    f'the readings last {np.ptp(time):.1f} s, which is too short to hold some of '
                    'them out; record some minutes, or hold out another file with --hold-out'
                )
        # Segments of the original table stay separate, too.
        segment = segment + (segment.max() + 1) * self.segment
        return self._part(~is_held_out, segment), self._part(held_out, segment)

    def _part(self, chosen: Bools, segment: Ints) -> Table:
        return Table(self.rows.at(chosen), self.at_rest, segment[chosen])

    def length_zeros(self, robot: Robot) -> Array:
        """Return the reading of each length sensor where the modelled length is 0 [m], (M,).

        This is the median difference between the lengths and those of the geometric model, over the
        rows with all joint positions.

        Raises:
            TableError: If there are no such rows.
        """
        known = np.isfinite(self.rows.theta).all(axis=1)
        if not known.any():
            raise TableError(
                'no row has all joint positions, so the zeros of the lengths cannot be estimated; '
                'measure all joints in at least some rows'
            )
        modelled = robot.muscle_lengths(self.rows.theta[known], self.rows.tension[known])
        zeros: Array = np.median(self.rows.length[known] - modelled, axis=0)
        return zeros

    def without_zeros(self, zeros: Array) -> Table:
        """Return the table with lengths reduced by `zeros` [m], (M,)."""
        return replace(self, rows=self.rows._replace(length=self.rows.length - zeros))
