# SPDX-License-Identifier: Apache-2.0
"""Checks that the node `estimator` publishes the network's estimate on the present interpreter.

Run `python -m bench.platform_node CHECKPOINT` from the root of the repository. The check needs
neither torch nor the built package; `python -m bench platforms` and the tests run it with other
interpreters.
"""

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from bench.processes import end_processes
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.ros.message_building import array_message

ROBOT = 'arm26'
PATIENCE = 120.0  # wait at most this long for an estimate, because the machine may be busy [s]
LARGEST_DIFFERENCE = 1e-9  # fail if the estimates of node and core differ by more than this [rad]
START = 'from musculoskeletal_ae.executables import estimator; raise SystemExit(estimator())'


def check(file: Path) -> str:
    """Check the node; return one line that describes the result.

    Raises:
        RuntimeError: If the node publishes no estimate or a wrong one, or fails to end cleanly.
    """
    robot = Robot.load(ROBOT)
    mae = checkpoint.load(file)
    theta = 0.5 * (robot.lower + robot.upper)
    tension = np.full(robot.muscle_count, 60.0)
    length = robot.muscle_lengths(theta, tension)
    expected = mae.estimate(tension, length).theta
    rows = np.stack([length, tension, np.full(robot.muscle_count, 25.0)])
    message = array_message(rows, 'quantity', 'muscle')

    received: list[JointState] = []
    rclpy.init()
    node = rclpy.create_node('platform_node')
    node.create_subscription(
        JointState, 'estimated_joint_states', received.append, qos_profile_sensor_data
    )
    publisher = node.create_publisher(Float64MultiArray, 'muscle_states', qos_profile_sensor_data)
    parameters = ['-p', f'robot:={ROBOT}', '-p', f'checkpoint:={file}']
    process = subprocess.Popen([sys.executable, '-c', START, '--ros-args', *parameters])
    try:
        deadline = time.monotonic() + PATIENCE
        while not received:
            if process.poll() is not None:
                raise RuntimeError(f'the estimator ended with status {process.returncode}')
            if time.monotonic() > deadline:
                raise RuntimeError(f'no estimate within {PATIENCE:g} s')
            publisher.publish(message)
            rclpy.spin_once(node, timeout_sec=0.05)
    finally:
        end_processes([process], signal.SIGTERM)
        node.destroy_node()
        rclpy.try_shutdown()
    difference = float(np.max(np.abs(np.array(received[0].position) - expected)))
    if not difference < LARGEST_DIFFERENCE:
        raise RuntimeError(
            f'the estimates of node and core differ by {difference:g} rad; legal: below '
            f'{LARGEST_DIFFERENCE:g}'
        )
    if process.returncode != 0:
        raise RuntimeError(
            f'the estimator ended with status {process.returncode} after SIGTERM; expected 0'
        )
    version = '.'.join(map(str, sys.version_info[:3]))
    return f'Python {version}, NumPy {np.__version__}: node and core have the same estimate'


if __name__ == '__main__':
    print(check(Path(sys.argv[1])))
