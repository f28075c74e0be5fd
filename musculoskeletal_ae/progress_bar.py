# SPDX-License-Identifier: Apache-2.0
"""Shows the progress of a long task on stderr: a bar on a terminal, lines of text elsewhere."""

import math
import os
import sys
import time
from collections.abc import Callable

from tqdm import tqdm

REPORT_INTERVAL = 5.0  # print lines of text at this interval [s]
NOTE_INTERVAL = 0.2  # update the note behind a bar at this interval [s]
FORMAT = '{desc}: {percentage:3.0f}%|{bar}| {elapsed}{postfix}'
#: estimate the remaining time only after this time [s] and share of the task; earlier estimates are
#: wrong by large factors
ESTIMATE_TIME, ESTIMATE_SHARE = 5.0, 0.05
SMOOTHING_TIME = 30.0  # average the speed with this time constant [s]


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
    REPORT_INTERVAL, so that short tasks print none. The remaining time is left out until
    ESTIMATE_TIME has passed and, unless all parts take the same time, ESTIMATE_SHARE is done.
    """

    def __init__(
        self,
        title: str,
        total: float = 1.0,
        note: Callable[[], str] | None = None,
        *,
        is_even: bool = False,
        ends_early: bool = False,
    ) -> None:
        """Show the bar, if stderr is a terminal.

        Args:
            title: What the task does, in a few words.
            total: Sum of the parts that `add` will report.
            note: Returns a text on the present state, which is shown beside the progress.
            is_even: Whether all parts take the same time.
            ends_early: Whether the task may end before all parts are done.
        """
        self._about = 'at most about' if ends_early else 'about'
        self._least_share = 0.0 if is_even else ESTIMATE_SHARE
        self._title, self._total, self._note = title, total, note
        self._is_bar = is_bar_visible()
        self._bar = tqdm(
            total=total, desc=title, bar_format=FORMAT, leave=False, disable=not self._is_bar
        )
        self._done = 0.0
        self._first: tuple[float, float] | None = None  # time [s] and sum after the first part
        self._last = 0.0  # time at which the last part was done [s]
        # sums of durations [s] and parts since the first part, in which older parts count less
        self._recent_time = self._recent_parts = 0.0
        self._shown = time.perf_counter()  # time at which the last text was printed [s]

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
        """Count a part as done, and show the progress if the last output is old enough."""
        now = time.perf_counter()
        self._done = min(self._done + part, self._total)
        if self._first is None:
            self._first = now, self._done
        else:
            kept = math.exp((self._last - now) / SMOOTHING_TIME)
            self._recent_time = kept * self._recent_time + now - self._last
            self._recent_parts = kept * self._recent_parts + part
        self._last = now
        if now - self._shown >= (NOTE_INTERVAL if self._is_bar else REPORT_INTERVAL):
            self._shown = now
            self._show(now)
        self._bar.update(self._done - self._bar.n)

    def _show(self, now: float) -> None:
        """Show the note and the remaining time beside the bar, or a line of text."""
        note = '' if self._note is None else self._note()
        texts = ', '.join(filter(None, (note, self._left(now))))
        if self._is_bar:
            self._bar.set_postfix_str(texts, refresh=False)
        else:
            share = f'{self._title}: {100.0 * self._done / self._total:.0f} %'
            self._print(', '.join(filter(None, (share, texts))))

    def _left(self, now: float) -> str:
        """Return the remaining time as a text, or '' while an estimate would be unreliable."""
        assert self._first is not None
        begun, done = self._first
        if now - begun < ESTIMATE_TIME or self._done - done < self._least_share * self._total:
            return ''
        left = (self._total - self._done) * self._recent_time / self._recent_parts
        return f'{self._about} {left:.0f} s left'

    def _print(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)
