# SPDX-License-Identifier: Apache-2.0
"""What a process takes of the machine, as Linux counts it."""

from __future__ import annotations

import os
from pathlib import Path

TICK, PAGE = os.sysconf('SC_CLK_TCK'), os.sysconf('SC_PAGE_SIZE')  # [1/s], [bytes]


def cpu(pid: int) -> float:
    """Return the processor time of a process and of its children, alive or gone [s]."""
    total = 0.0
    for child in Path(f'/proc/{pid}/task/{pid}/children').read_text('ascii').split():
        total += cpu(int(child))
    fields = Path(f'/proc/{pid}/stat').read_text('ascii').rpartition(')')[2].split()
    return total + sum(map(int, fields[11:15])) / TICK


def memory(pid: int) -> float:
    """Return what a process holds now [MB]."""
    return int(Path(f'/proc/{pid}/statm').read_text('ascii').split()[1]) * PAGE / 1e6
