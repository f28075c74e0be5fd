# SPDX-License-Identifier: Apache-2.0
"""The errors of this package, with a common base class."""

from pathlib import Path

LONGEST_TEXT = 4000


def printable(text: object) -> str:
    """Return the first LONGEST_TEXT characters of a text, with non-printable ones escaped.

    Texts from files and messages could otherwise control the user's terminal.
    """
    shown = str(text)[:LONGEST_TEXT]
    return ''.join(c if c.isprintable() else repr(c)[1:-1] for c in shown)


class MusculoskeletalError(Exception):
    """Base class of the errors whose text tells the user what is wrong."""

    #: short text under which messages that are rejected with this error are counted
    reason = 'cannot be used'

    def __str__(self) -> str:
        return printable(super().__str__())


class RobotDescriptionError(MusculoskeletalError):
    """A robot description is invalid, or cannot be used as requested.

    For a wrong entry, the text names the file, the entry and the legal values.
    """


class ParameterError(MusculoskeletalError):
    """A parameter has a value that is not legal; the text begins with the name of the parameter."""


class CheckpointError(MusculoskeletalError):
    """A checkpoint is damaged or does not fit the robot."""

    reason = 'unfit checkpoint'


class GateError(CheckpointError):
    """A checkpoint has failed checkpoint validation; the present network stays in use.

    `estimation/network_validation/validator.py` defines the validation.
    """

    reason = 'does not explain the arm'


class InfeasibleError(MusculoskeletalError):
    """No muscle tensions within the limits produce the given torque, or an input is not finite."""


class DivergedError(MusculoskeletalError):
    """An emulated arm has left the range in which it can be simulated.

    The text names the joint, its value, the legal range, the probable cause and a remedy.
    """


class MessageError(MusculoskeletalError):
    """A received message is invalid or refused; it is counted under the short text `reason`."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f'{reason}: {detail}')
        self.reason = reason


class BagError(MusculoskeletalError):
    """A recording cannot be used as requested.

    It is damaged, lacks required content, or does not fit the request. The text names the problem
    and a remedy.
    """

    def __init__(self, file: Path, problem: str, remedy: str) -> None:
        super().__init__(f'{file}: {problem}; {remedy}')
        self.file, self.problem = file, problem


class StateError(MusculoskeletalError):
    """The learner's state on disk cannot be used or written."""
