# SPDX-License-Identifier: Apache-2.0
"""The controller moves an emulated arm on a real graph, with every method."""

import numpy as np
import pytest
from controlled_arm import ControlledArm
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

HERE, THERE = np.array([-0.5, -1.2]), np.array([0.1, -0.4])


@pytest.fixture
def arm(graph, arm26, trained_file):
    return ControlledArm(graph, arm26, trained_file)


def test_methods_and_exploration_move_the_arm_without_a_jump(arm):
    for n, method in enumerate(('geometric', 'proposed')):
        assert arm.graph.set_parameter('controller', 'method', method)[0]
        goal = THERE if n % 2 else HERE
        arm.target(goal)
        arm.goes_to(goal, within=0.5)
    done, reason = arm.graph.set_parameter('controller', 'method', 'magic')
    assert not done
    assert 'proposed' in reason
    request = SetBool.Request(data=True)
    assert arm.graph.call(SetBool, 'controller/explore', request).success
    start = arm.posture()
    arm.graph.wait(lambda: np.linalg.norm(arm.posture() - start) > 0.3, 'motion')
    arm.says('exploring')
    arm.target(HERE)
    arm.says('holding')
    arm.goes_to(HERE)
    assert arm.count('tension') == 0
    arm.never_jumped()


def test_method_tension_sends_tensions_only_and_returns_to_lengths(arm):
    arm.target(HERE)
    arm.goes_to(HERE)
    assert arm.graph.set_parameter('controller', 'method', 'tension')[0]
    arm.graph.wait(lambda: arm.count('tension') > 25, 'tension commands')
    lengths = arm.count()
    arm.target(THERE)
    arm.goes_to(THERE, within=0.4)
    assert arm.count() == lengths
    sent = arm.sent('tension')
    assert sent.min() >= arm.robot.tension.bias[0]
    assert sent.max() <= arm.robot.tension.limit[0]
    assert arm.graph.set_parameter('controller', 'method', 'proposed')[0]
    arm.graph.wait(lambda: arm.count() > lengths + 25, 'length commands')
    arm.goes_to(THERE)


def test_a_target_beyond_the_limits_is_clamped_and_an_unknown_joint_rejected(arm, capfd):
    arm.targets.publish(JointState(name=['elbow'], position=[-9.0]))
    arm.says('target clamped')
    assert 'accepted target_joint_states: elbow -9.000' in capfd.readouterr().err
    arm.targets.publish(JointState(name=['knee'], position=[0.0]))
    rejected = arm.controller.rejected
    arm.graph.wait(lambda: rejected['target_joint_states: unknown joint'] == 1, 'the rejection')
    assert arm.controller.core.target_state.theta[1] == arm.robot.lower[1]


def test_a_push_moves_an_arm_in_gravity_compensation_and_is_estimated(arm):
    graph = arm.graph
    graph.listen(WrenchStamped, 'estimated_external_wrench', 1000)
    pushes = graph.publisher(WrenchStamped, 'hardware_emulator/external_wrench')
    arm.target(HERE)
    arm.goes_to(HERE)

    def still():
        postures = [arm.posture() for _ in range(20)]
        return np.ptp(postures, axis=0).max() < 0.01

    graph.wait(still, 'rest')
    assert graph.set_parameter('controller', 'method', 'float')[0]
    arm.says('gravity compensation')
    before = arm.posture()
    for _ in range(30):
        left = arm.posture()
    assert np.abs(left - before).max() < 0.1

    def force(size):
        wrench = WrenchStamped()
        wrench.wrench.force.x = size
        pushes.publish(wrench)
        return graph.next('estimated_external_wrench')

    size = 20.0 if left[1] > np.mean([arm.robot.lower[1], arm.robot.upper[1]]) else -20.0
    graph.wait(lambda: force(size).wrench.force.x * size > 25.0, 'the force')
    assert graph.next('estimated_external_wrench').header.frame_id == arm.robot.root_link
    graph.wait(lambda: np.abs(arm.posture() - left).max() > 0.15, 'motion')
