# SPDX-License-Identifier: Apache-2.0
"""Pieces of a batch on all cores: one Python thread per core, BLAS with one thread in each.

numpy lets go of Python's lock while it computes, so threads suffice. BLAS would also like to use
all cores for every product, and the two together are slower than either. The package asks for one
BLAS thread when it is imported (`__init__`), which comes too late where numpy was imported first;
for the time of a batch OpenBLAS, which numpy's wheels carry, is then told so directly.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np

Piece = TypeVar('Piece')
Result = TypeVar('Result')


def on_all_cores(function: Callable[[Piece], Result], pieces: Sequence[Piece]) -> list[Result]:
    """Return function(piece) of each piece, in order; the function may not wait for others."""
    with _one_blas_thread():
        return list(_pool().map(function, pieces))


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix='batch')


@cache
def _openblas() -> ctypes.CDLL | None:
    for file in (Path(np.__file__).parent.parent / 'numpy.libs').glob('*openblas*'):
        library = ctypes.CDLL(str(file))
        if hasattr(library, 'scipy_openblas_set_num_threads64_'):
            return library
    return None


@contextmanager
def _one_blas_thread() -> Iterator[None]:
    library = _openblas()
    before = 1 if library is None else library.scipy_openblas_get_num_threads64_()
    if library is None or before == 1:
        yield
        return
    library.scipy_openblas_set_num_threads64_(1)
    try:
        yield
    finally:
        library.scipy_openblas_set_num_threads64_(before)
