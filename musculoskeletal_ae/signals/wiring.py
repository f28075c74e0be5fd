# SPDX-License-Identifier: Apache-2.0
"""Judges which muscle each column of the readings belongs to, and which sign its length has.

Arrays of readings carry no names. A driver may publish muscles in a wrong order, or lengths with a
wrong sign. If it reads its commands in the same way, every muscle still obeys its control law. Only
the lengths then reveal the fault: those of column j change with the posture like those of another
muscle.

    column j shows muscle order[j], with the sign sign[j]                            (`Wiring`)

Known posture. For N messages with measured θ,

    e_jk² = var(±l_j(t) − f_k(θ(t), T_j(t)))

is the misfit of column j to muscle k (`square_misfits`). f are the lengths of any model, such as
the geometric model or a network. The variance is taken within each segment of the recording, so
length offsets do not matter. Two columns count as exchanged if exchanging them divides their summed
e² by at least BETTER². A column counts as having the wrong sign if reversing the sign does so, and
several columns count as exchanged if several exchanges together do so (`judge`).

Unknown posture. The caller states the cost of the readings as they are, and the cost under each of
the wirings that differ by one fault (`single_faults`). Two cases use this: the fit of a length
calibration, and the residual of a network with known length offsets. `decide` compares the costs.

If several wirings explain the readings equally well, all of them are reported as alternatives. This
happens if muscles have nearly the same moment arms.

In gentle motion of emulated individual 0 of musashi_left_arm, both emulator models, a correction
divides the misfit by 2.2 to 18 and the cost by 1.3 to 8. On the healthy arm, no exchange divides
the misfit by more than 0.9 or the cost by more than 1.01, with initial and with learned networks.
`bench wiring` counts what live arms report.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints

#: Assume a wrong order or sign of columns if correcting it divides their misfit by at least this
#: factor. Conclude that the order of two columns is right if exchanging them multiplies their
#: misfit by at least this factor.
BETTER = 1.4
#: assume a wrong order or sign if correcting it divides the cost of all readings by at least this
COST_BETTER = 1.1
#: add noise of this standard deviation to every misfit [m]; an arm that hardly moves then shows
#: neither a fault nor that the wiring is right
NOISE = 0.0005
MOST_SAMPLES = 400  # judge the wiring by at most this many messages, evenly distributed

#: computes the lengths [m], (N, M), for θ [rad], (N, D), and T [N], (N, M)
Lengths = Callable[[Array, Array], Array]


class Wiring(NamedTuple):
    """The muscle to which each column of the readings belongs, and the sign of its length."""

    order: tuple[int, ...]  # index of the muscle to which each column belongs
    sign: tuple[int, ...]  # 1, or −1 if the length of the column has the wrong sign

    @classmethod
    def straight(cls, muscle_count: int) -> Wiring:
        """Return the wiring without a fault: the right order, with the right signs."""
        return cls(tuple(range(muscle_count)), (1,) * muscle_count)

    def exchanged(self, j: int, k: int) -> Wiring:
        """Return this wiring with two columns exchanged."""
        order, sign = list(self.order), list(self.sign)
        order[j], order[k] = order[k], order[j]
        sign[j], sign[k] = sign[k], sign[j]
        return Wiring(tuple(order), tuple(sign))

    def reversed(self, j: int) -> Wiring:
        """Return this wiring with the sign of one column reversed."""
        sign = list(self.sign)
        sign[j] = -sign[j]
        return self._replace(sign=tuple(sign))

    @property
    def misplaced(self) -> dict[int, int]:
        """The muscle to which each misplaced column belongs, by column; {} in the right order."""
        return {j: k for j, k in enumerate(self.order) if j != k}

    @property
    def faulty(self) -> tuple[int, ...]:
        """Indices of the columns in a wrong place or with a wrong sign."""
        return tuple(
            j for j, (k, sign) in enumerate(zip(self.order, self.sign)) if j != k or sign < 0
        )

    def unsigned(self, columns: Array) -> Array:
        """Return columns (..., M) in the order of the muscles, without changing signs.

        This is right for tensions, which have no sign.
        """
        return columns[..., np.argsort(self.order)]

    def signed(self, columns: Array) -> Array:
        """Return columns of lengths (..., M) in the order and with the signs of the muscles."""
        return self.unsigned(columns * np.array(self.sign))

    def text(self, names: Sequence[str]) -> str:
        """Return the faults of this wiring as a text for users; `names` are the muscles' names."""
        parts, rest = list[str](), self.misplaced
        for j, k in self.misplaced.items():
            if j < k and rest.get(k) == j:
                parts.append(f'the readings of {names[j]} and {names[k]} are exchanged')
                del rest[j], rest[k]
        parts += [f'the readings of {names[j]} are those of {names[k]}' for j, k in rest.items()]
        wrong = [names[j] for j, sign in enumerate(self.sign) if sign < 0]
        if len(wrong) == 1:
            parts.append(f'the length of {wrong[0]} has the wrong sign')
        elif wrong:
            parts.append(f'the lengths of {" and ".join(wrong)} have the wrong sign')
        return ', and '.join(parts)


class WiringJudgement(NamedTuple):
    """Judgement of the wiring by the readings: faults, alternatives and certainly right columns.

    Attributes:
        wiring: The wiring that explains the readings best; straight unless a fault is certain.
        alternatives: Wirings that explain the readings equally well, `wiring` first.
        right: Columns that certainly belong to their muscle.
        misfit: Misfit of the readings under `wiring`: a length [m], or a cost without unit.
    """

    wiring: Wiring
    alternatives: tuple[Wiring, ...]
    right: tuple[int, ...]
    misfit: float

    @property
    def is_faulty(self) -> bool:
        """Whether columns are certainly in a wrong place or have a wrong sign."""
        return bool(self.wiring.faulty)

    @property
    def faulty(self) -> tuple[int, ...]:
        """All columns that may be in a wrong place or have a wrong sign, in ascending order."""
        return tuple(sorted({j for wiring in self.alternatives for j in wiring.faulty}))

    def text(self, names: Sequence[str]) -> str:
        """Return the fault, with its alternatives, as a text for users; '' without a fault."""
        if not self.is_faulty:
            return ''
        texts = [wiring.text(names) for wiring in self.alternatives]
        return texts[0] if len(texts) == 1 else f'either {", or ".join(texts)} (undetermined)'


def single_faults(wiring: Wiring, columns: Iterable[int], signs: bool = True) -> Iterator[Wiring]:
    """Yield the wirings that differ from `wiring` by one fault of these columns.

    A fault is an exchange of two columns, or a reversed sign if `signs`.
    """
    columns = tuple(columns)
    for j, k in combinations(columns, 2):
        yield wiring.exchanged(j, k)
    if signs:
        for j in columns:
            yield wiring.reversed(j)


def decide(
    wiring: Wiring, cost: float, others: Sequence[tuple[Wiring, float]], better: float = COST_BETTER
) -> WiringJudgement:
    """Return the wiring that explains the readings best according to costs.

    Args:
        wiring: The wiring that is assumed as long as no other one is clearly better.
        cost: Cost of `wiring`.
        others: Other wirings with their costs.
        better: Factor by which the cost of a better wiring must be lower.
    """
    likely = sorted(others, key=lambda other: other[1])
    if not likely or cost <= better * likely[0][1]:
        return WiringJudgement(wiring, (wiring,), (), cost)
    best, least = likely[0]
    equal = tuple(other for other, its in likely if its < better * least and cost > better * its)
    return WiringJudgement(best, equal, (), least)


def judge(
    lengths: Lengths,
    theta: Array,
    length: Array,
    tension: Array,
    segments: Ints | None = None,
    used: Bools | None = None,
    signs: bool = True,
) -> WiringJudgement:
    """Judge by measured joint angles whether columns are exchanged or have a wrong sign.

    Args:
        lengths: The lengths of a model.
        theta: Measured joint angles θ [rad], (N, D). Messages with NaN are not used.
        length: l as read [m], (N, M).
        tension: T as read [N], (N, M).
        segments: Number of the segment to which each message belongs, (N,); None for one segment.
        used: Columns to judge, (M,); None for all.
        signs: Whether to judge signs. If not, they are assumed to be right.
    """
    square = square_misfits(lengths, theta, length, tension, segments, signs)
    count = square.shape[1]
    columns = np.arange(count) if used is None else np.flatnonzero(used)
    wiring = Wiring.straight(count)

    def misfit(wiring: Wiring, of: Iterable[int]) -> float:
        """Return the summed squares of the misfit of some columns [m²]."""
        return float(sum(square[int(wiring.sign[j] < 0), j, wiring.order[j]] for j in of))

    def concerned(other: Wiring) -> list[int]:
        changed = zip(zip(*wiring), zip(*other))
        return [j for j, (now, then) in enumerate(changed) if now != then]

    def gain(other: Wiring) -> float:
        """Return how much a wiring reduces the misfit; 0 if it is not clearly better."""
        of = concerned(other)
        now, then = misfit(wiring, of), misfit(other, of)
        return now - then if now > BETTER**2 * then else 0.0

    # Correct one fault after the other, so that no more columns are blamed than necessary.
    alternatives: tuple[Wiring, ...] = (wiring,)
    for _ in columns:
        best = max(single_faults(wiring, columns, signs), key=gain, default=wiring)
        if gain(best) <= 0.0:
            break

        def is_equal(other: Wiring, best: Wiring = best) -> bool:
            """Return whether another fault explains the readings as well as the best one."""
            of = {*concerned(best), *concerned(other)}
            return gain(other) > 0.0 and misfit(other, of) < BETTER**2 * misfit(best, of)

        others = [other for other in single_faults(wiring, columns, signs) if is_equal(other)]
        alternatives = (best, *(other for other in others if other != best))
        wiring = best
    # If columns are exchanged in a cycle, no single exchange need be clearly better. Make every
    # exchange that helps at all, and judge all of them together.
    cycle, least = wiring, misfit(wiring, columns)
    while True:
        exchanged = (cycle, *single_faults(cycle, columns, signs=False))
        cost, better = min((misfit(each, columns), each) for each in exchanged)
        if not cost < least:  # also if the cost is NaN, because a reading is missing
            break
        cycle, least = better, cost
    if gain(cycle) > 0.0:
        wiring, alternatives = cycle, (cycle,)
    unclear = set[int]()
    for j, k in combinations(columns.tolist(), 2):
        if misfit(wiring.exchanged(j, k), (j, k)) < BETTER**2 * misfit(wiring, (j, k)):
            unclear |= {j, k}
    right = tuple(j for j in columns.tolist() if j not in unclear and j not in wiring.faulty)
    return WiringJudgement(wiring, alternatives, right, np.sqrt(misfit(wiring, columns.tolist())))


def square_misfits(
    lengths: Lengths,
    theta: Array,
    length: Array,
    tension: Array,
    segments: Ints | None = None,
    signs: bool = False,
) -> Array:
    """Return e² + NOISE² of the module docstring [m²], (1, M, M), or (2, M, M) with `signs`.

    The first index is 1 for a reversed sign. `judge` describes the arguments.
    """
    rows = np.flatnonzero(np.isfinite(theta).all(axis=1))
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_SAMPLES)).astype(int)]
    theta, length, tension = theta[rows], length[rows], tension[rows]
    segments = np.zeros(len(rows), dtype=int) if segments is None else segments[rows]
    groups = [np.flatnonzero(segments == each) for each in np.unique(segments)]
    count = length.shape[1]
    square = np.empty((1 + signs, count, count))
    for j in range(count):
        # The tension in column j stretches the muscle of this column, whichever muscle that is.
        model = lengths(theta, np.repeat(tension[:, [j]], count, axis=1))
        for sign in range(1 + signs):
            error = (1.0 - 2.0 * sign) * length[:, [j]] - model
            for each in groups:
                error[each] -= error[each].mean(axis=0)
            square[sign, j] = np.square(error).mean(axis=0) + NOISE**2
    return square
