# SPDX-License-Identifier: Apache-2.0
"""The common form of what the arm can do: one object for each activity."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.command import Command, Pull
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.signals.muscle_stream import MuscleSample


class Inputs(NamedTuple):
    """What an activity knows at one step. All of it is present whenever an activity is stepped."""

    mae: Mae
    sample: MuscleSample  # the newest muscle states
    pull: Pull
    theta: Array  # the estimated posture [rad], (D,)
    length: Array  # the last length command, or one under which the muscles pull as now [m], (M,)
    tension: Array  # the same of tensions [N], (M,)
    limit: Array  # the highest tension that may be planned [N], (M,)
    dt: float  # since the last command [s]


class ActivityControl(Protocol):
    """Commands the arm as long as one activity goes on."""

    def enter(self, inputs: Inputs, /) -> None:
        """Begin, or begin again after a pause, from how the muscles pull now."""

    def step(self, inputs: Inputs, /) -> Command | None:
        """Return the desired command; None keeps the last one."""

    def leave(self) -> None:
        """End: another activity follows, or a stop."""
