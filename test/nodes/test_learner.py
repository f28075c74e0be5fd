# SPDX-License-Identifier: Apache-2.0
"""The learner among real processes: it learns, gates, saves, resumes, and never blocks."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64MultiArray, UInt8MultiArray
from std_srvs.srv import SetBool, Trigger

from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.nodes.messages import array_message
from musculoskeletal_ae.nodes.qos import LATCHED

# Faster than on a robot, so that a test takes seconds.
QUICK = {'rest_time': 0.4, 'update_steps': 20}
REST = 0.8  # [s] in one posture


class Arm:
    """Plays the hardware: rests in one posture after another."""

    def __init__(self, graph, robot):
        self.graph, self.robot = graph, robot
        self.rng = np.random.default_rng(0)
        self.joints = graph.publisher(JointState, 'joint_states')
        self.muscles = graph.publisher(Float64MultiArray, 'muscle_states')
        self.move()

    def move(self):
        self.theta = self.robot.random_postures(1, self.rng)[0]
        self.tension = self.rng.uniform(30.0, 150.0, self.robot.muscle_count)
        self.since = time.monotonic()

    def publish(self):
        """Publish one message of each kind, of a new posture now and then."""
        if time.monotonic() - self.since > REST:
            self.move()
        length = self.robot.muscle_lengths(self.theta, self.tension) + 0.005
        rows = np.stack([length, self.tension, np.full(self.robot.muscle_count, 25.0)])
        self.joints.publish(JointState(name=self.robot.joints, position=self.theta.tolist()))
        self.muscles.publish(array_message(rows, 'quantity', 'muscle'))
        self.graph.spin(0.01)


def start(graph, **parameters):
    """Start a learner and listen to it."""
    process = graph.start('learner', robot='arm26', **{**QUICK, **parameters})
    graph.listen(UInt8MultiArray, 'mae_checkpoint', LATCHED)
    graph.listen(DiagnosticArray, '/diagnostics')
    return process


def diagnosis(graph):
    name = f'{graph.namespace}/learner: state'
    found = [s for m in graph.received['/diagnostics'] for s in m.status if s.name == name]
    return found[-1] if found else DiagnosticStatus()


def values(graph):
    return {v.key: v.value for v in diagnosis(graph).values}


def versions(graph, robot):
    return [
        checkpoint.from_bytes(bytes(m.data), robot).version
        for m in graph.received['mae_checkpoint']
    ]


def learn(graph, arm, condition, what):
    def step():
        arm.publish()
        return condition()

    graph.wait(step, what)


@pytest.fixture
def state(tmp_path):
    return str(tmp_path / 'state')


def samples(graph):
    return int(values(graph).get('samples', 0))


def test_it_learns_and_publishes_whole_checkpoints_that_count_up(graph, arm26, trained, state):
    start(graph, checkpoint=trained, state_directory=state)
    arm = Arm(graph, arm26)
    learn(graph, arm, lambda: len(graph.received['mae_checkpoint']) >= 4, 'three updates')
    learn(graph, arm, lambda: samples(graph) >= 3, 'samples')
    assert versions(graph, arm26) == sorted(set(versions(graph, arm26)))
    assert (Path(state) / 'samples.log').exists()
    assert graph.call(Trigger, 'learner/save').success


def test_a_killed_learner_goes_on_from_disk(graph, arm26, trained, state):
    process = start(graph, checkpoint=trained, state_directory=state)
    arm = Arm(graph, arm26)
    learn(graph, arm, lambda: samples(graph) >= 4, 'samples')
    stored, version = samples(graph), versions(graph, arm26)[-1]
    worker = int(values(graph)['training process'])
    process.end(signal.SIGKILL)
    graph.processes.remove(process)
    graph.received['/diagnostics'].clear()
    start(graph, checkpoint='/no/such/file', state_directory=state)
    graph.wait(lambda: samples(graph) >= stored, 'the samples of before')
    graph.wait(lambda: versions(graph, arm26)[-1] >= version, 'the network of before')
    graph.wait(lambda: not _alive(worker), 'the end of the orphaned training process')


def _alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_an_anomaly_stops_learning_until_the_reset(graph, arm26, trained):
    start(graph, checkpoint=trained, state_directory='')
    arm = Arm(graph, arm26)
    detected = graph.publisher(Bool, 'anomaly_detected', LATCHED)
    learn(graph, arm, lambda: samples(graph) >= 2, 'samples')
    detected.publish(Bool(data=True))
    learn(graph, arm, lambda: 'anomaly' in diagnosis(graph).message, 'the gate')
    before = samples(graph)
    learn(graph, arm, lambda: int(values(graph).get('not learned: anomaly', 0)) >= 3, 'refusals')
    assert samples(graph) == before
    detected.publish(Bool(data=False))
    learn(graph, arm, lambda: samples(graph) > before, 'learning again')
    assert not graph.call(Trigger, 'learner/save').success


def test_enable_stops_and_resumes(graph, arm26, trained):
    start(graph, checkpoint=trained, state_directory='')
    arm = Arm(graph, arm26)
    learn(graph, arm, lambda: samples(graph) >= 2, 'samples')
    assert graph.call(SetBool, 'learner/enable', SetBool.Request(data=False)).success
    learn(graph, arm, lambda: 'enable' in diagnosis(graph).message, 'the stop')
    before = samples(graph)
    for _ in range(100):
        arm.publish()
    assert graph.call(SetBool, 'learner/enable', SetBool.Request(data=True)).success
    learn(graph, arm, lambda: samples(graph) > before, 'learning again')


def test_a_checkpoint_set_at_run_time_replaces_the_saved_state_and_keeps_a_backup(
    graph, arm26, trained, state, tmp_path
):
    start(graph, checkpoint=trained, state_directory=state)
    arm = Arm(graph, arm26)
    learn(graph, arm, lambda: samples(graph) >= 2, 'samples')
    broken = tmp_path / 'broken.safetensors'
    broken.write_bytes(b'nonsense')
    success, reason = graph.set_parameter('learner', 'checkpoint', str(broken))
    assert not success
    assert 'broken' in reason
    before = len(graph.received['mae_checkpoint'])
    assert graph.set_parameter('learner', 'checkpoint', trained) == (True, '')
    graph.wait(lambda: len(graph.received['mae_checkpoint']) > before, 'the new network')
    graph.wait(lambda: samples(graph) == 0, 'an empty store')
    assert (Path(state) / 'backup-1' / 'samples.log').exists()
    assert graph.set_parameter('learner', 'fresh', True) == (True, '')


def test_a_training_process_that_dies_is_noticed_and_replaced(graph, arm26, trained):
    start(graph, checkpoint=trained, state_directory='')
    arm = Arm(graph, arm26)
    learn(graph, arm, lambda: samples(graph) >= 2 and 'update' in values(graph), 'an update')
    first = values(graph)['training process']
    os.kill(int(first), signal.SIGKILL)
    learn(graph, arm, lambda: values(graph).get('training process restarts') == '1', 'a notice')
    before = len(graph.received['mae_checkpoint'])
    learn(graph, arm, lambda: len(graph.received['mae_checkpoint']) > before, 'an update')
    assert values(graph)['training process'] != first


def test_relearning_names_legal_muscles(graph, arm26, trained, state):
    start(graph, checkpoint=trained, state_directory=state)
    arm = Arm(graph, arm26)
    learn(graph, arm, lambda: samples(graph) >= 2, 'samples')
    success, reason = graph.set_parameter('learner', 'relearn_muscles', ['no_such_muscle'])
    assert not success
    assert arm26.muscles[0] in reason
    assert graph.set_parameter('learner', 'relearn_muscles', [arm26.muscles[1]])[0]


def test_learning_goes_on_from_the_vision_of_the_estimator(graph, arm26, trained):
    from geometry_msgs.msg import PoseStamped

    graph.start('hardware_emulator', robot='arm26', joint_sensors=False, marker_rate=30.0)
    graph.start('estimator', robot='arm26', checkpoint=trained)
    graph.start('controller', robot='arm26', checkpoint=trained, explore=True)
    graph.start(
        'learner', robot='arm26', checkpoint=trained, state_directory='', joint_source='marker'
    )
    graph.listen(JointState, 'vision_joint_states')
    graph.listen(DiagnosticArray, '/diagnostics')
    seen = graph.received['vision_joint_states']
    graph.wait(lambda: seen, 'joint angles from the marker')
    assert tuple(seen[-1].name) == arm26.joints
    graph.wait(lambda: samples(graph) >= 1, 'a sample', deadline=120.0)
    publisher = graph.publisher(PoseStamped, 'marker_pose')
    wrong = PoseStamped()
    wrong.header.frame_id = 'camera'

    def refused():
        publisher.publish(wrong)
        return any(
            v.key == 'rejected marker_pose: wrong frame'
            for m in graph.received['/diagnostics']
            for s in m.status
            for v in s.values
        )

    graph.wait(refused, 'the refusal of another frame')


def test_two_learners_do_not_share_a_directory(graph, trained, state):
    start(graph, checkpoint=trained, state_directory=state)
    graph.wait(lambda: graph.received['mae_checkpoint'], 'the first one')
    second = graph.start('learner', robot='arm26', state_directory=state)
    graph.processes.remove(second)
    output, _ = second.process.communicate(timeout=60)
    assert second.process.returncode == 1
    assert 'another learner' in output
    assert 'Traceback' not in output


def test_it_ends_quietly_and_takes_its_training_process_with_it(graph, trained):
    process = start(graph, checkpoint=trained, state_directory='')
    graph.wait(lambda: 'training process' in values(graph), 'the training process')
    worker = int(values(graph)['training process'])
    status, output = process.end(signal.SIGINT)
    graph.processes.remove(process)
    assert status == 0
    assert 'Traceback' not in output
    assert not _alive(worker)
