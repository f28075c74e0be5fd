# SPDX-License-Identifier: Apache-2.0
"""The controller moving an emulated arm on a real graph, by every method."""

from __future__ import annotations

import numpy as np
import pytest
from controlled_arm import RATE_LIMIT, ControlledArm
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import UInt8MultiArray
from std_srvs.srv import SetBool

from musculoskeletal_ae.control.stiffness import stiffness_command
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.nodes.messages import bytes_message
from musculoskeletal_ae.nodes.qos import LATCHED
from musculoskeletal_ae.robot.stiffness import push_deflection

HERE, THERE = np.array([-0.5, -1.2]), np.array([0.1, -0.4])


@pytest.fixture
def arm(graph, arm26, trained_file):
    return ControlledArm(graph, arm26, trained_file)


def test_every_length_method_moves_the_arm_and_a_wrong_one_is_refused(arm):
    for n, method in enumerate(('geometric', 'first', 'second', 'proposed', 'stiffness')):
        assert arm.graph.set_parameter('controller', 'method', method)[0]
        goal = THERE if n % 2 else HERE
        arm.target(goal)
        arm.goes_to(goal, within=0.5)
    done, reason = arm.graph.set_parameter('controller', 'method', 'magic')
    assert not done
    assert 'proposed' in reason
    assert len(arm.sent('tension')) == 0


def test_a_target_is_approached_without_a_jump_and_the_next_one_as_well(arm):
    arm.target(HERE)
    arm.goes_to(HERE)
    arm.target(THERE)
    arm.goes_to(THERE)
    # 0.1 s is the longest step that control takes after a pause.
    assert np.abs(np.diff(arm.sent(), axis=0)).max() <= RATE_LIMIT * 0.1 + 1e-9


def test_tension_sends_tensions_only_reaches_the_posture_and_goes_back_to_lengths(arm):
    arm.target(HERE)
    arm.goes_to(HERE)
    assert arm.graph.set_parameter('controller', 'method', 'tension')[0]
    arm.graph.wait(lambda: len(arm.sent('tension')) > 50, 'tension commands')
    lengths = len(arm.sent())
    arm.target(THERE)
    arm.goes_to(THERE, within=0.4)
    assert len(arm.sent()) == lengths
    sent = arm.sent('tension')
    assert sent.min() >= arm.robot.tension.bias
    assert sent.max() <= arm.robot.tension.limit
    assert arm.graph.set_parameter('controller', 'method', 'proposed')[0]
    arm.graph.wait(lambda: len(arm.sent()) > lengths + 50, 'length commands')
    arm.goes_to(THERE)


def test_a_push_measures_the_stiffness_that_was_wished_within_the_reported_range(arm, trained_file):
    theta, robot = np.array([0.3, -0.8]), arm.robot
    mae = checkpoint.load(trained_file, robot)
    # A torque on the shoulder alone, large against friction.
    wrench = 3.0 * np.linalg.pinv(robot.kinematics.end_effector_jacobian(theta).T)[:, 0]
    assert arm.graph.set_parameter('controller', 'method', 'stiffness')[0]
    assert not arm.graph.set_parameter('controller', 'joint_stiffness', [1.0, 2.0, 3.0])[0]
    arm.target(theta)
    low, high = arm.reachable(robot.joints[0])
    push = arm.graph.publisher(WrenchStamped, 'hardware_emulator/external_wrench')
    turned, expected = [], []
    for share in (0.125, 0.875):
        wish = np.array([low + share * (high - low), 0.0])
        done, _ = arm.graph.set_parameter('controller', 'joint_stiffness', wish.tolist())
        assert done
        arm.graph.spin(3.0)
        ends = []
        for sign in (1.0, -1.0):
            message = WrenchStamped()
            force, torque = message.wrench.force, message.wrench.torque
            force.x, force.y, force.z = sign * wrench[:3]
            torque.x, torque.y, torque.z = sign * wrench[3:]
            push.publish(message)
            arm.graph.spin(1.5)
            ends.append(np.mean([arm.posture()[0] for _ in range(10)]))
        push.publish(WrenchStamped())
        turned.append(ends[0] - ends[1])
        weight = robot.kinematics.holding_torque(theta)
        found = stiffness_command(robot, mae, theta, weight, wish, robot.tension.limit)
        expected.append(push_deflection(robot.kinematics, theta, found.stiffness, wrench)[0])
    assert turned[0] / turned[1] == pytest.approx(expected[0] / expected[1], rel=0.2)
    assert arm.graph.set_parameter('controller', 'joint_stiffness', [1e4, 0.0])[0]
    arm.says('clamped')


def test_a_target_beyond_the_limits_is_clamped_and_an_unknown_joint_rejected(arm):
    arm.targets.publish(JointState(name=['elbow'], position=[-9.0]))
    arm.says('target clamped')
    arm.targets.publish(JointState(name=['knee'], position=[0.0]))
    arm.says('unknown joint')


def test_exploration_moves_the_arm_and_a_target_ends_it(arm):
    request = SetBool.Request(data=True)
    assert arm.graph.call(SetBool, 'controller/explore', request).success
    start = arm.posture()
    arm.graph.wait(lambda: np.linalg.norm(arm.posture() - start) > 0.3, 'motion')
    arm.says('exploring')
    arm.target(HERE)
    arm.says('holding')
    arm.goes_to(HERE)


def test_a_new_checkpoint_changes_no_command_by_a_jump(arm, trained_file):
    arm.target(HERE)
    arm.goes_to(HERE)
    publisher = arm.graph.publisher(UInt8MultiArray, 'mae_checkpoint', LATCHED)
    with open(trained_file, 'rb') as file:  # noqa: PTH123
        publisher.publish(bytes_message(file.read()))
    before = len(arm.sent())
    arm.graph.wait(lambda: len(arm.sent()) > before + 100, 'commands')
    assert np.abs(np.diff(arm.sent(), axis=0)).max() <= RATE_LIMIT * 0.1 + 1e-9
    assert 'stopped' not in arm.state().message


def test_heat_lowers_the_limit_and_is_said(arm):
    arm.target(HERE)
    arm.goes_to(HERE)
    # Modules at room temperature lie 15 °C below 40 °C; the load of holding warms them into that.
    assert arm.graph.set_parameter('controller', 'temperature_limit', 40.0)[0]
    arm.says('tension limited by heat')
    assert 'stopped' not in arm.state().message


def test_parameters_set_together_are_taken_all_or_none(arm):
    changes = [Parameter('method', value='tension'), Parameter('checkpoint', value='/nowhere')]
    request = SetParametersAtomically.Request(parameters=[p.to_parameter_msg() for p in changes])
    result = arm.graph.call(
        SetParametersAtomically, 'controller/set_parameters_atomically', request
    ).result
    assert not result.successful
    assert 'nowhere' in result.reason
    arm.target(HERE)
    arm.goes_to(HERE)
    assert len(arm.sent('tension')) == 0
    arm.says('method')
    said = {pair.key: pair.value for pair in arm.state().values}
    assert said['method'] == 'proposed'
