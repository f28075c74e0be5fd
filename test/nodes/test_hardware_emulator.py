# SPDX-License-Identifier: Apache-2.0
"""The emulated hardware as a robot on the graph."""

import numpy as np
import pinocchio as pin
import pytest
from geometry_msgs.msg import PoseStamped, WrenchStamped
from robots import write_robot
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.nodes.hardware_emulator import HardwareEmulatorNode
from musculoskeletal_ae.remedy_steps import Step
from musculoskeletal_ae.ros.message_building import LATCHED, array_message
from musculoskeletal_ae.signals.muscle_states import QUANTITIES, read_muscle_states


@pytest.fixture
def arm(graph):
    graph.listen(Float64MultiArray, 'muscle_states')
    graph.listen(JointState, 'joint_states')
    graph.listen(String, 'robot_description', LATCHED)
    graph.listen(MarkerArray, 'hardware_emulator/markers')
    graph.listen(PoseStamped, 'marker_pose')
    graph.emulator = graph.host(HardwareEmulatorNode, robot='arm26', seed=1)
    graph.next('muscle_states')
    graph.next('joint_states')
    return graph


def reading(graph, robot):
    return read_muscle_states(graph.next('muscle_states'), robot)


def drive(graph, command, condition, what):
    publisher = graph.publisher(Float64MultiArray, 'muscle_length_command')

    def done():
        publisher.publish(array_message(command, 'muscle'))
        graph.spin(0.02)
        return condition()

    graph.wait(done, what)


def test_the_emulator_publishes_the_topics_of_a_robot(arm, arm26):
    message = arm.next('muscle_states')
    assert [(d.label, d.size, d.stride) for d in message.layout.dim] == [
        ('quantity', len(QUANTITIES), 6 * len(QUANTITIES)),
        ('muscle', 6, 6),
    ]
    read = reading(arm, arm26)
    assert np.all(read.tension > 0.5 * arm26.tension.bias)
    assert np.all(np.abs(read.temperature - 25.0) < 5.0)
    joints = arm.next('joint_states')
    assert tuple(joints.name) == arm26.joints
    described = arm.received['robot_description']
    arm.wait(lambda: described, 'the description')
    assert described[0].data == arm26.description.urdf
    arm.next('hardware_emulator/markers')
    markers = arm.received['hardware_emulator/markers'][-1].markers
    assert sum(m.ns == 'muscles' for m in markers) == 6
    assert {m.header.frame_id for m in markers} == {arm26.root_link}


def test_length_commands_move_the_arm_and_their_absence_makes_it_safe(arm, arm26):
    theta = 0.5 * (arm26.lower + arm26.upper)
    tension = np.full(6, 80.0)
    command = arm26.muscle_lengths(theta, tension) - 50.0 / arm26.stiffness
    drive(
        arm,
        command,
        lambda: np.abs(np.array(arm.received['joint_states'][-1].position) - theta).max() < 0.4,
        'the posture',
    )
    arm.wait(lambda: reading(arm, arm26).tension.max() > 50.0, 'tension')
    arm.wait(lambda: reading(arm, arm26).tension.max() < 35.0, 'the safe state after the timeout')


def test_a_muscle_is_ruptured_and_repaired_at_run_time(arm, arm26):
    name = arm26.muscles[3]
    success, reason = arm.set_parameter('hardware_emulator', 'faults', ['rupture:biceps'])
    assert not success
    assert name in reason  # the reason lists the legal names
    assert arm.set_parameter('hardware_emulator', 'faults', [f'rupture:{name}'])[0]
    before = reading(arm, arm26)
    assert before.tension[3] == 0.0
    assert Step.REPAIR_EMULATED_FAULT in arm.emulator.report().steps
    arm.wait(lambda: reading(arm, arm26).length[3] < before.length[3] - 0.01, 'winding in')
    assert arm.set_parameter('hardware_emulator', 'faults', [''])[0]
    arm.wait(lambda: reading(arm, arm26).tension[3] > 15.0, 'tension')
    assert Step.REPAIR_EMULATED_FAULT not in arm.emulator.report().steps


def test_payload_offset_and_wrench_act(arm, arm26):
    start = reading(arm, arm26).length
    assert arm.set_parameter('hardware_emulator', 'faults', ['offset:0.01'])[0]
    np.testing.assert_allclose(reading(arm, arm26).length, start + 0.01, atol=3e-3)
    for wrong in ('offset:2.0', 'offset:nan'):
        assert not arm.set_parameter('hardware_emulator', 'faults', [wrong])[0]
    assert arm.set_parameter('hardware_emulator', 'payload', 2.0)[0]
    assert not arm.set_parameter('hardware_emulator', 'payload', -1.0)[0]
    push = arm.publisher(WrenchStamped, 'hardware_emulator/external_wrench')
    message = WrenchStamped()
    message.wrench.force.x = 30.0
    at_rest = np.array(arm.next('joint_states').position)

    def moved():
        push.publish(message)
        return np.abs(np.array(arm.next('joint_states').position) - at_rest).max() > 0.1

    arm.wait(moved, 'the push')


def test_a_marker_pose_is_published_on_request(graph, arm26):
    for kind, topic in ((JointState, 'joint_states'), (PoseStamped, 'marker_pose')):
        graph.listen(kind, topic)
    arm = graph
    arm.host(HardwareEmulatorNode, robot='arm26', sensors=['joints', 'marker:30'])
    pose = arm.next('marker_pose', 3)
    assert pose.header.frame_id == arm26.root_link
    theta = np.array(arm.received['joint_states'][-1].position)
    expected = arm26.kinematics.end_effector_pose(theta)
    p, q = pose.pose.position, pose.pose.orientation
    np.testing.assert_allclose([p.x, p.y, p.z], expected.translation, atol=0.02)
    turn = pin.Quaternion(q.w, q.x, q.y, q.z).toRotationMatrix().T @ expected.rotation
    assert np.linalg.norm(pin.log3(turn)) < 0.1


def test_bad_commands_are_rejected_and_do_not_move_the_arm(arm, arm26):
    publisher = arm.publisher(Float64MultiArray, 'muscle_length_command')
    before = reading(arm, arm26).length
    for data in ([float('nan')] * 6, [-0.05] * 5, [], [0.0] * 1_300_000):
        publisher.publish(Float64MultiArray(data=data))
    arm.next('muscle_states', 30)
    np.testing.assert_allclose(reading(arm, arm26).length, before, atol=2e-3)
    assert sum(arm.emulator.rejected.values()) == 4


def test_a_reset_brings_the_arm_back(arm, arm26):
    command = reading(arm, arm26).length - 0.02
    start = np.array(arm.next('joint_states').position)
    drive(arm, command, lambda: reading(arm, arm26).tension.max() > 60.0, 'tension')
    assert arm.call(Trigger, 'hardware_emulator/reset').success
    np.testing.assert_allclose(np.array(arm.next('joint_states').position), start, atol=0.05)


def test_an_impossible_wrench_is_rejected_and_a_reset_repairs_a_broken_simulation(arm, arm26):
    push = arm.publisher(WrenchStamped, 'hardware_emulator/external_wrench')
    message = WrenchStamped()
    message.wrench.torque.x = 1000.0
    push.publish(message)
    arm.wait(lambda: sum(arm.emulator.rejected.values()), 'the refusal')
    arm.emulator.arm.set_wrench(np.full(6, 1e9))
    arm.wait(lambda: arm.emulator.report().level == 'error', 'the report')
    assert arm.call(Trigger, 'hardware_emulator/reset').success
    assert np.isfinite(reading(arm, arm26).rows[:3]).all()
    arm.next('joint_states', 20)
    assert arm.emulator.report().level != 'error'


def test_faults_are_switched_at_run_time(arm, arm26):
    name = arm26.muscles[1]
    success, reason = arm.set_parameter('hardware_emulator', 'faults', ['melt'])
    assert not success and 'stuck_motor' in reason
    assert arm.set_parameter(
        'hardware_emulator', 'faults', [f'overheat:{name}', f'dead_sensor:tension:{name}']
    )[0]
    arm.wait(lambda: reading(arm, arm26).tension[1] == 0.0, 'the dead sensor')
    assert reading(arm, arm26).temperature[1] > 80.0
    assert arm.set_parameter('hardware_emulator', 'faults', ['drop:1'])[0]
    before = len(arm.received['muscle_states'])
    arm.spin(0.5)
    assert len(arm.received['muscle_states']) - before < 10
    assert arm.set_parameter('hardware_emulator', 'faults', [''])[0]
    assert reading(arm, arm26).tension[1] > 10.0


def test_without_joint_sensors_there_are_no_joint_states(graph):
    graph.listen(Float64MultiArray, 'muscle_states')
    graph.host(HardwareEmulatorNode, robot='arm26', sensors=[''])
    graph.next('muscle_states', 10)
    assert graph.node.count_publishers('joint_states') == 0


def test_the_foreign_emulator_has_the_same_topics(graph, arm26):
    graph.listen(Float64MultiArray, 'muscle_states')
    graph.listen(JointState, 'joint_states')
    graph.listen(MarkerArray, 'hardware_emulator/markers')
    graph.emulator = graph.host(HardwareEmulatorNode, robot='arm26', reality='foreign')
    start = reading(graph, arm26).length
    drive(graph, start - 0.02, lambda: reading(graph, arm26).tension.max() > 60.0, 'tension')
    assert tuple(graph.next('joint_states').name) == arm26.joints
    assert graph.next('hardware_emulator/markers').markers
    for wrong in (['rupture:front'], [f'rupture:{arm26.muscles[0]}', 'rupture:front']):
        assert not graph.set_parameter('hardware_emulator', 'faults', wrong)[0]


def test_an_accelerometer_is_published_on_request(graph):
    graph.host(HardwareEmulatorNode, robot='arm26', sensors=['imu:hand'], frame_prefix='left/')
    read = graph.listen(Imu, 'imu')
    message = graph.wait(lambda: read and read[-1], 'the accelerometer')
    assert message.header.frame_id == 'left/hand'
    held = message.linear_acceleration
    assert abs(np.linalg.norm([held.x, held.y, held.z]) - 9.81) < 0.5
    with pytest.raises(MusculoskeletalError, match=r'parameter sensors: .*forearm'):
        graph.host(HardwareEmulatorNode, robot='arm26', sensors=['imu:knee'])


def test_the_sensor_of_a_prismatic_joint_is_published_in_metres(graph, tmp_path):
    write_robot(tmp_path / 'slider', slider=True)
    graph.listen(JointState, 'joint_states')
    graph.host(HardwareEmulatorNode, robot=str(tmp_path / 'slider'), seed=1)
    joints = graph.next('joint_states')
    assert joints.name[-1] == 'wrist'
    assert -0.01 < joints.position[-1] < 0.06
