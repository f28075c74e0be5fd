# SPDX-License-Identifier: Apache-2.0
"""From messages to rests: when the arm is still.

The arm rests while the means of the two halves of a short window differ by no more than the given
rates allow, beyond what the sensors' own scatter explains (a camera's θ is far noisier than a joint
sensor's). The rest is averaged until it ends, or for `LONGEST` at a time. An arm without joint
sensors (`blind`) rests while its muscles do, and θ is averaged where there is any. A motion begins
and ends too slowly to be told from rest, but not to bend what an accelerometer reads of gravity:
that counts where the whole windows before and after it were still.
"""

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass, field
from operator import itemgetter

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.samples import NOTHING, Sample
from musculoskeletal_ae.learning.settings import Settings

LONGEST = 1.0  # [s] of rest that one sample averages
MOST = 20_000  # readings of one rest: an end where the clock stands still
LEAST_READINGS = 4  # in half of `rest_time`, which slow messages make longer: fewer hide a drift
SURE = 3.0  # standard errors that a difference of means may have by chance


class ReadingWindow:
    """The latest readings with the times when they came, and their values as rows of an array.

    The array is reused, because a new one for every message would be slow.
    """

    def __init__(self) -> None:
        self.readings: deque[tuple[float, Sample]] = deque(maxlen=MOST)
        self._rows = np.empty((0, 1))  # from `_first` on (l, θ) of the readings
        self._first = 0

    def clear(self) -> None:
        """Forget all readings."""
        self.readings.clear()

    @property
    def start(self) -> float:
        """When the first reading came [s]."""
        return self.readings[0][0]

    def append(self, time: float, reading: Sample) -> None:
        """Add a reading that came at `time` [s]."""
        held = min(len(self.readings), MOST - 1)  # of which one goes when the window is full
        self._first += len(self.readings) - held
        row = np.concatenate((reading.length, reading.theta))
        if self._first + held == len(self._rows):
            kept = self._rows[self._first :]
            self._rows, self._first = np.empty((2 * held + 100, len(row))), 0
            self._rows[:held] = kept
        self._rows[self._first + held] = row
        self.readings.append((time, reading))

    def drop_before(self, time: float) -> None:
        """Forget the readings that came before `time` [s]."""
        while self.start < time:
            self.readings.popleft()
            self._first += 1

    def parts(self, time: float) -> tuple[Array, Array]:
        """Return the rows of the readings up to `time` [s], and of those after it."""
        cut = bisect_right(self.readings, time, key=itemgetter(0))
        middle, end = self._first + cut, self._first + len(self.readings)
        return self._rows[self._first : middle], self._rows[middle:end]


@dataclass
class OpenRest:
    """A rest that goes on.

    Attributes:
        since: When the arm was found still [s].
        span: How long the readings last that are averaged [s].
        readings: Those readings.
        gravity: What IMUs read of gravity in readings with still windows before and after them.
    """

    since: float
    span: float = 0.0
    readings: list[Sample] = field(default_factory=list)
    gravity: list[Array] = field(default_factory=list)

    def mean(self) -> Sample | None:
        """Return the mean of the readings; None if there is none."""
        if not self.readings:
            return None
        theta, tension, length, direction = (
            _mean(np.array(part)) for part in [*zip(*self.readings)][:4]
        )
        # All readings of a rest were taken under one body state.
        return self.readings[-1]._replace(
            theta=theta,
            tension=tension,
            length=length,
            direction=direction,
            gravity=_mean(np.array(self.gravity)) if self.gravity else NOTHING,
        )


class RestDetector:
    """Turns the stream of readings into one mean per rest."""

    def __init__(
        self, settings: Settings, blind: bool = False, radian: Array | float = 1.0
    ) -> None:
        """Start with an empty window; `radian` is that of `SampleStore`."""
        self.settings, self.blind, self._radian = settings, blind, radian
        self._window = ReadingWindow()
        self.reset()

    def reset(self) -> None:
        """Forget the window, as after a jump of the clock."""
        self._window.clear()
        self._time = 0.0  # [s]
        self._read_at, self._periods = 0.0, (0.0, 0.0)  # of messages that count, the last two [s]
        self._rest: OpenRest | None = None  # None: the arm moves

    def step(self, reading: Sample, dt: float) -> Sample | None:
        """Take a message, `dt` [s] after the one before, with θ NaN where none was measured.

        Returns the mean of a rest that ended or is long enough.
        """
        self._time += dt
        self._window.append(self._time, reading)
        if self.blind or _is_measured(reading):
            self._periods = self._periods[1], self._time - self._read_at
            self._read_at = self._time
        # Of the last two periods the shorter one counts: a gap is no rate.
        readings = (2 * LEAST_READINGS + 1) * min(self._periods)
        needed = max(self.settings.rest_time, readings)
        self._window.drop_before(self._time - needed - 1e-9)
        rest = self._rest
        if not self._is_still(needed):
            self._rest = None
            return None if rest is None else rest.mean()
        if rest is None:
            rest = self._rest = OpenRest(since=self._time, span=needed)
            new = [each for _, each in self._window.readings]
        else:
            rest.span += dt
            new = [reading]
        rest.readings += new if self.blind else filter(_is_measured, new)
        time, earlier = self._window.readings[0]
        if time >= rest.since:
            rest.gravity.append(earlier.gravity)
        if rest.span < LONGEST and len(rest.readings) < MOST:
            return None
        self._rest = OpenRest(since=rest.since)
        return rest.mean()

    def _is_still(self, needed: float) -> bool:
        """Whether the arm was still for the time that a rest needs [s]."""
        half = 0.5 * needed
        if self._time - self._window.start <= 0.7 * needed:
            return False
        halves = self._window.parts(self._time - half)
        muscles = len(self._window.readings[0][1].length)
        if not _unmoved([h[:, :muscles] for h in halves], self.settings.rest_length_rate * half):
            return False
        angles = [part[:, muscles:] for part in halves]
        angles = [part[~np.isnan(part).all(axis=1)] for part in angles]
        if min(map(len, angles)) < LEAST_READINGS:
            return self.blind
        known = [np.isfinite(part) for part in angles]
        enough = np.minimum(*(part.sum(axis=0) for part in known)) >= LEAST_READINGS
        if not enough.any():
            return self.blind
        rate = self.settings.rest_joint_rate * half * self._radian
        allowed, whole = np.broadcast_to(rate, enough.shape), known[0].all(0) & known[1].all(0)
        # Of some joints only some messages tell, as where two nodes publish some joints each.
        some = (
            [a[k[:, j], j] for a, k in zip(angles, known)] for j in np.flatnonzero(enough & ~whole)
        )
        return _unmoved([part[:, whole] for part in angles], allowed[whole]) and all(
            map(_unmoved, some, allowed[enough & ~whole])
        )


def _is_measured(reading: Sample) -> bool:
    return not np.isnan(reading.theta).all()


def _mean(values: Array) -> Array:
    """Return the mean of rows where they are numbers, NaN where none is."""
    known = np.isfinite(values)
    mean: Array = np.where(known, values, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(known.any(axis=0), mean, np.nan)


def _unmoved(halves: list[Array], allowed: Array | float) -> bool:
    first, second = halves
    difference = np.abs(second.sum(axis=0) / len(second) - first.sum(axis=0) / len(first))
    if (difference <= allowed).all():
        return True
    # Taken from neighbours' differences, which a slow drift hardly enters.
    error = sum(
        np.square(half[1:] - half[:-1]).sum(axis=0) / (2.0 * len(half) * (len(half) - 1))
        for half in halves
        if len(half) > 1
    )
    return bool((difference <= allowed + SURE * np.sqrt(error)).all())
