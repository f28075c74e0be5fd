# SPDX-License-Identifier: Apache-2.0
"""Ends a node that hangs, and writes the stacks of its threads to stderr.

A timer callback of the node calls `ProgressWatch.note` ten times a second. A watching thread checks
twice a second how long ago the last call was. After 10 s without a call, the thread dumps the
stacks of all threads to stderr and ends the process with status 70. By then, other nodes have long
treated the topics of this node as stale.

A native call that never returns and holds Python's global interpreter lock blocks the watching
thread as well. For this case, the watching thread restarts a timer at each check. After 10 s of CPU
time without a restart, the timer sends SIGVTALRM, which dumps the stacks and ends the process.

The watching thread does not count the time in which the process was suspended. Nor does it count
the time in which the main thread waited for a processor of an overloaded computer. It does not end
a process whose main thread is in a debugger or in numba's compiler.
"""

import faulthandler
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

LONGEST_STALL = 10.0  # end the process after this time without progress [s]
LOOK_PERIOD = 0.5  # check the progress at this interval [s]
STALLED = 70  # exit status of a process that ends because it hangs: EX_SOFTWARE of sysexits.h
#: do not end the process while its main thread runs code of these modules
SLOW_MODULES = ('bdb', 'numba', 'pdb', '_pydevd_bundle')


def waited_for_processor() -> float:
    """Return how long the main thread has waited for a processor since its start [s].

    Returns 0 if the kernel does not provide this time.
    """
    thread = threading.main_thread().native_id
    try:
        _, waited, _ = Path(f'/proc/self/task/{thread}/schedstat').read_text('ascii').split()
    except (OSError, ValueError):
        return 0.0
    return 1e-9 * int(waited)


def end_process() -> None:
    """End the process immediately, after dumping the stacks of all threads."""
    problem = f'no progress for {LONGEST_STALL:g} s; the process ends'
    print(f'{problem}. Stacks of all threads:', file=sys.stderr)
    faulthandler.dump_traceback(all_threads=True)
    os._exit(STALLED)


class ProgressWatch:
    """Watches, between `start` and `stop`, whether the main thread makes progress."""

    def __init__(
        self,
        longest: float = LONGEST_STALL,
        look_period: float = LOOK_PERIOD,
        on_stall: Callable[[], object] = end_process,
        waited: Callable[[], float] = waited_for_processor,
    ) -> None:
        """Prepare the watch; `start` begins it.

        Args:
            longest: Longest legal time without progress [s].
            look_period: Time between two checks [s].
            on_stall: Called in another thread after `longest` without progress.
            waited: Returns how long the main thread has waited for a processor so far [s].
        """
        self._longest, self._look_period, self._on_stall = longest, look_period, on_stall
        self._waited = waited
        self._quiet = 0.0  # time without progress [s]
        self._is_stopped = threading.Event()
        self._thread = threading.Thread(target=self._watch, name='progress', daemon=True)

    def start(self) -> None:
        """Start the watching thread and the timer of CPU time."""
        faulthandler.register(signal.SIGVTALRM, all_threads=True, chain=True)
        # Set the timer here as well as in the thread, because a native call may take Python's lock,
        # and never release it, before the thread runs for the first time.
        signal.setitimer(signal.ITIMER_VIRTUAL, self._longest)
        self._thread.start()

    def note(self) -> None:
        """Note that the main thread makes progress."""
        self._quiet = 0.0

    def stop(self) -> None:
        """Stop watching, so that the main thread may take as long as it needs."""
        if not self._thread.is_alive():  # `start` was not called
            return
        self._is_stopped.set()
        self._thread.join()
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        faulthandler.unregister(signal.SIGVTALRM)

    def _watch(self) -> None:
        before, waited_before = time.monotonic(), self._waited()
        while True:
            signal.setitimer(signal.ITIMER_VIRTUAL, self._longest)
            if self._is_stopped.wait(self._look_period):
                return
            now, waited = time.monotonic(), self._waited()
            # If the wait took much longer than the period, the process was suspended. Therefore
            # count at most two periods.
            passed = min(now - before, 2.0 * self._look_period)
            self._quiet += max(passed - (waited - waited_before), 0.0)
            before, waited_before = now, waited
            if self._quiet > self._longest:
                if not _is_patient():
                    self._on_stall()
                self._quiet = 0.0


def _is_patient() -> bool:
    """Return whether the main thread runs code that may take long without being stuck.

    SLOW_MODULES lists the modules with such code, which are debuggers and a compiler.
    """
    frame = sys._current_frames().get(threading.main_thread().ident or 0)
    while frame is not None:
        if frame.f_globals.get('__name__', '').partition('.')[0] in SLOW_MODULES:
            return True
        frame = frame.f_back
    return False
