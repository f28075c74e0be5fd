# SPDX-License-Identifier: Apache-2.0
"""Type definitions in bags are only compared with those of ROS 2 Jazzy, never used to decode."""

import re
import sys
from pathlib import Path

import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState

from bags import bag_samples as samples
from bags.bare_file import write
from musculoskeletal_ae.bags import message_types
from musculoskeletal_ae.bags.check import check_bag
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.topics import TOPICS, interface_topics
from musculoskeletal_ae.exceptions import BagError

LINE = '=' * 80 + '\n'


@pytest.mark.parametrize(
    'types',
    [
        {topic.type for topic in TOPICS.values()},
        pytest.param(message_types.TYPESTORE.fielddefs, marks=pytest.mark.thorough, id='all'),
    ],
)
def test_our_types_are_those_of_the_installed_ros_messages(types):
    share = Path(sys.prefix) / 'share'
    compared = 0
    for type_name in sorted(types):
        package, _, name = type_name.split('/')
        file = share / package / 'msg' / f'{name}.msg'
        if not file.exists():
            continue
        # rosbag2 writes the .msg file itself: with comments, constants, defaults and type names
        # without their package.
        text = file.read_text()
        for line in message_types.definition(type_name).splitlines():
            if line.startswith('MSG: '):
                package, name = line[5:].split('/')
                contained = (share / package / 'msg' / f'{name}.msg').read_text()
                text += f'\n{LINE}{line}\n{contained}'
        # A recorder on Windows writes other ends of lines.
        end = '\r\n' if compared % 5 == 0 else '\n'
        data = end.join(text.splitlines()).encode()
        assert message_types.mismatch(type_name, 'ros2msg', data, '') == ''
        compared += 1
    if not compared:
        pytest.skip('the message packages are not in this environment')
    assert compared > 0.6 * len(types)


@pytest.mark.parametrize(
    ('options', 'problem'),
    [
        ({'text': 'float32 data\n'}, 'the fields of std_msgs/msg/Float64 differ'),
        ({'text': 'float64 data[__import__("os")]\n'}, 'its definition cannot be read'),
        ({'text': 'float64 data\n' + ' ' * (1 << 18)}, 'is longer than 65536 bytes'),
        ({'metadata': {'topic_type_hash': 'RIHS01_0'}}, "the hash 'RIHS01_0' instead of"),
        ({'schema': 'other_msgs/msg/Thing'}, 'which ROS 2 Jazzy does not define'),
        ({'message_encoding': 'json'}, "is encoded as 'json', not cdr"),
        ({'topic': '/../etc'}, 'has a name that is not legal in ROS'),
    ],
)
def test_topics_of_another_type_than_declared_are_not_decoded(options, problem, tmp_path):
    bag = Bag.open(write(tmp_path / 'a.mcap', **options))
    (topic,) = bag.topics.values()
    assert problem in topic.problem
    with pytest.raises(BagError, match=rf'a.mcap: .*{re.escape(problem[:20])}'):
        bag.decode(*bag.messages())
    if topic.name == '/anomaly':
        with pytest.raises(BagError, match='/anomaly'):
            interface_topics(bag)


@pytest.mark.parametrize(
    'options',
    [
        {'encoding': '', 'text': ''},
        {'text': ' \n'},
        {'encoding': 'ros2idl'},
    ],
)
def test_a_known_type_needs_no_definition_in_our_format(options, tmp_path):
    bag = Bag.open(write(tmp_path / 'a.mcap', **options))
    assert [bag.decode(message).data for message in bag.messages()] == [1.0]


def test_a_type_of_another_distribution_costs_its_own_topic_only(tmp_path):
    options = {'schema': 'sensor_msgs/msg/Range', 'text': 'float32 range\n', 'topic': '/sonar'}
    bag = Bag.open(write(tmp_path / 'a.mcap', **options))
    assert bag.message_count == 1 and interface_topics(bag) == {}
    assert 'sensor_msgs/msg/Range' in str(check_bag(tmp_path / 'a.mcap'))


def test_no_code_is_made_of_a_definition(tmp_path, monkeypatch):
    evil = 'string x "__import__(\'os\').abort()"\nint32 X=1\n'
    text = f'float64 data 1.0\n{LINE}MSG: std_msgs/Evil\n{evil}'
    for library in ('codegen.gen_code', 'store.Typestore.register'):
        name = f'rosbags.typesys.{library}'
        monkeypatch.setattr(name, lambda *_, **__: pytest.fail('compiled'), raising=False)
    # Another test may have created this module.
    monkeypatch.delitem(sys.modules, 'rosbags.usertypes', raising=False)
    bag = Bag.open(write(tmp_path / 'a.mcap', text=text))
    assert [bag.decode(message).data for message in bag.messages()] == [1.0]
    assert 'rosbags.usertypes' not in sys.modules


def test_what_rmw_reserves_beyond_a_message_is_no_damage():
    data = serialize_message(JointState(name=['elbow'], position=[1.0]))
    read = message_types.decode(data, 'sensor_msgs/msg/JointState')
    again = samples.encode(read, 'sensor_msgs/msg/JointState')
    assert len(data) >= len(again) + 4
    assert read.name == ['elbow'] and read.position.tolist() == [1.0]
