# SPDX-License-Identifier: Apache-2.0
"""Settings of control, from which the parameters of the controller node are generated, too."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.messages.arrival import INTERRUPTION
from musculoskeletal_ae.parameters import PRESET, naming_parameter, parameters_of, settable
from musculoskeletal_ae.presets.registry import preset_named
from musculoskeletal_ae.robot.joint_units import SLIDE, JointUnits

if TYPE_CHECKING:
    from musculoskeletal_ae.motion.methods import LengthMethod
    from musculoskeletal_ae.robot.robot import Robot

UNREACHABLE = ('refuse', 'nearest')  # legal values of the setting `unreachable`
MOST_STIFFNESS = 1000.0  # refuse a larger desired stiffness of a revolute joint [N·m/rad]


@dataclass(frozen=True)
class ControlMethod:
    """How a control method differs from others, apart from how it computes commands.

    Attributes:
        commands_tension: Whether the method commands tensions; all others command lengths.
        is_guided: Whether a hand guides the arm, so that it follows no target.
        uses_effort: Whether the arm exerts the effort of a target.
        sets_stiffness: Whether tensions are chosen for the setting `joint_stiffness`.
    """

    commands_tension: bool = False
    is_guided: bool = False
    uses_effort: bool = True
    sets_stiffness: bool = False


#: all control methods, by the value of the setting `method`
METHODS = {
    'geometric': ControlMethod(uses_effort=False),
    'first': ControlMethod(uses_effort=False),
    'second': ControlMethod(uses_effort=False),
    'proposed': ControlMethod(),
    'tension': ControlMethod(commands_tension=True),
    'stiffness': ControlMethod(sets_stiffness=True),
    'float': ControlMethod(commands_tension=True, is_guided=True),
}
#: names of the control methods that command lengths
BY_LENGTH = tuple(name for name, method in METHODS.items() if not method.commands_tension)


def _most_stiffness(radian: float) -> float:
    """Return the largest legal stiffness of a joint [N·m/rad, or N/m for a prismatic joint].

    The result is a whole number, so that messages state the limit exactly.

    Args:
        radian: Position of the joint [rad or m] at θ = 1 rad.
    """
    return float(math.ceil(MOST_STIFFNESS / radian**2))


@dataclass(frozen=True)
class Settings:
    """Settings of control; `Controller.configure` applies changed settings."""

    method: str = settable(
        'proposed', 'control method, which computes commands from targets', legal=tuple(METHODS)
    )
    preset: str = replace(PRESET, settable=True).field()
    joint_stiffness: tuple[float, ...] = settable(
        (0.0,),
        f'desired joint stiffness, one value per joint, at most {MOST_STIFFNESS:g} for revolute '
        'joints (0 or []: unconstrained)',
        'N·m/rad or N/m',
        0.0,
        # the limit of prismatic joints [N/m], which is the larger one; `desired_stiffness` limits
        # each joint by its own kind
        _most_stiffness(SLIDE.radian),
    )
    first_duration: float = settable(
        5.0,
        'duration of the movement to the target after a stop, and of the first movement with '
        'method `geometric`, `first` or `second` (with presets other than `default`: also '
        '`proposed`)',
        's',
        0.1,
        60.0,
    )
    rate_limit: float = settable(
        0.1,
        'largest rate of change of a length command (tension commands: times K_stiff)',
        'm/s',
        0.001,
        1.0,
    )
    unreachable: str = settable(
        'refuse',
        'response to a target_pose out of reach, or to a target that is not holdable without the '
        'isolated muscles: `refuse` the target, or go to the `nearest` posture',
        legal=UNREACHABLE,
    )
    max_age: float = settable(
        INTERRUPTION,
        'age of muscle_states or estimated_joint_states above which the arm pauses, and after a '
        'further hold_time stops; `bringup.sh` sets 1.0 for emulated arms',
        's',
        0.01,
        10.0,
    )
    hold_time: float = settable(
        0.5,
        'time for which a stop holds the last command; if only data is missing and it returns '
        'within this time, the arm resumes its target; with more than 5 s, the verification of an '
        'isolated muscle ends before the muscle is wound in',
        's',
        0.0,
        60.0,
    )
    temperature_limit: float = settable(
        85.0,
        'highest winding temperature, which limits the tensions; 20 °C above it the arm stops',
        '°C',
        40.0,
        200.0,
    )

    # Durations that experiments vary, and users do not.
    #: duration of the second movement of method `second`, and of that after a new checkpoint [s]
    second_duration: float = 2.0
    #: duration of a movement to a target with method `stiffness`, or with method `proposed` of
    #: preset `default` [s]; extended if muscle modules or muscles are too weak
    target_duration: float = 1.0

    def __post_init__(self) -> None:
        """Check the fields that are parameters, and turn lists into tuples.

        Raises:
            ParameterError: If a value is not legal.
        """
        for name, parameter in parameters_of(Settings).items():
            with naming_parameter(name):
                object.__setattr__(self, name, parameter.checked(getattr(self, name)))

    def desired_stiffness(self, units: JointUnits) -> Array:
        """Return the desired stiffness of each joint [N·m/rad], (D,); 0 for unconstrained joints.

        Args:
            units: Units of the joints, in which the setting `joint_stiffness` states the values.

        Raises:
            MusculoskeletalError: If `joint_stiffness` has the wrong size or a value out of range.
        """
        values, most = self.joint_stiffness, [_most_stiffness(each.radian) for each in units]
        if values in ((), (0.0,)):
            return np.zeros(len(most))
        if len(values) != len(most) or not all(0.0 <= v <= high for v, high in zip(values, most)):
            ends = ', '.join(f'{high:g}' for high in most)
            legal = f'{len(most)} numbers of at least 0, at most {ends} [N·m/rad or N/m], or []'
            raise MusculoskeletalError(f'{list(values)}; legal: {legal}')
        return units.to_stiffness(np.array(values))

    def check_fit(self, robot: Robot) -> None:
        """Check that the desired stiffness fits the robot's joints, and the method its modules.

        Raises:
            ParameterError: If one of them does not fit; the text names the reason and the legal
                values.
        """
        with naming_parameter('joint_stiffness'):
            self.desired_stiffness(robot.units)
        with naming_parameter('method'):
            self._check_method(robot)

    def _check_method(self, robot: Robot) -> None:
        """Check that the robot's muscle modules measure the tensions that the method needs."""
        if robot.tension_source.is_current and self.control_method.commands_tension:
            raise MusculoskeletalError(
                f'{self.method!r} requires measured tensions, but tension_source in '
                'muscles.yaml is `current`: the friction of a resting drive hides the force of a '
                f'hand; legal: {", ".join(BY_LENGTH)}'
            )
        if robot.tension_source.is_known:
            return
        legal = preset_named(self.preset).methods_without_tension
        if self.method not in legal:
            raise MusculoskeletalError(
                f'{self.method!r} requires tensions, but tension_source in muscles.yaml is '
                f'`none`; legal with preset {self.preset!r}: {", ".join(legal)}'
            )

    @property
    def control_method(self) -> ControlMethod:
        """How the chosen method differs from others."""
        return METHODS[self.method]

    @property
    def length_methods(self) -> Mapping[str, LengthMethod]:
        """The control methods of the preset that command lengths, by name."""
        return preset_named(self.preset).length_methods()

    @property
    def is_by_follower(self) -> bool:
        """Whether the `Follower` moves the arm to targets and holds them.

        All other methods ramp the lengths (`LengthRamps`) or command tensions (`TorqueControl`).
        With these methods, the `Follower` only follows trajectories, hand poses and twists.
        """
        return self.method in BY_LENGTH and self.method not in self.length_methods


@dataclass
class Setup:
    """The robot description and the settings that control uses now.

    All parts of the controller read the same `Setup`, and only the controller changes it.

    Attributes:
        robot: The robot description. Isolated muscles have no tension in it.
        settings: The settings of control.
    """

    robot: Robot
    settings: Settings
