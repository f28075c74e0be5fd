# SPDX-License-Identifier: Apache-2.0
"""The programs of examples/ end silently after Ctrl-C (SIGINT) or SIGTERM, at any moment.

The tests that use the two nodes end them so while they run. test/test_plain_python.py does so with
the other program, learn_in_python.py, while it learns.
"""

import random
import signal
import sys
import time
from pathlib import Path

import pytest
from graph import Process
from processes import catches
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

EXAMPLES = Path(__file__).parents[2] / 'examples'
#: the first message of each example that is a node, and the first line of the other example
FIRST = {
    'driver.py': (Float64MultiArray, 'muscle_states'),
    'ros2_control/fake_robot.py': (JointState, 'joint_states'),
    'learn_in_python.py': 'posture 1 of',
}
LONGEST_START = 3.0  # latest of the random moments while a program starts [s]
STOPS = (signal.SIGINT, signal.SIGTERM)


def start(graph, name, folder):
    """Start an example, and return when it reacts to the signals itself."""
    command = [sys.executable, str(EXAMPLES / name)]
    if isinstance(FIRST[name], tuple):
        command += ['--ros-args', '-r', f'__ns:={graph.namespace}']
    else:
        command += ['--steps', '100', '--out', str(folder / 'learned.safetensors')]
    process = Process(Path(name).name, command, cwd=folder)
    graph.tools.append(process)
    graph.wait(lambda: catches(process.process.pid, *STOPS), f'{name} to start', 60.0)
    return process


def runs(graph, process, name):
    """Wait until an example has published its first message, or written its first line."""
    if isinstance(FIRST[name], tuple):
        _, topic = FIRST[name]
        graph.received[topic].clear()
        graph.next(topic)
    else:
        process.wait_for_output(FIRST[name])


@pytest.mark.thorough
def test_an_example_that_takes_long_to_start_ends_silently_meanwhile(graph, tmp_path):
    start(graph, 'learn_in_python.py', tmp_path).ends_silently(signal.SIGINT)


@pytest.mark.thorough
@pytest.mark.parametrize('stop', STOPS)
@pytest.mark.parametrize('name', FIRST)
def test_an_example_ends_silently_after_a_stop_signal_at_any_moment(graph, name, stop, tmp_path):
    if isinstance(FIRST[name], tuple):
        graph.listen(*FIRST[name])
    for n in range(3):
        process = start(graph, name, tmp_path)
        if is_running := n % 2 == 1:
            runs(graph, process, name)
        time.sleep(random.uniform(0.0, 0.3 if is_running else LONGEST_START))
        process.ends_silently(stop)


def test_every_example_in_python_is_tested_here():
    nodes = {file.relative_to(EXAMPLES).as_posix() for file in EXAMPLES.rglob('*.py')}
    assert nodes - {'make_csv.py'} == set(FIRST)  # test/tables tests this one
