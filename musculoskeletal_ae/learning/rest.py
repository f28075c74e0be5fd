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
from operator import itemgetter

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.samples import NOTHING, Sample
from musculoskeletal_ae.learning.settings import Settings

LONGEST = 1.0  # [s] of rest that one sample averages
MOST = 20_000  # readings of one rest: an end where the clock stands still
LEAST_READINGS = 4  # in half of `rest_time`, which slow messages make longer: fewer hide a drift
SURE = 3.0  # standard errors that a difference of means may have by chance


class RestDetector:
    """Turns the stream of readings into one mean per rest."""

    def __init__(
        self, settings: Settings, blind: bool = False, radian: Array | float = 1.0
    ) -> None:
        """Start with an empty window; `radian` is that of `SampleStore`."""
        self.settings, self.blind, self._radian = settings, blind, radian
        self._window: deque[tuple[float, Sample]] = deque(maxlen=MOST)
        # Rows from `_first` on are (l, θ) of the window's readings: no new array for every message.
        self._rows, self._first = np.empty((0, 1)), 0
        self.reset()

    def reset(self) -> None:
        """Forget the window, as after a jump of the clock."""
        self._window.clear()
        self._read_at, self._periods = 0.0, (0.0, 0.0)  # of messages that count, the last two [s]
        self._rest: list[Sample] = []
        self._gravity: list[Array] = []  # what counts of it in the rest
        self._since = 0.0  # when the arm was found still [s]
        self._span = self._time = 0.0
        self._still = False

    def step(self, reading: Sample, dt: float) -> Sample | None:
        """Take a message, `dt` [s] after the one before, with θ NaN where none was measured.

        Returns the mean of a rest that ended or is long enough.
        """
        self._time += dt
        self._append(reading)
        if self.blind or _measured(reading):
            self._periods = self._periods[1], self._time - self._read_at
            self._read_at = self._time
        # The shorter one: a hole is no rate.
        readings = (2 * LEAST_READINGS + 1) * min(self._periods)
        self._needed = max(self.settings.rest_time, readings)
        while self._time - self._window[0][0] > self._needed + 1e-9:
            self._window.popleft()
            self._first += 1
        was_still, self._still = self._still, self._is_still()
        if not self._still and not was_still:
            return None
        if self._still:
            new = [reading] if was_still else [reading for _, reading in self._window]
            self._rest += new if self.blind else filter(_measured, new)
            self._since = self._since if was_still else self._time
            time, earlier = self._window[0]
            if time >= self._since:
                self._gravity.append(earlier.gravity)
            self._span = self._span + dt if was_still else self._needed
            if self._span < LONGEST and len(self._rest) < MOST:
                return None
        rest, self._rest, self._span = self._rest, [], 0.0
        gravity, self._gravity = self._gravity, []
        if not rest:
            return None
        theta, tension, length, direction = (_mean(np.array(part)) for part in [*zip(*rest)][:4])
        # All messages of a rest were taken under one body state.
        return rest[-1]._replace(
            theta=theta,
            tension=tension,
            length=length,
            direction=direction,
            gravity=_mean(np.array(gravity)) if gravity else NOTHING,
        )

    def _append(self, reading: Sample) -> None:
        held = min(len(self._window), MOST - 1)  # of which one goes when the window is full
        self._first += len(self._window) - held
        row = np.concatenate((reading.length, reading.theta))
        if self._first + held == len(self._rows):
            kept = self._rows[self._first :]
            self._rows, self._first = np.empty((2 * held + 100, len(row))), 0
            self._rows[:held] = kept
        self._rows[self._first + held] = row
        self._window.append((self._time, reading))

    def _is_still(self) -> bool:
        half = 0.5 * self._needed
        if self._time - self._window[0][0] <= 0.7 * self._needed:
            return False
        cut = bisect_right(self._window, self._time - half, key=itemgetter(0))
        middle, end = self._first + cut, self._first + len(self._window)
        halves = self._rows[self._first : middle], self._rows[middle:end]
        muscles = len(self._window[0][1].length)
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


def _measured(reading: Sample) -> bool:
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
