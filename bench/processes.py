# SPDX-License-Identifier: Apache-2.0
"""What a process takes of the machine, as Linux counts it, and its end."""

import os
import signal
import subprocess
from collections.abc import Collection
from pathlib import Path
from typing import Any

TICK, PAGE = os.sysconf('SC_CLK_TCK'), os.sysconf('SC_PAGE_SIZE')  # [1/s], [bytes]
PATIENCE = 20.0  # [s]


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


def end_processes(processes: Collection[subprocess.Popen[Any]], asked: signal.Signals) -> None:
    """Ask processes to end by a signal, and kill what goes on."""
    for process in processes:
        process.send_signal(asked)
    for process in processes:
        try:
            process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
