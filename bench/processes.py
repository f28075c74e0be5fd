# SPDX-License-Identifier: Apache-2.0
"""Measures CPU time and memory of processes on Linux, and ends processes."""

import os
import signal
import subprocess
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

TICK = os.sysconf('SC_CLK_TCK')  # number of ticks per second; /proc counts CPU time in ticks
PAGE = os.sysconf('SC_PAGE_SIZE')  # number of bytes per page; /proc counts memory in pages
PATIENCE = 20.0  # kill a process that has not ended after this time [s]


def children(pid: int) -> list[int]:
    """Return the running child processes of a process."""
    return [int(child) for child in Path(f'/proc/{pid}/task/{pid}/children').read_text().split()]


def family(pid: int) -> Iterator[int]:
    """Yield a process and its running descendants."""
    yield pid
    for child in children(pid):
        yield from family(child)


def cpu(pid: int) -> float:
    """Return the CPU time of a process and its descendants, running or ended [s]."""
    fields = Path(f'/proc/{pid}/stat').read_text('ascii').rpartition(')')[2].split()
    return sum(map(int, fields[11:15])) / TICK + sum(map(cpu, children(pid)))


def memory(pid: int) -> float:
    """Return the resident memory of a process [MB]."""
    return int(Path(f'/proc/{pid}/statm').read_text('ascii').split()[1]) * PAGE / 1e6


def memory_share(pid: int) -> float:
    """Return the memory of a process [MB]; pages of several processes count in equal shares."""
    lines = Path(f'/proc/{pid}/smaps_rollup').read_text('ascii').splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith('Pss:')) * 1024 / 1e6


def thread_count(pid: int) -> int:
    """Return the number of threads of a process."""
    return sum(1 for _ in Path(f'/proc/{pid}/task').iterdir())


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
