# SPDX-License-Identifier: Apache-2.0
"""Queries about processes that other code has started."""

import os
from pathlib import Path


def is_running(pid):
    """Return whether a process exists."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def catches(pid, *signals):
    """Return whether a process has handlers of its own for all of these signals."""
    status = Path(f'/proc/{pid}/status').read_text('utf-8')
    (mask,) = (int(line.split()[1], 16) for line in status.splitlines() if line[:6] == 'SigCgt')
    return all(mask >> number - 1 & 1 for number in signals)
