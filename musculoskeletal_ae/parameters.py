# SPDX-License-Identifier: Apache-2.0
"""Parameters with default, meaning, unit and legal values, independent of ROS.

Settings that a user may choose are a frozen dataclass whose fields are parameters:

    @dataclass(frozen=True)
    class Settings:
        hold_time: float = Parameter(
            0.5, 'time for which a stop holds the last command', 's', (0.0, 60.0)
        ).field()

`nodes/parameters.py` assembles the parameters of each node from such classes.
"""

import sys
from dataclasses import dataclass, field, fields
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.options import DEFAULT_ROBOT
from musculoskeletal_ae.presets.names import DEFAULT, PRESET_NAMES

#: torch devices on which networks can be trained
DEVICES = 'cpu', 'cuda'
UNBOUNDED = 2**63 - 1  # largest integer of a ROS parameter


@dataclass(frozen=True)
class Parameter:
    """A value that a user may choose, with its default, meaning, unit and legal values."""

    default: Any  # also determines the type; a tuple for a list of numbers or names
    meaning: str  # description as one phrase
    unit: str = ''  # such as 'rad/s'
    within: tuple[float, float] | None = None  # lowest and highest legal value of a number
    legal: tuple[str, ...] = ()  # legal words; empty for any
    settable: bool = False  # whether it may change while a node runs

    @property
    def description(self) -> str:
        """Description for `ros2 param describe`: meaning, unit and legal words."""
        unit = f' [{self.unit}]' if self.unit else ''
        return f'{self.meaning}{unit}' + (f'; {self.legal_values}' if self.legal else '')

    @property
    def legal_values(self) -> str:
        """Legal words, or range and unit, as text; '' if the parameter has none of these."""
        if self.legal:
            return f'one of: {", ".join(self.legal)}'
        if self.within is None:
            return f'in {self.unit}' if self.unit else ''
        low, high = self.within
        span = f'at least {low:g}' if high >= UNBOUNDED else f'{low:g} to {high:g}'
        return f'{span} {self.unit}'.rstrip()

    @property
    def is_number_list(self) -> bool:
        """Whether the value is a list of numbers."""
        values = self.default if isinstance(self.default, tuple) else ('',)
        return not any(isinstance(value, str) for value in values)

    def field(self) -> Any:
        """Return a dataclass field with this parameter as metadata."""
        return field(default=self.default, metadata={'parameter': self})

    def checked(self, value: Any) -> Any:
        """Return a value if it is legal; a list is returned as a tuple, without empty names.

        The type and the range of a single number are not checked here, because ROS checks them.

        Raises:
            MusculoskeletalError: If the value is not legal.
        """
        if self.legal and value not in self.legal:
            raise MusculoskeletalError(f'{value!r}; legal: {", ".join(self.legal)}')
        if self.is_number_list:
            low, high = self.within or (-sys.float_info.max, sys.float_info.max)
            legal = f'a list of finite numbers, {self.legal_values}'.removesuffix(', ')
            # ROS represents an empty list as the byte array b''.
            numbers = [] if value == b'' else value
            if hasattr(numbers, 'tolist'):  # ROS represents lists of numbers as arrays
                numbers = numbers.tolist()
            try:
                kind = tuple[Annotated[float, Meta(ge=low, le=high)], ...]
                return msgspec.convert(numbers, kind)
            except msgspec.ValidationError as error:
                raise MusculoskeletalError(f'{value!r}; legal: {legal}') from error
        return tuple(filter(None, value)) if isinstance(self.default, tuple) else value


def settable(
    default: Any, meaning: str, unit: str = '', *within: float, legal: tuple[str, ...] = ()
) -> Any:
    """Return the dataclass field of a parameter that may be set while a node runs.

    Args:
        default: Default value.
        meaning: What the parameter means, for the documentation.
        unit: Unit of the value, or ''.
        within: Smallest and largest legal number, if the value is a number.
        legal: Legal words, if the value is one of several words.
    """
    low_high = (within[0], within[1]) if within else None
    return Parameter(default, meaning, unit, low_high, legal, settable=True).field()


def parameters_of(settings: type) -> dict[str, Parameter]:
    """Return the parameters of a settings dataclass by name."""
    return {f.name: f.metadata['parameter'] for f in fields(settings)}


ROBOT = Parameter(DEFAULT_ROBOT, 'a shipped robot, or a directory with robot.urdf and muscles.yaml')
RATE = Parameter(100.0, 'rate of the muscle modules', 'Hz', (1.0, 1000.0))
CHECKPOINT = Parameter(
    '', 'file of a trained network (empty: wait for one on the topic)', settable=True
)
PRESET = Parameter(
    DEFAULT,
    '`default`: the most accurate methods; `paper`: exactly the methods of the paper',
    legal=PRESET_NAMES,
)
SEED = Parameter(
    0, 'random seed of the emulated individual, exploration and learning', '', (0, UNBOUNDED)
)
