# SPDX-License-Identifier: Apache-2.0
"""Queries about processes that other code has started."""

import os


def is_running(pid):
    """Return whether a process exists."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True
