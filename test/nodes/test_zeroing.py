# SPDX-License-Identifier: Apache-2.0
"""Length calibration over DDS."""

import numpy as np
import pytest
from graph import DEADLINE
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger

from musculoskeletal_ae.estimation import length_calibration
from musculoskeletal_ae.nodes.controller import Controller
from musculoskeletal_ae.nodes.estimator import Estimator
from musculoskeletal_ae.nodes.hardware_emulator import HardwareEmulator
from musculoskeletal_ae.nodes.learner import Learner
from musculoskeletal_ae.nodes.messages import LATCHED, array_message


@pytest.mark.parametrize('stands', [True, False], ids=['stated posture', 'gentle motion'])
def test_length_offsets_are_found_and_reach_every_node(
    graph, trained_file, tmp_path, monkeypatch, stands
):
    monkeypatch.setattr(length_calibration, 'ENOUGH_WITH_ANGLES', 2.0)
    common = {'robot': 'arm26', 'checkpoint': trained_file}
    hardware = graph.host(HardwareEmulator, robot='arm26', seed=1, faults=['unzeroed'])
    hardware.arm.step(10.0)
    node = graph.host(Estimator, **common)
    # On a loaded machine messages arrive late. A large max_age avoids stops.
    controller = graph.host(Controller, **common, max_age=10.0)
    learner = graph.host(Learner, robot='arm26', state_directory=str(tmp_path))
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


def test_length_offsets_of_a_restarted_estimator_are_unknown_until_it_finds_them(
    graph, trained_file
):
    controller = graph.host(Controller, robot='arm26', checkpoint=trained_file)
    estimator = graph.publisher(Float64MultiArray, 'muscle_length_zeros', LATCHED)

    def reported(offset, deviation):
        rows = np.array([np.full(6, offset), np.full(6, deviation)])
        estimator.publish(array_message(rows, 'quantity', 'muscle'))

    def known(expected):
        graph.wait(
            lambda: (
                controller.body.offsets.known
                == controller.core.stream.body.offsets.known
                == expected
            ),
            'the length offsets',
        )

    reported(0.05, 0.0)
    graph.wait(lambda: controller.body.offsets.offset.all(), 'the length offsets')
    # A restarted estimator publishes these offsets, but they contradict the earlier ones.
    reported(0.0, 0.0)
    known(False)
    reported(0.0, 0.0)
    graph.spin(0.3)
    known(False)
    reported(0.01, 1.0)
    graph.wait(lambda: controller.body.offsets.offset.all(), 'the uncertain length offsets')
    reported(0.05, 0.001)
    known(True)
    # After the repair of a muscle, the estimator confirms the offsets with a larger deviation.
    before = controller.core.stream.body.offsets
    reported(0.05, 0.01)
    graph.wait(lambda: controller.core.stream.body.offsets is not before, 'the confirmed offsets')
    known(True)


def test_zero_at_start_begins_the_length_calibration_for_every_node(graph, trained_file):
    common = {'robot': 'arm26', 'checkpoint': trained_file}
    controller = graph.host(Controller, **common)
    estimator = graph.host(Estimator, **common, zero_at_start=True)
    graph.wait(
        lambda: not controller.body.offsets.known,
        'the controller to receive unknown length offsets',
    )
    assert not estimator.core.body.offsets.known
