# SPDX-License-Identifier: Apache-2.0
"""A stop signal lets a process end its work in order."""

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from musculoskeletal_ae.process_signals import INTERRUPTED, STOP_SIGNALS

ROOT = Path(__file__).resolve().parent.parent

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


def is_prepared(process):
    """Return whether a process handles SIGTERM, by a handler of its own."""
    status = Path(f'/proc/{process.pid}/status').read_text()
    caught = int(re.search(r'^SigCgt:\s*(\w+)$', status, re.MULTILINE)[1], 16)
    return bool(caught >> (signal.SIGTERM - 1) & 1)


def test_ctrl_c_ends_a_module_that_bringup_runs_silently():
    module = [sys.executable, '-m', 'musculoskeletal_ae.executables', 'tools.recorded_robot']
    process = subprocess.Popen(
        [*module, 'bags/teaching', 'arm26'], cwd=ROOT, stderr=subprocess.PIPE, text=True
    )
    while not is_prepared(process):
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=300)[1] == ''
    assert process.returncode == INTERRUPTED


def test_a_terminal_is_prepared_from_any_directory_in_spite_of_cdpath(tmp_path):
    """The files that terminal.sh reads state the directory in which it looks for them."""
    folders = [tmp_path / 'here' / 'sub', tmp_path / 'elsewhere' / 'sub']
    for folder in folders:
        (folder / '.ci').mkdir(parents=True)
    shutil.copy(ROOT / 'terminal.sh', folders[0])
    stub = 'environment_setup() { printf "set up %s\\n" "$repository"; exit 1; }\n'
    (folders[0] / '.ci' / 'environment.sh').write_text(stub)
    done = subprocess.run(
        ['bash', '-c', '. sub/terminal.sh'], cwd=folders[0].parent, capture_output=True, text=True,
        env=os.environ | {'CDPATH': f'{folders[1].parent}:.'}, timeout=300, check=False,
    )  # fmt: skip
    assert (done.stdout, done.stderr) == (f'set up {folders[0].resolve()}\n', '')
