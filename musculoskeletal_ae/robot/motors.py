# SPDX-License-Identifier: Apache-2.0
"""Reads motors.yaml: how the motors of a ros2_control robot are connected to its muscles.

The file is an optional part of a robot directory (doc/reference/file_formats.md describes it for
users). With the direction s = ±1, the radius r of the spool, the position q and the effort e of a
motor, a muscle has

    l = s r (q − q₀),   T = k (e − e₀)

This module imports nothing slow, because `record` and `replay` read the names of the topics.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import UNSET, Meta, UnsetType, field

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.files import read_yaml
from musculoskeletal_ae.robot.directories import find_robot
from musculoskeletal_ae.schema import LONGEST_LIST, Name, Names, Number, Strict, convert

FILE = 'motors.yaml'
ARRAY = 'std_msgs/msg/Float64MultiArray'
JOINT_STATE = 'sensor_msgs/msg/JointState'
TOPIC_NAME = re.compile(r'(~?/)?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*')

Radius = Annotated[float, Meta(ge=1e-4, le=10.0)]


class MotorTopics(NamedTuple):
    """Topics of a ros2_control robot. The defaults stand for a robot without motor topics."""

    states: str = ''  # topic of the JointState messages that contain the motors
    commands: str = ''  # topic of the commanded positions; '' to command no motor


NO_MOTORS = MotorTopics()  # topics of a robot that publishes muscle_states


class Constants(Strict, frozen=True):
    """Constants of a motor. Those of the file apply to every motor that does not state its own."""

    #: length of tendon per unit of position: radius of the spool for angles, 1 for lengths [m]
    spool_radius: Radius | UnsetType = UNSET
    #: 1 if the position rises as the motor pays out, −1 if it rises as the motor winds in
    direction: Number | UnsetType = UNSET
    zero: Number | UnsetType = UNSET  # position of the motor at which l is 0
    #: tension per unit of effort, negative if the effort falls as the motor pulls [N]
    tension_per_effort: Number | UnsetType = UNSET
    effort_zero: Number | UnsetType = UNSET  # effort of the motor at which T is 0

    def __post_init__(self) -> None:
        """Check that the direction is 1 or −1, and that the tension per effort is not 0."""
        if self.direction not in (UNSET, 1.0, -1.0):
            raise ValueError(f'direction: expected 1 or -1, got {self.direction:g}')
        if self.tension_per_effort == 0.0:
            raise ValueError('tension_per_effort: expected a number other than 0, got 0')


CONSTANTS = {
    'spool_radius': 1.0, 'direction': 1.0, 'zero': 0.0, 'tension_per_effort': 1.0,
    'effort_zero': 0.0,
}  # fmt: skip


class MotorEntry(Constants, frozen=True):
    """The entry of motors.yaml that describes the motor of one muscle."""

    joint: Name | UnsetType = UNSET  # joint of ros2_control; by default, the name of the muscle


class MotorFile(Constants, frozen=True, kw_only=True):
    """The content of motors.yaml: topics, common constants, and the motor of each muscle."""

    state_topic: Name
    command_topic: Name | None = None
    command_order: Names | None = None  # joints in the order of the command controller
    #: the motor of each muscle, by the name of the muscle
    motors: Annotated[dict[Name, MotorEntry], Meta(max_length=LONGEST_LIST)] = field(
        default_factory=dict
    )

    def __post_init__(self) -> None:
        """Check that the topics have legal names."""
        super().__post_init__()
        for key, name in (('state_topic', self.state_topic), ('command_topic', self.command_topic)):
            if name is not None and not TOPIC_NAME.fullmatch(name):
                legal = 'words of letters, digits and _, joined by /, as in arm/joint_states'
                raise ValueError(f'{key}: {name!r} is no name of a topic; legal: {legal}')


@dataclass(frozen=True)
class Motors:
    """The checked content of motors.yaml. All values are in the order of the muscles, (M,)."""

    topics: MotorTopics
    joints: tuple[str, ...]  # the joint of ros2_control that is the motor of each muscle
    command_order: tuple[str, ...]  # these joints in the order of the command controller
    spool_radius: Array  # radius of the spool, or 1 for a linear motor [m]
    direction: Array  # 1 if the position rises as the motor pays out, −1 if it falls
    zero: Array
    #: tension per unit of effort; negative if the effort falls as the motor pulls [N]
    tension_per_effort: Array
    effort_zero: Array


def motor_topics(robot: str | Path) -> MotorTopics:
    """Return the motor topics of a robot, which is a shipped name or a directory.

    Raises:
        RobotDescriptionError: If the robot is unknown, or its motors.yaml is invalid.
    """
    content = _read_file(find_robot(robot) / FILE)
    return NO_MOTORS if content is None else _topics(content)


def read_motors(directory: Path, muscles: Sequence[str]) -> Motors | None:
    """Return how motors are connected to muscles; None if the directory has no motors.yaml.

    Args:
        directory: The robot directory, which may contain a motors.yaml.
        muscles: Names of the muscles.

    Raises:
        RobotDescriptionError: If the file is invalid; the message names the file, the entry and
            the legal values.
    """
    content = _read_file(directory / FILE)
    if content is None:
        return None
    fail = _refusal(directory / FILE)
    if unknown := sorted(content.motors.keys() - {*muscles}):
        raise fail(f'$.motors: unknown muscle {unknown[0]!r}; legal: {", ".join(muscles)}')
    entries = [content.motors.get(muscle, MotorEntry()) for muscle in muscles]
    joints = tuple(
        muscle if entry.joint is UNSET else entry.joint for muscle, entry in zip(muscles, entries)
    )
    if twice := _repeated(joints):
        raise fail(f'$.motors: joint {twice!r} winds two muscles; each muscle needs its own motor')
    order = content.command_order or joints
    if sorted(order) != sorted(joints):
        wrong = sorted({*order} ^ {*joints}) or [_repeated(order)]
        legal = f'each of {", ".join(joints)} once'
        problem = f'{wrong[0]!r} is missing, unknown or repeated; expected {legal}'
        raise fail(f'$.command_order: {problem}')
    constants = {
        name: np.array([_constant(name, content, entry) for entry in entries]) for name in CONSTANTS
    }
    return Motors(_topics(content), joints, order, **constants)


def _read_file(file: Path) -> MotorFile | None:
    if not (file.exists() or file.is_symlink()):
        return None
    refuse = _refusal(file)
    return convert(read_yaml(file, lambda _, problem: refuse(problem)), MotorFile, refuse)


def _refusal(file: Path) -> Callable[[str], RobotDescriptionError]:
    """Return a function that returns the error for a problem in a motors.yaml."""
    remedy = 'doc/howto/ros2_control.md describes the file'
    return lambda problem: RobotDescriptionError(f'{file}: {problem}; {remedy}')


def _topics(content: MotorFile) -> MotorTopics:
    return MotorTopics(content.state_topic, content.command_topic or '')


def _constant(name: str, content: MotorFile, entry: MotorEntry) -> float:
    """Return the constant `name` of a motor: its own, or that of the file, or the default."""
    values = (getattr(source, name) for source in (entry, content))
    stated = [value for value in values if value is not UNSET]
    return stated[0] if stated else CONSTANTS[name]


def _repeated(names: Iterable[str]) -> str:
    """Return a name that is listed more than once, or ''."""
    listed = [*names]
    return next((name for name in listed if listed.count(name) > 1), '')
