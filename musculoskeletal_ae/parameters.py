# SPDX-License-Identifier: Apache-2.0
"""Parameters with default, meaning, unit and legal values, independent of ROS.

The settings of control are a frozen dataclass whose fields are parameters (`control/settings.py`).
`nodes/declared_parameters.py` has the parameters of each node. `Parameter.checked` is the only
function that validates a value. The constructor of the settings calls it, and so do the nodes.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from musculoskeletal_ae.exceptions import MusculoskeletalError, ParameterError
from musculoskeletal_ae.options import DEFAULT_ROBOT
from musculoskeletal_ae.presets.preset import DEFAULT, PRESET_NAMES

#: highest legal value of a parameter without an upper limit: the largest integer of ROS
UNBOUNDED = 2**63 - 1


@dataclass(frozen=True)
class Parameter:
    """A value that a user may choose, with its default, meaning, unit and legal values."""

    default: Any  # also determines the type; a tuple for a list of numbers or names
    meaning: str  # meaning of the parameter, as one phrase for the documentation
    unit: str = ''  # unit of the value for users, such as 'rad/s'
    within: tuple[float, float] | None = None  # lowest and highest legal value of a number
    legal: tuple[str, ...] = ()  # legal words; empty if any word is legal
    settable: bool = False  # whether the parameter may be set while the node runs

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

        Raises:
            MusculoskeletalError: If the value is not legal.
        """
        if self.legal and value not in self.legal:
            raise MusculoskeletalError(f'{value!r}; legal: {", ".join(self.legal)}')
        # ROS represents lists of numbers as arrays, and an empty list as the byte array b''.
        given = value.tolist() if hasattr(value, 'tolist') else value
        given = [] if isinstance(given, bytes) and not given else given
        try:
            checked = msgspec.convert(given, self._type)
        except msgspec.ValidationError as error:
            legal = f'{self._kind}, {self.legal_values}'.removesuffix(', ')
            raise MusculoskeletalError(f'{value!r}; legal: {legal}') from error
        return tuple(filter(None, checked)) if self._is_name_list else checked

    @property
    def _is_name_list(self) -> bool:
        return isinstance(self.default, tuple) and not self.is_number_list

    @property
    def _type(self) -> Any:
        """The type of legal values, as msgspec checks it."""
        if self._is_name_list:
            return tuple[str, ...]
        if isinstance(self.default, str | bool):
            return type(self.default)
        low, high = self.within or (-sys.float_info.max, sys.float_info.max)
        if isinstance(self.default, int):
            return Annotated[int, Meta(ge=int(low), le=int(high))]
        number = Annotated[float, Meta(ge=low, le=high)]
        return tuple[number, ...] if self.is_number_list else number

    @property
    def _kind(self) -> str:
        """The kind of value, as text for users."""
        if isinstance(self.default, tuple):
            return 'a list of finite numbers' if self.is_number_list else 'a list of names'
        kinds = {bool: 'true or false', int: 'a whole number', float: 'a finite number'}
        return kinds.get(type(self.default), 'a text')


@contextmanager
def naming_parameter(name: str) -> Iterator[None]:
    """Prefix the messages of errors in this context with the name of the parameter."""
    try:
        yield
    except ParameterError:  # its message already names the parameter
        raise
    except (MusculoskeletalError, OSError) as error:
        raise ParameterError(f'parameter {name}: {error}') from error


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
    """Return the parameters of a settings dataclass by name.

    Fields without a parameter are left out: experiments vary them, but users do not.
    """
    return {f.name: f.metadata['parameter'] for f in fields(settings) if 'parameter' in f.metadata}


ROBOT = Parameter(DEFAULT_ROBOT, 'a shipped robot, or a directory with robot.urdf and muscles.yaml')
RATE = Parameter(100.0, 'rate of the muscle modules', 'Hz', (1.0, 1000.0))
CHECKPOINT = Parameter(
    '', 'file of a trained network (empty: wait until a network is published)', settable=True
)
PRESET = Parameter(
    DEFAULT,
    '`default`: the most accurate methods; `paper`: exactly the methods of the paper',
    legal=PRESET_NAMES,
)
SEED = Parameter(
    0, 'random seed of the emulated individual, exploration and learning', '', (0, UNBOUNDED)
)
