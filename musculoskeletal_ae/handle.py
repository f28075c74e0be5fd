# SPDX-License-Identifier: Apache-2.0
"""Arrays handed to compiled code once: numba unpacks those of an argument anew at every call.

An arm has some sixty of them, and they took it longer than its physics. Who hands over makes the
handle in compiled code, in the file of what is handed over: numba keeps its code, and asks only
that file whether it is still right.
"""

from typing import Any

from numba import types
from numba.experimental import structref


@structref.register
class HandleType(types.StructRef):  # type: ignore[misc]
    """What numba calls a Handle."""


class Handle(structref.StructRefProxy):  # type: ignore[misc]
    """Arrays, in tuples, as one argument: what is written into them later is seen through it."""

    held: Any  # for compiled code only


structref.define_proxy(Handle, HandleType, ['held'])
