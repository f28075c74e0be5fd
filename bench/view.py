# SPDX-License-Identifier: Apache-2.0
"""What the page costs: CPU of the node `view` while nobody looks, and while somebody does.

python -m bench view [--seconds 20] [--robot musashi_left_arm]

All topics of a moving arm are published at 100 Hz; the visitor takes the pictures and draws none,
as a browser's own work is not counted. Passes if `view` takes at most 10 % of a core while somebody
looks, and at most 0.5 % while nobody does.
"""

import subprocess
import sys
import threading
import time

import msgspec
import numpy as np
import rclpy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray

from bench.processes import cpu
from musculoskeletal_ae.nodes.messages import RELIABLE, array_message, joint_message
from musculoskeletal_ae.nodes.view import ARM_TOPICS
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.robot import Robot

MOST, MOST_IDLE = 0.10, 0.005  # of a core
PORT, NAMESPACE = 8097, '/bench_view'
RATE = 100.0  # [Hz]


def share(pid: int, seconds: float) -> float:
    """Return the share of a core that a process uses for a while."""
    begun, used = time.monotonic(), cpu(pid)
    time.sleep(seconds)
    return (cpu(pid) - used) / (time.monotonic() - begun)


def publish(robot: Robot, ended: threading.Event) -> None:
    """Publish an arm that moves through its range."""
    node = rclpy.create_node('bench', namespace=NAMESPACE)
    joints = [node.create_publisher(JointState, each, RELIABLE) for each in ARM_TOPICS.values()]
    muscles = node.create_publisher(Float64MultiArray, 'muscle_states', RELIABLE)
    anomaly = node.create_publisher(Float64, 'anomaly', RELIABLE)
    middle, half = 0.5 * (robot.lower + robot.upper), 0.4 * (robot.upper - robot.lower)
    phase = np.arange(robot.muscle_count)
    while not ended.wait(1.0 / RATE):
        now = time.monotonic()
        for i, publisher in enumerate(joints):
            theta = middle + half * np.sin(now + 0.05 * i + phase[: robot.joint_count])
            stamp = node.get_clock().now().to_msg()
            publisher.publish(joint_message(robot.joints, theta, stamp))
        tension = 100.0 + 80.0 * np.sin(now + phase)
        rows = np.stack([0.0 * tension, tension, 40.0 + 0.0 * tension])
        muscles.publish(array_message(rows, 'quantity', 'muscle'))
        anomaly.publish(Float64(data=0.1))
    node.destroy_node()


def visit(ended: threading.Event) -> int:
    """Look at the page until the end; return how many messages came."""
    import viser
    from viser import _messages
    from websockets.sync.client import connect

    url, protocol = f'ws://127.0.0.1:{PORT}', f'viser-v{viser.__version__}'
    camera = {
        'type': _messages.ViewerCameraMessage.__name__,
        'wxyz': (1.0, 0.0, 0.0, 0.0),
        'position': (1.0, 1.0, 1.0),
        'look_at': (0.0, 0.0, 0.0),
        'up_direction': (0.0, 0.0, 1.0),
        'fov': 1.0,
        'near': 0.01,
        'far': 10.0,
        'image_height': 800,
        'image_width': 1200,
    }
    came = 0
    with connect(url, subprotocols=[protocol], max_size=None) as socket:
        socket.send(msgspec.msgpack.encode(camera))
        while not ended.is_set():
            socket.recv(timeout=30)
            came += 1
    return came


def main(argv: list[str]) -> int:
    """Measure."""
    parser = Parser('view', 'What the page costs.')
    parser.add_argument('--seconds', type=float, default=20.0, help='of each')
    parser.add_robot()
    options = parser.parse_args(argv)
    start = 'import sys; from musculoskeletal_ae.nodes.view import main; sys.exit(main({}))'
    arguments = ['--robot', options.robot, '--port', str(PORT)]
    arguments += ['--ros-args', '-r', f'__ns:={NAMESPACE}']
    view = subprocess.Popen(
        [sys.executable, '-c', start.format(arguments)], stdout=subprocess.PIPE, text=True
    )
    rclpy.init()
    ended, left, came = threading.Event(), threading.Event(), list[int]()
    publisher = threading.Thread(target=publish, args=(Robot.load(options.robot), ended))
    visitor = threading.Thread(target=lambda: came.append(visit(left)))
    try:
        assert view.stdout is not None
        print(view.stdout.readline().strip())
        publisher.start()
        time.sleep(3.0)
        idle = share(view.pid, options.seconds)
        visitor.start()
        time.sleep(3.0)
        looked_at = share(view.pid, options.seconds)
        left.set()
        visitor.join()
    finally:
        ended.set()
        left.set()
        view.terminate()
        view.wait()
        publisher.join()
        rclpy.try_shutdown()
    print(f'nobody looks {100 * idle:.1f} %, somebody does {100 * looked_at:.1f} % of a core')
    print(f'{came[0] / (options.seconds + 3.0):.0f} messages a second')
    return int(idle > MOST_IDLE or looked_at > MOST)
