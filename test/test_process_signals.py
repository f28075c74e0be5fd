# SPDX-License-Identifier: Apache-2.0
"""A stop signal lets a process end its work in order."""

import signal
import subprocess
import sys

import pytest

from musculoskeletal_ae.process_signals import STOP_SIGNALS

WORK = """
import signal, sys, time
if sys.argv[1] == 'nohup':
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
from musculoskeletal_ae.process_signals import STOP, Reaction
STOP.install(Reaction.REMEMBER)
print('ready', flush=True)
while not STOP.received:
    time.sleep(0.05)
    print("awake", flush=True)
print('finished in order')
"""


def start(way):
    command = [sys.executable, '-c', WORK, way]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == 'ready\n'
    return process


@pytest.mark.parametrize('number', STOP_SIGNALS)
def test_a_process_finishes_its_work_after_a_stop_signal(number):
    process = start('terminal')
    process.send_signal(number)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0 and 'finished in order' in output


def test_a_process_that_ignores_a_closed_terminal_goes_on():
    process = start('nohup')
    process.send_signal(signal.SIGHUP)
    for _ in range(5):
        assert process.stdout.readline().startswith('awake')
    assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    assert 'finished in order' in process.communicate(timeout=300)[0]
