# SPDX-License-Identifier: Apache-2.0
"""From the stream of messages to samples: rest, novelty, and the gate that anomalies close.

What comes within `MARGIN` before an anomaly is noticed was already wrong; samples and healthy
messages therefore wait that long before they count.
"""

from __future__ import annotations

from collections import Counter, deque
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.healthy import Healthy, Reservoir
from musculoskeletal_ae.learning.rest import RestDetector, RestSettings
from musculoskeletal_ae.learning.sample import Sample
from musculoskeletal_ae.learning.sliding import SlidingTracker
from musculoskeletal_ae.learning.store import Novelty, SampleStore
from musculoskeletal_ae.robot.robot import Robot

MARGIN = 2.0  # [s] before a detection and after its reset
# Beyond these a sensor errs, not the arm.
OUTSIDE = 0.1  # of the joint's range
TOO_TENSE = 1.1  # of tension.max
POSTURES = 500  # that tell how long the muscles get
LENGTH_MARGIN = 0.1  # [m], for wires that wrap, wind slack, or were tied elsewhere
#: messages that wait at most: more than MARGIN at 1 kHz, and an end where the clock stands still
MOST_WAITING = 5000


class Waiting(NamedTuple):
    """Something that counts once no anomaly has followed it for MARGIN."""

    time: float
    dt: float
    tension: Array
    length: Array
    sample: Sample | None


class Collector:
    """Steps through the messages and keeps what may be learned.

    Attributes:
        store: The samples.
        reservoir: Healthy messages, moving and resting.
        rejected: Messages that no sensor measures and rests that did not become samples, by reason.
    """

    def __init__(
        self,
        robot: Robot,
        rest: RestSettings | None = None,
        novelty: Novelty | None = None,
        seed: int = 0,
    ) -> None:
        """Watch `robot`."""
        self._robot = robot
        self.store = SampleStore(novelty)
        self.reservoir = Reservoir(robot.muscle_count, seed)
        self.rejected: Counter[str] = Counter()
        #: rests that differ, since the reservoir was cleared
        self._rests = SampleStore(novelty)
        self._rest = RestDetector(rest or RestSettings())
        self._longest = _longest(robot)
        self._sliding = SlidingTracker(robot.muscle_count)
        self._waiting: deque[Waiting] = deque(maxlen=MOST_WAITING)
        self._time = self._skipped = 0.0
        self._closed_until = 0.0
        self._anomaly = False

    def step(
        self, tension: Array, length: Array, dt: float, theta: Array | None = None
    ) -> Sample | None:
        """Take one message of the muscle modules; return a sample that has just been accepted.

        Args:
            tension: T [N], shape (M,).
            length: l [m], shape (M,).
            dt: Time since the message before [s].
            theta: θ measured at the same time [rad], shape (D,); None without.
        """
        self._time += dt
        dt += self._skipped
        if implausible := self._implausible(tension, length, theta):
            self.rejected[implausible] += 1
            self._skipped = dt
            return None
        self._skipped = 0.0
        sliding = self._sliding.step(length, dt)
        nothing = np.full(self._robot.joint_count, np.nan)
        reading = Sample(nothing if theta is None else theta, tension, length, sliding)
        rest = self._rest.step(reading, theta is not None, dt)
        if self._anomaly or self._time < self._closed_until:
            if rest is not None:
                self.rejected['anomaly'] += 1
            return None
        self._waiting.append(Waiting(self._time, dt, tension, length, rest))
        accepted = None
        while self._waiting and self._time - self._waiting[0].time >= MARGIN:
            passed = self._waiting.popleft()
            self.reservoir.step(passed.tension, passed.length, passed.dt)
            if passed.sample is not None and self._accept(passed.sample):
                accepted = passed.sample
        return accepted

    def _implausible(self, tension: Array, length: Array, theta: Array | None) -> str:
        """Return why no sensor of this arm measures that, or ''."""
        if (tension > TOO_TENSE * self._robot.tension.max).any():
            return 'tension beyond the maximum'
        if (np.abs(length) > self._longest).any():
            return 'length beyond what the joints allow'
        if theta is not None:
            reach = self._robot.upper - self._robot.lower
            beyond = np.maximum(theta - self._robot.upper, self._robot.lower - theta)
            if (beyond > OUTSIDE * reach).any():
                return 'θ far outside the joint limits'
        return ''

    def _accept(self, sample: Sample) -> bool:
        if self._rests.is_new(sample):
            self._rests.add(sample)
        if not self.store.is_new(sample):
            self.rejected['like a stored one'] += 1
            return False
        self.store.add(sample)
        return True

    def healthy(self) -> Healthy:
        """Return what was seen of the healthy arm."""
        return Healthy(self.reservoir.messages(), self.reservoir.time, len(self._rests))

    def _forget_healthy(self) -> None:
        self.reservoir.clear()
        self._rests.clear()

    def set_anomaly(self, detected: bool) -> None:
        """Close the gate on an anomaly, open it some time after the reset."""
        if detected and not self._anomaly:
            lost = sum(1 for waiting in self._waiting if waiting.sample is not None)
            self.rejected['anomaly'] += lost
            self._waiting.clear()
        if self._anomaly and not detected:
            self._closed_until = self._time + MARGIN
        self._anomaly = detected

    def relearn(self, muscle: int, newest: int = 0) -> None:
        """Let older samples say nothing about a muscle; its healthy residuals are unknown again."""
        self.store.forget(muscle, newest)
        self._forget_healthy()
        if newest == 0:
            self.reset()

    def clear(self) -> None:
        """Forget everything learned."""
        self.store.clear()
        self._forget_healthy()
        self.reset()

    def reset(self) -> None:
        """Forget what is not a sample yet, as after a backward jump of the clock."""
        self._skipped = 0.0
        self._rest.reset()
        self._sliding.reset()
        self._waiting.clear()


def _longest(robot: Robot) -> Array:
    """Return |l| of every muscle that no posture passes [m], shape (M,)."""
    theta = robot.random_postures(POSTURES, np.random.default_rng(0), OUTSIDE)
    slack = np.zeros((POSTURES, robot.muscle_count))
    length = np.abs(
        [robot.muscle_lengths(theta, slack + pull) for pull in (0.0, robot.tension.max)]
    )
    longest: Array = length.max(axis=(0, 1)) + LENGTH_MARGIN
    return longest
