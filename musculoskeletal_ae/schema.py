# SPDX-License-Identifier: Apache-2.0
"""Checks the content of files against types (by msgspec), and explains msgspec's errors.

A format is a class derived from `Strict`, with ranges and lengths in its annotations. Its
`__post_init__` checks rules that annotations cannot express and raises a ValueError.
"""

import re
import reprlib
from collections.abc import Callable, Iterator
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta, Struct, inspect

T = TypeVar('T')

# Types of values in files of a robot directory, with their legal ranges.

#: refuse a number beyond ± this [SI units], because it is certainly a mistake
LARGEST = 1e8
LONGEST_LIST = 1000  # refuse a longer list, such as of muscles, route points or joints

Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Meta(gt=0.0, le=LARGEST)]
NotNegative = Annotated[float, Meta(ge=0.0, le=LARGEST)]
Vector = tuple[Number, Number, Number]
Name = Annotated[str, Meta(min_length=1, max_length=200)]
Names = Annotated[tuple[Name, ...], Meta(min_length=1, max_length=LONGEST_LIST)]

#: Matches, for example, "Expected `float`, got `str` - at `$.muscles[3].stiffness`".
_MESSAGE = re.compile(
    r'(?P<problem>.*?)( - at (?P<key>`key` in )?`(?P<place>\$[^`]*)`)?', re.DOTALL
)
_STEP = re.compile(r'\.(?P<field>\w+)|\[(?P<index>\d+)\]|\[\.\.\.\]')
_UNKNOWN_FIELD, _INVALID_WORD = 'unknown field', 'Invalid enum value'


class Strict(Struct, frozen=True, forbid_unknown_fields=True):
    """Base class of file formats; unknown keys are errors."""


def convert(value: Any, kind: type[T], refuse: Callable[[str], Exception]) -> T:
    """Convert a value from a file to a type.

    If the value does not fit, the function raises the exception that `refuse` returns for a text.
    The text names the place, the problem, the value and the legal keys or words.
    """
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise refuse(explanation(error, value, kind)) from error


def explanation(error: msgspec.ValidationError, value: Any, kind: Any) -> str:
    """Return a readable text for msgspec's error about a value that does not fit a type, `kind`."""
    message = _MESSAGE.fullmatch(str(error))
    assert message is not None  # the pattern matches every text
    place, problem = message['place'] or '$', message['problem'].replace('`', '')
    if isinstance(error.__cause__, ValueError):  # `__post_init__` raised it with a complete text
        return f'{place}: {problem}'
    steps = [match.groupdict() for match in _STEP.finditer(place)]
    legal = ', '.join(_legal_words(kind, steps))
    if _UNKNOWN_FIELD in problem:
        key = problem.rpartition(' ')[2]
        return f'{place}: unknown key {key!r}; legal keys: {legal}'
    if 'missing required field' in problem:
        return f'{place}: key {problem.rpartition(" ")[2]!r} is missing'
    if message['key']:
        problem = problem[0].lower() + problem[1:]
        return f'{place}: wrong key: {problem}' + f'; legal: {legal}' * bool(legal)
    if _INVALID_WORD in problem:
        return f'{place}: expected one of {legal}, got {problem.removeprefix(_INVALID_WORD)[1:]}'
    # `repr` raises a ValueError for integers with more digits than Python prints.
    try:
        shown = reprlib.repr(_value_at(value, steps))
    except (LookupError, ValueError):
        shown = ''
    problem = problem[0].lower() + problem[1:]
    if shown:
        problem += f': {shown}' if ', got ' in problem else f', got {shown}'
    if problem.startswith('expected float, got str'):
        problem += ' (YAML reads 1e5 as text; write 1.0e+5)'
    return f'{place}: {problem}'


def _value_at(value: Any, steps: list[dict[str, str | None]]) -> Any:
    """Return the value to which the path `steps` leads from `value`.

    The path ends early, at a mapping, if msgspec does not name the key of the wrong value in it.
    """
    for step in steps:
        if step['field'] is not None:
            value = value[step['field']]
        elif step['index'] is not None:
            value = value[int(step['index'])]
        else:
            break
    return value


def _legal_words(kind: Any, steps: list[dict[str, str | None]]) -> list[str]:
    """Return the legal keys or words at the place in a type to which the path `steps` leads."""
    types = [inspect.type_info(kind)]
    for step in [*steps, None]:
        # Replace a union such as `X | None` by its members.
        types = [part for each in types for part in getattr(each, 'types', [each])]
        if step is not None:
            types = [inner for each in types for inner in _inner_types(each, step)]
    words = list[str]()
    for each in types:
        if isinstance(each, inspect.StructType):
            words += [field.encode_name for field in each.fields]
        elif isinstance(each, inspect.LiteralType):
            words += map(str, each.values)
        elif isinstance(each, inspect.DictType) and isinstance(each.key_type, inspect.LiteralType):
            words += map(str, each.key_type.values)
    return words


def _inner_types(kind: inspect.Type, step: dict[str, str | None]) -> Iterator[inspect.Type]:
    """Yield the types that a type allows for the field or item to which `step` leads."""
    if isinstance(kind, inspect.StructType):
        yield from (field.type for field in kind.fields if field.encode_name == step['field'])
    elif isinstance(kind, inspect.ListType | inspect.VarTupleType):
        yield kind.item_type
    elif isinstance(kind, inspect.TupleType):
        yield kind.item_types[int(step['index'] or 0)]
    elif isinstance(kind, inspect.DictType):
        yield kind.value_type
