# SPDX-License-Identifier: Apache-2.0
"""A muscle ruptures, is verified and isolated, and the arm moves on, over DDS."""

from dataclasses import replace

import numpy as np
import pytest
from controlled_arm import ControlledArm
from std_msgs.msg import Bool, String
from std_srvs.srv import Trigger

from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.nodes.estimator import Estimator
from musculoskeletal_ae.ros.messages import LATCHED

HERE, THERE = np.array([-0.5, -1.2]), np.array([-0.3, -0.9])


@pytest.fixture
def arm(graph, arm26, trained_file):
    graph.listen(String, 'isolated_muscles', LATCHED)
    graph.listen(Bool, 'anomaly_detected', LATCHED)
    arm = ControlledArm(graph, arm26, trained_file)
    arm.target(HERE)
    arm.goes_to(HERE)
    return arm


def test_a_ruptured_muscle_is_verified_isolated_and_restored(arm):
    graph, name = arm.graph, arm.robot.muscles[3]
    assert graph.received['isolated_muscles'][-1].data == ''
    assert graph.set_parameter('estimator', 'on_anomaly', 'isolate')[0]
    assert graph.set_parameter('hardware_emulator', 'faults', [f'rupture:{name}'])[0]
    graph.wait(lambda: graph.received['anomaly_detected'][-1].data, 'the anomaly')
    graph.wait(lambda: arm.state().values['mode'] == 'verifying', 'the verification')
    graph.wait(
        lambda: graph.report('estimator').values['verification'] == 'running',
        'the verification to be reported',
    )
    assert graph.report('estimator').values['suspect muscle'] == name
    graph.wait(lambda: not graph.received['anomaly_detected'][-1].data, 'the end of the anomaly')
    assert arm.estimator.core.suspects.last_verification == f'{name}: ruptured'
    assert graph.received['isolated_muscles'][-1].data == name
    graph.wait(lambda: arm.controller.core.supervisor.is_running, 'the arm to go on')
    assert arm.controller.core.robot.isolated == (3,)
    arm.target(THERE)
    arm.goes_to(THERE)
    assert arm.estimator.core.cause == ''
    assert graph.set_parameter('hardware_emulator', 'faults', [''])[0]
    # It is refused as long as the newest message is from before the repair.
    answer = graph.wait(
        lambda: (reply := graph.call(Trigger, 'estimator/restore')).success and reply,
        'the repaired muscle to be accepted',
    )
    assert answer.message == 'isolated: none'
    graph.wait(
        lambda: arm.controller.core.robot.isolated == (), 'the controller to use the muscle again'
    )


def test_a_muscle_whose_sensor_sends_nan_is_isolated_and_the_arm_goes_on(arm):
    graph, name = arm.graph, arm.robot.muscles[2]
    assert graph.set_parameter('estimator', 'on_anomaly', 'isolate')[0]
    assert graph.set_parameter('hardware_emulator', 'faults', [f'nan_sensor:tension:{name}'])[0]
    graph.wait(
        lambda: arm.controller.core.robot.isolated == (2,), 'the controller to isolate the muscle'
    )
    verified = arm.estimator.core.suspects.last_verification
    assert verified == f'{name}: a sensor reports NaN instead of a number'
    graph.wait(lambda: arm.controller.core.supervisor.is_running, 'the arm to go on')
    arm.target(THERE)
    arm.goes_to(THERE)
    assert np.isfinite(arm.controller.core.limiter.command.value).all()
    for node in (arm.estimator, arm.controller):
        assert any('not finite' in reason for reason in node.rejected)


def test_muscles_are_isolated_by_service_and_unknown_names_are_refused(arm, trained):
    graph, names = arm.graph, list(arm.robot.muscles[1:3])
    # The service is refused while the parameter isolate_muscles is empty.
    assert not graph.call(Trigger, 'estimator/isolate').success
    done, reason = graph.set_parameter('estimator', 'isolate_muscles', ['tail'])
    assert not done
    assert 'legal: ' in reason
    assert graph.set_parameter('estimator', 'isolate_muscles', names)[0]
    assert graph.call(Trigger, 'estimator/isolate').message == f'isolated: {", ".join(names)}'
    graph.wait(
        lambda: arm.controller.core.robot.isolated == (1, 2),
        'the controller to isolate the muscles',
    )
    # A network in which no muscle is isolated does not change that.
    graph.send_network(checkpoint.to_bytes(replace(trained['default'], version=7)))
    graph.wait(lambda: arm.estimator.checkpoint_version == 7, 'the next network')
    assert arm.estimator.core.body.isolated == (1, 2)


def test_a_restarted_estimator_takes_isolated_muscles_from_the_network(graph, arm26, trained):
    known = replace(trained['default'].without((4,)), version=5)
    reported = graph.listen(String, 'isolated_muscles', LATCHED)
    estimator = graph.host(Estimator, robot='arm26')
    graph.send_network(checkpoint.to_bytes(known))
    graph.wait(lambda: reported, 'the list of isolated muscles')
    assert reported[-1].data == arm26.muscles[4]
    assert estimator.core.mae.isolated == (4,)
    # Only the first network determines the isolated muscles. From now on the estimator does.
    graph.wait(lambda: not estimator.candidates.queue.is_busy, 'the end of the validation')
    others = replace(trained['default'].without((1, 2)), version=6)
    graph.send_network(checkpoint.to_bytes(others))
    graph.wait(lambda: estimator.checkpoint_version == 6, 'the next network')
    assert estimator.core.body.isolated == (4,)
