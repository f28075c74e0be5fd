# SPDX-License-Identifier: Apache-2.0
"""Keeps a latched stop on disk, so that a controller that is started again is still stopped.

    controller.stop    the stop with which the next controller begins
    controller.lock    locked by the controller that uses the directory

While a controller commands the arm, controller.stop contains the word `running`. A latched stop
replaces this word by its cause. A controller that ends properly while no stop is latched deletes
controller.stop. The file therefore remains if a stop was latched, or if the controller was killed
or has crashed. A controller that finds controller.stop when it starts is stopped from the
beginning. It moves the arm only after `controller/reset`, or after a verification that ends a stop
by an anomaly. If the file names no cause, the cause is `restarted`.
"""

from pathlib import Path
from typing import TextIO

from musculoskeletal_ae.conditions import Condition, ConditionKind, stop_causes
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.files import locked
from musculoskeletal_ae.remembered_text import RememberedText

RUNNING = 'running'  # the word in the file while a controller commands the arm
FILE, LOCK = 'controller.stop', 'controller.lock'
BEFORE = 'before this controller was started'
LOST = 'the stop cannot be saved, so a restarted controller may not know it, or not its cause'


class StopMemory:
    """Reads and writes the file that keeps a stop.

    Attributes:
        found: The stop that the previous controller has left behind, or None.
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
        #: the word that the file certainly contains, RUNNING or a stop cause; None if there is none
        self._written: str | None = None
        self._file: RememberedText | None = None
        self._lock: TextIO | None = None
        if directory is None:
            return
        name = f'state_directory {str(directory)!r}'
        try:
            file = directory.expanduser() / FILE
            file.parent.mkdir(parents=True, exist_ok=True)
            self._lock = locked(file.with_name(LOCK))
            remembered = RememberedText(file, LOST)
            text = remembered.read()
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
        self._file = remembered
        if text is not None:
            cause = _cause_in(text)
            self.found, self._written = cause.condition(BEFORE), cause.identifier

    def note(self, stop: Condition | None) -> None:
        """Write the present latched stop to the file.

        If writing fails, `problem` states the reason, and a later call tries again.

        Args:
            stop: The latched stop, or None if the controller commands the arm.
        """
        word, text = RUNNING, 'a controller commands the arm'
        if stop is not None:
            word, text = stop.kind.identifier, stop.text
        if self._file is None or word == self._written:
            return
        self._written = None
        if self._file.write(f'{word}\n{text}\n'):
            self._written = word

    @property
    def problem(self) -> str:
        """Why the present stop cannot be kept, as a text for users; '' if it is kept."""
        return '' if self._file is None else self._file.problem

    def close(self) -> None:
        """Delete the file unless it may contain a stop, and release the directory."""
        if self._file is not None and self._written == RUNNING:
            self._file.delete()
        if self._lock is not None:
            self._lock.close()
            self._lock = None
        self._file = None


def _cause_in(text: str) -> ConditionKind:
    """Return the stop cause in the text of a file; `restarted` if the text names none."""
    for cause in stop_causes():
        if text.partition('\n')[0] == cause.identifier:
            return cause
    return ConditionKind.RESTARTED
