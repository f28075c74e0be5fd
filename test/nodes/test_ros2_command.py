# SPDX-License-Identifier: Apache-2.0
"""The real `ros2` command starts the nodes and shows their topics."""

import os
import shutil
import signal

import numpy as np
import pytest
import yaml
from graph import Process
from std_msgs.msg import Float64MultiArray

from musculoskeletal_ae.ros.message_building import array_message

ROS2 = shutil.which('ros2') or ''
pytestmark = pytest.mark.skipif(not ROS2, reason='there is no ros2 command (doc/howto/install.md)')


def test_ros2_run_starts_a_node_and_ros2_topic_echo_shows_the_anomaly(graph, arm26, trained_file):
    parameters = ['-p', 'robot:=arm26', '-p', f'checkpoint:={trained_file}']
    parameters += ['-r', f'__ns:={graph.namespace}']
    command = [ROS2, 'run', 'musculoskeletal_ae', 'estimator', '--ros-args', *parameters]
    node = Process('ros2_run', command, start_new_session=True)
    try:
        topic = f'{graph.namespace}/anomaly', 'std_msgs/msg/Float64'
        echo = [ROS2, 'topic', 'echo', '--once', '--no-daemon', *topic]
        shown = Process('ros2_topic_echo', echo)
        graph.tools.append(shown)
        muscles = graph.publisher(Float64MultiArray, 'muscle_states')
        theta, tension = 0.5 * (arm26.lower + arm26.upper), np.full(6, 60.0)
        rows = [arm26.muscle_lengths(theta, tension), tension, np.full(6, 25.0)]
        message = array_message(np.stack(rows), 'quantity', 'muscle')

        def has_ended():
            muscles.publish(message)
            graph.spin(0.05)
            return not shown.alive()

        graph.wait(has_ended, 'a message on /anomaly')
        status, output = shown.ended()
        assert status == 0, output
        (anomaly,) = [each['data'] for each in yaml.safe_load_all(output) if each]
        assert np.isfinite(anomaly) and anomaly > 0.0
    finally:
        os.killpg(node.process.pid, signal.SIGINT)
        node.ended()
