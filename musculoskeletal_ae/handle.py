# SPDX-License-Identifier: Apache-2.0
"""Pass many arrays to compiled code as one argument.

At every call, numba unpacks each array of each argument. An emulated arm has about sixty arrays;
unpacking them would take longer than computing its physics. A compiled function creates the
`Handle`. This function belongs in the file that defines the types of the arrays: numba discards the
cached code of a function only when the file of the function changes.
"""

from typing import Any

from numba import types
from numba.experimental import structref


@structref.register
class HandleType(types.StructRef):  # type: ignore[misc]
    """The type by which numba recognises a `Handle` in compiled code."""


class Handle(structref.StructRefProxy):  # type: ignore[misc]
    """Passes tuples of arrays to compiled code as one argument, without copying the arrays."""

    held: Any  # the arrays, which only compiled code may read


structref.define_proxy(Handle, HandleType, ['held'])
