# SPDX-License-Identifier: Apache-2.0
"""The whole loop: emulator, estimator and controller on one graph."""

from __future__ import annotations

import signal

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger

from musculoskeletal_ae.nodes.messages import read_array


@pytest.fixture
def arm(graph, trained):
    graph.listen(Float64MultiArray, 'muscle_states')
    graph.listen(JointState, 'joint_states')
    graph.listen(JointState, 'estimated_joint_states')
    graph.listen(Float64MultiArray, 'muscle_length_command', 1000)
    graph.listen(DiagnosticArray, '/diagnostics')
    graph.hardware = graph.start('hardware_emulator', robot='arm26', seed=1)
    graph.estimator = graph.start('estimator', robot='arm26', checkpoint=trained)
    graph.controller = graph.start(
        'controller', robot='arm26', checkpoint=trained, first_duration=1.0, rate_limit=0.2
    )
    graph.next('estimated_joint_states')
    graph.target = graph.publisher(JointState, 'target_joint_states')
    return graph


def state(graph):
    name = f'{graph.namespace}/controller: state'
    found = [s for m in graph.received['/diagnostics'] for s in m.status if s.name == name]
    return found[-1] if found else DiagnosticStatus()


def commands(graph, robot):
    return np.array(
        [read_array(m, 1, robot.muscle_count) for m in graph.received['muscle_length_command']]
    )


def target(graph, robot, theta, effort=None):
    graph.target.publish(
        JointState(name=robot.joints, position=list(theta), effort=list(effort or []))
    )


def posture(graph):
    return np.array(graph.next('joint_states').position)


def test_a_target_is_approached_without_a_jump(arm, arm26):
    theta = np.array([-0.5, -1.2])
    target(arm, arm26, theta)
    arm.wait(lambda: np.linalg.norm(posture(arm) - theta) < 0.3, 'the posture')
    sent = commands(arm, arm26)
    # 100 Hz and at most 0.2 m/s: 2 mm a step; ten steps of grace for a loaded machine.
    assert np.abs(np.diff(sent, axis=0)).max() <= 0.2 * 0.1 + 1e-9
    other = np.array([0.1, -0.4])
    target(arm, arm26, other)
    arm.wait(lambda: np.linalg.norm(posture(arm) - other) < 0.3, 'the other posture')


@pytest.mark.parametrize('method', ['geometric', 'first', 'second'])
def test_every_method_moves_the_arm(arm, arm26, method):
    assert arm.set_parameter('controller', 'method', method)[0]
    assert not arm.set_parameter('controller', 'method', 'magic')[0]
    theta = np.array([-0.4, -1.3])
    target(arm, arm26, theta)
    arm.wait(lambda: np.linalg.norm(posture(arm) - theta) < 0.5, 'the posture')


def test_a_target_beyond_the_limits_is_clamped_and_reported(arm, arm26):
    arm.target.publish(JointState(name=['elbow'], position=[-9.0]))
    arm.wait(lambda: 'elbow' in str(state(arm).values), 'the report')
    arm.target.publish(JointState(name=['knee'], position=[0.0]))
    arm.wait(lambda: 'unknown joint' in str(state(arm).values), 'the rejection')


def test_stop_pays_out_to_the_bias_and_only_reset_ends_it(arm, arm26):
    target(arm, arm26, [-0.5, -1.5])
    arm.wait(lambda: len(commands(arm, arm26)) > 50, 'commands')
    assert arm.call(Trigger, 'controller/stop').success
    before = len(arm.received['muscle_length_command'])

    def released():
        tension = read_array(arm.next('muscle_states'), 3, 6)[1]
        return tension.max() < arm26.tension.bias + 8.0

    arm.wait(released, 'the muscles to be paid out')
    assert len(arm.received['muscle_length_command']) > before  # keeps publishing
    assert not arm.call(SetBool, 'controller/explore', SetBool.Request(data=True)).success
    assert arm.call(Trigger, 'controller/reset').success
    assert arm.call(SetBool, 'controller/explore', SetBool.Request(data=True)).success


def test_a_dead_estimator_stops_it_and_a_new_one_lets_it_resume(arm, arm26, trained):
    target(arm, arm26, [-0.5, -1.2])
    arm.wait(lambda: len(commands(arm, arm26)) > 20, 'commands')
    arm.processes.remove(arm.estimator)
    arm.estimator.end(signal.SIGKILL)
    arm.wait(lambda: 'estimated_joint_states older' in state(arm).message, 'the stop')
    answer = arm.call(Trigger, 'controller/reset')
    assert not answer.success
    assert 'estimated_joint_states' in answer.message
    arm.start('estimator', robot='arm26', checkpoint=trained)
    arm.next('estimated_joint_states', 5)
    arm.wait(lambda: arm.call(Trigger, 'controller/reset').success, 'the reset')
    theta = np.array([-0.3, -1.0])
    target(arm, arm26, theta)
    arm.wait(lambda: np.linalg.norm(posture(arm) - theta) < 0.4, 'the posture')


def test_a_dead_controller_leaves_the_modules_safe(arm, arm26):
    target(arm, arm26, [-0.5, -1.5])
    arm.wait(lambda: len(commands(arm, arm26)) > 100, 'commands')
    arm.processes.remove(arm.controller)
    arm.controller.end(signal.SIGKILL)

    def released():
        return read_array(arm.next('muscle_states'), 3, 6)[1].max() < arm26.tension.bias + 8.0

    arm.wait(released, 'the modules to go safe')


def test_an_anomaly_stops_it_until_both_are_reset(arm, arm26):
    target(arm, arm26, [-0.5, -1.2])
    arm.wait(lambda: len(commands(arm, arm26)) > 20, 'commands')
    assert arm.set_parameter('hardware_emulator', 'ruptured_muscles', [arm26.muscles[0]])[0]
    arm.wait(lambda: 'anomaly' in state(arm).message, 'the stop')
    assert not arm.call(Trigger, 'controller/reset').success
    assert arm.set_parameter('hardware_emulator', 'ruptured_muscles', [''])[0]

    def mended():
        return read_array(arm.next('muscle_states'), 3, 6)[1][0] > 15.0

    arm.wait(mended, 'tension in the mended muscle')
    assert arm.call(Trigger, 'estimator/reset').success
    arm.wait(lambda: arm.call(Trigger, 'controller/reset').success, 'the reset')


def test_exploration_moves_the_arm_and_a_target_ends_it(arm, arm26):
    assert arm.call(SetBool, 'controller/explore', SetBool.Request(data=True)).success
    start = posture(arm)
    arm.wait(lambda: np.linalg.norm(posture(arm) - start) > 0.3, 'motion')
    arm.wait(lambda: state(arm).message == 'exploring', 'the report')
    target(arm, arm26, [-0.3, -1.0])
    arm.wait(lambda: state(arm).message == 'holding', 'the end of exploration')
