# SPDX-License-Identifier: Apache-2.0
"""Length calibration over DDS."""

import numpy as np
import pytest
from graph import DEADLINE
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger

from musculoskeletal_ae.estimation.lengths import length_calibration
from musculoskeletal_ae.nodes.controller import ControllerNode
from musculoskeletal_ae.nodes.estimator import EstimatorNode
from musculoskeletal_ae.nodes.hardware_emulator import HardwareEmulatorNode
from musculoskeletal_ae.nodes.learner import LearnerNode
from musculoskeletal_ae.ros.message_building import array_message
from musculoskeletal_ae.signals.body_state import BodyState, LengthOffsets, Trust


@pytest.mark.parametrize('stands', [True, False], ids=['stated posture', 'gentle motion'])
def test_length_offsets_are_found_and_reach_every_node_until_the_estimator_restarts(
    graph, trained_file, tmp_path, monkeypatch, stands
):
    monkeypatch.setattr(length_calibration, 'ENOUGH_WITH_ANGLES', 2.0)
    common = {'robot': 'arm26', 'checkpoint': trained_file}
    hardware = graph.host(HardwareEmulatorNode, robot='arm26', seed=1, faults=['unzeroed'])
    hardware.arm.step(10.0)
    node = graph.host(EstimatorNode, **common)
    # On a loaded machine messages arrive late. A large max_age avoids stops.
    controller = graph.host(ControllerNode, **common, max_age=10.0)
    learner = graph.host(LearnerNode, robot='arm26', state_directory=str(tmp_path))
    if stands:
        graph.set_parameter('estimator', 'zero_posture', hardware.arm.theta.tolist())
    assert graph.call(Trigger, 'estimator/zero').success
    assert not node.core.body.offsets.known
    if not stands:
        assert graph.call(SetBool, 'controller/explore', SetBool.Request(data=True)).success
    nodes = [node, controller, learner]
    graph.wait(
        lambda: all(n.body.offsets.known and n.body.offsets.offset.any() for n in nodes),
        'the length offsets',
        8 * DEADLINE,
    )
    offset = hardware.arm.faults.zero
    assert np.abs(offset).min() > 0.05
    for other in nodes:
        # The calibration is inaccurate, because the network has learned only the geometric model.
        np.testing.assert_allclose(other.body.offsets.offset, offset, atol=0.03)
        assert not any('length' in reason for reason in other.rejected)
    assert controller.core.stream.body.offsets.known and controller.core.supervisor.is_running
    assert not node.core.cause
    found = node.body.offsets.offset
    graph.end(node)
    restarted = graph.host(EstimatorNode, **common)
    others = [controller, learner]
    graph.wait(lambda: not any(n.body.offsets.known for n in others), 'the loss of the offsets')
    for other in (restarted, *others):
        np.testing.assert_array_equal(other.body.offsets.offset, found)
    assert restarted.core.calibration is None  # `zero_posture` need not be the present posture
    assert 'restarted' in restarted.report().message


def test_every_decision_of_the_estimator_is_used_once_and_as_it_states(graph, trained_file):
    controller = graph.host(ControllerNode, robot='arm26', checkpoint=trained_file)
    uses, use = [], controller.core.use_body

    def noted(body):
        uses.append(body.generation)
        use(body)

    controller.core.use_body = noted

    def reported(generation, offset, deviation, trust):
        trusts = np.full(6, trust)
        offsets = LengthOffsets(np.full(6, offset), np.full(6, deviation), trusts)
        body = BodyState(offsets, generation=generation)
        graph.tell_body(body)
        graph.wait(lambda: controller.body.generation == generation, 'the decision')
        assert controller.core.stream.body == body
        assert controller.core.stream.body.offsets.known == (trust is Trust.KNOWN)

    reported(2, 0.05, 0.0, Trust.KNOWN)
    reported(2, 0.05, 0.0, Trust.KNOWN)
    # The estimator has restarted. Its sensors are absolute, so its offsets are known at once.
    reported(1, 0.0, 0.0, Trust.KNOWN)
    reported(3, 0.05, 1e-3, Trust.REVOKED)
    reported(4, 0.01, 1.0, Trust.UNKNOWN)
    reported(5, 0.05, 1e-3, Trust.KNOWN)
    reported(6, 0.05, 1e-2, Trust.KNOWN)  # the estimator has confirmed the offsets
    assert uses == [2, 1, 3, 4, 5, 6]


def test_commanded_lengths_are_corrected_by_the_same_offsets_as_measured_ones(graph, monkeypatch):
    core, noted = graph.host(EstimatorNode, robot='arm26').core, []
    monkeypatch.setattr(core, 'commanded', lambda _, length: noted.append(length))
    core.body = core.body.with_offsets(LengthOffsets.of(np.full(6, 0.05), np.full(6, 1e-3)))
    publisher = graph.publisher(Float64MultiArray, 'muscle_length_command')

    def is_noted():
        publisher.publish(array_message(np.full(6, 0.02), 'muscle'))
        return noted

    np.testing.assert_allclose(graph.wait(is_noted, 'the command')[0], -0.03)


def test_zero_at_start_begins_the_length_calibration_for_every_node(graph, trained_file):
    common = {'robot': 'arm26', 'checkpoint': trained_file}
    controller = graph.host(ControllerNode, **common)
    estimator = graph.host(EstimatorNode, **common, zero_at_start=True)
    graph.wait(
        lambda: not controller.body.offsets.known,
        'the controller to receive unknown length offsets',
    )
    assert not estimator.core.body.offsets.known
