# SPDX-License-Identifier: Apache-2.0
"""The node `learner`: it learns, validates, saves, resumes, and ends with its processes."""

import errno
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from graph import DEADLINE, LOOK
from processes import is_running
from rclpy.parameter import Parameter
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float64MultiArray, UInt8MultiArray
from std_srvs.srv import SetBool, Trigger

from musculoskeletal_ae.estimation.finding import DETECTION_DELAY
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.learning import state_directory as states
from musculoskeletal_ae.learning.state_directory import NETWORK, NEWEST
from musculoskeletal_ae.learning.training_process import Trainer
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.nodes.controller import ControllerNode
from musculoskeletal_ae.nodes.estimator import EstimatorNode
from musculoskeletal_ae.nodes.hardware_emulator import HardwareEmulatorNode
from musculoskeletal_ae.nodes.learner import LearnerNode
from musculoskeletal_ae.nodes.running import NICENESS
from musculoskeletal_ae.ros.message_building import LATCHED, array_message
from musculoskeletal_ae.signals.body_state import Anomaly, BodyState

REST, MOVE = 0.8, 0.3  # duration of a rest, and of the motion between two rests [s]
DT = 0.02


class Arm:
    """Stands in for the hardware; it rests in one posture after another."""

    def __init__(self, graph, robot):
        self.graph, self.robot = graph, robot
        self.rng = np.random.default_rng(0)
        self.joints = graph.publisher(JointState, 'joint_states')
        self.muscles = graph.publisher(Float64MultiArray, 'muscle_states')
        self.time = self.until = 0.0
        self.theta, self.tension = self.draw()

    def draw(self):
        """Return a random posture and random tensions."""
        tension = self.rng.uniform(30.0, 150.0, self.robot.muscle_count)
        return self.robot.random_postures(1, self.rng)[0], tension

    def end(self):
        """Stop publishing, because the learner would reject messages of two arms."""
        for publisher in (self.joints, self.muscles):
            self.graph.node.destroy_publisher(publisher)

    def publish(self):
        """Advance the arm by DT, and publish its states; after each rest, the arm moves on."""
        self.time += DT
        if self.time > self.until:
            self.before, self.begun = (self.theta, self.tension), self.time
            self.theta, self.tension = self.draw()
            self.until = self.time + MOVE + REST
        share = min(1.0, (self.time - self.begun) / MOVE)
        theta, tension = (
            (1.0 - share) * old + share * new
            for old, new in zip(self.before, (self.theta, self.tension), strict=True)
        )
        length = self.robot.muscle_lengths(theta, tension) + 0.005
        rows = np.stack([length, tension, np.full(self.robot.muscle_count, 25.0)])
        self.joints.publish(JointState(name=self.robot.joints, position=theta.tolist()))
        self.muscles.publish(array_message(rows, 'quantity', 'muscle'))

    def step(self):
        """Publish once, and process messages for DT."""
        self.publish()
        self.graph.spin(DT)


class HostedLearner:
    """A learner in this process and an arm, whose common clock the test advances."""

    def __init__(self, graph, robot, **parameters):
        self.graph = graph
        self.node = graph.host(LearnerNode, robot='arm26', **parameters)
        graph.listen(UInt8MultiArray, 'mae_checkpoint', LATCHED)
        self.arm = Arm(graph, robot)
        self.node.now = lambda: self.arm.time
        self.taken = 0
        take = self.node.core.take

        def taking(*values):
            self.taken += 1
            take(*values)

        self.node.core.take = taking

    @property
    def samples(self):
        return len(self.node.core.samples)

    @property
    def tilted(self):
        return any(sample.gravity.size for sample in self.node.core.samples.samples)

    @property
    def updates(self):
        return self.node.core.updates

    def report(self):
        return self.node.report()

    def end(self):
        """End the node and its arm."""
        self.graph.end(self.node)
        self.arm.end()

    def step(self):
        taken, deadline = self.taken, time.monotonic() + 1.0
        self.arm.publish()
        while self.taken == taken and time.monotonic() < deadline:
            self.graph.executor.spin_once(LOOK)

    def run(self, seconds):
        """Advance the time by `seconds` [s]."""
        for _ in range(round(seconds / DT)):
            self.step()

    def learn(self, condition, what):
        """Advance the time until a condition holds; fail with the text `what` at the deadline."""
        deadline = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < deadline, f'timeout: {what}'
            self.step()
            if not self.node.core.trainer.ready:  # leave the processor to the training
                time.sleep(DT)


@pytest.fixture
def state(tmp_path):
    return str(tmp_path / 'state')


@pytest.fixture
def here(monkeypatch):
    """Let learners that run in the test's process train there, too, not in another process."""
    name = 'musculoskeletal_ae.nodes.learner.TrainerProcess'
    monkeypatch.setattr(name, Trainer)


@pytest.fixture
def host(graph, arm26, trained_file, request):
    """Return a function that creates a learner that trains in this process or in another one."""

    def make(process=False, **parameters):
        if not process:
            request.getfixturevalue('here')
        defaults = {'checkpoint': trained_file, 'state_directory': ''}
        return HostedLearner(graph, arm26, **(defaults | parameters))

    return make


def versions(graph, robot):
    return [
        checkpoint.from_bytes(bytes(m.data), robot).version
        for m in graph.received['mae_checkpoint']
    ]


def test_the_learner_publishes_and_saves_checkpoints_and_replaces_a_dead_training_process(
    host, graph, arm26, state
):
    learner = host(process=True, state_directory=state)
    first = learner.report().values['training process']
    os.kill(int(first), signal.SIGKILL)
    learner.learn(
        lambda: learner.report().values['training process restarts'] == '1',
        'the report of the restarted training process',
    )
    learner.learn(lambda: len(graph.received['mae_checkpoint']) >= 3, 'two updates')
    assert learner.report().values['training process'] != first
    assert learner.samples >= 2
    assert versions(graph, arm26) == sorted(set(versions(graph, arm26)))
    assert learner.report().level == 'ok'
    assert (Path(state) / NEWEST).exists()
    assert graph.call(Trigger, 'learner/save').success
    assert checkpoint.load(Path(state) / NETWORK, arm26).version in versions(graph, arm26)


def test_the_learner_saves_what_the_estimator_accepts_and_returns_from_what_it_rejects(
    host, graph, arm26, state
):
    learner = host(state_directory=state)
    published = graph.received['mae_checkpoint']
    accepted = graph.publisher(UInt8MultiArray, 'accepted_checkpoint', LATCHED)
    rejected = graph.publisher(KeyValue, 'rejected_checkpoint', LATCHED)

    def saved():
        return checkpoint.from_bytes(learner.node.core.checkpoint, arm26).version

    learner.learn(lambda: len(published) >= 2, 'a candidate')
    assert graph.call(SetBool, 'learner/enable', SetBool.Request(data=False)).success
    accepted.publish(published[-1])
    candidate = versions(graph, arm26)[-1]
    learner.learn(lambda: saved() == candidate, 'the accepted network')
    assert graph.call(SetBool, 'learner/enable', SetBool.Request(data=True)).success
    learner.learn(lambda: versions(graph, arm26)[-1] > candidate, 'another candidate')
    rejected.publish(KeyValue(key='no number', value=''))
    learner.learn(lambda: 'no version' in str(learner.node.rejected), 'the refusal')
    learner.node.core.enable(False)
    rejected.publish(KeyValue(key=str(learner.node.core.mae.version), value='it is too wrong'))
    learner.learn(lambda: versions(graph, arm26)[-1] == candidate, 'the network in use')
    assert saved() == candidate
    assert learner.report().values['last rejected network'] == 'it is too wrong'


def test_of_a_fast_arm_the_learner_uses_more_than_100_messages_a_second_but_not_all(host, graph):
    learner, duration, period = host(rate=500.0), 0.3, 0.002
    for _ in range(round(duration / period)):
        learner.arm.time += period - DT  # `publish` adds DT
        learner.arm.publish()
        graph.spin(0.005)
    graph.wait(lambda: learner.taken > 100 * duration, 'messages that are used')
    assert learner.taken < 200 * duration


def test_an_anomaly_and_learner_enable_stop_learning_for_a_time(host, graph):
    learner = host()
    healthy = BodyState.healthy(6)
    learner.learn(lambda: learner.updates >= 1, 'an update')

    def learns_nothing():
        learner.learn(lambda: learner.node.core.trainer.ready, 'the end of the last update')
        samples, updates = learner.samples, learner.updates
        learner.run(
            DETECTION_DELAY + 2.0
        )  # longer than the time until the first samples after a pause
        assert (learner.samples, learner.updates) == (samples, updates)

    def learns_again():
        updates = learner.updates
        learner.learn(lambda: learner.updates > updates, 'learning again')

    assert graph.call(SetBool, 'learner/enable', SetBool.Request(data=False)).success
    assert 'enable' in learner.report().message
    learns_nothing()
    assert graph.call(SetBool, 'learner/enable', SetBool.Request(data=True)).success
    learns_again()
    graph.tell_body(replace(healthy, anomaly=Anomaly.FOUND, suspect=0, generation=1))
    learner.learn(lambda: 'anomaly' in learner.report().message, 'the learner to pause')
    learns_nothing()
    assert int(learner.report().values['not learned: anomaly']) >= 3
    graph.tell_body(replace(healthy, anomaly=Anomaly.ENDED, suspect=0, generation=2))
    learns_again()
    assert not graph.call(Trigger, 'learner/save').success  # this learner has no state directory


def test_a_checkpoint_set_at_run_time_replaces_the_saved_state_and_keeps_a_backup(
    host, graph, trained_file, state, tmp_path
):
    learner = host(state_directory=state)
    learner.learn(lambda: learner.samples >= 2, 'samples')
    broken = tmp_path / 'broken.safetensors'
    broken.write_bytes(b'nonsense')
    success, reason = graph.set_parameter('learner', 'checkpoint', str(broken))
    assert not success
    assert 'broken' in reason
    assert learner.samples >= 2
    before = len(graph.received['mae_checkpoint'])
    assert graph.set_parameter('learner', 'checkpoint', trained_file) == (True, '')
    assert learner.samples == 0
    graph.wait(lambda: len(graph.received['mae_checkpoint']) > before, 'the new network')
    assert (Path(state) / 'backup-1.state').exists()
    learner.learn(lambda: learner.samples >= 1, 'a sample')
    assert graph.set_parameter('learner', 'checkpoint', trained_file) == (True, '')
    assert learner.samples == 0  # setting the same value again starts afresh as well


def test_a_fresh_start_drops_the_saved_state_and_keeps_a_backup(host, state):
    learner = host(state_directory=state)
    learner.learn(lambda: learner.samples >= 2, 'samples')
    learner.end()
    fresh = host(state_directory=state, fresh=True)
    assert fresh.samples == 0
    assert (Path(state) / 'backup-1.state').exists()
    fresh.learn(lambda: fresh.updates >= 1, 'an update from the start')


def test_relearning_forgets_the_named_muscles_and_refuses_unknown_ones(host, graph, arm26, state):
    learner = host(state_directory=state)
    learner.learn(lambda: learner.samples >= 2, 'samples')
    success, reason = graph.set_parameter('learner', 'relearn_muscles', ['no_such_muscle'])
    assert not success
    assert arm26.muscles[0] in reason
    nameless = graph.call(Trigger, 'learner/relearn')
    assert not nameless.success
    assert 'set that parameter first' in nameless.message
    assert graph.set_parameter('learner', 'relearn_muscles', [arm26.muscles[1]])[0]
    assert all(each.known[1] for each in learner.node.core.samples.stored)
    assert graph.call(Trigger, 'learner/relearn').success
    assert not any(each.known[1] for each in learner.node.core.samples.stored)
    assert all(each.known[0] for each in learner.node.core.samples.stored)
    learner.end()
    learner = host(state_directory=state, relearn_muscles=[arm26.muscles[2]])
    assert all(each.known[2] for each in learner.node.core.samples.stored)
    assert graph.call(Trigger, 'learner/relearn').success
    assert not any(each.known[2] for each in learner.node.core.samples.stored)


def test_parameters_refused_together_change_nothing(host, arm26, trained_file, state):
    learner = host(state_directory=state)
    core, first = learner.node.core, arm26.muscles[0]

    def together(**values):
        parameters = [Parameter(name, value=value) for name, value in values.items()]
        return learner.node.set_parameters_atomically(parameters)

    learner.learn(lambda: learner.samples >= 2, 'samples')
    refused = together(relearn_muscles=[first], checkpoint='/nowhere')
    assert not refused.successful and '/nowhere' in refused.reason
    assert not together(checkpoint=trained_file, relearn_muscles=['tail']).successful
    assert not together(checkpoint=trained_file, fresh=True).successful  # only at the start
    assert learner.samples >= 2 and all(each.known.all() for each in core.samples.stored)
    assert together(relearn_muscles=[first], checkpoint=trained_file).successful
    assert learner.samples == 0
    assert [backup.name for backup in Path(state).glob('backup-*')] == ['backup-1.state']
    assert together(checkpoint='').successful


def test_the_learner_follows_the_isolated_muscles_of_the_estimator(host, graph, trained, tmp_path):
    file, healthy = str(tmp_path / 'without.safetensors'), BodyState.healthy(6)
    checkpoint.save(trained['default'].without((4,)), file)
    core = host(checkpoint=file).node.core
    assert core.isolated == ()
    for generation, muscles in enumerate([(4,), (2, 4), (2,), ()], 1):
        graph.tell_body(replace(healthy, isolated=muscles, generation=generation))
        graph.wait(lambda wanted=muscles: core.isolated == wanted, f'{muscles}')
    assert core.mae.isolated == (4,)  # the network of the user is left as it is


def test_the_learner_gives_up_the_joint_sensors_that_the_estimator_doubts(host, graph, arm26):
    learner = host()
    publisher = graph.publisher(Float64MultiArray, 'joint_sensor_trust', LATCHED)
    for trust in (1.0, 2.0):
        rows = np.array([[0.0, trust], [0.0, 3.0], [0.0, 0.5]])
        publisher.publish(array_message(rows, 'quantity', 'joint'))
        graph.wait(
            lambda wanted=trust: learner.node.core.joint_trust.trust[1] == wanted,
            f'trust {trust:g} in {arm26.joints[1]}',
        )


# -- real processes -------------------------------------------------------------------------------


def start(graph, **parameters):
    """Start a learner and listen to it."""
    process = graph.start('learner', robot='arm26', **parameters)
    graph.listen(UInt8MultiArray, 'mae_checkpoint', LATCHED)
    graph.listen(DiagnosticArray, '/diagnostics')
    return process


def values(graph):
    return graph.report('learner').values


def samples(graph):
    return int(values(graph).get('samples', 0))


def learn(graph, arm, condition, what):
    def step():
        arm.step()
        return condition()

    graph.wait(step, what)


def test_a_killed_learner_resumes_from_its_saved_state_and_ctrl_c_ends_it_with_its_training_process(
    graph, arm26, trained_file, state
):
    process = start(graph, checkpoint=trained_file, state_directory=state)
    arm = Arm(graph, arm26)
    learn(graph, arm, lambda: samples(graph) >= 2, 'samples')
    # Commands do not depend on a learner, so its priority is low.
    assert os.getpriority(os.PRIO_PROCESS, process.process.pid) == max(os.nice(0), NICENESS)
    stored, version = samples(graph), versions(graph, arm26)[-1]
    worker = int(values(graph)['training process'])
    graph.ended(process, signal.SIGKILL)
    graph.received['/diagnostics'].clear()
    process = start(graph, checkpoint='/no/such/file', state_directory=state)
    graph.wait(lambda: samples(graph) >= stored, 'the saved samples')
    graph.wait(lambda: versions(graph, arm26)[-1] >= version, 'the saved network')
    graph.wait(lambda: not is_running(worker), 'the end of the orphaned training process')
    worker = int(values(graph)['training process'])
    status, output = graph.ended(process, signal.SIGINT)
    assert status == 0
    assert 'Traceback' not in output
    assert not is_running(worker)


@pytest.mark.usefixtures('here')
def test_learning_works_with_a_marker_instead_of_joint_sensors(graph, arm26, trained_file):
    common = {'robot': 'arm26', 'checkpoint': trained_file}
    graph.host(HardwareEmulatorNode, robot='arm26', sensors=['marker:30'])
    graph.host(EstimatorNode, **common)
    graph.host(ControllerNode, **common, explore=True, max_age=10.0)
    learner = graph.host(LearnerNode, **common, state_directory='', joint_source='marker')
    observed = graph.listen(JointState, 'vision_joint_states')
    graph.wait(lambda: observed, 'joint angles from the marker')
    assert tuple(observed[-1].name) == arm26.joints
    graph.wait(lambda: len(learner.core.samples) >= 1, 'a sample')


def test_learning_works_without_joint_sensors_and_with_an_accelerometer(host, graph):
    graph.listen(JointState, 'joint_states')  # the learner does not subscribe to it
    learner = host(joint_source='none')
    learner.learn(lambda: learner.samples >= 2, 'samples without angles')
    assert np.isnan(learner.node.core.samples.observations().theta).all()
    assert 'joint_states' not in learner.node.needed
    publisher = graph.publisher(Imu, 'imu')
    message = Imu()
    message.linear_acceleration.z = 9.81
    for frame, reason in (('forearm', ''), ('nowhere', 'imu: wrong frame')):
        message.header.frame_id = frame

        def taken(reason=reason):
            publisher.publish(message)
            learner.step()
            reported = learner.node.rejected
            return reason in reported if reason else learner.tilted

        graph.wait(taken, f'the result of the message with frame {frame!r}')


def test_a_second_learner_in_the_same_directory_is_refused(host, state):
    host(state_directory=state)
    with pytest.raises(MusculoskeletalError, match='another learner'):
        host(state_directory=state)


def test_a_full_disk_is_reported_at_once_and_nothing_is_lost(host, state, graph, monkeypatch):
    graph.listen(DiagnosticArray, '/diagnostics', 100)
    learner = host(state_directory=state)
    learner.learn(lambda: learner.samples >= 2, 'samples')

    def levels():
        statuses = (s for m in graph.received['/diagnostics'] for s in m.status)
        return [s.level for s in statuses if s.name.startswith(graph.namespace)]

    def full(*_):
        raise OSError(errno.ENOSPC, 'No space left on device')

    def goes_on(condition):
        learner.arm.step()
        return condition()

    with monkeypatch.context() as patch:
        patch.setattr(states, 'write_whole', full)
        count, before = learner.samples, len(levels())
        learner.learn(lambda: learner.samples > count, 'samples meanwhile')
        graph.wait(
            lambda: goes_on(lambda: DiagnosticStatus.ERROR in levels()[before:]), 'the error'
        )
    graph.wait(
        lambda: goes_on(lambda: levels()[-1] != DiagnosticStatus.ERROR), 'the end of the error'
    )
    count = learner.samples
    graph.end(learner.node)
    assert len(host(state_directory=state).node.core.samples) == count
