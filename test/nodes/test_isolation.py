# SPDX-License-Identifier: Apache-2.0
"""A muscle ruptures, is verified and isolated, and the arm moves on, over DDS."""

from dataclasses import replace

import numpy as np
import pytest
from controlled_arm import ControlledArm
from std_srvs.srv import Trigger

from musculoskeletal_ae.estimation.body_memory import FILE
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.nodes.estimator import EstimatorNode
from musculoskeletal_ae.nodes.hardware_emulator import HardwareEmulatorNode
from musculoskeletal_ae.signals.body_state import Anomaly

HERE, THERE = np.array([-0.5, -1.2]), np.array([-0.3, -0.9])


def has_network(estimator, version):
    return estimator.core.mae is not None and estimator.core.mae.version == version


@pytest.fixture
def arm(graph, arm26, trained_file):
    arm = ControlledArm(graph, arm26, trained_file)
    arm.target(HERE)
    arm.goes_to(HERE)
    return arm


def test_a_ruptured_muscle_is_verified_isolated_and_restored(arm):
    graph, name = arm.graph, arm.robot.muscles[3]
    bodies = graph.follow_body()
    graph.wait(lambda: bodies, 'the body state')
    assert (bodies[-1].isolated, bodies[-1].anomaly) == ((), Anomaly.NONE)
    assert graph.set_parameter('estimator', 'on_anomaly', 'isolate')[0]
    assert graph.set_parameter('hardware_emulator', 'faults', [f'rupture:{name}'])[0]
    graph.wait(lambda: bodies[-1].has_anomaly, 'the anomaly')
    # One message tells of finding, isolation and verification.
    assert (bodies[-1].isolated, bodies[-1].anomaly, bodies[-1].suspect) == (
        (3,),
        Anomaly.VERIFYING,
        3,
    )
    assert len(bodies) == 2
    graph.wait(lambda: arm.state().values['mode'] == 'verifying', 'the verification')
    graph.wait(
        lambda: graph.report('estimator').values['verification'] == 'running',
        'the verification to be reported',
    )
    assert graph.report('estimator').values['suspect muscle'] == name
    graph.wait(lambda: not bodies[-1].has_anomaly, 'the end of the anomaly')
    assert bodies[-1].anomaly is Anomaly.ENDED
    assert arm.estimator.core.suspects.last_verification == f'{name}: ruptured'
    assert bodies[-1].isolated == (3,)
    assert len(bodies) == 3
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
    graph.wait(lambda: has_network(arm.estimator, 7), 'the next network')
    assert arm.estimator.core.body.isolated == (1, 2)


def test_a_restarted_estimator_remembers_isolated_muscles(graph, arm26, trained):
    bodies = graph.follow_body()
    names = list(arm26.muscles[1:3])
    estimator = graph.host(EstimatorNode, robot='arm26', isolate_muscles=names)
    graph.send_network(checkpoint.to_bytes(replace(trained['default'], version=5)))
    graph.wait(lambda: has_network(estimator, 5), 'the network')
    assert graph.set_parameter('estimator', 'isolate_muscles', names[:1])[0]
    graph.wait(lambda: graph.call(Trigger, 'estimator/restore').success, 'the restoration')
    graph.wait(lambda: bodies and bodies[-1].isolated == (2,), 'the restored muscle')
    before = bodies[-1]
    graph.end(estimator)
    restarted = graph.host(EstimatorNode, robot='arm26')
    graph.wait(lambda: bodies[-1].generation > before.generation, 'its first body state')
    assert bodies[-1].isolated == (2,)
    # The learner's network may name other muscles, but only the estimator decides.
    others = replace(trained['default'].without((1, 4)), version=6)
    graph.send_network(checkpoint.to_bytes(others))
    graph.wait(lambda: has_network(restarted, 6), 'the next network')
    assert restarted.core.mae.isolated == restarted.core.body.isolated == (2,)
    assert bodies[-1].isolated == (2,)


def test_an_isolation_that_could_not_be_saved_is_saved_once_that_is_possible(
    graph, arm26, tmp_path
):
    state = tmp_path / 'state'
    state.write_text('')  # a file where the directory should be
    graph.host(HardwareEmulatorNode, robot='arm26')
    name = arm26.muscles[1]
    common = {'robot': 'arm26', 'state_directory': str(state)}
    estimator = graph.host(EstimatorNode, isolate_muscles=[name], **common)
    graph.wait(lambda: estimator.memory.problem, 'the failed attempt')
    state.unlink()
    graph.wait((state / FILE).exists, 'the next attempt')
    assert name in (state / FILE).read_text()


def test_the_estimator_isolates_no_muscle_because_a_network_lacks_it(graph, trained, tmp_path):
    file = str(tmp_path / 'without.safetensors')
    checkpoint.save(trained['default'].without((4,)), file)
    bodies = graph.follow_body()
    graph.host(EstimatorNode, robot='arm26', checkpoint=file)
    graph.wait(lambda: bodies, 'the body state')
    assert bodies[-1].isolated == ()


def test_a_stop_outlasts_a_restart_of_the_estimator_and_no_suspect_is_used_again(arm):
    graph, name = arm.graph, arm.robot.muscles[3]
    bodies = graph.follow_body()
    assert graph.set_parameter('estimator', 'on_anomaly', 'isolate')[0]
    assert graph.set_parameter('hardware_emulator', 'faults', [f'rupture:{name}'])[0]
    graph.wait(lambda: arm.state().values['mode'] == 'verifying', 'the verification')
    graph.end(arm.estimator)
    count = len(bodies)
    arm.estimator = graph.host(EstimatorNode, robot='arm26', checkpoint=arm.checkpoint)
    graph.wait(lambda: len(bodies) > count, 'the body state of the new estimator')
    assert (bodies[-1].isolated, bodies[-1].anomaly) == ((3,), Anomaly.NONE)
    graph.wait(lambda: arm.state().values['mode'] == 'stopped', 'the end of the verification')
    graph.spin(1.0)
    assert arm.controller.core.supervisor.is_latched
    assert arm.controller.core.robot.isolated == (3,)
    graph.wait(lambda: graph.call(Trigger, 'controller/reset').success, 'the reset')
    arm.goes_to(HERE)
    assert arm.controller.core.robot.isolated == (3,)
