# SPDX-License-Identifier: Apache-2.0
"""Decides when a visitor has finished entering a value, so that it may be sent.

Each slider has a box for numbers. viser reports every change of either, and does not say which of
them the visitor used: while somebody types -1.2 into the box, the slider first becomes -1. Nobody
types as fast as a dragged slider changes. The rate of changes therefore shows which one was used.
"""

import threading
from collections import deque

SETTLE_TIME = 0.7  # count a value as complete after this time without a change [s]
#: A slider is being dragged if it has changed DRAG_CHANGES times within DRAG_TIME [s]. viser
#: reports up to 20 changes per second; typing a number changes its value at most four times.
DRAG_CHANGES, DRAG_TIME = 5, 0.5
HOLD_TIME = 3.0  # keep a slider from following the arm for this time after a change [s]
Key = tuple[str, str]  # a request and the label of a slider


class Entries:
    """Values that visitors are entering, by request and label; may be used by several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._changes: dict[Key, deque[float]] = {}  # times of the last changes [s]
        #: values that a visitor has entered and that `take` has not returned yet
        self._values: dict[Key, float] = {}

    def change(self, key: Key, value: float, now: float) -> None:
        """Record that a visitor has changed a value at the time `now` [s]."""
        with self._lock:
            self._changes.setdefault(key, deque(maxlen=DRAG_CHANGES)).append(now)
            self._values[key] = value

    def take(self, now: float) -> dict[Key, float]:
        """Return the values that are complete at the time `now` [s], each in one call only."""
        with self._lock:
            complete = {key: self._values[key] for key in self._values if self._ended(key, now)}
            for key in complete:
                del self._values[key]
        return complete

    def _ended(self, key: Key, now: float) -> bool:
        times = self._changes[key]
        is_dragged = len(times) == DRAG_CHANGES and times[-1] - times[0] < DRAG_TIME
        return is_dragged or now - times[-1] >= SETTLE_TIME

    def discard(self) -> None:
        """Discard the values that `take` has not returned yet."""
        with self._lock:
            self._values.clear()

    def are_recent(self, what: str, now: float) -> bool:
        """Return whether a value of the request `what` was changed shortly before `now` [s]."""
        with self._lock:
            return any(
                key[0] == what and now - times[-1] < HOLD_TIME
                for key, times in self._changes.items()
            )
