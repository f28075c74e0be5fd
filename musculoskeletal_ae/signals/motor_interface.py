# SPDX-License-Identifier: Apache-2.0
"""Converts between messages of ros2_control and lengths and tensions of muscles.

The motors of the muscles are joints of a ros2_control hardware interface. With the direction
s = ±1, the radius r of the spool, the position q and the effort e of a motor, a muscle has

    l = s r (q − q₀),   T = k (e − e₀)

joint_state_broadcaster publishes q and e as a JointState: in any order, mixed with other joints,
and with NaN for interfaces that the hardware does not have. forward_command_controller takes a
Float64MultiArray of positions, in the order of its own parameter `joints`.

The tension of a motor without effort is unknown, and so is every temperature. Unknown values are
NaN, never 0.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.arrival import is_later, nanoseconds
from musculoskeletal_ae.exceptions import MessageError, MusculoskeletalError
from musculoskeletal_ae.signals.motor_settings import ARRAY, JOINT_STATE, MotorSettings
from musculoskeletal_ae.validity import joint_names, read_array

STATES = 'muscle_states'


class Layout(NamedTuple):
    """The layout of a reading, as in a Float64MultiArray: no named dimensions and no offset."""

    dim: tuple[()] = ()
    data_offset: int = 0


class MuscleReading(NamedTuple):
    """Lengths [m], tensions [N] and temperatures [°C] in the format of a muscle_states message."""

    data: Array  # (3·M,)
    layout: Layout = Layout()


class MotorInterface:
    """Converts the messages of one arm; keep one object for each subscription.

    Attributes:
        settings: The parameters.
        is_ros2_control: Whether states arrive as JointState; otherwise as muscle_states.
        state_topic: Topic of the states.
        state_type: Type of the messages on `state_topic`.
        command_topic: Topic of the motor commands, or '' if there are none.
    """

    def __init__(self, settings: MotorSettings, muscles: Sequence[str]) -> None:
        """Assign motors to muscles according to the parameters.

        Args:
            settings: The parameters.
            muscles: Names of the muscles.

        Raises:
            MusculoskeletalError: If a parameter does not fit the muscles.
        """
        count = len(muscles)
        self.settings = settings
        self._motors = tuple(filter(None, settings.motor_names)) or tuple(muscles)
        self.is_ros2_control = bool(settings.motor_state_topic)
        self.state_topic = settings.motor_state_topic or STATES
        self.state_type = JOINT_STATE if self.is_ros2_control else ARRAY
        self.command_topic = settings.motor_command_topic
        if self.command_topic and not self.is_ros2_control:
            problem = 'needs motor_state_topic, which is empty; set both, or none'
            raise _refused('motor_command_topic', problem)
        if len(self._motors) != count:
            legal = f'a motor for each of the {count} muscles: {", ".join(muscles)}'
            raise _refused('motor_names', f'got {len(self._motors)} names; expected {legal}')
        if len(set(self._motors)) < count:
            twice = max(self._motors, key=self._motors.count)
            problem = f'{twice!r} is listed twice; each muscle needs a motor of its own'
            raise _refused('motor_names', problem)
        order = tuple(filter(None, settings.motor_command_order)) or self._motors
        if sorted(order) != sorted(self._motors):
            wrong = sorted({*order} ^ {*self._motors}) or [max(order, key=order.count)]
            legal = f'each of {", ".join(self._motors)} once'
            problem = f'{wrong[0]!r} is missing, unknown or repeated; expected {legal}'
            raise _refused('motor_command_order', problem)
        #: index of the muscle to which each value of a command belongs, (M,)
        self._order: Ints = np.array([self._motors.index(name) for name in order])
        each = {
            name: _each(name, getattr(settings, name), count)
            for name in (
                'spool_radius', 'motor_direction', 'motor_zero', 'tension_per_effort', 'effort_zero'
            )
        }  # fmt: skip
        for name, legal in (
            ('motor_direction', '1 or -1'),
            ('tension_per_effort', 'a number other than 0'),
        ):
            values = np.abs(each[name])
            fits = values == 1.0 if name == 'motor_direction' else values > 0.0
            if not fits.all():
                raise _refused(name, f'got {each[name][~fits][0]:g}; expected {legal}')
        self._length_per_position = each['motor_direction'] * each['spool_radius']
        self._zero, self._effort_zero = each['motor_zero'], each['effort_zero']
        self._tension_per_effort = each['tension_per_effort']
        self._names: list[str] = []  # names of the joints in the last message
        self._places = np.zeros(count, dtype=int)  # places of the motors among these names, (M,)
        self.reset()

    def reset(self) -> None:
        """Discard the last stamp, for example after a jump of the clock."""
        self._stamp = 0  # the last stamp [ns]; 0 before the first

    def reading(self, message: Any) -> Any:
        """Return a message of `state_topic` in the format of muscle_states.

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
            detail = f'{1e-9 * stamp:.9f} s is not later than the previous stamp'
            raise MessageError('repeated stamp', detail)
        self._stamp = stamp
        position = np.array(message.position, dtype=float)[self._places]
        rows = np.full((3, len(position)), np.nan)
        with np.errstate(over='ignore'):  # a result that overflows is later rejected as not finite
            rows[0] = self._length_per_position * (position - self._zero)
            if len(message.effort):
                effort = np.array(message.effort, dtype=float)[self._places]
                rows[1] = self._tension_per_effort * (effort - self._effort_zero)
        return MuscleReading(rows.ravel())

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
        effort = tension / self._tension_per_effort + self._effort_zero
        return tuple(self._motors), self._position(length), effort

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


def _refused(name: str, problem: str) -> MusculoskeletalError:
    return MusculoskeletalError(f'parameter {name}: {problem}')


def _each(name: str, values: Sequence[float], count: int) -> Array:
    """Return one value for each muscle, (M,); a single value in `values` is for all muscles."""
    if len(values) not in (1, count):
        raise _refused(name, f'got {len(values)} values; expected 1, or {count} for all muscles')
    each: Array = np.full(count, values[0]) if len(values) == 1 else np.array(values)
    return each
