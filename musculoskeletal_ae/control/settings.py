# SPDX-License-Identifier: Apache-2.0
"""What a user may choose about control: every setting with its meaning, unit and range.

One table for the core and the node, which declares a parameter for each field here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.presets import PRESETS

METHODS = ('geometric', 'first', 'second', 'proposed', 'tension', 'stiffness')


def choice(default: str, legal: tuple[str, ...], meaning: str) -> Any:
    """Return the field of a setting that is one of a few words."""
    return field(default=default, metadata={'meaning': meaning, 'legal': legal})


def quantity(default: float, low: float, high: float, meaning: str) -> Any:
    """Return the field of a setting that is a number within [low, high]."""
    return field(default=default, metadata={'meaning': meaning, 'range': (low, high)})


@dataclass(frozen=True)
class Settings:
    """Settings of control; `Controller.configure` takes changed ones.

    Attributes are described by their own `meaning`, except for
    joint_stiffness: desired diagonal entries of the joint stiffness [N·m/rad], one for each joint,
        0 as it comes; empty for all as they come.
    """

    method: str = choice('proposed', METHODS, 'how a target posture becomes a command')
    preset: str = choice('default', tuple(PRESETS), 'of the method proposed')
    first_duration: float = quantity(5.0, 0.1, 60.0, 'of a movement [s]')
    second_duration: float = quantity(
        2.0, 0.1, 60.0, 'of the second movement of second, and after a new checkpoint [s]'
    )
    constant_tension: float = quantity(
        0.0, 0.0, 1000.0, 'T_const of first [N], within [T_bias, T_limit]'
    )
    rate_limit: float = quantity(
        0.1, 0.001, 1.0, 'fastest change of a commanded length [m/s]; of a tension K_stiff times it'
    )
    position_gain: float = quantity(
        10.0, 0.0, 200.0, 'method tension: torque towards the target [N·m/rad]; 0: torque only'
    )
    velocity_gain: float = quantity(
        0.5, 0.0, 20.0, 'method tension: damping torque [N·m·s/rad]; 0: torque only'
    )
    feedback_gain: float = quantity(
        0.5,
        0.0,
        2.0,
        'proposed, default: correction of error and needless tension at rest [1/s]; 0: none',
    )
    max_age: float = quantity(
        0.2, 0.01, 10.0, 'older muscle_states or estimated_joint_states stop the arm [s]'
    )
    hold_time: float = quantity(0.5, 0.0, 60.0, 'a stop holds the last command so long [s]')
    temperature_limit: float = quantity(
        85.0, 40.0, 200.0, 'a module this hot pulls with T_bias only [°C]'
    )
    joint_stiffness: tuple[float, ...] = ()

    @property
    def by_balance(self) -> bool:
        """Whether `proposed` solves the balance of torques, instead of the printed descent."""
        return PRESETS[self.preset].equilibrium


def read_stiffness(desired: Iterable[Any], joints: int) -> tuple[float, ...]:
    """Return joint stiffness as `Settings` keeps it; nothing, or a single 0, is all as they come.

    Raises:
        MusculoskeletalError: If it is not one finite number of at least 0 for each joint.
    """
    try:
        values = tuple(float(value) for value in desired)
    except (TypeError, ValueError):
        values = (math.nan,)
    if values == (0.0,):
        return ()
    if len(values) not in (0, joints) or not all(0.0 <= value < math.inf for value in values):
        raise MusculoskeletalError(
            f'joint stiffness {desired!r}; legal: {joints} numbers of at least 0 [N·m/rad], or []'
        )
    return values
