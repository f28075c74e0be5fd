# SPDX-License-Identifier: Apache-2.0
"""Estimator and controller in one process: the same nodes, and a common shutdown."""

import os
import signal

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.nodes.declared_parameters import check_names
from musculoskeletal_ae.nodes.hardware_emulator import HardwareEmulatorNode


def test_both_nodes_of_one_process_move_the_arm_and_end_by_one_signal(graph, trained_file):
    graph.listen(DiagnosticArray, '/diagnostics', 100)
    for kind, topic in (
        (Float64MultiArray, 'muscle_length_command'),
        (JointState, 'estimated_joint_states'),
    ):
        graph.listen(kind, topic)
    graph.host(HardwareEmulatorNode, robot='arm26')
    process = graph.start(
        'combined', robot='arm26', checkpoint=trained_file, explore=True, max_age=10.0
    )
    graph.next('estimated_joint_states', 20)
    graph.next('muscle_length_command', 20)
    for node in ('estimator', 'controller'):
        graph.wait(lambda node=node: graph.report(node).message != 'not heard of', node)
    graph.wait(lambda: graph.report('controller').message == 'exploring', 'exploration')
    assert os.getpriority(os.PRIO_PROCESS, process.process.pid) == os.nice(0)
    done, why = graph.set_parameter('estimator', 'on_anomaly', 'panic')
    assert not done and 'on_anomaly' in why
    assert graph.ended(process, signal.SIGINT)[0] == 0


def test_a_parameter_that_only_another_node_has_is_refused():
    with pytest.raises(MusculoskeletalError, match='combined has no parameter'):
        check_names(['payload'], 'combined')
