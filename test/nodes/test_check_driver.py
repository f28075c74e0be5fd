# SPDX-License-Identifier: Apache-2.0
"""`check_driver` on the graph: it waits, checks a live driver, and moves only if asked to."""

import signal
from argparse import Namespace

import pytest
from graph import PATIENCE
from std_msgs.msg import Float32MultiArray, Float64MultiArray

from musculoskeletal_ae.nodes import check_driver
from musculoskeletal_ae.nodes.hardware_emulator import HardwareEmulator
from musculoskeletal_ae.robot.robot import Robot


def check(graph, *options):
    return graph.run('check_driver', '--robot', 'arm26', *options)


def start_driver(graph, **parameters):
    graph.host(HardwareEmulator, robot='arm26', **parameters)
    graph.listen(Float64MultiArray, 'muscle_states')
    graph.next('muscle_states')


def ended(graph, process):
    """Let the driver run until check_driver has ended; return check_driver's status and output."""
    graph.wait(lambda: not process.alive(), 'the end of check_driver', PATIENCE)
    return process.ended()


def test_a_sound_driver_passes_and_is_moved_only_with_move(graph):
    start_driver(graph)
    commands = graph.listen(Float64MultiArray, 'muscle_length_command')
    # On a busy machine, messages of a healthy driver may be irregular. With --wait, `check_driver`
    # repeats the check until they are regular.
    assert ended(graph, check(graph, '--wait', '--seconds', '2'))[0] == 0
    assert not commands
    one = ['--move', '--muscles', 'biceps_long']
    status, output = ended(graph, check(graph, '--wait', '--seconds', '2', *one))
    faults = [line for line in output.splitlines() if line.startswith('fault: ')]
    assert {line.split()[1] for line in faults} <= {'latency', 'rate'}, output
    assert status == 0 or faults
    graph.spin(0.5)
    assert commands
    heard, moved = output.split('after the motion test:\n')
    assert 'biceps_long ' in heard and 'biceps_long ' in moved  # both contain the table
    repeated = {*heard.splitlines()} & {line for line in moved.splitlines() if ': ' in line}
    assert not repeated  # no remark is printed twice


def test_with_wait_check_driver_reports_faults_until_the_driver_is_right(graph):
    waiting = check(graph, '--wait', '--seconds', '2')
    waiting.wait_for_output(f'waiting for {graph.namespace}/muscle_states')
    start_driver(graph, faults=['bias:biceps_long:0.1'])
    expected = ('fault: zero of biceps_long', 'change: ', 'fix the driver before moving')
    graph.wait(lambda: all(text in waiting.output for text in expected), 'the fault')
    assert 'no fault found' not in waiting.output
    assert graph.set_parameter('hardware_emulator', 'faults', [''])[0]
    status, output = ended(graph, waiting)
    assert status == 0
    assert output.splitlines()[-1].startswith('no fault found; not judged: '), output
    assert 'keeps its contract' not in output


def test_check_driver_says_at_the_first_message_what_it_does_and_then_the_remaining_time(graph):
    start_driver(graph)
    process = check(graph, '--seconds', '1010')
    graph.wait(lambda: '1010 s' in process.output, 'the instruction')
    graph.wait(lambda: '1000 s' in process.output, 'the remaining time')
    assert process.alive()
    process.end()


def test_the_arm_is_announced_to_move_before_the_first_command(graph):
    start_driver(graph)
    commands = graph.listen(Float64MultiArray, 'muscle_length_command')
    process = check(graph, '--wait', '--seconds', '1', '--move', '--muscles', 'biceps_long')
    graph.wait(lambda: commands, 'the first command')
    assert 'moves now' in process.output
    process.end()


def test_what_to_do_while_check_driver_listens_depends_on_arm_and_options():
    robot = Robot.load('arm26')
    options = {'move': False, 'posture': None}
    cases = [({}, True), ({}, False), ({'move': True}, True), ({'posture': [0.0, 0.0]}, False)]
    instructions = {
        check_driver._instruction(robot, Namespace(**options | changes), has_joint_sensors)
        for changes, has_joint_sensors in cases
    }
    assert len(instructions) == len(cases)


def test_a_topic_of_the_wrong_type_is_reported(graph):
    graph.node.create_publisher(Float32MultiArray, 'muscle_states', 10)
    status, output = check(graph, '--seconds', '1').ended()
    assert status == 1
    assert 'is a std_msgs/msg/Float32MultiArray' in output


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


def test_check_driver_does_not_move_an_arm_under_control(graph):
    start_driver(graph)
    graph.publisher(Float64MultiArray, 'muscle_length_command')
    status, output = ended(graph, check(graph, '--seconds', '1', '--move'))
    assert status == 1
    assert 'stop the controller' in output


def test_check_driver_stops_moving_when_a_controller_starts(graph):
    start_driver(graph)
    commands = graph.listen(Float64MultiArray, 'muscle_length_command')
    process = check(graph, '--wait', '--seconds', '1', '--move')
    graph.wait(lambda: commands, 'the first command')
    graph.publisher(Float64MultiArray, 'muscle_length_command')
    status, output = ended(graph, process)
    assert status == 1
    assert 'stop the controller' in output


def test_ctrl_c_ends_check_driver_without_a_traceback(graph):
    waiting = check(graph)
    waiting.wait_for_output('waiting for')
    status, output = waiting.end(signal.SIGINT)
    assert status == 130
    assert 'Traceback' not in output


def test_nodes_report_the_topics_that_they_wait_for(graph):
    estimator = graph.start('estimator', robot='arm26')
    waiting = estimator.wait_for_output('waiting for')
    assert f'{graph.namespace}/muscle_states, which has no publisher' in waiting
    assert f'{graph.namespace}/mae_checkpoint, which has no publisher' in waiting
