# SPDX-License-Identifier: Apache-2.0
"""Errors of this package: one base, so that a caller can catch all of them."""

import io
import sys
from pathlib import Path

LONGEST_TEXT = 4000


def printable(text: object) -> str:
    """Return a text that can do nothing to a terminal: what is not printable is escaped."""
    shown = str(text)[:LONGEST_TEXT]
    return ''.join(c if c.isprintable() else repr(c)[1:-1] for c in shown)


def replace_unprintable() -> None:
    """Let what the terminal's encoding lacks, such as θ in ISO-8859-1, be replaced by "?"."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors='replace')


class MusculoskeletalError(Exception):
    """Base of every error this package raises on purpose."""

    reason = 'cannot be used'  # in a few words, what a rejected message is counted under

    def __str__(self) -> str:
        return printable(super().__str__())


class RobotDescriptionError(MusculoskeletalError):
    """A robot directory that cannot be used; names the file, the entry and what is legal."""


class CheckpointError(MusculoskeletalError):
    """A checkpoint that is damaged or does not fit the robot."""

    reason = 'unfit checkpoint'


class GateError(CheckpointError):
    """A checkpoint that does not explain the arm; the one in use stays.

    `estimation/checkpoint_validation.py` has the rules.
    """

    reason = 'does not explain the arm'


class InfeasibleError(MusculoskeletalError):
    """No muscle tension within its limits does what was asked."""


class MessageError(MusculoskeletalError):
    """A received message that breaks a rule of validity."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f'{reason}: {detail}')
        self.reason = reason


class BagError(MusculoskeletalError):
    """A recording that is damaged, or not what it says it is."""

    def __init__(self, file: Path, problem: str, remedy: str) -> None:
        super().__init__(f'{file}: {problem}; {remedy}')
        self.file = file


class StateError(MusculoskeletalError):
    """What a learner keeps on disk cannot be used or written."""
