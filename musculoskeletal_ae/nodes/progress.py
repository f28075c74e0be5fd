# SPDX-License-Identifier: Apache-2.0
"""Ends a node that makes no progress, and writes down where it hangs.

The executor notes progress ten times a second (`ProgressWatch.note`). A thread looks twice a
second. Without progress for 10 s it dumps the stacks of all threads to stderr and ends the process
with status 70: whoever started the node sees that, and what it published has grown old long ago.

A native call that computes for ever without giving up Python's lock would stop that thread, too.
For this case a timer of processor time ends the process by SIGVTALRM, after a dump of the stacks.

Neither counts time in which the whole process was suspended, nor what a debugger or numba's
compiler takes.
"""

import faulthandler
import os
import signal
import sys
import threading
import time
from collections.abc import Callable

LONGEST = 10.0  # [s] without progress
LOOK_PERIOD = 0.5  # [s]
STALLED = 70  # exit status: EX_SOFTWARE of sysexits.h
#: modules that may take long in the main thread
PATIENT = ('bdb', 'numba', 'pdb', '_pydevd_bundle')


def end_process() -> None:
    """Dump the stacks of all threads, and end the process at once."""
    print(f'no progress for {LONGEST:g} s: ending; the stacks of all threads:', file=sys.stderr)
    faulthandler.dump_traceback(all_threads=True)
    os._exit(STALLED)


class ProgressWatch:
    """Watches the main thread, between `start` and `stop`."""

    def __init__(
        self,
        longest: float = LONGEST,
        look_period: float = LOOK_PERIOD,
        on_stall: Callable[[], object] = end_process,
    ) -> None:
        """Watch nothing yet.

        Args:
            longest: Time without progress [s].
            look_period: Between looks [s].
            on_stall: Is called, in another thread, when there was none for so long.
        """
        self._longest, self._look_period, self._on_stall = longest, look_period, on_stall
        self._quiet = 0.0  # [s]
        self._is_stopped = threading.Event()
        self._thread = threading.Thread(target=self._watch, name='progress', daemon=True)

    def start(self) -> None:
        """Watch from now on."""
        faulthandler.register(signal.SIGVTALRM, all_threads=True, chain=True)
        self._thread.start()

    def note(self) -> None:
        """Note that there is progress."""
        self._quiet = 0.0

    def stop(self) -> None:
        """Watch no longer."""
        if not self._thread.is_alive():  # never started
            return
        self._is_stopped.set()
        self._thread.join()
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        faulthandler.unregister(signal.SIGVTALRM)

    def _watch(self) -> None:
        before = time.monotonic()
        while True:
            signal.setitimer(signal.ITIMER_VIRTUAL, self._longest)
            if self._is_stopped.wait(self._look_period):
                return
            now = time.monotonic()
            # A process that was suspended has had no time for progress.
            self._quiet += min(now - before, 2.0 * self._look_period)
            before = now
            if self._quiet > self._longest:
                if not _is_patient():
                    self._on_stall()
                self._quiet = 0.0


def _is_patient() -> bool:
    """Whether the main thread is in code that may take long."""
    frame = sys._current_frames().get(threading.main_thread().ident or 0)
    while frame is not None:
        if frame.f_globals.get('__name__', '').partition('.')[0] in PATIENT:
            return True
        frame = frame.f_back
    return False
