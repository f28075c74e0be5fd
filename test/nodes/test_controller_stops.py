# SPDX-License-Identifier: Apache-2.0
"""Every stop cause on a real graph, and how the arm resumes."""

import signal
import time

import numpy as np
import pytest
from controlled_arm import IMPATIENT, PATIENT, ControlledArm
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from musculoskeletal_ae.awake_clock import PAUSE
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.nodes.controller import ControllerNode
from musculoskeletal_ae.nodes.stop_recording import FILE
from musculoskeletal_ae.remedy_steps import Step
from musculoskeletal_ae.ros.message_building import LATCHED

HERE, THERE = np.array([-0.5, -1.2]), np.array([-0.3, -1.0])


@pytest.fixture
def moving(graph, arm26, trained_file):
    """Return a function that starts an arm and makes it move, or hold its posture."""

    def start(*processes, holds=False, **hardware):
        arm = ControlledArm(graph, arm26, trained_file, processes, **hardware)
        arm.target(arm.posture() if holds else HERE)
        graph.wait(lambda: arm.count() > 30, 'commands')
        return arm

    return start


def reset(arm):
    return arm.graph.call(Trigger, 'controller/reset')


def test_a_stop_pays_out_is_reported_and_recorded_and_ends_only_by_a_reset(
    moving, tmp_path, monkeypatch
):
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path))
    arm = moving()
    assert arm.graph.call(Trigger, 'controller/stop').success
    before = arm.count()
    arm.pays_out()
    assert arm.count() > before
    request = SetBool.Request(data=True)
    refused = arm.graph.call(SetBool, 'controller/explore', request)
    assert not refused.success
    assert 'stopped' in refused.message
    modes = arm.graph.listen(String, 'controller_mode', LATCHED)  # subscribes after the stop

    def reported(mode):
        arm.graph.wait(lambda: modes and modes[-1].data == mode, mode)

    reported('stopped:operator_stop')
    values = arm.state().values
    assert (values['mode'], values['stop cause']) == ('stopped', 'operator_stop')
    assert arm.state().steps[0] is Step.RESET_CONTROLLER
    files = arm.graph.wait(
        lambda: [f for f in tmp_path.glob(f'stop_*/{FILE}') if f.stat().st_size], 'the recording'
    )
    assert reset(arm).success
    reported('moving')
    reported('holding')
    assert 'stop cause' not in arm.state().values
    arm.goes_to(HERE)
    assert files[0].read_text() == 'controller/stop was called\n'
    bag = Bag.open(files[0].parent)
    sent = [m for m in bag.messages() if m.topic.endswith('/muscle_length_command')]
    assert sent
    heard = {name.rpartition('/')[2] for name in bag.topics}
    assert {'muscle_states', 'estimated_joint_states', 'target_joint_states'} <= heard


def test_a_crashed_estimator_stops_the_arm_and_a_new_one_lets_it_resume(moving):
    arm = moving('estimator')
    arm.kill(arm.estimator, signal.SIGSEGV)
    status, output = arm.estimator.ended()
    assert status == -signal.SIGSEGV
    assert 'Segmentation fault' in output and 'File "' in output  # says where it happened
    arm.set_max_age(IMPATIENT)
    arm.says('stale_estimate')
    answer = reset(arm)
    assert not answer.success
    assert 'estimated_joint_states' in answer.message
    arm.pays_out()
    arm.processes = ()
    arm.start('estimator', checkpoint=arm.checkpoint)
    arm.graph.next('estimated_joint_states', 5)
    arm.set_max_age(PATIENT)
    arm.graph.wait(lambda: reset(arm).success, 'the reset')
    arm.goes_to(HERE)


def test_a_lost_driver_stops_the_arm_and_a_new_one_lets_it_resume(moving):
    arm = moving(holds=True)  # the new emulated arm begins in the same posture
    arm.graph.end(arm.hardware)
    arm.set_max_age(IMPATIENT)
    arm.says('stale_muscle_states')
    refused = reset(arm).message
    assert refused.startswith('refused: no usable muscle_states')
    assert 'call controller/reset again' in refused
    arm.start('hardware_emulator', seed=1)
    arm.graph.next('estimated_joint_states', 5)
    arm.set_max_age(PATIENT)
    arm.graph.wait(lambda: reset(arm).success, 'the reset')
    arm.target(HERE)
    arm.goes_to(HERE)


def test_a_command_from_before_a_pause_of_the_process_is_not_published(moving, monkeypatch):
    arm = moving()
    core, before, stale = arm.controller.core, arm.count(), []
    step = core.step

    def suspended_step(*args):
        command = step(*args)
        if stale or command is None:
            return command
        time.sleep(1.2 * PAUSE)
        stale.append(command.value + 1e-4)  # no other command has these values
        return command._replace(value=stale[0])

    monkeypatch.setattr(core, 'step', suspended_step)
    arm.graph.wait(lambda: stale and arm.count() > before + 30, 'commands after the pause')
    assert not (arm.sent()[before:] == stale[0]).all(axis=1).any()


def test_after_a_killed_controller_or_a_stop_a_new_controller_waits_for_a_reset(moving):
    arm = moving('controller')
    arm.kill(arm.controller)
    arm.pays_out()
    arm.processes = ()
    arm.controller = arm.start_controller(explore=True)
    arm.says('restarted')

    # The new controller may not have been discovered yet, so repeat the message until it arrives.
    def heard():
        arm.target(THERE)
        return arm.controller.core.target_state.theta is not None

    arm.graph.wait(heard, 'the target')
    arm.pays_out()
    arm.says("'mode': 'stopped'")
    arm.graph.wait(lambda: reset(arm).success, 'the reset')
    arm.goes_to(THERE)
    arm.says('holding')
    assert arm.graph.call(Trigger, 'controller/stop').success
    arm.graph.end(arm.controller)  # end this controller without a reset of the stop
    arm.controller = arm.start_controller(explore=True)
    arm.says("'stop cause': 'operator_stop'")
    arm.graph.wait(lambda: reset(arm).success, 'the reset')
    arm.says('no target')


def test_an_anomaly_stops_the_arm_until_estimator_and_controller_are_reset(moving):
    arm = moving()
    muscle = arm.hardware.robot.muscles[0]
    assert arm.graph.set_parameter('hardware_emulator', 'faults', [f'rupture:{muscle}'])[0]
    arm.says('anomaly_detected')
    answer = reset(arm)
    assert not answer.success
    assert 'the estimator has found a fault' in answer.message
    assert arm.graph.set_parameter('hardware_emulator', 'faults', [''])[0]
    assert not reset(arm).success
    arm.graph.wait(
        lambda: arm.graph.call(Trigger, 'estimator/reset').success, 'the reset of the estimator'
    )
    arm.graph.wait(lambda: reset(arm).success, 'the reset')


def test_an_unfit_checkpoint_file_is_refused_and_the_arm_goes_on(moving):
    arm = moving()
    done, reason = arm.graph.set_parameter('controller', 'checkpoint', '/nowhere.safetensors')
    assert not done
    assert 'nowhere' in reason
    arm.goes_to(HERE)
    assert 'stopped' not in arm.state().message


def test_an_unfit_accepted_checkpoint_stops_the_controller(graph, trained_file):
    controller = graph.host(ControllerNode, robot='arm26', checkpoint=trained_file)
    before, supervisor = controller.core.mae, controller.core.supervisor
    graph.send_network(b'not a checkpoint', 'accepted_checkpoint')
    graph.wait(lambda: supervisor.is_latched, 'the stop')
    assert supervisor.condition.kind is ConditionKind.UNFIT_CHECKPOINT
    assert controller.core.mae is before


def test_the_arm_moves_without_joint_sensors_and_learner(moving):
    arm = moving(sensors=[''])
    arm.graph.wait(lambda: arm.count() > 100, 'commands')
    assert 'stopped' not in arm.state().message
    assert len(arm.graph.received['joint_states']) == 0


def test_the_end_of_a_learner_does_not_disturb_a_motion(moving):
    arm = moving()
    learner = arm.start('learner', checkpoint=arm.checkpoint, state_directory='')
    arm.says('checkpoint version', 'learner')
    arm.target(THERE)
    before = arm.count()
    arm.graph.wait(lambda: arm.count() > before + 20, 'a movement under way')
    arm.graph.end(learner)
    arm.goes_to(THERE)
    # All remaining nodes report `ok` again.
    for node in ('controller', 'estimator', 'hardware_emulator'):
        arm.graph.wait(lambda node=node: arm.state(node).level == 'ok', f'{node} to be well')
    arm.never_jumped(before)
