# SPDX-License-Identifier: Apache-2.0
"""The file of the newest network: replaced as a whole, and made good when that failed."""

from __future__ import annotations

import time
from pathlib import Path

from musculoskeletal_ae.learning.sample_log import PAUSE
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot


class NetworkFile:
    """Where a learner's network is; `trouble` says why the newest one is not there, or ''."""

    def __init__(self, path: Path, robot: Robot) -> None:
        """Write nothing yet."""
        self.path = path
        self._robot = robot
        self._retry_at = 0.0
        self.trouble = ''

    def save(self, mae: Mae) -> None:
        """Keep a network in the place of the one before.

        Raises:
            OSError: If the disk is full or gone; the one before stays then.
        """
        checkpoint.save(mae, self.path)
        self.trouble = ''

    def keep(self, mae: Mae) -> None:
        """Keep a network, or be in trouble."""
        try:
            self.save(mae)
        except OSError as error:
            self.outcome(str(error))

    def outcome(self, unsaved: str) -> None:
        """Note why another process could not save the newest network, or '' if it could."""
        self.trouble = f'the network cannot be saved: {unsaved}' if unsaved else ''
        self._retry_at = time.monotonic() + PAUSE

    def heal(self, data: bytes) -> None:
        """Try again to save the newest network; does nothing where it is saved."""
        if self.trouble and time.monotonic() >= self._retry_at:
            self.keep(checkpoint.from_bytes(data, self._robot))
