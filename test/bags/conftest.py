# SPDX-License-Identifier: Apache-2.0
"""Bags for tests, and the tools as processes on a private ROS graph."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from graph import DEADLINE
from nodes.conftest import graph

from bags import bag_samples as samples

__all__ = ['graph']


@pytest.fixture(scope='session')
def content():
    """Return messages on every topic of the interface."""
    return samples.samples(63, '/left_arm')


@pytest.fixture
def bag(tmp_path, content):
    """Return a valid bag, written by the writer of this package."""
    samples.write_ours(tmp_path / 'bag', content, 'zstd', finish=True)
    return tmp_path / 'bag'


class Tool:
    """`record` or `replay` as a process; the test that started it also ends it."""

    def __init__(self, name: str, *arguments: str | Path) -> None:
        code = f'import sys; from musculoskeletal_ae.executables import {name}; sys.exit({name}())'
        self.process = subprocess.Popen(
            [sys.executable, '-c', code, *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | {'PYTHONPATH': str(Path(__file__).parents[2])},
        )

    def wait_for(self, text: str) -> str:
        """Read lines until one contains the text, and return this line."""
        for line in self.process.stdout:
            if text in line:
                return line
        raise AssertionError(f'{text!r} was never printed')

    def end(self, number: int = signal.SIGINT) -> str:
        """Send the tool a signal; return the rest of its output after its end."""
        self.process.send_signal(number)
        return self.output()

    def output(self) -> str:
        """Wait for the end of the tool; return the rest of its output."""
        return self.process.communicate(timeout=DEADLINE)[0]


@pytest.fixture
def tool():
    """Return a function that starts a tool; tools that still run at the end are killed."""
    started: list[Tool] = []

    def start(name: str, *arguments: str | Path) -> Tool:
        started.append(Tool(name, *arguments))
        return started[-1]

    yield start
    for one in started:
        if one.process.poll() is None:
            one.process.kill()
            one.process.communicate()


@pytest.fixture(autouse=True, scope='session')
def private_graph():
    """Restrict the ROS graph to this machine, unless test.sh has already done so."""
    os.environ.setdefault('ROS_DOMAIN_ID', '67')
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
