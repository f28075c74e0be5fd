# SPDX-License-Identifier: Apache-2.0
"""Observations and findings of detectors, and the interface of all detectors.

For each message, the estimator calls the methods of all detectors (`Detector`) in this order:

    read          every message of a legal shape, also without a network, and if it is rejected
    step          a message for which there is an estimate, at most one in 6 ms (SPACING)
    step_healthy  the same message, unless there is an anomaly or a length offset is unknown
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.conditions import Condition, ConditionKind, Revokes
from musculoskeletal_ae.estimation.contact import Contact
from musculoskeletal_ae.estimation.estimate import Estimate
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.signals.muscle_states import MuscleReadings
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

#: discard messages that arrived within this time before a fault was detected [s], because the fault
#: may have begun that much earlier
DETECTION_DELAY = 2.0


@dataclass(frozen=True)
class Finding:
    """A fault that a detector has found, and the muscle to which it is attributed.

    Attributes:
        muscle: Index of the most suspect muscle. If several muscles are faulty, it is one of them.
        kind: Kind of the fault. Its declaration states the consequence and the remedy.
        evidence: The evidence as a text for users.
        others: Indices of further muscles that are also faulty, or that may be faulty instead of
            `muscle`.
    """

    muscle: int
    kind: ConditionKind
    evidence: str
    others: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Refuse a kind that is no finding: it neither stops the arm nor isolates a muscle."""
        if self.kind.reaction is None:
            raise ValueError(
                f'{self.kind.identifier} has no reaction that stops the arm or isolates a muscle; '
                'report it as a condition instead'
            )

    @property
    def muscles(self) -> tuple[int, ...]:
        """Indices of all muscles that the fault may concern, the most suspect one first."""
        return (self.muscle, *self.others)

    @property
    def is_of_one_length(self) -> bool:
        """Whether the finding makes a single length unreliable, that of `muscle`."""
        return self.kind.revokes is Revokes.ONE


def jump_finding(jumped: tuple[int, ...]) -> Finding:
    """Return the finding that the lengths of one or several muscles have jumped, and stay changed.

    `signals/length_jumps.py` rejects messages with a jump. If the new lengths persist, messages are
    accepted again, and the first sample names these muscles (`MuscleSample.jumped`).
    """
    if len(jumped) == 1:
        return Finding(jumped[0], ConditionKind.LENGTH_JUMP, 'its length jumped')
    others = '1 other length' if len(jumped) == 2 else f'{len(jumped) - 1} other lengths'
    evidence = f'its length and {others} jumped'
    return Finding(jumped[0], ConditionKind.LENGTHS_JUMPED, evidence)


@dataclass(frozen=True, eq=False)
class Observation:
    """One message as the input of the detectors.

    Attributes:
        sample: The checked readings.
        estimate: The network's estimate for these readings.
        demand: Tensions that the newest command demands of the muscle modules [N], (M,); None
            without a command, and for position-controlled modules.
        dt: Time since the previous message [s]; the caller limits it after a pause.
        lengths_known: Whether the length offsets are known.
        measured: Joint angles from joint sensors [rad], (D,); None unless all are measured.
        command: Target lengths of the muscle modules [m], (M,); None without a length command.
        joints: Usable readings of the joint sensors [rad], (D,), also of sensors that are not
            trusted; NaN for joints without a reading. None if no readings are stated.
        now: Time of the message on a steady clock [s].
    """

    sample: MuscleSample
    estimate: Estimate
    demand: Array | None
    dt: float
    lengths_known: bool = True
    measured: Array | None = None
    command: Array | None = None
    joints: Array | None = None
    now: float = 0.0


class Detector:
    """Base class of the detectors, each of which watches the readings for one kind of fault.

    A fault that stops the arm or isolates a muscle is returned as a `Finding`, which
    `SuspectHandling` latches. A fault that only warns is a condition. All methods do nothing here;
    a new detector overrides those that it needs. To use it, add it to the list in `HealthMonitor`.
    """

    def use(self, mae: Mae) -> None:
        """Use another network; its isolated muscles are ignored."""

    def reset(self) -> None:
        """Reset the detector, for example after a jump of the clock or a reset by the user."""

    def forget(self) -> None:
        """Forget all stored messages, because the length offsets have changed."""

    def accept(self) -> None:
        """Accept the present state of the body as healthy, because a user says so."""

    def read(self, readings: MuscleReadings, usable: Bools, now: float) -> Finding | None:
        """Check the readings of a message, even of a rejected one; return a finding or None.

        Args:
            readings: The readings of the sensors. Values of isolated muscles, and tensions of a
                robot that does not measure them, have no meaning and may be NaN.
            usable: Whether each muscle is used, (M,).
            now: Time of the message on a steady clock [s].
        """

    def follow(self, sample: MuscleSample, elapsed: float) -> None:
        """Follow the sample of an accepted message, also without a network.

        Args:
            sample: The checked readings, with filtered temperatures.
            elapsed: Time between the sending of the previous message and of this one [s].
        """

    def step(self, observation: Observation) -> Finding | None:
        """Check a message for which the network has made an estimate; return a finding or None."""

    def step_healthy(self, observation: Observation, load: Contact | None) -> None:
        """Check a message of an arm without an anomaly, whose length offsets are known.

        Args:
            observation: The message, which all detectors have checked by `step`.
            load: The external load; None on a robot whose tensions are unknown.
        """

    def conditions(self) -> Iterable[Condition]:
        """Return the conditions of which users should know, as long as they are present."""
        return ()
