# SPDX-License-Identifier: Apache-2.0
"""Reactions of a process to SIGINT (Ctrl-C), SIGTERM and SIGHUP (the terminal was closed).

SIGHUP remains ignored if it is when the process starts, as under `nohup`.

rclpy's own signal handlers are not installed (`SignalHandlerOptions.NO`), because they shut the ROS
context down from a native thread at any moment. A node under construction then fails with "context
is invalid", and a publisher cannot send its last message. Removing the handlers while that thread
runs can crash the process. Instead, one Python handler in the main thread reacts as the current
work requires (`Reaction`). Nodes and tools then end their work and destroy their objects in order.
"""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum, auto
from importlib import import_module
from types import ModuleType

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
INTERRUPTED = 130  # exit status of an interrupted tool
#: under `Reaction.EXIT_SOON`, end the process at the latest this long after the signal [s]
GRACE = 2


class Reaction(Enum):
    """Reaction of a process to a stop signal."""

    #: End the process at once. Used during imports, because extension modules turn a
    #: KeyboardInterrupt during their initialisation into other errors.
    EXIT = auto()
    #: Remember the signal, and end the process if the work lasts longer than `GRACE`. Used while
    #: nodes are constructed, which takes a second, or a minute if numba has to compile.
    EXIT_SOON = auto()
    #: Remember the signal; the running code checks `received`. Used for all code inside rclpy,
    #: which turns a KeyboardInterrupt during message conversion into other errors.
    REMEMBER = auto()
    #: Raise KeyboardInterrupt. Used for the Python code of tools.
    RAISE = auto()


class StopSignals:
    """Handles the stop signals; the only instance, `STOP`, serves the whole process."""

    def __init__(self) -> None:
        self.received = False
        self._reaction = Reaction.RAISE
        self._exit_status = INTERRUPTED

    def install(self, reaction: Reaction, exit_status: int = INTERRUPTED) -> None:
        """Begin to handle the signals.

        Args:
            reaction: Effect of a signal outside `reacting` blocks.
            exit_status: Exit status under `Reaction.EXIT` and `Reaction.EXIT_SOON`.
        """
        self.received, self._reaction, self._exit_status = False, reaction, exit_status
        for number in STOP_SIGNALS:
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, self._on_signal)
        signal.signal(signal.SIGALRM, lambda *_: os._exit(exit_status))

    def ignore(self) -> None:
        """Ignore further signals, so that they do not interrupt Python's shutdown."""
        for number in STOP_SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    @contextmanager
    def reacting(self, reaction: Reaction) -> Iterator[None]:
        """Use another reaction within a `with` block; without `install` this has no effect."""
        before, self._reaction = self._reaction, reaction
        try:
            yield
        finally:
            self._reaction = before
            if reaction is Reaction.EXIT_SOON:
                signal.alarm(0)

    def raise_if_received(self) -> None:
        """Raise KeyboardInterrupt if a signal was received."""
        if self.received:
            raise KeyboardInterrupt

    def _on_signal(self, *_: object) -> None:
        self.received = True
        if self._reaction is Reaction.EXIT:
            os._exit(self._exit_status)
        if self._reaction is Reaction.EXIT_SOON:
            signal.alarm(GRACE)
        if self._reaction is Reaction.RAISE:
            raise KeyboardInterrupt


STOP = StopSignals()


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Block SIGINT and SIGHUP within a `with` block, and in child processes that start there.

    Ctrl-C sends SIGINT to the whole process group, and closing the terminal sends SIGHUP, but only
    the parent may end its children.
    """
    from multiprocessing import resource_tracker

    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})
    try:
        # The resource tracker unblocks SIGINT when it starts. Start it before SIGINT is blocked,
        # because the first child would otherwise start it afterwards.
        resource_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def import_heavy(module: str) -> ModuleType:
    """Import a slow module; a stop signal during the import ends the process immediately."""
    with STOP.reacting(Reaction.EXIT):
        return import_module(module)
