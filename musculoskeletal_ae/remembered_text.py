# SPDX-License-Identifier: Apache-2.0
"""A small text file from which a restarted node reads the state that it had before.

The file is replaced as a whole, but without fsync, which could delay a command or an estimate by
0.1 s. If the process is killed, nothing that was written is lost. A power failure may leave an
empty file, which a reader has to treat as damaged.
"""

import time
from contextlib import suppress
from pathlib import Path

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.files import read_text

LARGEST = 1_000_000  # treat a larger file as damaged [bytes]
RETRY_INTERVAL = 2.0  # wait this long after a failed attempt to write [s]


class RememberedText:
    """Reads and replaces one such file.

    Attributes:
        problem: What is lost because the last text could not be saved, and why, as a text for
            users; '' if it was saved.
    """

    def __init__(self, file: Path, lost: str) -> None:
        """Use a file, whose directory is created by the first `write`.

        Args:
            file: The file.
            lost: What is lost if a text cannot be saved, for `problem`.
        """
        self._file, self._lost = file, lost
        self._next_attempt = 0.0
        self.problem = ''

    def read(self) -> str | None:
        """Return the text of the file; None without a file, and '' if it cannot be read.

        Raises:
            OSError: If the directory cannot be used.
            ValueError: If there is a NUL in the path.
        """
        if not self._file.exists():
            return None
        with suppress(MusculoskeletalError):
            return read_text(self._file, lambda _, problem: MusculoskeletalError(problem), LARGEST)
        return ''

    def write(self, text: str) -> bool:
        """Replace the text of the file, and return whether that succeeded.

        If it fails, `problem` states the reason, and a call in the next 2 s (RETRY_INTERVAL) does
        nothing.
        """
        if time.monotonic() < self._next_attempt:
            return False
        new = self._file.with_name(f'.{self._file.name}')
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            new.write_text(text, encoding='utf-8')
            new.replace(self._file)
        except OSError as error:
            self._next_attempt = time.monotonic() + RETRY_INTERVAL
            self.problem = f'{self._lost}: {error}'
            return False
        self.problem = ''
        return True

    def keep(self) -> None:
        """Keep the text of the file, because it is right again; clear `problem`."""
        self.problem = ''

    def delete(self) -> None:
        """Delete the file, if that is possible."""
        with suppress(OSError):
            self._file.unlink(missing_ok=True)
