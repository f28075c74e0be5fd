# SPDX-License-Identifier: Apache-2.0
"""Measures CPU time and memory of processes on Linux, and ends processes."""

import os
import signal
import subprocess
from collections.abc import Collection
from pathlib import Path
from typing import Any

TICK = os.sysconf('SC_CLK_TCK')  # number of ticks per second; /proc counts CPU time in ticks
PAGE = os.sysconf('SC_PAGE_SIZE')  # number of bytes per page; /proc counts memory in pages
PATIENCE = 20.0  # kill a process that has not ended after this time [s]


def cpu(pid: int) -> float:
    """Return the CPU time of a process and its children, running or ended [s]."""
    total = 0.0
    for child in Path(f'/proc/{pid}/task/{pid}/children').read_text('ascii').split():
        total += cpu(int(child))
    fields = Path(f'/proc/{pid}/stat').read_text('ascii').rpartition(')')[2].split()
    return total + sum(map(int, fields[11:15])) / TICK


def memory(pid: int) -> float:
    """Return the resident memory of a process [MB]."""
    return int(Path(f'/proc/{pid}/statm').read_text('ascii').split()[1]) * PAGE / 1e6


def end_processes(processes: Collection[subprocess.Popen[Any]], asked: signal.Signals) -> None:
    """End processes by a signal, and kill those that have not ended PATIENCE seconds later."""
    for process in processes:
        process.send_signal(asked)
    for process in processes:
        try:
            process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
