# SPDX-License-Identifier: Apache-2.0
"""A smooth way from one command to another.

    c(t) = c₀ + (3u² − 2u³)(c₁ − c₀),   u = t / duration

starts and ends at rest, and all muscles arrive together. Its fastest moment is 1.5 times its mean
speed; the duration is stretched until no muscle is faster than the rate limit there.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array

PEAK = 1.5  # fastest over mean speed


class Ramp:
    """From a start to a goal.

    Attributes:
        goal: Where it ends, shape (M,).
        done: Whether it has ended.
    """

    def __init__(self, start: Array, goal: Array, duration: float, rate_limit: float) -> None:
        """Plan the way.

        Args:
            start: Command of the moment, shape (M,).
            goal: Command to reach, shape (M,).
            duration: Time it should take [s]; it takes longer if the rate limit asks for it.
            rate_limit: Fastest change of an entry [1/s].
        """
        self._start, self.goal = start.copy(), goal
        farthest = float(np.abs(goal - start).max())
        self.duration = max(duration, PEAK * farthest / rate_limit)
        self._elapsed = 0.0

    @property
    def done(self) -> bool:
        """Whether the goal is reached."""
        return self._elapsed >= self.duration

    def step(self, dt: float) -> Array:
        """Return the command dt seconds on."""
        self._elapsed += dt
        u = 1.0 if self.done else self._elapsed / self.duration
        command: Array = self._start + (3.0 - 2.0 * u) * u * u * (self.goal - self._start)
        return command
