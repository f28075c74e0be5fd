# SPDX-License-Identifier: Apache-2.0
"""`check_driver` on the graph: it waits, checks a live driver, and moves only if asked to."""

from contextlib import redirect_stdout
from io import StringIO

import pytest
from graph import PATIENCE
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32MultiArray, Float64MultiArray

from musculoskeletal_ae.nodes.estimator import EstimatorNode
from musculoskeletal_ae.nodes.hardware_emulator import HardwareEmulatorNode
from musculoskeletal_ae.ros_tools import check_driver

RATE = 50.0  # rate of the driver's messages [Hz]; 100 Hz would take twice the processor time
COMMON = ['--robot', 'arm26', '--rate', f'{RATE:g}']


@pytest.fixture(autouse=True)
def discovers_at_once(monkeypatch):
    """Shorten the time for the discovery of other nodes, because the graph is in this process."""
    monkeypatch.setattr(check_driver, 'DISCOVERY_TIME', 0.3)


def check(graph, *options):
    return graph.run('check_driver', *COMMON, *options)


def check_here(graph, *options):
    """Run check_driver in this process, and the driver in another thread; return the status."""
    remap = ['--ros-args', '-r', f'__ns:={graph.namespace}']
    with graph.spinning():
        return check_driver.main([*COMMON, *options, *remap])


def start_driver(graph, **parameters):
    graph.host(HardwareEmulatorNode, robot='arm26', rate=RATE, **parameters)
    graph.listen(Float64MultiArray, 'muscle_states')
    graph.next('muscle_states')


def ended(graph, process):
    """Let the driver run until check_driver has ended; return check_driver's status and output."""
    graph.wait(lambda: not process.alive(), 'the end of check_driver', PATIENCE)
    return process.ended()


def test_a_sound_driver_is_moved_by_move_after_an_announcement_and_passes(graph):
    start_driver(graph)
    printed, said = StringIO(), []

    def on_command(_):
        said.append(printed.getvalue())

    graph.node.create_subscription(Float64MultiArray, 'muscle_length_command', on_command, 10)
    # On a busy machine, messages of a healthy driver may be irregular. With --wait, `check_driver`
    # repeats the check until they are regular.
    with redirect_stdout(printed):
        options = ['--wait', '--seconds', '1', '--move', '--muscles', 'biceps_long']
        status = check_here(graph, *options)
    assert 'moves now' in said[0]  # before the first command
    output = printed.getvalue()
    faults = [line for line in output.splitlines() if line.startswith('fault: ')]
    assert {line.split()[1] for line in faults} <= {'latency', 'rate'}, output
    assert status == 0 or faults
    heard, moved = output.split('after the motion test:\n')
    assert 'biceps_long ' in heard and 'biceps_long ' in moved  # both contain the table
    repeated = {*heard.splitlines()} & {line for line in moved.splitlines() if ': ' in line}
    assert not repeated  # no remark is printed twice


def test_with_wait_check_driver_reports_faults_until_the_driver_is_right_and_moves_nothing(graph):
    waiting = check(graph, '--wait', '--seconds', '1')
    waiting.wait_for_output(f'waiting for {graph.namespace}/muscle_states')
    mistyped = graph.node.create_publisher(Float32MultiArray, 'muscle_states', 10)
    waiting.wait_for_output('is a std_msgs/msg/Float32MultiArray')
    graph.node.destroy_publisher(mistyped)
    commands = graph.listen(Float64MultiArray, 'muscle_length_command')
    start_driver(graph, faults=['bias:biceps_long:0.1'])
    expected = ('fault: zero of biceps_long', 'change: ', 'correct the faults of the driver before')
    graph.wait(lambda: all(text in waiting.output for text in expected), 'the fault')
    assert 'no fault found' not in waiting.output
    assert graph.set_parameter('hardware_emulator', 'faults', [''])[0]
    status, output = ended(graph, waiting)
    assert status == 0
    assert output.splitlines()[-1].startswith('no fault found; not judged: '), output
    assert 'keeps its contract' not in output
    assert not commands


def test_check_driver_says_what_it_does_and_the_remaining_time(graph, monkeypatch, capsys):
    monkeypatch.setattr(check_driver, 'COUNTDOWN', 0.2)
    start_driver(graph)
    check_here(graph, '--seconds', '0.5')
    output = capsys.readouterr().out
    assert 'listening for 0.5 s' in output and 's left' in output


@pytest.mark.parametrize(
    ('options', 'problem'),
    [
        (['--muscles', 'bicep_long'], "unknown muscle 'bicep_long'"),
        (['--tension', '35'], 'needs at least 50 N, but it may command 35 N'),
    ],
)
def test_a_muscle_that_cannot_be_moved_is_refused_at_once(options, problem, capsys):
    arguments = ['--robot', 'arm26', '--seconds', '1000', '--move', *options]
    assert check_driver.main(arguments) == 1
    assert problem in capsys.readouterr().err


def test_check_driver_does_not_move_an_arm_under_control(graph, capsys):
    start_driver(graph)
    graph.publisher(Float64MultiArray, 'muscle_length_command')
    assert check_here(graph, '--seconds', '0.5', '--move') == 1
    printed, refusal = capsys.readouterr()
    assert 'stop the controller' in refusal and 'moves now' not in printed


def test_check_driver_stops_moving_when_a_controller_starts(graph, capsys):
    start_driver(graph)
    topic, controller = 'muscle_length_command', []

    def start_controller(_):
        if not controller:
            controller.append(graph.node.create_publisher(Float64MultiArray, topic, 10))

    graph.node.create_subscription(Float64MultiArray, topic, start_controller, 10)
    assert check_here(graph, '--wait', '--seconds', '1', '--move') == 1
    assert controller and 'stop the controller' in capsys.readouterr().err


@pytest.mark.parametrize('topic', ['muscle_states', 'joint_states'])
def test_a_second_node_on_a_topic_of_the_driver_is_a_fault(graph, capsys, topic):
    start_driver(graph)
    kinds = {'muscle_states': Float64MultiArray, 'joint_states': JointState}
    graph.node.create_publisher(kinds[topic], topic, 10)
    assert check_here(graph, '--seconds', '0.6') == 1
    output = capsys.readouterr().out
    nodes = f'{graph.namespace}/hardware_emulator and {graph.namespace}/test'
    assert f'{graph.namespace}/{topic} come from {nodes}' in output
    assert ('source_list' in output) == (topic == 'joint_states')


def test_two_publishers_of_one_node_name_are_no_fault_unless_their_messages_interleave(
    graph, capsys
):
    """A killed driver stays in the graph for up to 20 s beside its successor."""
    start_driver(graph)
    killed = Node('hardware_emulator', context=graph.context, namespace=graph.namespace)
    killed.create_publisher(Float64MultiArray, 'muscle_states', 10)
    check_here(graph, '--seconds', '1.5')
    assert 'come from' not in capsys.readouterr().out
    killed.destroy_node()


def test_remapped_joint_states_are_found(graph, capsys):
    start_driver(graph)
    remap = ['--ros-args', '-r', f'__ns:={graph.namespace}', '-r', 'joint_states:=other']
    with graph.spinning():
        check_driver.main([*COMMON, '--seconds', '0.5', *remap])
    assert 'joint_states has no publisher' in capsys.readouterr().out
    graph.node.create_publisher(JointState, 'other', 10)
    with graph.spinning():
        check_driver.main([*COMMON, '--seconds', '0.5', *remap])
    assert 'joint_states has no publisher' not in capsys.readouterr().out


def test_nodes_report_the_topics_that_they_wait_for(graph, capfd):
    graph.host(EstimatorNode, robot='arm26')
    logged = ''

    def waits():
        nonlocal logged
        logged += capfd.readouterr().err
        return 'waiting for' in logged

    graph.wait(waits, 'the log')
    assert f'{graph.namespace}/muscle_states, which has no publisher' in logged
    assert f'{graph.namespace}/mae_checkpoint, which has no publisher' in logged
