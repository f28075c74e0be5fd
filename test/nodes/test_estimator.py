# SPDX-License-Identifier: Apache-2.0
"""The estimator as users meet it, over DDS."""

from __future__ import annotations

import shutil
import signal

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64, Float64MultiArray, UInt8MultiArray
from std_srvs.srv import Trigger

from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.residuals import AnomalyStatistics
from musculoskeletal_ae.nodes.messages import array_message, bytes_message
from musculoskeletal_ae.nodes.qos import LATCHED


@pytest.fixture
def estimator(graph, trained):
    graph.node_under_test = graph.start('estimator', robot='arm26', checkpoint=trained)
    graph.listen(JointState, 'estimated_joint_states')
    graph.listen(Float64, 'anomaly')
    graph.listen(Bool, 'anomaly_detected', LATCHED)
    graph.listen(DiagnosticArray, '/diagnostics')
    graph.muscles = graph.publisher(Float64MultiArray, 'muscle_states')
    graph.wait(lambda: graph.node.count_publishers('estimated_joint_states') > 0, 'the estimator')
    return graph


def healthy(robot, theta, tension):
    rows = [robot.muscle_lengths(theta, tension), tension, np.full(robot.muscle_count, 25.0)]
    return array_message(np.stack(rows), 'quantity', 'muscle')


def diagnosis(graph):
    """Return the newest status of this graph's estimator."""
    name = f'{graph.namespace}/estimator: state'
    found = [s for m in graph.received['/diagnostics'] for s in m.status if s.name == name]
    return found[-1] if found else DiagnosticStatus()


def values(graph):
    return {v.key: v.value for v in diagnosis(graph).values}


def answer(graph, message):
    """Publish until an estimate comes back: best-effort may lose the first one."""
    before = len(graph.received['estimated_joint_states'])

    def arrived():
        graph.muscles.publish(message)
        graph.spin(0.05)
        return len(graph.received['estimated_joint_states']) > before

    graph.wait(arrived, 'an estimate')
    return graph.received['estimated_joint_states'][-1]


def test_estimates_come_by_name_and_near_the_truth(estimator, arm26):
    theta = 0.5 * (arm26.lower + arm26.upper)
    joints = answer(estimator, healthy(arm26, theta, np.full(6, 60.0)))
    assert tuple(joints.name) == arm26.joints
    assert joints.header.stamp.sec > 0
    np.testing.assert_allclose(joints.position, theta, atol=0.3)
    assert np.isfinite(estimator.received['anomaly'][-1].data)
    detected = estimator.received['anomaly_detected']
    estimator.wait(lambda: detected, 'the latched decision')
    assert detected[0].data is False


def test_bad_messages_are_counted_by_reason_and_the_next_good_one_works(estimator, arm26):
    theta, tension = 0.5 * (arm26.lower + arm26.upper), np.full(6, 60.0)
    good = healthy(arm26, theta, tension)
    answer(estimator, good)
    nan = healthy(arm26, theta, tension)
    nan.data[3] = float('nan')
    big = Float64MultiArray(data=[0.0] * 1_300_000)  # 10 MB
    cases = {
        'not finite': nan,
        'wrong length': Float64MultiArray(data=[0.0] * 17),
        'empty': Float64MultiArray(),
        'oversized': big,
        'wrong layout': healthy(arm26, theta, tension),
    }
    cases['wrong layout'].layout.data_offset = 3
    for reason, message in cases.items():

        def counted(reason=reason, message=message):
            estimator.muscles.publish(message)
            estimator.spin(0.2)
            return f'rejected muscle_states: {reason}' in values(estimator)

        estimator.wait(counted, f'the count of {reason}')
    assert answer(estimator, good) is not None
    assert estimator.node_under_test.alive()


def test_a_checkpoint_is_swapped_in_by_parameter_and_topic_and_an_unfit_one_refused(
    estimator, arm26, trained, tmp_path
):
    good = healthy(arm26, 0.5 * (arm26.lower + arm26.upper), np.full(6, 60.0))
    answer(estimator, good)
    broken = tmp_path / 'broken.safetensors'
    broken.write_bytes(b'\x00' * 100)
    success, reason = estimator.set_parameter('estimator', 'checkpoint', str(broken))
    assert not success
    assert 'broken.safetensors' in reason
    copy = shutil.copy(trained, tmp_path / 'copy.safetensors')
    assert estimator.set_parameter('estimator', 'checkpoint', str(copy)) == (True, '')
    from dataclasses import replace

    mae = replace(checkpoint.load(trained), version=41)
    publisher = estimator.publisher(UInt8MultiArray, 'mae_checkpoint', LATCHED)
    publisher.publish(bytes_message(checkpoint.to_bytes(mae)))
    estimator.wait(lambda: values(estimator).get('checkpoint version') == '41', 'version 41')
    unprintable = checkpoint.to_bytes(replace(mae, joints=('\ud800', 'b')))
    singular = np.ones((12, 12)) + 1e-15 * np.eye(12)
    statistics = AnomalyStatistics(np.zeros(12), singular, True, 100, {})
    for refusals, data in enumerate(
        (
            b'not a checkpoint',
            unprintable,
            checkpoint.to_bytes(replace(mae, anomaly=statistics)),
        ),
        start=1,
    ):
        publisher.publish(bytes_message(data))
        estimator.wait(
            lambda count=str(refusals): (
                values(estimator).get('rejected mae_checkpoint: unfit checkpoint') == count
            ),
            f'refusal {refusals}',
        )
    assert values(estimator)['checkpoint version'] == '41'
    answer(estimator, good)


def test_an_anomaly_is_latched_until_reset(estimator, arm26):
    theta, tension = 0.5 * (arm26.lower + arm26.upper), np.full(6, 60.0)
    sick = healthy(arm26, theta, tension)
    sick.data[0] -= 0.1  # a muscle wound in by 10 cm
    for _ in range(10):
        answer(estimator, sick)
    assert not any(m.data for m in estimator.received['anomaly_detected'])  # uncalibrated: no latch
    assert values(estimator).get('anomaly calibrated', 'False') == 'False'
    assert estimator.set_parameter('estimator', 'anomaly_threshold', 0.2)[0]
    for _ in range(8):
        answer(estimator, sick)
    detected = estimator.received['anomaly_detected']
    estimator.wait(lambda: detected[-1].data, 'the detection')
    estimator.wait(lambda: 'detected' in diagnosis(estimator).message, 'the diagnosis')
    named = values(estimator)['suspect muscle']
    other = healthy(arm26, theta, tension)
    other.data[6 + arm26.muscles.index(named)] += 5.0
    other.data[5 if named == arm26.muscles[0] else 0] -= 0.1
    for _ in range(8):
        answer(estimator, other)
    estimator.received['/diagnostics'].clear()
    estimator.wait(lambda: values(estimator), 'the next diagnosis')
    assert values(estimator)['suspect muscle'] == named
    for _ in range(8):
        answer(estimator, healthy(arm26, theta, tension))
    assert detected[-1].data
    assert estimator.call(Trigger, 'estimator/reset').success
    estimator.wait(lambda: not detected[-1].data, 'the reset')


def test_a_muscle_dead_from_the_start_is_named(estimator, arm26):
    theta, tension = 0.5 * (arm26.lower + arm26.upper), np.full(6, 60.0)
    message = healthy(arm26, theta, tension)
    message.data[6 + 2] = 0.0  # tension of muscle 2
    command = estimator.publisher(Float64MultiArray, 'muscle_length_command')
    length = np.array(message.data[:6]) - 0.003
    detected = estimator.received['anomaly_detected']

    def found():
        command.publish(array_message(length, 'muscle'))
        estimator.muscles.publish(message)
        estimator.spin(0.02)
        return detected and detected[-1].data

    estimator.wait(found, 'the detection')
    estimator.wait(lambda: arm26.muscles[2] in diagnosis(estimator).message, 'its name')


def test_it_ends_quietly_on_ctrl_c(graph, trained):
    process = graph.start('estimator', robot='arm26', checkpoint=trained)
    graph.wait(lambda: graph.node.count_publishers('anomaly') > 0, 'the estimator')
    status, output = process.end(signal.SIGINT)
    graph.processes.remove(process)
    assert status == 0
    assert 'Traceback' not in output


@pytest.mark.parametrize(
    ('parameters', 'expected'),
    [
        ({'robot': 'no_such_arm'}, 'musashi_left_arm'),
        ({'robot': 'arm26', 'checkpoint': '/no/such/file'}, '/no/such/file'),
        ({'robot': 'arm26', 'anomaly_threshold': 1}, 'anomaly_threshold'),
        ({'robot': 'arm26', 'anomaly_threshold': -1.0}, 'anomaly_threshold'),
    ],
)
def test_a_wrong_parameter_is_one_clear_line(graph, parameters, expected):
    process = graph.start('estimator', **parameters)
    graph.processes.remove(process)
    output, _ = process.process.communicate(timeout=60)
    assert process.process.returncode == 1
    assert expected in output
    assert 'Traceback' not in output
