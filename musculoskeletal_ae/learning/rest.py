# SPDX-License-Identifier: Apache-2.0
"""Detects when the arm is at rest, and averages the messages of each rest.

The arm is at rest while the means of the two halves of a short window differ by no more than the
rates of a resting arm allow. Sensor noise is taken into account, because θ from a camera is much
noisier than θ from a joint sensor. A long rest is averaged in parts of `LONGEST_PART`. For an arm
without joint sensors (`blind`) only the muscles have to be at rest; θ is averaged where it was
measured.

The slow start and end of a motion cannot be distinguished from rest, but they disturb the direction
of gravity that an accelerometer measures. Therefore gravity is used only if the arm was still in
the whole windows before and after a reading.
"""

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass, field
from operator import itemgetter

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.body_model.observations import NOTHING, Sample

REST_TIME = 0.3  # conclude that the arm rests after it has been still for this long [s]
JOINT_RATE = 0.02  # conclude that the arm moves if a joint is faster than this [rad/s]
LENGTH_RATE = 0.002  # conclude that the arm moves if a length changes faster than this [m/s]
LONGEST_PART = 1.0  # average at most this much of a rest in one sample, then begin another [s]
#: keep at most this many readings of a rest, which bounds the memory if the clock stands still
MOST_READINGS = 20_000
#: Require this many readings in each half of the window, and lengthen it if messages are slow: with
#: fewer readings, noise could hide a drift.
LEAST_READINGS = 4
#: attribute a difference between the means of both halves to sensor noise, not to motion, up to
#: this many standard errors
NOISE_FACTOR = 3.0


class ReadingWindow:
    """Stores the latest readings with their times, and their values as rows of an array.

    The array is reused, because allocating one for every message would be slow.
    """

    def __init__(self) -> None:
        self.readings: deque[tuple[float, Sample]] = deque(maxlen=MOST_READINGS)
        self._rows = np.empty((0, 1))  # (l, θ) of the readings, starting at row `_first`
        self._first = 0

    def clear(self) -> None:
        """Clear all readings."""
        self.readings.clear()

    @property
    def start(self) -> float:
        """Time of the first reading [s]."""
        return self.readings[0][0]

    def append(self, time: float, reading: Sample) -> None:
        """Append a reading received at `time` [s]."""
        held = min(len(self.readings), MOST_READINGS - 1)  # a full window loses its oldest reading
        self._first += len(self.readings) - held
        row = np.concatenate((reading.length, reading.theta))
        if self._first + held == len(self._rows):
            kept = self._rows[self._first :]
            self._rows, self._first = np.empty((2 * held + 100, len(row))), 0
            self._rows[:held] = kept
        self._rows[self._first + held] = row
        self.readings.append((time, reading))

    def drop_before(self, time: float) -> None:
        """Drop the readings from before `time` [s]."""
        while self.start < time:
            self.readings.popleft()
            self._first += 1

    def parts(self, time: float) -> tuple[Array, Array]:
        """Return the readings in two parts, up to `time` [s] and later, as rows of l and θ."""
        earlier_count = bisect_right(self.readings, time, key=itemgetter(0))
        middle, end = self._first + earlier_count, self._first + len(self.readings)
        return self._rows[self._first : middle], self._rows[middle:end]


@dataclass
class OpenRest:
    """A rest that has not ended yet.

    Attributes:
        since: Time at which the rest was detected [s].
        span: Duration of the averaged readings [s].
        readings: The averaged readings.
        gravity: Directions of gravity from those readings before and after which the arm was
            still for a whole window.
    """

    since: float
    span: float = 0.0
    readings: list[Sample] = field(default_factory=list)
    gravity: list[Array] = field(default_factory=list)

    def mean(self) -> Sample | None:
        """Return the mean of the readings as one sample; None if there are no readings."""
        if not self.readings:
            return None
        theta, tension, length, direction = (
            _mean(np.array(part)) for part in [*zip(*self.readings)][:4]
        )
        # Keep the body state of the last reading, because all readings of a rest have the same one.
        return self.readings[-1]._replace(
            theta=theta,
            tension=tension,
            length=length,
            direction=direction,
            gravity=_mean(np.array(self.gravity)) if self.gravity else NOTHING,
        )


class RestDetector:
    """Detects rests of the arm in a stream of readings, and returns the mean of each rest."""

    def __init__(self, blind: bool = False) -> None:
        """Start with an empty window.

        Args:
            blind: Whether the arm has no joint sensors. Then only the muscles have to be at rest.
        """
        self.blind = blind
        self._window = ReadingWindow()
        self.reset()

    def reset(self) -> None:
        """Reset the detector: clear the window, for example after a jump of the clock."""
        self._window.clear()
        self._time = 0.0  # time of the last reading, as the sum of all `dt` [s]
        self._read_at = 0.0  # time of the last usable message [s]
        self._periods = 0.0, 0.0  # last two periods between usable messages [s]
        self._rest: OpenRest | None = None  # None while the arm moves

    def step(self, reading: Sample, dt: float) -> Sample | None:
        """Add a reading, and detect whether a rest has ended.

        Args:
            reading: The reading, with NaN for unmeasured θ.
            dt: Time since the previous reading [s].

        Returns:
            The mean of a rest that has ended, or of a part that has reached `LONGEST_PART` or
            `MOST_READINGS`; otherwise None.
        """
        self._time += dt
        self._window.append(self._time, reading)
        if self.blind or _is_measured(reading):
            self._periods = self._periods[1], self._time - self._read_at
            self._read_at = self._time
        # Use the shorter of the last two periods, so that a single gap does not count.
        readings = (2 * LEAST_READINGS + 1) * min(self._periods)
        needed = max(REST_TIME, readings)
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
        if rest.span < LONGEST_PART and len(rest.readings) < MOST_READINGS:
            return None
        self._rest = OpenRest(since=rest.since)
        return rest.mean()

    def _is_still(self, needed: float) -> bool:
        """Return whether the arm was still during the last `needed` seconds."""
        half = 0.5 * needed
        if self._time - self._window.start <= 0.7 * needed:
            return False
        halves = self._window.parts(self._time - half)
        muscles = len(self._window.readings[0][1].length)
        if not _unmoved([h[:, :muscles] for h in halves], LENGTH_RATE * half):
            return False
        angles = [part[:, muscles:] for part in halves]
        angles = [part[~np.isnan(part).all(axis=1)] for part in angles]
        if min(map(len, angles)) < LEAST_READINGS:
            return self.blind
        known = [np.isfinite(part) for part in angles]
        enough = np.minimum(*(part.sum(axis=0) for part in known)) >= LEAST_READINGS
        if not enough.any():
            return self.blind
        rate = JOINT_RATE * half
        allowed, whole = np.broadcast_to(rate, enough.shape), known[0].all(0) & known[1].all(0)
        # Only some messages may contain a joint, for example if two nodes publish joints. Compare
        # the means of such a joint separately.
        some = (
            [a[k[:, j], j] for a, k in zip(angles, known)] for j in np.flatnonzero(enough & ~whole)
        )
        return _unmoved([part[:, whole] for part in angles], allowed[whole]) and all(
            map(_unmoved, some, allowed[enough & ~whole])
        )


def _is_measured(reading: Sample) -> bool:
    return not np.isnan(reading.theta).all()


def _mean(values: Array) -> Array:
    """Return the mean of each column without its NaN entries; NaN if it has no other entries."""
    known = np.isfinite(values)
    mean: Array = np.where(known, values, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(known.any(axis=0), mean, np.nan)


def _unmoved(halves: list[Array], allowed: Array | float) -> bool:
    first, second = halves
    difference = np.abs(second.sum(axis=0) / len(second) - first.sum(axis=0) / len(first))
    if (difference <= allowed).all():
        return True
    # Estimate the noise from differences of consecutive rows, which a slow drift hardly affects.
    error = sum(
        np.square(half[1:] - half[:-1]).sum(axis=0) / (2.0 * len(half) * (len(half) - 1))
        for half in halves
        if len(half) > 1
    )
    return bool((difference <= allowed + NOISE_FACTOR * np.sqrt(error)).all())
