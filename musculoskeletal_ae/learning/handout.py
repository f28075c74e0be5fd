# SPDX-License-Identifier: Apache-2.0
"""Hands checkpoints out at 1 Hz at most: of several that come faster, the latest."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

#: between two checkpoints [s]
LEAST_INTERVAL = 1.0


class Handout:
    """Stands between those who make checkpoints and `publish`; `count` were published."""

    def __init__(self, publish: Callable[[bytes], None]) -> None:
        """Publish nothing yet."""
        self._publish = publish
        self._waiting: bytes | None = None
        self._last = -math.inf
        self.count = 0

    def give(self, data: bytes) -> None:
        """Publish a checkpoint, in the place of one that waits: now or in a later `poll`."""
        self._waiting = data
        self.poll()

    def poll(self) -> None:
        """Publish the one that waits, if the last one is old enough."""
        now = time.monotonic()
        if self._waiting is None or now - self._last < LEAST_INTERVAL:
            return
        data, self._waiting, self._last = self._waiting, None, now
        self.count += 1
        self._publish(data)

    def drop(self) -> None:
        """Forget the one that waits."""
        self._waiting = None
