# SPDX-License-Identifier: Apache-2.0
"""The node `estimator` over DDS."""

import shutil
import time
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray
from std_srvs.srv import Trigger

from musculoskeletal_ae.estimation.detectors.joint_sensor_trust import SensorDoubt
from musculoskeletal_ae.estimation.lengths.length_trust import Evidence
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.nodes.estimator import EstimatorNode
from musculoskeletal_ae.nodes.hardware_emulator import HardwareEmulatorNode
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.ros.message_building import LATCHED, array_message
from musculoskeletal_ae.signals.joint_trust_message import SensorTrust


@pytest.fixture
def estimator(graph, trained_file):
    graph.estimator = graph.host(EstimatorNode, robot='arm26', checkpoint=trained_file)
    graph.listen(JointState, 'estimated_joint_states')
    graph.listen(JointState, 'vision_joint_states')
    graph.listen(Float64MultiArray, 'estimated_muscle_states')
    graph.listen(Float64, 'anomaly')
    graph.bodies = graph.follow_body()
    graph.listen(DiagnosticArray, '/diagnostics')
    graph.muscles = graph.publisher(Float64MultiArray, 'muscle_states')
    return graph


@pytest.fixture
def healthy(arm26):
    """Return a message of the geometric model in the middle of its joint range."""
    theta, tension = 0.5 * (arm26.lower + arm26.upper), np.full(6, 60.0)
    rows = [arm26.muscle_lengths(theta, tension), tension, np.full(6, 25.0)]
    return array_message(np.stack(rows), 'quantity', 'muscle')


def values(graph):
    return graph.report('estimator').values


def answer(graph, message):
    """Publish a message until an estimate arrives, and return the estimate.

    The estimator's best-effort subscription may lose the first messages.
    """
    before = len(graph.received['estimated_joint_states'])

    def arrived():
        graph.muscles.publish(message)
        graph.spin(0.02)
        return len(graph.received['estimated_joint_states']) > before

    graph.wait(arrived, 'an estimate')
    return graph.received['estimated_joint_states'][-1]


def test_estimates_are_published_by_name_and_near_the_truth(estimator, arm26, healthy):
    joints = answer(estimator, healthy)
    assert tuple(joints.name) == arm26.joints
    assert joints.header.stamp.sec > 0
    # After 600 training steps, the mean error of the network is 0.01 rad. This test only checks
    # that each angle is published under its joint's name.
    np.testing.assert_allclose(joints.position, 0.5 * (arm26.lower + arm26.upper), atol=0.1)
    muscles = estimator.received['estimated_muscle_states']
    restored = estimator.wait(lambda: muscles, 'the restored muscles')[-1]
    assert [(d.label, d.size) for d in restored.layout.dim] == [('quantity', 2), ('muscle', 6)]
    length, tension = np.reshape(restored.data, (2, 6))
    np.testing.assert_allclose(length, healthy.data[:6], atol=0.01)
    np.testing.assert_allclose(tension, 60.0, atol=20.0)
    values_of_a = estimator.received['anomaly']
    assert np.isfinite(estimator.wait(lambda: values_of_a, 'A')[-1].data)
    estimator.wait(lambda: estimator.bodies, 'the latched body state')
    assert not estimator.bodies[0].has_anomaly


def test_bad_messages_are_counted_by_reason_and_the_next_good_one_works(estimator, healthy):
    answer(estimator, healthy)
    nan, shifted = deepcopy(healthy), deepcopy(healthy)
    nan.data[3] = float('nan')
    shifted.layout.data_offset = 3
    cases = {
        'not finite': nan,
        'wrong length': Float64MultiArray(data=[0.0] * 17),
        'empty': Float64MultiArray(),
        'oversized': Float64MultiArray(data=[0.0] * 1_300_000),  # 10 MB of data
        'wrong layout': shifted,
    }
    for reason, message in cases.items():

        def counted(reason=reason, message=message):
            estimator.muscles.publish(message)
            estimator.spin(0.05)
            return estimator.estimator.rejected[f'muscle_states: {reason}']

        estimator.wait(counted, f'the count of {reason}')
    answer(estimator, healthy)
    estimator.received['/diagnostics'].clear()
    estimator.wait(lambda: values(estimator), 'a report with the counts')
    assert {f'rejected muscle_states: {reason}' for reason in cases} <= values(estimator).keys()


def test_a_length_that_changes_over_lost_messages_has_not_jumped_if_they_were_sent_long_ago(
    estimator, healthy
):
    answer(estimator, healthy)
    moved = deepcopy(healthy)
    moved.data[0] += 0.046
    before = len(estimator.received['estimated_joint_states'])
    estimator.muscles.publish(healthy)
    time.sleep(0.1)  # the estimator runs in this process, so the first message waits
    estimator.muscles.publish(moved)
    estimates = estimator.received['estimated_joint_states']
    estimator.wait(lambda: len(estimates) >= before + 2, 'two estimates')
    assert not any('jumped' in reason for reason in estimator.estimator.rejected)


def test_a_checkpoint_is_replaced_by_parameter_and_topic_and_an_unfit_one_refused(
    estimator, healthy, trained_file, tmp_path
):
    answer(estimator, healthy)
    broken = tmp_path / 'broken.safetensors'
    broken.write_bytes(b'\x00' * 100)
    success, reason = estimator.set_parameter('estimator', 'checkpoint', str(broken))
    assert not success
    assert 'broken.safetensors' in reason
    copy = shutil.copy(trained_file, tmp_path / 'copy.safetensors')
    assert estimator.set_parameter('estimator', 'checkpoint', str(copy)) == (True, '')
    mae = replace(checkpoint.load(trained_file), version=41)
    estimator.send_network(checkpoint.to_bytes(mae))
    core, rejected = estimator.estimator.core, estimator.estimator.rejected
    estimator.wait(lambda: core.mae.version == 41, 'version 41')
    singular = replace(mae.anomaly, covariance=np.ones((12, 12)) + 1e-15 * np.eye(12))
    unfit = (
        b'not a checkpoint',
        # UTF-8 cannot encode this name, so no message could contain it.
        checkpoint.to_bytes(replace(mae, joints=('\ud800', 'b'))),
        checkpoint.to_bytes(replace(mae, anomaly=singular)),
    )
    for count, data in enumerate(unfit, start=1):
        estimator.send_network(data)
        estimator.wait(
            lambda count=count: rejected['mae_checkpoint: unfit checkpoint'] == count,
            f'refusal {count}',
        )
    estimator.received['/diagnostics'].clear()
    estimator.wait(lambda: values(estimator), 'the report of the estimator')
    assert values(estimator)['checkpoint version'] == '41'
    answer(estimator, healthy)


def test_an_anomaly_is_published_logged_and_latched_until_reset(estimator, healthy):
    command = estimator.publisher(Float64MultiArray, 'muscle_tension_command')
    bodies = estimator.bodies
    sick = deepcopy(healthy)
    sick.data[6] = 0.0

    def observed():
        command.publish(array_message(np.full(6, 60.0), 'muscle'))
        answer(estimator, sick)
        return bodies and bodies[-1].has_anomaly

    estimator.wait(observed, 'the detection')
    estimator.wait(lambda: estimator.report('estimator').level == 'error', 'the report of an error')
    assert 'slack_tendon' in estimator.report('estimator').identifiers
    for _ in range(8):
        answer(estimator, healthy)
    assert bodies[-1].has_anomaly
    response = estimator.call(Trigger, 'estimator/reset')
    assert response.success and response.message.startswith('cleared the anomaly')
    estimator.wait(lambda: not bodies[-1].has_anomaly, 'the reset')
    assert estimator.call(Trigger, 'estimator/reset').message == 'no anomaly was detected'


@pytest.mark.parametrize('kind', ['length', 'tension'])
def test_a_muscle_without_its_commanded_length_or_tension_is_an_anomaly(
    estimator, arm26, healthy, kind
):
    healthy.data[6 + 2] = 0.0  # no tension in muscle 2
    command = estimator.publisher(Float64MultiArray, f'muscle_{kind}_command')
    demand = np.array(healthy.data[:6]) - 0.003 if kind == 'length' else np.full(6, 60.0)
    bodies = estimator.bodies

    def observed():
        command.publish(array_message(demand, 'muscle'))
        estimator.muscles.publish(healthy)
        estimator.spin(0.02)
        return bodies and bodies[-1].has_anomaly

    estimator.wait(observed, 'the detection')
    assert estimator.estimator.core.cause.startswith(arm26.muscles[2])


def test_isolating_another_muscle_does_not_end_a_verification(estimator, arm26, healthy):
    assert estimator.set_parameter('estimator', 'on_anomaly', 'isolate')[0]
    healthy.data[6 + 2] = 0.0  # no tension in muscle 2
    command = estimator.publisher(Float64MultiArray, 'muscle_tension_command')
    bodies = estimator.bodies

    def is_verified():
        command.publish(array_message(np.full(6, 60.0), 'muscle'))
        estimator.muscles.publish(healthy)
        estimator.spin(0.02)
        return bodies and bodies[-1].verified == 2

    estimator.wait(is_verified, 'the verification')
    suspect, other = arm26.muscles[2], arm26.muscles[4]
    assert estimator.set_parameter('estimator', 'isolate_muscles', [other])[0]
    answer = estimator.call(Trigger, 'estimator/isolate')
    assert not answer.success
    assert f'{suspect} is being verified' in answer.message
    assert estimator.set_parameter('estimator', 'isolate_muscles', [suspect, other])[0]
    answer = estimator.call(Trigger, 'estimator/isolate')
    assert answer.message == f'isolated: {suspect}, {other}'


def test_a_restarted_estimator_relies_on_no_doubted_sensor_and_no_length_that_moved_in_a_repair(
    estimator, trained_file, healthy
):
    trusts = estimator.listen(Float64MultiArray, 'joint_sensor_trust', LATCHED)
    answer(estimator, healthy)
    core = estimator.estimator.core
    core.doubt_joint_sensors({1: SensorDoubt(0.5, 0.02, 0.01)}, time.monotonic())
    answer(estimator, healthy)
    core.trust.take(Evidence.MOVED, [2])
    answer(estimator, healthy)
    assert estimator.bodies[-1].offsets.known
    estimator.end(estimator.estimator)
    trusts.clear()
    before = estimator.bodies[-1].generation
    estimator.host(EstimatorNode, robot='arm26', checkpoint=trained_file)
    estimator.wait(lambda: trusts and estimator.bodies[-1].generation > before, 'the new estimator')
    assert trusts[0].data[:2].tolist() == [SensorTrust.TRUSTED, SensorTrust.DOUBTED]
    estimator.wait(lambda: not estimator.bodies[-1].offsets.known, 'the unknown offsets')


def picture(robot, theta):
    pose = robot.kinematics.end_effector_pose(theta)
    message = PoseStamped()
    message.header.frame_id, message.header.stamp.sec = robot.root_link, 42
    position, turn = message.pose.position, message.pose.orientation
    position.x, position.y, position.z = pose.translation.tolist()
    half = 0.5 * np.sqrt(1.0 + np.trace(pose.rotation))
    turn.w, r = half, pose.rotation
    turn.x, turn.y, turn.z = (
        float(difference) / (4.0 * half)
        for difference in (r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1])
    )
    return message


def test_a_marker_gives_no_angles_of_joints_that_do_not_move_it(graph):
    robot = Robot.load('musashi_upper_body')
    graph.host(EstimatorNode, robot='musashi_upper_body')
    observed = graph.listen(JointState, 'vision_joint_states')
    graph.publisher(PoseStamped, 'marker_pose').publish(picture(robot, 0.5 * robot.lower))
    graph.wait(lambda: observed, 'the joint angles')
    hand = robot.description.end_effector.partition('_')[0]
    assert observed[0].name == [joint for joint in robot.joints if joint.startswith(hand)]
    assert 0 < len(observed[0].position) == len(observed[0].name) < robot.joint_count


def test_a_marker_pose_becomes_joint_angles_with_the_stamp_of_the_picture(estimator, arm26):
    theta = arm26.lower + 0.4 * (arm26.upper - arm26.lower)
    message = picture(arm26, theta)
    camera, observed = estimator.publisher(PoseStamped, 'marker_pose'), estimator.received

    def arrived():
        camera.publish(message)
        estimator.spin(0.05)
        return observed['vision_joint_states']

    estimator.wait(arrived, 'the joint angles')
    assert observed['vision_joint_states'][0].header.stamp.sec == 42
    np.testing.assert_allclose(observed['vision_joint_states'][0].position, theta, atol=1e-3)
    message.header.frame_id = 'camera'
    rejected = estimator.estimator.rejected
    estimator.wait(lambda: arrived() and rejected['marker_pose: wrong frame'], 'the refusal')


@pytest.mark.parametrize(
    ('parameters', 'error', 'expected'),
    [
        ({'robot': 'no_such_arm'}, MusculoskeletalError, 'musashi_left_arm'),
        ({'preset': 'magic'}, MusculoskeletalError, r'parameter preset: .*default, paper'),
        ({'on_anomaly': 'panic'}, MusculoskeletalError, r'parameter on_anomaly: .*stop, isolate'),
    ],
)
def test_a_wrong_parameter_is_refused_by_name(graph, parameters, error, expected):
    with pytest.raises(error, match=expected):
        graph.host(EstimatorNode, **{'robot': 'arm26', **parameters})


def test_the_covariance_of_the_network_is_published(graph, arm26, trained_file, tmp_path):
    covariance = np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
    mae = replace(checkpoint.load(trained_file, arm26), covariance=covariance)
    file = tmp_path / 'sure.safetensors'
    checkpoint.save(mae, file)
    node = graph.host(EstimatorNode, robot='arm26', checkpoint=str(file))
    reported = graph.listen(Float64MultiArray, 'estimated_joint_covariance')
    graph.host(HardwareEmulatorNode, robot='arm26')
    message = graph.wait(lambda: reported and reported[-1], 'the covariance')
    np.testing.assert_array_equal(np.reshape(message.data, (2, 2)), covariance)
    assert '0.020' in node.report().values['joint uncertainty']


def test_silence_of_the_driver_is_an_error_also_for_a_node_that_has_just_started(
    estimator, healthy
):
    def reported(level):
        report = estimator.report('estimator')
        named = 'no usable muscle_states' in report.message
        assert report.message.count('muscle_states') <= 1  # said once
        assert named == ('silent_topic' in report.identifiers)
        return report.level == level and named == (level == 'error')

    estimator.wait(lambda: reported('error'), 'the error without any message')

    def is_heard():
        estimator.muscles.publish(healthy)
        return reported('ok')

    estimator.wait(is_heard, 'the end of the error')
    estimator.wait(lambda: reported('error'), 'the error after the last message')


def test_messages_that_keep_coming_too_slowly_are_a_warning(graph, trained_file, healthy):
    node = graph.host(EstimatorNode, robot='arm26', checkpoint=trained_file, rate=1000.0)
    muscles = graph.publisher(Float64MultiArray, 'muscle_states')
    reports = graph.listen(DiagnosticArray, '/diagnostics')

    def is_reported():
        muscles.publish(healthy)
        graph.spin(0.02)
        texts = [status.message for report in reports for status in report.status]
        return any('Hz instead of 1000 Hz' in text for text in texts)

    graph.wait(is_reported, 'the warning')
    reported = [each.identifier for each in node.core.conditions(node.core.stepped_at)]
    assert reported == []  # the slow messages are used nevertheless
