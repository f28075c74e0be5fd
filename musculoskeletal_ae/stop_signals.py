# SPDX-License-Identifier: Apache-2.0
"""How a process answers SIGINT (Ctrl-C) and SIGTERM.

rclpy's own signal handlers are not installed (`SignalHandlerOptions.NO`). They shut the ROS context
down from a native thread, at any moment: a node under construction then fails with "context is
invalid", a publisher is dead before its last message, and removing the handlers while that thread
runs can crash. Instead one Python handler, which runs in the main thread, does what suits the work
in progress (`Reaction`). Nodes and tools then end their work and destroy what they made, in order.
"""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum, auto
from importlib import import_module
from types import ModuleType

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
INTERRUPTED = 130  # exit status of a tool
GRACE = 2  # [s] that `Reaction.EXIT_SOON` leaves


class Reaction(Enum):
    """What a stop signal does."""

    #: End the process at once. For imports: a KeyboardInterrupt inside the initialisation of an
    #: extension module turns into other errors.
    EXIT = auto()
    #: Remember the signal, and end the process if it still works on the same after `GRACE`. For
    #: the construction of nodes, which takes a second, but a minute while numba compiles.
    EXIT_SOON = auto()
    #: Remember the signal; whoever works looks at `received`. For everything that runs inside
    #: rclpy, which turns a KeyboardInterrupt that is raised while it converts a message into
    #: other errors.
    REMEMBER = auto()
    #: Raise KeyboardInterrupt. For the Python code of a tool.
    RAISE = auto()


class StopSignals:
    """The handler of both signals; it belongs to the process, so that there is one (`STOP`)."""

    def __init__(self) -> None:
        self.received = False
        self._reaction = Reaction.RAISE
        self._exit_status = INTERRUPTED

    def install(self, reaction: Reaction, exit_status: int = INTERRUPTED) -> None:
        """Handle the signals from now on; `exit_status` is that of `Reaction.EXIT`."""
        self.received, self._reaction, self._exit_status = False, reaction, exit_status
        for number in STOP_SIGNALS:
            signal.signal(number, self._on_signal)
        signal.signal(signal.SIGALRM, lambda *_: os._exit(exit_status))

    def ignore(self) -> None:
        """Ignore further signals: nothing that Python does at its end should be interrupted."""
        for number in STOP_SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    @contextmanager
    def reacting(self, reaction: Reaction) -> Iterator[None]:
        """React in another way within a `with` block; without `install` it changes nothing."""
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


def import_heavy(module: str) -> ModuleType:
    """Import a module that takes a while; a stop signal meanwhile ends the process at once."""
    with STOP.reacting(Reaction.EXIT):
        return import_module(module)
