# SPDX-License-Identifier: Apache-2.0
"""Unwanted data on the graph: networks, second publishers, implausible values, and clocks."""

import time
from dataclasses import replace

import numpy as np
import pytest
import rclpy
from controlled_arm import ControlledArm
from diagnostic_msgs.msg import KeyValue
from graph import DEADLINE, LOOK
from network_attacks import ATTACKS
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.finding import Finding
from musculoskeletal_ae.estimation.network_validation import validator
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.nodes.controller import ControllerNode
from musculoskeletal_ae.nodes.estimator import EstimatorNode
from musculoskeletal_ae.nodes.hardware_emulator import HardwareEmulatorNode
from musculoskeletal_ae.nodes.learner import LearnerNode
from musculoskeletal_ae.nodes.sim import SimNode
from musculoskeletal_ae.ros.message_building import LATCHED, array_message, joint_message

HERE = np.array([-0.5, -1.2])
REFUSED = 'mae_checkpoint: does not explain the arm'


@pytest.fixture
def arm(graph, arm26, trained_file):
    arm = ControlledArm(graph, arm26, trained_file)
    arm.target(HERE)
    graph.wait(lambda: arm.count() > 30, 'commands')
    return arm


def test_a_bad_network_is_rejected_for_all_nodes_and_the_arm_goes_on(arm, trained, trained_file):
    bad = replace(ATTACKS['weights × 1.5'](trained['default']), version=66)
    sim = arm.graph.host(SimNode, robot='arm26', checkpoint=trained_file)
    decisions = arm.graph.listen(KeyValue, 'rejected_checkpoint', LATCHED)
    arm.graph.send_network(checkpoint.to_bytes(bad))
    arm.graph.wait(lambda: arm.estimator.rejected[REFUSED] and decisions, 'the rejection')
    assert decisions[-1].key == '66'
    assert 'from the geometric model, limit' in decisions[-1].value
    why = arm.estimator._reception.last_rejected
    assert 'from the geometric model, limit' in why
    assert 66 not in (arm.estimator.core.mae.version, arm.controller.core.mae.version)
    assert sim.arm.mae.version != 66
    arm.goes_to(HERE)
    assert arm.controller.core.supervisor.is_running
    arm.never_jumped()


def test_a_file_with_a_bad_network_is_refused_with_figure_and_limit(
    arm, trained, trained_file, tmp_path
):
    learner = arm.graph.host(
        LearnerNode, robot='arm26', checkpoint=trained_file, state_directory=''
    )
    bad = tmp_path / 'bad.safetensors'
    checkpoint.save(ATTACKS['noise of 100 %'](trained['default']), bad)
    for node in ('estimator', 'learner'):
        done, reason = arm.graph.set_parameter(node, 'checkpoint', str(bad))
        assert not done
        assert 'limit' in reason
    learner.core.close()


def test_of_networks_received_during_a_validation_all_nodes_use_the_last_without_a_jump(
    arm, trained
):
    nodes = arm.controller, arm.estimator
    for version in range(1, 21):
        mae = replace(trained['default'], version=version)
        arm.graph.send_network(checkpoint.to_bytes(mae))
        arm.graph.executor.spin_once(LOOK)
    arm.graph.wait(lambda: all(node.core.mae.version == 20 for node in nodes), 'the last network')
    for name in ('controller', 'estimator'):
        arm.graph.wait(
            lambda name=name: arm.graph.report(name).values.get('checkpoint version') == '20',
            f'the version of {name}',
        )
    arm.goes_to(HERE)
    arm.never_jumped()
    assert 'stopped' not in arm.state().message


def find(estimator):
    """Let an estimator find a fault of the first muscle, or end the anomaly if there is one."""
    suspects, finding = estimator.suspects, Finding(0, ConditionKind.RESIDUAL_DISTANCE, 'd = 9')
    has_found = suspects.finding is not None
    estimator.isolate(suspects.clear(()) if has_found else suspects.take(finding, (), 0.0))


def test_an_anomaly_rejects_a_network_that_is_being_validated(arm, trained):
    estimator = arm.estimator
    decisions = arm.graph.listen(KeyValue, 'rejected_checkpoint', LATCHED)
    first = estimator.core.complete_mae
    arm.graph.send_network(checkpoint.to_bytes(replace(trained['paper'], version=67)))

    # An anomaly begins again and again, until one begins while the network is being validated.
    def is_decided():
        find(estimator.core)
        return decisions

    arm.graph.wait(is_decided, 'the decision')
    assert decisions[-1].key == '67'
    assert 'anomaly' in decisions[-1].value
    assert estimator.core.complete_mae is first


def test_an_anomaly_soon_after_a_new_network_brings_the_proven_one_back_in_all_nodes(
    arm, trained, monkeypatch
):
    # The new network must not be proven before the anomaly, however slow the machine is.
    monkeypatch.setattr(validator, 'PROOF', 1e6)
    nodes = arm.estimator, arm.controller
    first = trained['default'].version
    network = replace(trained['paper'], version=first + 1)
    rejected = -1

    # On a busy machine, messages may arrive late. The estimator may then find that they contradict
    # the new network, and reject it although it is healthy. In this case, send the network again.
    def is_used():
        nonlocal rejected
        if arm.estimator.rejected[REFUSED] > rejected:
            rejected = arm.estimator.rejected[REFUSED]
            arm.graph.send_network(checkpoint.to_bytes(network))
        return all(node.core.mae.version == first + 1 for node in nodes)

    arm.graph.wait(is_used, 'the new network')
    decisions = arm.graph.listen(KeyValue, 'rejected_checkpoint', LATCHED)
    find(arm.estimator.core)
    arm.graph.wait(
        lambda: decisions and 'soon after' in decisions[-1].value, 'the rejection of the new one'
    )
    assert decisions[-1].key == str(first + 1)
    arm.graph.wait(lambda: all(n.core.mae.version == first for n in nodes), 'the proven network')


def test_an_impossible_body_state_is_refused(graph, trained_file):
    controller = graph.host(ControllerNode, robot='arm26', checkpoint=trained_file)
    rows = np.zeros((6, 6))
    rows[0] = 1e17
    latched = graph.publisher(Float64MultiArray, 'body_state', LATCHED)
    latched.publish(array_message(rows, 'quantity', 'muscle'))
    reason = 'body_state: impossible body state'
    graph.wait(lambda: controller.rejected[reason], 'the refusal')
    assert not controller.body.offsets.offset.any()


def test_a_second_publisher_of_muscle_states_stops_the_arm_until_it_is_gone(arm):
    stranger = arm.graph.node.create_publisher(Float64MultiArray, 'muscle_states', 10)
    space = arm.graph.namespace
    arm.says('second_publisher')
    assert f'{space}/hardware_emulator and {space}/test' in arm.state().message
    assert not arm.graph.call(Trigger, 'controller/reset').success
    refused = arm.estimator.rejected
    arm.graph.wait(
        lambda: refused['muscle_states: several publishers'], 'the rejection of a message'
    )
    arm.graph.node.destroy_publisher(stranger)
    arm.graph.wait(lambda: arm.graph.call(Trigger, 'controller/reset').success, 'the reset')
    arm.goes_to(HERE)


def test_a_second_driver_of_the_same_name_stops_the_arm(arm):
    node, reported = arm.graph.node, set()
    twin = rclpy.create_node(
        'hardware_emulator', namespace=node.get_namespace(), context=node.context
    )
    try:
        publisher = twin.create_publisher(Float64MultiArray, 'muscle_states', 10)

        def repeat(message):  # publish the message a second time, unless it is itself such a copy
            if (data := bytes(message.data)) not in reported:
                reported.add(data)
                publisher.publish(message)

        node.create_subscription(Float64MultiArray, 'muscle_states', repeat, 10)
        two = f'from 2 nodes {node.get_namespace()}/hardware_emulator'
        arm.graph.wait(lambda: two in arm.controller.core.watchdog.second_publisher, 'the stop')
    finally:
        twin.destroy_node()


def test_impossible_lengths_stop_the_arm_with_their_cause_and_without_a_jump(arm):
    arm.goes_to(HERE)
    done, _ = arm.graph.set_parameter('hardware_emulator', 'faults', ['offset:0.15'])
    assert done
    # The reported cause is a jump of a length or an implausible length, whatever is noticed first.
    arm.says('stopped: muscle_states are implausible: length ')
    assert any(reason.startswith('muscle_states: length ') for reason in arm.estimator.rejected)
    # The modules pull too hard, because they compare the command with wrong lengths. Such muscles
    # may be paid out faster than the rate limit allows.
    arm.never_jumped(relieved=True)
    # Until the arm stops, the modules follow MSC with the wrong lengths, so the arm moves a little.
    assert np.linalg.norm(arm.posture() - HERE) < 0.7


def test_with_use_sim_time_a_trajectory_follows_the_clock(graph, arm26, trained_file):
    pace = 0.3  # simulated seconds per second
    sent = graph.listen(Float64MultiArray, 'muscle_length_command', 1000)
    node = graph.host(
        ControllerNode,
        robot='arm26',
        checkpoint=trained_file,
        first_duration=1.0,
        max_age=10.0,
        use_sim_time=True,
    )
    clock = graph.node.create_publisher(Clock, '/clock', 10)
    muscles = graph.publisher(Float64MultiArray, 'muscle_states')
    joints = graph.publisher(JointState, 'estimated_joint_states')
    targets = graph.publisher(JointState, 'target_joint_states')
    bias = np.full(arm26.muscle_count, arm26.tension.bias)
    rows = np.stack([arm26.muscle_lengths(HERE, bias), bias, np.full_like(bias, 25.0)])
    follower = node.core.activities.follower
    started, done_at = time.monotonic(), None
    while done_at is None:
        now = 100.0 + pace * (time.monotonic() - started)
        message = Clock()
        message.clock.sec, message.clock.nanosec = int(now), int(now % 1.0 * 1e9)
        clock.publish(message)
        muscles.publish(array_message(rows, 'quantity', 'muscle'))
        joints.publish(joint_message(arm26.joints, HERE, message.clock))
        if node.core.target_state.theta is None and now > 100.3:
            targets.publish(JointState(name=arm26.joints, position=[-0.2, -0.8]))
            begun = now
        if follower.progress.trajectory is not None and not follower.progress.is_moving:
            done_at = now
        graph.spin(0.01)
        assert time.monotonic() - started < DEADLINE
    assert node.core.supervisor.is_running
    # If the trajectory followed the steady clock, it would end after 0.3 s of simulated time.
    assert follower.progress.trajectory.duration >= 1.0
    assert done_at - begun >= 0.9 * follower.progress.trajectory.duration
    assert len(sent) > 0


def test_a_muscle_ruptured_before_the_start_is_detected(graph, trained_file):
    # With this muscle ruptured, the estimate is so wrong that the controller does not start.
    muscle = 'deltoid_anterior'
    hardware = graph.host(HardwareEmulatorNode, robot='arm26', seed=0, faults=[f'rupture:{muscle}'])
    hardware.arm.step(3.0)
    bodies = graph.follow_body()
    estimator = graph.host(EstimatorNode, robot='arm26', checkpoint=trained_file)
    graph.host(ControllerNode, robot='arm26', checkpoint=trained_file, explore=True, max_age=10.0)
    graph.wait(lambda: bodies and bodies[-1].has_anomaly, 'the detection')
    assert estimator.core.cause.startswith(muscle)
