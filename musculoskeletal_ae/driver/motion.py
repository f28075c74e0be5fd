# SPDX-License-Identifier: Apache-2.0
"""Common parts of the motion tests of both kinds of muscle modules."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Generator, Sequence

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.driver.verdict import Verdict

RELEASE = 0.6  # wait after a release [s]
MEAN = 0.3  # time over which readings are averaged [s]
RELEASE_SPEED = 0.03  # speed at which a target returns [m/s]

Wait = Generator[None, None, None]  # each step takes one message


class RunAwayError(Exception):
    """A muscle exceeds its demand and must be released."""


class MotionTest(ABC):
    """Moves one muscle at a time, with one command per message, and checks the responses."""

    def __init__(self, verdict: Verdict, muscles: Sequence[int]) -> None:
        """Prepare to test muscles, by default all. The verdict receives the results."""
        self.verdict, robot = verdict, verdict.robot
        self._robot, self._muscles = robot, muscles or range(robot.muscle_count)
        self.trying = ''  # current step, for messages
        self.done = False
        self._now = 0.0
        self._recent: deque[tuple[float, Array]] = deque()
        self._target: Array = np.full(robot.muscle_count, np.nan)  # NaN before l is known
        self._run = self._sequence()

    def step(self, states: Array, now: float) -> Array | None:
        """Take l, T, temperature (3, M) at a time [s]; return l_target [m] (M,), or None."""
        self._now = now
        self._recent.append((now, states))
        while now - self._recent[0][0] > MEAN:
            self._recent.popleft()
        self.done = self.done or next(self._run, self) is self
        return None if self.done or np.isnan(self._target).any() else self._target.copy()

    @abstractmethod
    def _sequence(self) -> Wait:
        """Run the whole test."""

    @abstractmethod
    def _wait(self, duration: float) -> Wait:
        """Wait [s]; raise a RunAwayError if a muscle exceeds its demand or moves too far."""

    def _noise(self) -> Array:
        """Return the standard deviation of T over MEAN [N] (M,)."""
        return np.std([states[1] for _, states in self._recent], axis=0)

    def _go(self, m: int, goal: float) -> Wait:
        """Move a target to `goal` [m] at RELEASE_SPEED, and wait."""
        last = self._now
        while self._target[m] != goal:
            yield from self._wait(1e-9)
            most = RELEASE_SPEED * (self._now - last)
            self._target[m] += np.clip(goal - self._target[m], -most, most)
            last = self._now
        yield from self._wait(RELEASE)
