# SPDX-License-Identifier: Apache-2.0
"""File formats as types: msgspec checks a value, and its errors are explained here.

A format is a class derived from `Strict`; ranges and lengths stand in its annotations. What the
annotations cannot express raises a ValueError in `__post_init__`.
"""

import re
import reprlib
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import msgspec
from msgspec import Struct, inspect

T = TypeVar('T')

#: "Expected `float`, got `str` - at `$.muscles[3].stiffness`"
_MESSAGE = re.compile(
    r'(?P<problem>.*?)( - at (?P<key>`key` in )?`(?P<place>\$[^`]*)`)?', re.DOTALL
)
_STEP = re.compile(r'\.(?P<field>\w+)|\[(?P<index>\d+)\]|\[\.\.\.\]')
_UNKNOWN_FIELD, _INVALID_WORD = 'unknown field', 'Invalid enum value'


class Strict(Struct, frozen=True, forbid_unknown_fields=True):
    """Base of the formats: a key that the format does not have is an error."""


def convert(value: Any, kind: type[T], refuse: Callable[[str], Exception]) -> T:
    """Return a value of a file as the given type, if it has that type.

    `refuse` makes the error from a text that names the place, the problem, the value and, of keys
    and words, the legal ones.
    """
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise refuse(explanation(error, value, kind)) from error


def explanation(error: msgspec.ValidationError, value: Any, kind: Any) -> str:
    """Return what is wrong with a value that is not of the given type."""
    message = _MESSAGE.fullmatch(str(error))
    assert message is not None  # the pattern matches every text
    place, problem = message['place'] or '$', message['problem'].replace('`', '')
    if isinstance(error.__cause__, ValueError):  # raised by a `__post_init__`, complete as it is
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
    # A number of more digits than Python prints has no `repr`.
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
    """Return the value at a place, or the mapping that holds it where msgspec names no key."""
    for step in steps:
        if step['field'] is not None:
            value = value[step['field']]
        elif step['index'] is not None:
            value = value[int(step['index'])]
        else:
            break
    return value


def _legal_words(kind: Any, steps: list[dict[str, str | None]]) -> list[str]:
    """Return the keys of the mapping, or the words, that are legal at a place of a format."""
    types = [inspect.type_info(kind)]
    for step in [*steps, None]:
        # Of `X | None` that is X.
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
    """Yield the types that a value has one step below a value of some type."""
    if isinstance(kind, inspect.StructType):
        yield from (field.type for field in kind.fields if field.encode_name == step['field'])
    elif isinstance(kind, inspect.ListType | inspect.VarTupleType):
        yield kind.item_type
    elif isinstance(kind, inspect.TupleType):
        yield kind.item_types[int(step['index'] or 0)]
    elif isinstance(kind, inspect.DictType):
        yield kind.value_type
