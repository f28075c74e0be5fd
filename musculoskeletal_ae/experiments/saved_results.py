# SPDX-License-Identifier: Apache-2.0
"""Saves parts of a run in npz files without pickle, because a pickle can contain code.

A value consists of None, numbers, texts, arrays, and of dictionaries, lists and named tuples of
values. Every array is a member of the npz file. A further member, `document`, contains the rest of
the value as JSON, in which an object with a single key stands for

    {"array": N}           the array in the member N
    {"dictionary": {…}}    a dictionary
    {"record": {…}}        a named tuple

Read values differ from written ones in their types only:
tuples have become lists, and named tuples have become objects with the same attributes.
"""

import json
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from zipfile import BadZipFile

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.files import write_whole

DOCUMENT = 'document'


def write(file: Path, value: Any) -> None:
    """Write a value to a file, which is replaced as a whole.

    Raises:
        TypeError: If a part of the value has a type that the module docstring does not list.
    """
    arrays = dict[str, Array]()
    document = json.dumps(_encoded(value, arrays))
    members: dict[str, Any] = {DOCUMENT: np.array(document), **arrays}
    stream = BytesIO()
    np.savez(stream, **members)
    write_whole(file, stream.getvalue())


def read(file: Path) -> Any:
    """Return the value of a file.

    Raises:
        MusculoskeletalError: If the file is not one that `write` has written.
    """
    try:
        with np.load(file, allow_pickle=False) as arrays:
            return _decoded(json.loads(str(arrays[DOCUMENT])), arrays)
    # zipfile, numpy and json raise these errors for damaged files and for other files. From an npy
    # file, numpy reads an array, which is no context manager.
    except (
        OSError, EOFError, ValueError, KeyError, TypeError, AttributeError, BadZipFile,
    ) as error:  # fmt: skip
        raise unusable(file, str(error)) from error


def unusable(file: Path, problem: str) -> MusculoskeletalError:
    """Return the error for a kept file that a `problem` makes unusable, with the remedy."""
    return MusculoskeletalError(
        f'{file} is no kept part of an experiment: {problem}; remove it, and the next run measures '
        'this part again'
    )


def _encoded(value: Any, arrays: dict[str, Array]) -> Any:
    """Return a value as JSON can represent it; append its arrays to `arrays`."""
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError(f'an array of {value.dtype} would need pickle; use a list')
        name = str(len(arrays))
        arrays[name] = value
        return {'array': name}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        if other := [key for key in value if not isinstance(key, str)]:
            raise TypeError(f'{other[0]!r}: expected a text as key')
        return {'dictionary': {key: _encoded(part, arrays) for key, part in value.items()}}
    if hasattr(value, '_asdict'):
        fields = value._asdict()
        return {'record': {key: _encoded(part, arrays) for key, part in fields.items()}}
    if isinstance(value, list | tuple):
        return [_encoded(part, arrays) for part in value]
    return value


def _decoded(value: Any, arrays: Any) -> Any:
    """Return the value that `_encoded` has converted, with its arrays from `arrays`, by name."""
    if isinstance(value, list):
        return [_decoded(part, arrays) for part in value]
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    if kind == 'array':
        return arrays[content]
    parts = {key: _decoded(part, arrays) for key, part in content.items()}
    if kind == 'record':
        return SimpleNamespace(**parts)
    if kind == 'dictionary':
        return parts
    raise ValueError(f'unknown kind of value {kind!r}')
