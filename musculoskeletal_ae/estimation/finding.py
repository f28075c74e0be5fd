# SPDX-License-Identifier: Apache-2.0
"""Observations and findings of detectors, and the interface of all detectors."""

from __future__ import annotations

from dataclasses import dataclass

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.conditions import ConditionKind, Revokes
from musculoskeletal_ae.estimation.estimate import Estimate
from musculoskeletal_ae.mae.mae import Mae
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
    """

    sample: MuscleSample
    estimate: Estimate
    demand: Array | None
    dt: float
    lengths_known: bool = True
    measured: Array | None = None
    command: Array | None = None


class Detector:
    """Base class of the detectors, each of which looks for one sign of a fault.

    `SuspectHandling` latches their findings. A new detector overrides `step`, and other methods as
    needed. To use a new detector, add it to the list in `HealthMonitor`.
    """

    def use(self, mae: Mae) -> None:
        """Use another network; its isolated muscles are ignored."""

    def reset(self) -> None:
        """Reset the detector, for example after a jump of the clock or a reset by the user."""

    def step(self, observation: Observation) -> Finding | None:  # noqa: ARG002
        """Check a message for which the network has made an estimate; return a finding or None."""
        return None
