# SPDX-License-Identifier: Apache-2.0
"""Keeps a latched stop on disk, so that a controller that is started again is still stopped.

    controller.stop    the stop with which the next controller begins
    controller.lock    locked by the controller that uses the directory

While a controller commands the arm, controller.stop names the stop cause `restarted`. A latched
stop replaces this cause by its own. A controller that ends properly while no stop is latched
deletes controller.stop. The file therefore remains if a stop was latched, or if the controller was
killed or has crashed. A controller that finds controller.stop when it starts is stopped from the
beginning, and moves the arm only after `controller/reset`.
"""

import fcntl
import time
from contextlib import suppress
from pathlib import Path
from typing import TextIO

from musculoskeletal_ae.conditions import Condition, ConditionKind, stop_causes
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.files import read_text

FILE, LOCK = 'controller.stop', 'controller.lock'
#: ignore the content of a larger file, which then counts as the stop cause `restarted` [bytes]
LARGEST = 10_000
RETRY_INTERVAL = 2.0  # wait this long after a failed attempt to write [s]
BEFORE = 'before this controller was started'


class StopMemory:
    """Reads and writes the file that keeps a stop.

    Attributes:
        found: The stop that the previous controller has left behind, or None.
        problem: Why the present stop cannot be kept, or ''.
    """

    def __init__(self, directory: Path | None) -> None:
        """Read the stop that the previous controller has left behind, and lock the directory.

        Args:
            directory: Directory of the file, which is created if it does not exist. With None, no
                stop is read or kept.

        Raises:
            MusculoskeletalError: If the directory cannot be used, or another controller uses it.
        """
        self.found: Condition | None = None
        self.problem = ''
        self._written: ConditionKind | None = None  # the stop cause that the file contains
        self._is_latched = False  # whether the file has to outlive this controller
        self._next_attempt = 0.0
        self._file: Path | None = None
        self._lock: TextIO | None = None
        if directory is None:
            return
        name = f'state_directory {str(directory)!r}'
        try:
            file = directory.expanduser() / FILE
            file.parent.mkdir(parents=True, exist_ok=True)
            self._lock = file.with_name(LOCK).open('w', encoding='utf-8')
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            exists = file.exists()
        except BlockingIOError as error:
            self.close()
            remedy = (
                'stop that controller, or set the parameter state_directory to another directory '
                'if that controller moves another arm'
            )
            raise MusculoskeletalError(f'{name} is in use by a controller; {remedy}') from error
        # A NUL in the path raises a ValueError, and an unknown home directory a RuntimeError.
        except (OSError, ValueError, RuntimeError) as error:
            self.close()
            remedy = (
                "set the parameter state_directory to a writable directory, or to '' to start "
                'without remembering stops (a latched stop then ends with the controller)'
            )
            raise MusculoskeletalError(f'{name} cannot be used ({error}); {remedy}') from error
        self._file = file
        if exists:
            self._is_latched, self._written = True, _cause_in(file)
            self.found = self._written.condition(BEFORE)

    def note(self, stop: Condition | None) -> None:
        """Write the present latched stop to the file.

        If writing fails, `problem` states the reason, and a later call tries again.

        Args:
            stop: The latched stop, or None. Without one, the file has the cause `restarted`, with
                which the controller stops if it restarts after a crash.
        """
        self._is_latched = stop is not None
        cause = ConditionKind.RESTARTED if stop is None else stop.kind
        if self._file is None or cause is self._written or time.monotonic() < self._next_attempt:
            return
        new = self._file.with_name(f'.{FILE}')
        try:
            # Write without fsync, which could delay a command by 0.1 s. If the process is killed,
            # nothing that was written is lost. A power failure may leave an empty file, which
            # counts as `restarted`.
            text = cause.text if stop is None else stop.text
            new.write_text(f'{cause.identifier}\n{text}\n', encoding='utf-8')
            new.replace(self._file)
        except OSError as error:
            self._next_attempt = time.monotonic() + RETRY_INTERVAL
            self.problem = (
                f'the stop cannot be saved, so a restarted controller will not know it: {error}'
            )
        else:
            self._written, self.problem = cause, ''

    def close(self) -> None:
        """Delete the file unless a stop is latched, and release the directory."""
        if self._file is not None and not self._is_latched:
            with suppress(OSError):
                self._file.unlink(missing_ok=True)
        if self._lock is not None:
            self._lock.close()
            self._lock = None
        self._file = None


def _cause_in(file: Path) -> ConditionKind:
    """Return the stop cause in a file; `restarted` if the file states none."""
    with suppress(MusculoskeletalError):
        text = read_text(file, lambda _, problem: MusculoskeletalError(problem), LARGEST)
        for cause in stop_causes():
            if text.partition('\n')[0] == cause.identifier:
                return cause
    return ConditionKind.RESTARTED
