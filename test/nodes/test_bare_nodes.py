# SPDX-License-Identifier: Apache-2.0
"""A bench compares nodes with processes that only exchange messages of the same size."""

import sys

import pytest
from graph import Process
from std_msgs.msg import Float64MultiArray

from bench.wire import ALONE
from musculoskeletal_ae.signals.muscle_states import QUANTITIES


@pytest.mark.thorough
def test_a_bare_node_publishes_readings_of_the_size_of_the_robot(graph, arm26):
    topic = f'{graph.namespace}/muscle_states'
    messages = graph.listen(Float64MultiArray, topic)
    command = [sys.executable, '-c', ALONE, 'bare', 'arm26', '20', '', topic, '']
    graph.processes.append(Process('bare', command))
    graph.wait(lambda: messages, 'readings')
    assert len(messages[0].data) == len(QUANTITIES) * arm26.muscle_count
