# SPDX-License-Identifier: Apache-2.0
"""A ros2_control robot on the graph: its messages reach the nodes, and their commands reach it."""

import shutil
import signal
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from graph import Process
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from musculoskeletal_ae.nodes.controller import ControllerNode
from musculoskeletal_ae.nodes.estimator import EstimatorNode
from musculoskeletal_ae.nodes.hardware_emulator import HardwareEmulatorNode
from musculoskeletal_ae.nodes.sim import SimNode
from musculoskeletal_ae.robot.directories import find_robot

EXAMPLE = Path(__file__).parents[2] / 'examples' / 'ros2_control'
CONNECTED = yaml.safe_load((EXAMPLE / 'motors.yaml').read_text(encoding='utf-8'))
STATES, COMMANDS = CONNECTED['state_topic'], CONNECTED['command_topic']
MOTORS = [motor['joint'] for motor in CONNECTED['motors'].values()]


@pytest.fixture(scope='module')
def robot_directory(tmp_path_factory):
    """Return a copy of arm26 with the motors of the example."""
    directory = tmp_path_factory.mktemp('robots') / 'arm26'
    shutil.copytree(find_robot('arm26'), directory)
    shutil.copy(EXAMPLE / 'motors.yaml', directory)
    return str(directory)


@pytest.fixture
def host(graph, robot_directory):
    return lambda kind, **more: graph.host(kind, robot=robot_directory, **more)


def joint_values(graph, field='position'):
    """Return the values of the next message of the robot, by joint."""
    message = graph.next(STATES)
    return dict(zip(message.name, getattr(message, field)))


def start_fake_robot(graph):
    graph.listen(JointState, STATES)
    command = [sys.executable, str(EXAMPLE / 'fake_robot.py')]
    command += ['--ros-args', '-r', f'__ns:={graph.namespace}']
    robot = Process('fake_robot', command)
    graph.processes.append(robot)
    graph.next(STATES)
    return robot


def test_the_files_of_controllers_and_motors_state_the_same_motors():
    controllers = yaml.safe_load((EXAMPLE / 'controllers.yaml').read_text(encoding='utf-8'))
    joints = controllers['tendon_controller']['ros__parameters']['joints']
    assert CONNECTED['command_order'] == joints


@pytest.mark.parametrize('name', ['controllers.yaml', 'motors.yaml'])
def test_the_guide_shows_the_files_of_the_example(name):
    guide = (EXAMPLE.parents[1] / 'doc' / 'howto' / 'ros2_control.md').read_text(encoding='utf-8')
    text = (EXAMPLE / name).read_text(encoding='utf-8')
    assert f'```yaml\n{text}```' in guide


def test_the_fake_robot_passes_check_driver_and_is_estimated_and_moved_by_the_nodes(
    graph, host, robot_directory, trained_file, arm26
):
    robot = start_fake_robot(graph)
    assert arm26.description.directory.name in robot.wait_for_output('Hz')
    commands = graph.listen(Float64MultiArray, COMMANDS)
    options = ['--seconds', '1', '--wait', '--move', '--muscles', 'brachialis']
    process = graph.run('check_driver', '--robot', robot_directory, *options)
    graph.wait(lambda: not process.alive(), 'the end of check_driver')
    status, output = process.ended()
    faults = [line.split()[1] for line in output.splitlines() if line.startswith('fault: ')]
    assert set(faults) <= {'latency', 'rate'} and (status == 0 or faults), output
    assert commands and len(commands[0].data) == len(MOTORS)

    estimator = host(EstimatorNode, checkpoint=trained_file)
    estimates = graph.listen(JointState, 'estimated_joint_states')
    graph.wait(lambda: estimates, 'an estimate')
    measured = [joint_values(graph)[joint] for joint in arm26.joints]
    assert np.linalg.norm(np.subtract(estimates[-1].position, measured)) < 1.0
    assert not estimator.rejected

    # On a loaded machine messages arrive late. A large max_age avoids pauses.
    controller = host(ControllerNode, checkpoint=trained_file, max_age=10.0)
    commands.clear()
    lengths = graph.listen(Float64MultiArray, 'muscle_length_command')
    before = joint_values(graph, 'effort')
    targets = graph.publisher(JointState, 'target_joint_states')
    targets.publish(JointState(name=arm26.joints, position=measured))
    graph.wait(lambda: commands and lengths, 'a command')

    def pulls():
        effort = joint_values(graph, 'effort')
        # A motor torque of 0.1 N·m corresponds to a tension of 8 N.
        return max(abs(effort[motor] - before[motor]) for motor in MOTORS) > 0.1

    graph.wait(pulls, 'a motor that pulls')
    converted = controller.motors.command(np.array(lengths[-1].data))
    assert any(np.allclose(message.data, converted) for message in commands[-5:])
    graph.wait(lambda: controller.core.supervisor.is_running, 'the arm to move')
    robot.ends_silently(signal.SIGINT)


def test_a_second_publisher_of_the_motors_is_named(graph, host):
    estimator = host(EstimatorNode)
    graph.publisher(JointState, STATES)
    stranger = Node('stranger', context=graph.context, namespace=graph.namespace)
    stranger.create_publisher(JointState, STATES, 10)
    graph.wait(lambda: estimator.intruders, 'the second publisher')
    nodes = ' and '.join(f'{graph.namespace}/{name}' for name in ('stranger', 'test'))
    assert f'{STATES} come from {nodes}' in estimator.intruders
    stranger.destroy_node()


def test_the_emulator_plays_the_same_robot(graph, host, arm26):
    emulator = host(HardwareEmulatorNode)
    graph.listen(JointState, STATES)
    position = joint_values(graph)
    assert {*MOTORS, *arm26.joints} == position.keys()
    reading = emulator.motors.reading(graph.next(STATES))
    np.testing.assert_allclose(reading.tension, arm26.tension.bias, atol=25.0)
    commands = graph.publisher(Float64MultiArray, COMMANDS)

    def pulls():
        wound = emulator.motors.command(reading.length - 50.0 / arm26.stiffness)
        commands.publish(Float64MultiArray(data=wound.tolist()))
        tension = emulator.motors.reading(graph.next(STATES)).tension
        return (tension > reading.tension + 5.0).all()

    graph.wait(pulls, 'motors that pull')


def test_our_nodes_command_the_emulator_by_its_motors(graph, host, trained_file):
    emulator = host(HardwareEmulatorNode)
    host(EstimatorNode, checkpoint=trained_file)
    host(ControllerNode, checkpoint=trained_file, max_age=10.0, explore=True)
    graph.wait(lambda: not emulator.arm.safe, 'a command to the motors')
    assert not emulator.rejected


def test_the_simulator_takes_the_place_of_the_robot_with_the_same_messages(
    graph, host, trained_file, arm26
):
    sim = host(SimNode, checkpoint=trained_file, as_robot=True)
    graph.listen(JointState, STATES)
    assert {*MOTORS, *arm26.joints} == joint_values(graph).keys()
    commands = graph.publisher(Float64MultiArray, COMMANDS)
    wound = np.full(len(MOTORS), -0.02)

    def followed():
        commands.publish(Float64MultiArray(data=sim.motors.command(wound).tolist()))
        graph.spin(0.02)
        return np.allclose(sim.command, wound)

    graph.wait(followed, 'the command')


def test_what_is_wrong_with_the_messages_is_counted_with_the_reason(graph, host, trained_file):
    estimator = host(EstimatorNode, checkpoint=trained_file)
    graph.listen(DiagnosticArray, '/diagnostics')
    states = graph.publisher(JointState, STATES)
    message = JointState(name=MOTORS, position=[0.0] * 6, effort=[0.5] * 6)

    def counted(reason):
        def is_counted():
            states.publish(message)
            graph.spin(0.05)
            return estimator.rejected[f'muscle_states: {reason}']

        graph.wait(is_counted, reason)

    counted('no stamp')
    message.header.stamp.sec = 5
    counted('repeated stamp')
    message.name = [*MOTORS[1:], 'elbow']
    counted('missing motor')
    graph.wait(
        lambda: (
            'missing motor: deltoid_anterior_motor'
            in graph.report('estimator').values.get('last rejected', '')
        ),
        'the report',
    )


def test_a_second_publisher_of_motor_commands_stops_the_arm(graph, host, trained_file):
    controller = host(ControllerNode, checkpoint=trained_file)
    graph.node.create_publisher(Float64MultiArray, COMMANDS, 10)
    graph.wait(
        lambda: COMMANDS in controller.core.watchdog.second_publisher,
        'the detection of the second publisher',
    )


def test_a_topic_of_joints_and_motors_is_named_once_if_two_nodes_publish_it(graph, host):
    node = host(EstimatorNode)
    for name in ('first', 'second'):
        other = graph.host(partial(Node, name))
        other.create_publisher(JointState, STATES, 10)
    graph.wait(lambda: node.intruders, 'the detection of the second publisher')
    assert node.intruders.startswith(f'{STATES} come from ')


def test_methods_that_command_tensions_are_refused(host):
    controller = host(ControllerNode)
    for method in ('tension', 'float'):
        result = controller.set_parameters([Parameter('method', value=method)])[0]
        assert not result.successful and f'{COMMANDS} follow lengths only' in result.reason
