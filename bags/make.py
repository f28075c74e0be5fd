# SPDX-License-Identifier: Apache-2.0
"""Record the bags of this folder with the emulated arm, in real time.

    . .ci/environment.sh … (see README.md), then: python bags/make.py NAME

Runs emulator, estimator and controller at 20 Hz on a private graph, and records the messages of
hardware and controller.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Any

# Select a private graph before rclpy reads the variables.
os.environ['ROS_DOMAIN_ID'] = str(os.getpid() % 101 + 1)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'

import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.robot import Robot

ROBOT = 'musashi_left_arm'
# The same individual in all bags, so that a network learned from one can be tested on another.
INDIVIDUAL = 1
RATE = 20.0  # [Hz], to keep ten minutes under 3 MB
TOPICS = 'joint_states,muscle_states,muscle_length_command,robot_description'
# `teaching` is short; it also contains the demonstration, the pushes and the commands.
TEACHING_RATE = 50.0  # [Hz]
TAUGHT = ',muscle_tension_command,estimated_joint_states,joint_trajectory'
LEFT_OUT = ',body_state,target_joint_states'  # of `isolation`
ANOMALY = ',anomaly,body_state'  # of `rupture`: A before and after the muscle is cut
PUSHED = 'hardware_emulator/external_wrench'
POSTURE = [0.2, -0.6, 0.1, -1.2, 0.0]  # [rad]


class Arm:
    """The running nodes."""

    def __init__(self, bag: Path, checkpoint: Path, exploration: int | None, more: str) -> None:
        """Start emulator, estimator, controller, and a recorder of TOPICS and `more`.

        `exploration` is the random seed of the exploration; None: the arm does not explore.
        """
        self._processes: list[subprocess.Popen[bytes]] = []
        self.scratch = checkpoint.parent
        rate = RATE if exploration else TEACHING_RATE
        self.common = common = ['--ros-args', '-p', f'robot:={ROBOT}', '-p', f'rate:={rate}']
        self.network = network = ['-p', f'checkpoint:={checkpoint}']
        explore = ['-p', 'explore:=true', '-p', f'seed:={exploration}'] if exploration else []
        body = 'foreign' if bag.name == 'foreign' else 'kin'
        emulated = '-p', f'seed:={INDIVIDUAL}', '-p', f'reality:={body}'
        self.start('hardware_emulator', *common, *emulated)
        self.start('estimator', *common, *network)
        self.start('record', '-o', str(bag), '--topics', TOPICS + more)
        self.start('controller', *common, *network, *explore, '-p', 'max_age:=0.5')
        rclpy.init()
        self.node = rclpy.create_node('make_bag')
        names = 'hardware_emulator', 'controller', 'estimator'
        self._parameters = {name: AsyncParameterClient(self.node, name) for name in names}
        for name, client in self._parameters.items():
            if not client.wait_for_services(timeout_sec=60.0):
                raise TimeoutError(f'{name} did not start within 60 s')

    def start(self, name: str, *arguments: str) -> None:
        """Start a node, which `close` ends."""
        self._processes.append(self.run(name, *arguments))

    def run(self, name: str, *arguments: str) -> subprocess.Popen[bytes]:
        """Start an executable."""
        for prefix in os.environ['AMENT_PREFIX_PATH'].split(os.pathsep):
            file = Path(prefix) / 'lib' / 'musculoskeletal_ae' / name
            if file.exists():
                return subprocess.Popen([sys.executable, str(file), *arguments])
        raise FileNotFoundError(f'{name}: not installed; run ./bringup.sh once')

    def spend(self, seconds: float) -> None:
        """Handle messages while the arm moves."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.1)

    def set(self, name: str, value: Any, node: str = 'hardware_emulator') -> None:
        """Set a parameter of a node."""
        print(f'{name}: {value}')
        future = self._parameters[node].set_parameters([Parameter(name, value=value)])
        rclpy.spin_until_future_complete(self.node, future, timeout_sec=10.0)

    def call(self, name: str, value: bool | None = None) -> None:
        """Call a service: SetBool with a value, Trigger without one."""
        kind = Trigger if value is None else SetBool
        client = self.node.create_client(kind, name)
        if not client.wait_for_service(timeout_sec=60.0):
            raise TimeoutError(f'{name} did not start within 60 s')
        future = client.call_async(kind.Request() if value is None else kind.Request(data=value))
        rclpy.spin_until_future_complete(self.node, future, timeout_sec=10.0)
        print(f'{name}: {future.result()}')

    def close(self) -> None:
        """End all processes in the reverse order of their start."""
        rclpy.shutdown()
        for process in reversed(self._processes):
            process.send_signal(signal.SIGTERM)
            process.wait(timeout=30)


def exploration(arm: Arm) -> None:
    """Ten minutes of the three steps of exploration."""
    arm.spend(600.0)


def foreign(arm: Arm) -> None:
    """Three and a half minutes of exploration of emulator model `foreign`."""
    arm.spend(210.0)


def rupture(arm: Arm) -> None:
    """Two minutes of motion, the second with a 3.6 kg dumbbell; then muscle #2 ruptures."""
    arm.spend(60.0)
    arm.set('payload', 3.6)
    arm.spend(60.0)
    arm.set('faults', ['rupture:deltoid_anterior'])
    arm.spend(20.0)


def faults(arm: Arm) -> None:
    """Two minutes of motion with faults of the sensors: a shifted length, broken messages."""
    arm.spend(40.0)
    arm.set('faults', [f'offset:{Robot.load(ROBOT).muscles[4]}:0.01'])
    arm.spend(40.0)
    arm.set('faults', [''])
    broken = arm.node.create_publisher(Float64MultiArray, 'muscle_states', 10)
    for data in ([float('nan')] * 30, [0.0] * 29, [], [float('inf')] + [0.0] * 29):
        arm.spend(10.0)
        print(f'broken message of {len(data)} values')
        broken.publish(Float64MultiArray(data=array('d', data)))


def teaching(arm: Arm) -> None:
    """A hand moves the arm under gravity compensation; the motion is recorded and repeated."""
    targets = arm.node.create_publisher(JointState, 'target_joint_states', 10)
    hand = arm.node.create_publisher(WrenchStamped, PUSHED, 10)
    joints = Robot.load(ROBOT).joints
    # Wait until the recorder has subscribed, because `replay` sends one message only.
    arm.node.create_publisher(JointTrajectory, 'joint_trajectory', 10)
    arm.spend(5.0)
    targets.publish(JointState(name=joints, position=POSTURE))
    arm.spend(6.0)
    arm.set('method', 'float', 'controller')
    with tempfile.TemporaryDirectory() as scratch:
        shown = str(Path(scratch) / 'shown')
        recorder = arm.run('record', '-o', shown, '--topics', 'estimated_joint_states')
        arm.spend(4.0)
        for force in PUSHES:
            push = WrenchStamped()
            push.wrench.force.x, push.wrench.force.y, push.wrench.force.z = force
            hand.publish(push)
            arm.spend(1.5)
        arm.spend(1.5)
        recorder.send_signal(signal.SIGTERM)
        recorder.wait(timeout=30)
        arm.set('method', 'proposed', 'controller')
        arm.spend(2.0)
        arm.run('replay', shown, '--as-trajectory', '--wait', '20').wait(timeout=60)
    arm.spend(20.0)


def isolation(arm: Arm) -> None:
    """A muscle ruptures, is verified, isolated, and later repaired and relearned."""
    targets = arm.node.create_publisher(JointState, 'target_joint_states', 10)
    joints, muscle = Robot.load(ROBOT).joints, 'deltoid_middle'
    arm.set('on_anomaly', 'isolate', 'estimator')
    arm.spend(25.0)
    arm.set('faults', [f'rupture:{muscle}'])
    arm.spend(15.0)
    targets.publish(JointState(name=joints, position=POSTURE))
    arm.spend(10.0)
    arm.set('faults', [''])
    arm.spend(3.0)
    arm.call('estimator/restore')
    options = f'state_directory:={arm.scratch}', f"relearn_muscles:=['{muscle}']"
    pairs = (part for option in options for part in ('-p', option))
    arm.start('learner', *arm.common, *arm.network, *pairs)
    arm.call('learner/relearn')
    arm.call('controller/explore', True)
    arm.spend(120.0)


# [N] of the hand, one after the other.
PUSHES = ((15.0, 0.0, 10.0), (0.0, 0.0, 0.0), (-10.0, 8.0, 12.0), (0.0, 0.0, 0.0))
#: recorded motion, random seed of the exploration, and further topics
RECORDINGS: dict[str, tuple[Callable[[Arm], None], int | None, str]] = {
    'exploration': (exploration, 101, ''),
    'rupture': (rupture, 102, ANOMALY),
    'faults': (faults, 103, ''),
    'teaching': (teaching, None, f'{TAUGHT},{PUSHED}'),
    'isolation': (isolation, 104, LEFT_OUT),
    'foreign': (foreign, 105, ''),
}


def main() -> None:
    """Record one bag into this folder."""
    parser = Parser('make.py', 'Records one bag of the emulated arm into this folder.')
    parser.add_argument('name', choices=RECORDINGS, help='what the arm does')
    name = parser.parse_args().name
    bag = Path(__file__).resolve().parent / name
    if bag.exists():
        parser.error(f'{bag} is there already; remove it first')
    with tempfile.TemporaryDirectory() as scratch:
        checkpoint = Path(scratch) / 'initial.safetensors'
        train = [sys.executable, '-c', 'from musculoskeletal_ae.tools.train import main; main()']
        subprocess.run([*train, '--robot', ROBOT, '--out', str(checkpoint)], check=True)
        drive, seed, more = RECORDINGS[name]
        arm = Arm(bag, checkpoint, seed, more)
        try:
            drive(arm)
        finally:
            arm.close()


if __name__ == '__main__':
    main()
