# SPDX-License-Identifier: Apache-2.0
"""Zeros of the lengths as users find them, over DDS."""

from __future__ import annotations

import numpy as np
from std_srvs.srv import Trigger

from musculoskeletal_ae.nodes.controller import Controller
from musculoskeletal_ae.nodes.estimator import Estimator
from musculoskeletal_ae.nodes.hardware_emulator import HardwareEmulator
from musculoskeletal_ae.nodes.learner import Learner


def test_a_stated_posture_tells_the_zeros_to_all_nodes(graph, trained_file, tmp_path):
    offset = [0.1, -0.05, 0.06, -0.13, 0.08, -0.07]
    hardware = graph.host(HardwareEmulator, robot='arm26', seed=1, length_offset=offset)
    hardware.arm.step(10.0)
    node = graph.host(Estimator, robot='arm26', checkpoint=trained_file)
    controller = graph.host(Controller, robot='arm26', checkpoint=trained_file)
    learner = graph.host(Learner, robot='arm26', state_directory=str(tmp_path))
    graph.set_parameter('estimator', 'zero_posture', hardware.arm.theta.tolist())
    assert graph.call(Trigger, 'estimator/zero').success
    assert not node.core.zeros.known
    told = [controller, learner]
    graph.wait(lambda: all(n.zeros.known and n.zeros.offset.any() for n in told), 'the zeros')
    for other in told:
        # The network knows the geometric model alone.
        np.testing.assert_allclose(other.zeros.offset, offset, atol=0.03)
    assert controller.core.safety.zeroed
