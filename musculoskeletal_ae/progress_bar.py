# SPDX-License-Identifier: Apache-2.0
"""Shows the progress of a long task on stderr: a bar on a terminal, lines of text elsewhere."""

import os
import sys
import time
from collections.abc import Callable

from tqdm import tqdm

REPORT_INTERVAL = 5.0  # time between two lines of text [s]
NOTE_INTERVAL = 0.2  # time between two updates of the note behind a bar [s]
FORMAT = '{desc}: {percentage:3.0f}%|{bar}| {elapsed} < {remaining}{postfix}'


def is_bar_visible() -> bool:
    """Return whether stderr is a terminal that can show a bar.

    Some terminals, such as those of `docker exec` and of serial lines, report a width of 0 columns.
    A bar would be empty there.
    """
    try:
        return sys.stderr.isatty() and os.get_terminal_size(sys.stderr.fileno()).columns > 0
    except (OSError, ValueError):  # stderr is closed, or no file
        return False


class ProgressBar:
    """The progress of one task; use it as a context manager, and call `add` after each part.

    Lines of text look like `training: 40 %, loss 0.0213, about 12 s left`. They are printed every
    REPORT_INTERVAL, so that short tasks print none.
    """

    def __init__(
        self, title: str, total: float = 1.0, note: Callable[[], str] | None = None
    ) -> None:
        """Show the bar, if stderr is a terminal.

        Args:
            title: What is being done.
            total: Sum of all parts.
            note: Returns a text on the present state, which is shown beside the progress.
        """
        self._title, self._total, self._note = title, total, note
        self._is_bar = is_bar_visible()
        self._bar = tqdm(
            total=total, desc=title, bar_format=FORMAT, leave=False, disable=not self._is_bar
        )
        self._done = 0.0
        self._first: tuple[float, float] | None = None  # time [s] and sum after the first part
        self._shown = time.perf_counter()  # time of the last line of text or note [s]

    def __enter__(self) -> 'ProgressBar':
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def announce(self, more: str = '') -> None:
        """Print the title as a line of text, unless a bar already shows it.

        Args:
            more: Text that follows the title.
        """
        if not self._is_bar:
            self._print(f'{self._title}{more}')

    def add(self, part: float = 1.0) -> None:
        """Count a part as done, and show the progress if it is time to."""
        now = time.perf_counter()
        self._done = min(self._done + part, self._total)
        if self._first is None:
            self._first = now, self._done
        elif self._is_bar:
            if self._note is not None and now - self._shown >= NOTE_INTERVAL:
                self._shown = now
                self._bar.set_postfix_str(self._note(), refresh=False)
        elif now - self._shown >= REPORT_INTERVAL:
            self._shown = now
            begun, done = self._first
            share = 100.0 * self._done / self._total
            left = (self._total - self._done) / (self._done - done) * (now - begun)
            note = '' if self._note is None else f', {self._note()}'
            self._print(f'{self._title}: {share:.0f} %{note}, about {left:.0f} s left')
        self._bar.update(self._done - self._bar.n)

    def _print(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)
