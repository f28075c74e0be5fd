# SPDX-License-Identifier: Apache-2.0
"""Determines whether settings fit a robot, and which code implements a control method."""

from collections.abc import Mapping

from musculoskeletal_ae.control.settings import BY_TENSION, METHODS, Settings
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.motion.methods import LengthMethod
from musculoskeletal_ae.parameters import naming_parameter
from musculoskeletal_ae.presets.registry import preset_named
from musculoskeletal_ae.robot.robot import Robot


def check_settings(robot: Robot, settings: Settings) -> None:
    """Check that the desired stiffness fits the robot's joints, and the method its modules.

    Raises:
        ParameterError: If one of them does not fit; the text names the reason and the legal values.
    """
    with naming_parameter('joint_stiffness'):
        settings.desired_stiffness(robot.units)
    with naming_parameter('method'):
        _check_method(robot, settings)


def _check_method(robot: Robot, settings: Settings) -> None:
    """Check that the robot's muscle modules measure the tensions that the method needs."""
    if robot.tension_source.is_current and settings.method in BY_TENSION:
        legal = tuple(method for method in METHODS if method not in BY_TENSION)
        raise MusculoskeletalError(
            f'{settings.method!r} requires measured tensions, but tension_source in '
            'muscles.yaml is `current`: the friction of a resting drive hides the force of a hand; '
            f'legal: {", ".join(legal)}'
        )
    if robot.tension_source.is_known:
        return
    legal = preset_named(settings.preset).methods_without_tension
    if settings.method not in legal:
        raise MusculoskeletalError(
            f'{settings.method!r} requires tensions, but tension_source in muscles.yaml is '
            f'`none`; legal with preset {settings.preset!r}: {", ".join(legal)}'
        )


def length_methods(settings: Settings) -> Mapping[str, LengthMethod]:
    """Return the control methods of the preset that command lengths, by name."""
    return preset_named(settings.preset).length_methods()


def by_follower(settings: Settings) -> bool:
    """Return whether the `Follower` moves the arm to targets with the control method.

    All other methods ramp the lengths (`LengthRamps`) or command tensions (`TorqueControl`).
    """
    return settings.method not in (*BY_TENSION, *length_methods(settings))
