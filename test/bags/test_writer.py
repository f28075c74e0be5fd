# SPDX-License-Identifier: Apache-2.0
import os
import random
import resource

import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from bags import bag_samples as samples
from musculoskeletal_ae.bags.metadata import offered_qos
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.topics import TOPICS
from musculoskeletal_ae.bags.writer import BagWriter
from musculoskeletal_ae.exceptions import BagError

LATCHED = (
    'robot_description', 'accepted_checkpoint', 'body_state', 'controller_mode',
    'joint_sensor_trust', 'mae_checkpoint', 'rejected_checkpoint',
)  # fmt: skip


@pytest.mark.parametrize('type_name', sorted({topic.type for topic in TOPICS.values()}))
def test_a_message_of_each_type_comes_back_as_it_was_written(type_name, tmp_path):
    data = samples.encode(samples.filled(type_name, random.Random(1)), type_name)
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/topic', type_name, [offered_qos(latched=False)])
        writer.write('/topic', 20, 10, data)
    bag = Bag.open(tmp_path / 'bag')
    (message,) = bag.messages()
    assert message[:4] == ('/topic', 20, 10, data)
    assert samples.encode(bag.decode(message), type_name) == data


def test_other_peoples_readers_count_the_same_messages(bag, content):
    expected = [(sample.topic, sample.log_time, sample.data) for sample in content]
    with Reader(bag) as reader:
        assert reader.message_count == len(content)
        assert [(c.topic, t, bytes(d)) for c, t, d in reader.messages()] == expected
    with AnyReader([bag]) as reader:
        assert sum(1 for _ in reader.messages()) == len(content)
    with (bag / 'bag_0.mcap').open('rb') as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == 'ros2'
        assert reader.get_summary().statistics.message_count == len(content)
        read = [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages()]
        assert read == expected
        assert {c.message_encoding for c in reader.get_summary().channels.values()} == {'cdr'}
        assert {s.encoding for s in reader.get_summary().schemas.values()} == {'ros2msg'}


def test_metadata_says_what_is_in_the_file(bag, content):
    info = yaml.safe_load((bag / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    assert info['version'] == 9
    assert info['storage_identifier'] == 'mcap'
    assert info['relative_file_paths'] == ['bag_0.mcap']
    assert info['message_count'] == len(content)
    assert info['starting_time']['nanoseconds_since_epoch'] == content[0].log_time
    assert info['duration']['nanoseconds'] == content[-1].log_time - content[0].log_time
    for topic in info['topics_with_message_count']:
        entry = topic['topic_metadata']
        count = sum(sample.topic == entry['name'] for sample in content)
        assert topic['message_count'] == count
        (qos,) = entry['offered_qos_profiles']
        assert qos['reliability'] == 'reliable'
        latched = entry['name'].split('/')[-1] in LATCHED
        assert qos['durability'] == ('transient_local' if latched else 'volatile')


def test_metadata_of_a_recording_names_its_topics_since_the_last_flush(tmp_path, content):
    samples.write_ours(tmp_path / 'bag', content, finish=False)
    text = (tmp_path / 'bag' / 'metadata.yaml').read_text()
    info = yaml.safe_load(text)['rosbag2_bagfile_information']
    named = {entry['topic_metadata']['name'] for entry in info['topics_with_message_count']}
    assert named == {sample.topic for sample in content}


def test_qos_in_the_mcap_file_can_be_read_again(bag):
    assert Bag.open(bag).topics['/left_arm/robot_description'].qos == [offered_qos(latched=True)]


def test_messages_are_ordered_by_time_whatever_order_they_came_in(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/anomaly', 'std_msgs/msg/Float64', [])
        data = samples.encode(
            samples.filled('std_msgs/msg/Float64', random.Random(0)), 'std_msgs/msg/Float64'
        )
        for times in ((5, 3, 9), (2, 7, 4), (1, 8, 6)):
            for time in times:
                writer.write('/anomaly', time, 0, data)
            writer.flush()
    read = [message.log_time for message in Bag.open(tmp_path / 'bag').messages()]
    assert read == sorted(read) == list(range(1, 10))
    # In the file itself, the messages of each flush are ordered.
    with (tmp_path / 'bag' / 'bag_0.mcap').open('rb') as file:
        messages = make_reader(file).iter_messages(log_time_order=False)
        assert [message.log_time for _, _, message in messages] == [3, 5, 9, 2, 4, 7, 1, 6, 8]


def test_a_directory_that_is_not_empty_is_refused(bag):
    with pytest.raises(BagError, match='is not empty; name a new directory'):
        BagWriter(bag)
    assert Bag.open(bag).message_count


def test_a_place_that_cannot_be_written_to_is_named(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(BagError, match=r'file/bag: cannot be written: Not a directory'):
        BagWriter(tmp_path / 'file' / 'bag')


@pytest.mark.parametrize(
    ('name', 'problem'),
    [(b'b\xffg', 'the name is not UTF-8; choose'), (b'b' * 250, 'File name too long')],
)
def test_a_name_that_a_bag_cannot_have_is_refused_and_leaves_nothing(name, problem, tmp_path):
    with pytest.raises(BagError, match=problem):
        BagWriter(tmp_path / os.fsdecode(name))
    assert not list(tmp_path.iterdir())


def test_an_empty_recording_is_a_sound_bag(tmp_path):
    BagWriter(tmp_path / 'bag').close()
    bag = Bag.open(tmp_path / 'bag')
    assert (bag.message_count, bag.unfinished, list(bag.messages())) == (0, [], [])


def test_a_full_disk_raises_an_error_with_the_directory_and_the_remedy(tmp_path, content):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, hard))
    refusal = pytest.raises(BagError, match=r'bag: cannot be written: .*; choose another directory')
    try:
        with refusal, BagWriter(tmp_path / 'bag', 'none') as writer:
            writer.add_topic(content[0].topic, content[0].type, [offered_qos(False)])
            for _ in range(30_000):
                writer.write(content[0].topic, *content[0][2:])
            writer.flush()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
