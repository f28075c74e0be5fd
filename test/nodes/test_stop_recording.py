# SPDX-License-Identifier: Apache-2.0
"""The recording of the seconds before a stop."""

import errno
import os

import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.topics import topics_with
from musculoskeletal_ae.nodes import stop_recording
from musculoskeletal_ae.nodes.stop_recording import FILE, SECONDS, StopRecording
from musculoskeletal_ae.robot.motors import MotorTopics


@pytest.fixture
def now(monkeypatch):
    """Replace the system clock; return a list with the time [ns], which tests change."""
    now = [1_000_000_000_000]
    monkeypatch.setattr(stop_recording.time, 'time_ns', lambda: now[0])
    return now


@pytest.fixture
def recording(tmp_path):
    return StopRecording(lambda topic: f'/arm/{topic}', tmp_path)


def states(value):
    return serialize_message(Float64MultiArray(data=[value] * 3))


def test_the_last_seconds_and_what_was_latched_before_are_kept(recording, now):
    recording.heard('body_state', states(1.0))
    for n in range(400):
        now[0] += 100_000_000
        recording.heard('muscle_states', states(float(n)))
    recording.save('a cause', 10)
    recording.close()
    bag = Bag.open(recording.saved)
    messages = list(bag.messages())
    times = [m.log_time for m in messages]
    assert len(messages) == 102
    assert max(times) - min(times) == int(SECONDS * 1e9)
    assert set(bag.topics) == {'/arm/body_state', '/arm/muscle_states'}
    assert (recording.saved / FILE).read_text() == 'a cause\n'


@pytest.mark.parametrize('most', [stop_recording.MOST, 3])
def test_what_was_latched_before_is_kept_though_newer_came(recording, now, monkeypatch, most):
    monkeypatch.setattr(stop_recording, 'MOST', most)
    for step in range(4):
        now[0] += int((0.4 if step else 0.0) * SECONDS * 1e9)
        recording.heard('body_state', states(float(step)))
    recording.save('a cause', 10)
    recording.close()
    bag = Bag.open(recording.saved)
    kept = [bag.decode(message).data[0] for message in bag.messages()]
    assert kept == [0.0, 1.0, 2.0, 3.0]


def test_large_messages_do_not_fill_the_memory(recording, monkeypatch):
    monkeypatch.setattr(stop_recording, 'MOST_BYTES', 1000)
    for n in range(100):
        recording.heard('muscle_states', states(float(n)))
    recording.save('a cause', 10)
    recording.close()
    bag = Bag.open(recording.saved)
    kept = [bag.decode(message).data[0] for message in bag.messages()]
    assert kept == list(range(100 - len(kept), 100))
    recording.heard('muscle_states', serialize_message(Float64MultiArray(data=[1.0] * 1000)))
    assert 0 < sum(len(message.data) for message in bag.messages()) <= 1000


def test_old_recordings_are_deleted_and_other_folders_stay(recording, now, tmp_path):
    (tmp_path / 'stop_of_mine').mkdir()
    (tmp_path / 'stop_20200101-000000-000000').mkdir()  # a killed node left it without a bag
    for n in range(5):
        now[0] += 1_000_000
        recording.heard('muscle_states', states(float(n)))
        recording.save(f'cause {n}', 2)
        recording.close()
    causes = sorted(file.read_text() for file in tmp_path.glob(f'*/{FILE}'))
    assert causes == ['cause 3\n', 'cause 4\n']
    assert (tmp_path / 'stop_of_mine').is_dir()
    assert len(list(tmp_path.iterdir())) == 3


def test_no_recording_is_kept_if_their_number_is_zero(recording, tmp_path):
    recording.heard('muscle_states', states(1.0))
    recording.save('a cause', 0)
    recording.close()
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_made_is_reported(tmp_path):
    (tmp_path / 'file').write_text('')
    recording = StopRecording(str, tmp_path / 'file')
    recording.heard('muscle_states', states(1.0))
    recording.save('a cause', 1)
    recording.close()
    assert recording.saved is None
    assert 'could not be written' in recording.problem


def test_an_incomplete_recording_on_a_full_disk_is_deleted_and_reported(
    recording, tmp_path, monkeypatch
):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(stop_recording.BagWriter, 'write', full)
    recording.heard('muscle_states', states(1.0))
    recording.save('a cause', 1)
    recording.close()
    assert not list(tmp_path.iterdir())
    assert recording.saved is None and 'No space left' in recording.problem


def test_the_motors_of_ros2_control_are_kept_as_they_were_received(tmp_path):
    recording = StopRecording(str, tmp_path, topics_with(MotorTopics('/joint_states')))
    data = serialize_message(JointState(name=['motor'], position=[0.5]))
    recording.heard('/joint_states', data)
    recording.save('a cause', 10)
    recording.close()
    bag = Bag.open(recording.saved)
    (message,) = bag.messages()
    assert message.topic == '/joint_states' and message.data == data
    assert bag.topics['/joint_states'].type == 'sensor_msgs/msg/JointState'
