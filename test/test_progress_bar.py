# SPDX-License-Identifier: Apache-2.0
import fcntl
import os
import re
import struct
import sys
import termios
import time
from contextlib import suppress
from operator import sub
from types import SimpleNamespace

import pytest

from musculoskeletal_ae import progress_bar
from musculoskeletal_ae.progress_bar import ProgressBar


def work(seconds=0.05, parts=5):
    """Do work that takes at least this time [s], and show its progress."""
    with ProgressBar('working', parts, lambda: 'note') as bar:
        bar.announce(' hard')
        for _ in range(parts):
            time.sleep(seconds / parts)
            bar.add()


@pytest.fixture
def shown_on(monkeypatch):
    """Return a function that works with a terminal of a given width, and returns what it shows."""

    def run(columns):
        ours, terminal = os.openpty()
        fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack('HHHH', 24, columns, 0, 0))
        with os.fdopen(terminal, 'w') as stderr, monkeypatch.context() as patch:
            patch.setattr(sys, 'stderr', stderr)
            work()
        shown = b''
        with suppress(OSError):  # EIO at the end
            while more := os.read(ours, 4096):
                shown += more
        os.close(ours)
        return shown.decode()

    return run


def test_a_short_task_prints_one_line_and_no_progress(capsys):
    work()
    assert capsys.readouterr() == ('', 'working hard\n')


def lines_of(durations, capsys, monkeypatch, **options):
    """Return the time [s] and the text of each line about parts with these durations [s]."""
    now = 0.0
    monkeypatch.setattr(progress_bar, 'time', SimpleNamespace(perf_counter=lambda: now))
    lines = []
    with ProgressBar('working', len(durations), **options) as bar:
        for duration in durations:
            now += duration
            bar.add()
            lines += [(now, line) for line in capsys.readouterr().err.splitlines()]
    return lines


def test_a_long_task_prints_its_progress_at_intervals(capsys, monkeypatch):
    lines = lines_of([1.0] * 100, capsys, monkeypatch, note=lambda: 'note')
    times = [at for at, _ in lines]
    assert len(times) > 1
    assert min(map(sub, times[1:], times)) >= progress_bar.REPORT_INTERVAL
    assert lines[0][1].startswith('working: ') and ' %, note, about ' in lines[-1][1]


@pytest.mark.parametrize('part', [0.05, 1.0], ids=['time', 'share'])
def test_the_remaining_time_is_not_shown_before_5_s_and_5_percent(part, capsys, monkeypatch):
    lines = lines_of([5.5, *[part] * 999], capsys, monkeypatch)
    for at, line in lines:
        is_reliable = at >= 5.5 + max(5.0, part * 50.0)
        assert (' s left' in line) == is_reliable, (at, line)
    assert ' s left' in lines[-1][1] and ' s left' not in lines[0][1]


def test_the_remaining_time_of_equal_parts_is_shown_after_5_s(capsys, monkeypatch):
    lines = lines_of([1.0] * 1000, capsys, monkeypatch, is_even=True)
    (at, line) = lines[1]
    assert at <= 10.0
    assert 'about 990 s left' in line


def test_the_remaining_time_does_not_jump_if_some_parts_take_much_longer(capsys, monkeypatch):
    durations = [3.0 if part % 20 == 19 else 0.1 for part in range(1000)]
    ends = [
        at + float(match[1])
        for at, line in lines_of(durations, capsys, monkeypatch)
        if (match := re.search(r'about (\d+) s left', line))
    ]
    assert len(ends) > 30
    assert all(abs(end - sum(durations)) < 0.3 * sum(durations) for end in ends)


def test_a_terminal_shows_a_bar(shown_on):
    shown = shown_on(80)
    assert 'working:   0%|' in shown and 'working hard' not in shown


def test_a_terminal_of_unknown_width_shows_lines(shown_on, monkeypatch):
    monkeypatch.setattr(progress_bar, 'REPORT_INTERVAL', 0.0)
    shown = shown_on(0)
    assert 'working hard' in shown and 'working: 100 %' in shown and '|' not in shown
