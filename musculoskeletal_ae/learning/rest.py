# SPDX-License-Identifier: Apache-2.0
"""When the arm is at rest, and the mean of what the sensors said meanwhile.

The arm rests while the means of the two halves of a short window differ by no more than the given
rates allow, beyond what the sensors' own scatter explains (a camera's θ is far noisier than a joint
sensor's). The rest is averaged until it ends, or for `LONGEST` at a time.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.sample import Sample

LONGEST = 1.0  # [s] of rest that one sample averages
MOST = 5000  # readings of one rest: an end where the clock stands still
SURE = 3.0  # standard errors that a difference of means may have by chance


@dataclass(frozen=True)
class RestSettings:
    """What counts as rest.

    Attributes:
        window: How long the arm has to be still [s].
        joint_rate: Highest rate of a joint [rad/s].
        length_rate: Highest rate of a muscle length [m/s].
        least_readings: Of θ in half a window.
    """

    window: float = 0.3
    joint_rate: float = 0.02
    length_rate: float = 0.002
    least_readings: int = 2


class RestDetector:
    """Turns the stream of readings into one mean per rest."""

    def __init__(self, settings: RestSettings) -> None:
        """Start with an empty window."""
        self.settings = settings
        self._window: deque[tuple[float, Array | None, Sample]] = deque(maxlen=MOST)
        self._rest: list[Sample] = []
        self._span = 0.0
        self._time = 0.0
        self._still = False

    def reset(self) -> None:
        """Forget the window, as after a jump of the clock."""
        self._window.clear()
        self._rest.clear()
        self._span, self._time, self._still = 0.0, 0.0, False

    @property
    def still(self) -> bool:
        """Whether the arm is at rest now."""
        return self._still

    def step(self, reading: Sample, measured: bool, dt: float) -> Sample | None:
        """Take one reading; return the mean of a rest that ended or is long enough.

        Args:
            reading: One message; its θ counts only if it was `measured`.
            measured: Whether a θ belongs to this message.
            dt: Time since the message before [s].
        """
        self._time += dt
        self._window.append((self._time, reading.theta if measured else None, reading))
        while self._time - self._window[0][0] > self.settings.window + 1e-9:
            self._window.popleft()
        was_still, self._still = self._still, self._is_still()
        if self._still:
            if not was_still:
                self._rest = [r for _, theta, r in self._window if theta is not None]
                self._span = self.settings.window
            else:
                self._span += dt
                if measured:
                    self._rest.append(reading)
            if self._span < LONGEST and len(self._rest) < MOST:
                return None
        elif not was_still:
            return None
        return self._finish()

    def _finish(self) -> Sample | None:
        if not self._rest:
            return None
        columns = (np.mean(column, axis=0) for column in zip(*self._rest, strict=True))
        self._rest, self._span = [], 0.0
        return Sample(*columns)

    def _is_still(self) -> bool:
        half = 0.5 * self.settings.window
        if self._time - self._window[0][0] < 0.9 * self.settings.window:
            return False
        middle = self._time - half
        first = [(theta, r) for t, theta, r in self._window if t <= middle]
        second = [(theta, r) for t, theta, r in self._window if t > middle]
        angles = [np.array([a for a, _ in part if a is not None]) for part in (first, second)]
        if min(map(len, angles)) < self.settings.least_readings:
            return False
        lengths = [np.array([r.length for _, r in part]) for part in (first, second)]
        return _unmoved(angles, self.settings.joint_rate * half) and _unmoved(
            lengths, self.settings.length_rate * half
        )


def _unmoved(halves: list[Array], allowed: float) -> bool:
    first, second = halves
    difference = np.abs(second.mean(axis=0) - first.mean(axis=0))
    if (difference <= allowed).all():
        return True
    # Taken from neighbours' differences, which a slow drift hardly enters.
    error = sum(
        np.square(np.diff(half, axis=0)).mean(axis=0) / (2.0 * len(half))
        for half in halves
        if len(half) > 1
    )
    return bool((difference <= allowed + SURE * np.sqrt(error)).all())
