# SPDX-License-Identifier: Apache-2.0
"""Converts between messages of ros2_control and lengths and tensions of muscles.

The motors of the muscles are joints of a ros2_control hardware interface. `robot/motors.py` has the
equations that connect them with the muscles.

joint_state_broadcaster publishes the positions q and efforts e of the motors as a JointState: in
any order, mixed with other joints, and with NaN for interfaces that the hardware does not have.
forward_command_controller takes a Float64MultiArray of positions, in the order of its own parameter
`joints`.

The tension of a motor without a measured effort is unknown, and so is every temperature. Unknown
values are NaN, never 0.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.messages.arrival import is_later, nanoseconds
from musculoskeletal_ae.messages.message_reading import joint_names, read_array
from musculoskeletal_ae.robot.motors import ARRAY, JOINT_STATE, NO_MOTORS, Motors
from musculoskeletal_ae.robot.tension_source import TENSION_SENSOR, TensionSource
from musculoskeletal_ae.signals.muscle_states import MuscleReadings

STATES = 'muscle_states'  # topic of the readings of a robot with a driver


class MotorInterface:
    """Converts the messages between the motors of one arm and its muscles.

    Keep one object for each subscription, because each remembers the last stamp.

    Attributes:
        topics: Topics of the motors.
        is_ros2_control: Whether states arrive as JointState; otherwise as muscle_states.
        state_topic: Topic of the states.
        state_type: Type of the messages on `state_topic`.
        command_topic: Topic of the motor commands, or '' if there are none.
    """

    def __init__(self, motors: Motors | None, source: TensionSource = TENSION_SENSOR) -> None:
        """Start without a message.

        Args:
            motors: How the motors are connected to the muscles; None for a robot with a driver,
                which publishes muscle_states.
            source: Whether the efforts are tensions or motor currents.
        """
        self._source = source
        self.topics = NO_MOTORS if motors is None else motors.topics
        self.is_ros2_control = motors is not None
        self.state_topic = self.topics.states or STATES
        self.state_type = JOINT_STATE if self.is_ros2_control else ARRAY
        self.command_topic = self.topics.commands
        if motors is not None:
            self._connect(motors)
        self.reset()

    def _connect(self, motors: Motors) -> None:
        self._motors = motors.joints
        #: index of the muscle to which each value of a command belongs, (M,)
        self._order: Ints = np.array([motors.joints.index(name) for name in motors.command_order])
        self._length_per_position = motors.direction * motors.spool_radius
        self._zero, self._effort_zero = motors.zero, motors.effort_zero
        self._tension_per_effort = motors.tension_per_effort
        self._names: list[str] = []  # names of the joints in the last message
        #: index of each motor in these names, (M,)
        self._places: Ints = np.zeros(len(motors.joints), dtype=int)

    def reset(self) -> None:
        """Discard the last stamp, for example after a jump of the clock."""
        self._stamp = 0  # the last stamp [ns]; 0 before the first

    def reading(self, message: Any) -> Any:
        """Return the `MuscleReadings` in a message of `state_topic`.

        Messages of muscle_states are returned unchanged.

        Raises:
            MessageError: If a JointState has no stamp or the stamp of an earlier message, if its
                arrays have different lengths, or if a motor is missing or named twice.
        """
        if not self.is_ros2_control:
            return message
        names = joint_names(message)
        if names != self._names:
            self._places, self._names = self._find(names), names
        stamp = nanoseconds(message.header.stamp)
        if stamp == 0:
            raise MessageError('no stamp', 'header.stamp is 0; expected the time of measurement')
        if not is_later(stamp, self._stamp):
            seconds, rest = divmod(stamp, 1_000_000_000)
            detail = f'{seconds}.{rest:09d} s is not later than the previous stamp'
            raise MessageError('repeated stamp', detail)
        self._stamp = stamp
        position = np.array(message.position, dtype=float)[self._places]
        with np.errstate(over='ignore'):  # a result that overflows is later rejected as not finite
            length = self._length_per_position * (position - self._zero)
            if not len(message.effort):
                return MuscleReadings(length=length)
            effort = np.array(message.effort, dtype=float)[self._places]
            tension = self._tension_per_effort * (effort - self._effort_zero)
            return MuscleReadings(length=length, tension=self._source.to_newtons(tension))

    def command(self, length: Array) -> Array:
        """Return the motor positions that command lengths, in the order of the motor commands.

        Args:
            length: Length commands [m], (M,), in the order of the muscles.
        """
        return self._position(length)[self._order]

    # -- the reverse conversion, for emulated arms -----------------------------------------------

    def take_command(self, follow: Callable[[Array], object]) -> Callable[[Any], None]:
        """Return a callback that converts motor commands to length commands.

        The callback calls `follow` with the length commands [m], (M,).
        """

        def take(message: Any) -> None:
            position = np.empty(len(self._order))
            position[self._order] = read_array(message, 1, len(self._order))
            follow(self._length_per_position * (position - self._zero))

        return take

    def joint_values(self, length: Array, tension: Array) -> tuple[tuple[str, ...], Array, Array]:
        """Return names, positions and efforts of the motors for given muscle states.

        Args:
            length: Lengths [m], (M,).
            tension: Tensions [N], (M,).
        """
        effort = self._source.to_message(tension) / self._tension_per_effort + self._effort_zero
        return self._motors, self._position(length), effort

    def _position(self, length: Array) -> Array:
        position: Array = length / self._length_per_position + self._zero
        return position

    def _find(self, names: list[str]) -> Ints:
        """Return the index of each muscle's motor in the names of a message, (M,)."""
        places = {name: place for place, name in enumerate(names)}
        if missing := [motor for motor in self._motors if motor not in places]:
            there = ', '.join(names[:20])
            detail = f'{", ".join(missing)}; the message contains {there}'
            raise MessageError('missing motor', detail)
        for motor in self._motors:
            if names.count(motor) > 1:
                raise MessageError('duplicate motor', f'{motor!r} is in the message more than once')
        return np.array([places[motor] for motor in self._motors])
