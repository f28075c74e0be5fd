# SPDX-License-Identifier: Apache-2.0
"""A node that hangs exits with a status, and logs where it hung."""

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from graph import DEADLINE

from musculoskeletal_ae.ros.hang_detection import STALLED, ProgressWatch, waited_for_processor

START = (
    'from musculoskeletal_ae.ros.hang_detection import ProgressWatch\n'
    'import time\n'
    'watch = ProgressWatch(longest=0.5, look_period=0.1)\n'
    'watch.start()\n'
    'print("started", flush=True)\n'
)


@pytest.fixture
def run() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Return a function that runs code in a process; those that still run at the end are killed."""
    processes = list[subprocess.Popen[str]]()

    def start(code: str, before: str = START) -> subprocess.Popen[str]:
        command = [sys.executable, '-X', 'faulthandler', '-c', before + code]
        pipes = {'stdout': subprocess.PIPE, 'stderr': subprocess.PIPE}
        processes.append(subprocess.Popen(command, text=True, **pipes))
        return processes[-1]

    yield start
    for process in processes:
        if process.poll() is None:
            process.kill()
            process.communicate()


def test_without_progress_the_process_ends_with_the_stacks_in_its_log(run):
    process = run('time.sleep(60)')
    _, errors = process.communicate(timeout=DEADLINE)
    assert process.returncode == STALLED
    assert 'no progress' in errors and 'most recent call first' in errors


def test_a_native_call_that_keeps_the_lock_of_python_ends_the_process_too(run):
    process = run('sum(range(10**12))', START.replace('longest=0.5', 'longest=0.3'))
    _, errors = process.communicate(timeout=DEADLINE)
    assert process.returncode == -signal.SIGVTALRM
    assert 'most recent call first' in errors


def test_a_suspended_process_is_no_process_that_hangs(run):
    process = run('end = time.monotonic() + 1.4\nwhile time.monotonic() < end:\n'
                  '    watch.note(); time.sleep(0.05)\nwatch.stop()')  # fmt: skip
    assert process.stdout is not None and process.stdout.readline() == 'started\n'
    process.send_signal(signal.SIGSTOP)
    time.sleep(0.8)
    process.send_signal(signal.SIGCONT)
    _, errors = process.communicate(timeout=DEADLINE)
    assert process.returncode == 0, errors


def test_progress_keeps_the_watch_quiet_until_it_ends():
    stalled = threading.Event()
    watch = ProgressWatch(longest=0.5, look_period=0.05, on_stall=stalled.set)
    watch.start()
    for _ in range(15):
        watch.note()
        assert not stalled.wait(0.05)
    assert stalled.wait(DEADLINE)
    watch.stop()


def test_a_process_that_gets_no_processor_does_not_hang():
    stalled, begun = threading.Event(), time.monotonic()
    is_overloaded = True
    watch = ProgressWatch(
        longest=0.5,
        look_period=0.05,
        on_stall=stalled.set,
        waited=lambda: time.monotonic() - begun if is_overloaded else 0.0,
    )
    watch.start()
    assert not stalled.wait(1.5)
    is_overloaded = False
    assert stalled.wait(DEADLINE)
    watch.stop()


def test_the_time_for_which_a_thread_waits_for_a_processor_grows():
    before = waited_for_processor()
    deadline = time.monotonic() + DEADLINE
    while waited_for_processor() == before and time.monotonic() < deadline:
        time.sleep(0.001)  # after each sleep, the thread waits a moment for a processor
    assert waited_for_processor() > before
