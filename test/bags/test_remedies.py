# SPDX-License-Identifier: Apache-2.0
"""Each remedy for a recording is tried in the situation in which it is printed.

Every case is a function that makes the situation in an empty folder and returns two functions:
`use`, which raises the error that a user meets, and `mend`, which follows the advice and returns
what `use` is called with afterwards. A remedy that does not change the outcome fails its test.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

from bags import bag_samples as samples
from musculoskeletal_ae.bags import message_types
from musculoskeletal_ae.bags.check import check_bag
from musculoskeletal_ae.bags.playback import window
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.topics import ALL, DEFAULT, interface_topics, select
from musculoskeletal_ae.bags.writer import BagWriter, recover
from musculoskeletal_ae.exceptions import BagError
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.ros_tools import record, replay
from musculoskeletal_ae.tools.recorded_robot import misfit

from .arm_bag import Arm

JOINTS = 'sensor_msgs/msg/JointState'


def converted(source, target, *options):
    """Convert a recording with the tool that the remedies name; return the result."""
    tool = Path(sys.executable).with_name('rosbags-convert')
    subprocess.run([tool, '--src', source, '--dst', target, *options], check=True)
    return target


def ros1_bag(path):
    """Write the bag file of ROS 1 with one message on /joint_states; return the message."""
    store = get_typestore(Stores.ROS1_NOETIC)
    header = store.types['std_msgs/msg/Header'](
        1, store.types['builtin_interfaces/msg/Time'](1, 2), ''
    )
    message = store.types[JOINTS](header, ['a'], np.ones(1), np.zeros(0), np.zeros(0))
    data = bytes(store.serialize_ros1(message, JOINTS))
    with Ros1Writer(path) as writer:
        connection = writer.add_connection('/joint_states', JOINTS, typestore=store)
        writer.write(connection, samples.START, data)
    return data


def read(path):
    bag = Bag.open(path)
    select(bag, [DEFAULT], None, False)
    return [bag.decode(message) for message in bag.messages()]


def ros1_file(folder, _):
    ros1_bag(folder / 'a.bag')
    return (
        lambda path=folder / 'a.bag': read(path),
        lambda: converted(folder / 'a.bag', folder / 'b', '--dst-typestore', 'ros2_jazzy'),
    )


def ros1_messages_in_mcap(folder, _):
    data = ros1_bag(folder / 'a.bag')
    with (folder / 'a.mcap').open('wb') as file:
        writer = Writer(file)
        writer.start(profile='ros1')
        schema = writer.register_schema('sensor_msgs/JointState', 'ros1msg', b'')
        channel = writer.register_channel('/joint_states', 'ros1', schema)
        writer.add_message(channel, samples.START, data, samples.START)
        writer.finish()
    return (
        lambda path=folder / 'a.mcap': read(path),
        lambda: converted(folder / 'a.bag', folder / 'b', '--dst-typestore', 'ros2_jazzy'),
    )


def disorder_between_topics(folder, content):
    late = [sample for sample in content if sample.topic.endswith('/joint_states')]
    early = [each._replace(log_time=each.log_time - 20 * 10**9) for each in late]
    others = [sample for sample in content if sample not in late]
    samples.write_mcap(folder / 'a.mcap', [*others, *early])
    return (
        lambda path=folder / 'a.mcap': read(path),
        lambda: converted(folder / 'a.mcap', folder / 'b'),
    )


def compressed_files(folder, content):
    writer = RosbagsWriter(folder / 'a', version=8, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, kind, log_time, _, data in content:
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, kind, typestore=message_types.TYPESTORE
                )
            writer.write(connections[topic], log_time, data)
    return (
        lambda path=folder / 'a': read(path),
        lambda: converted(folder / 'a', folder / 'b', '--compress', 'none'),
    )


def two_arms(folder, content):
    other = [each._replace(topic=each.topic.replace('left', 'right')) for each in content]
    samples.write_ours(folder / 'a', sorted([*content, *other], key=lambda each: each.log_time))
    bag = Bag.open(folder / 'a')
    return lambda namespace=None: interface_topics(bag, namespace), lambda: '/right_arm'


def two_arms_in_bringup(folder, _):
    arm = Arm(Robot.load('arm26'))
    both = [
        each._replace(topic=f'{namespace}{each.topic}')
        for each in sorted(arm.content, key=lambda each: each.log_time)
        for namespace in ('/left', '/right')
    ]
    samples.write_ours(folder / 'a', both)
    bag = Bag.open(folder / 'a')
    return lambda namespace=None: misfit(bag, 'arm26', namespace), lambda: '/left'


def unknown_namespace(folder, content):
    samples.write_ours(folder / 'a', content)
    bag = Bag.open(folder / 'a')
    return lambda namespace='/arm': interface_topics(bag, namespace), lambda: '/left_arm'


def type_of_another_topic(folder, content):
    (first, *_) = [each for each in content if each.topic.endswith('/anomaly')]
    others = [each for each in content if not each.topic.endswith('/joint_states')]
    for name, topic in ('a', 'joint_states'), ('b', 'something'):
        wrong = first._replace(topic=f'/left_arm/{topic}', log_time=others[0].log_time)
        samples.write_ours(folder / name, [wrong, *others])
    return lambda path=folder / 'a': read(path), lambda: folder / 'b'


def no_topic_to_play(folder, content):
    samples.write_ours(folder / 'a', [each for each in content if each.topic.endswith('/anomaly')])
    bag = Bag.open(folder / 'a')
    return lambda wanted=DEFAULT: select(bag, [wanted], None, False), lambda: ALL


def late_start(folder, content):
    samples.write_ours(folder / 'a', content)
    bag = Bag.open(folder / 'a')
    return lambda start=100.0: window(bag, start, None), lambda: 0.1


def occupied_directory(folder, content):
    samples.write_ours(folder / 'a', content)
    return lambda path=folder / 'a': BagWriter(path).close(), lambda: folder / 'b'


def long_name(folder, _):
    return lambda path=folder / ('a' * 250): BagWriter(path).close(), lambda: folder / 'b'


def no_space_for_a_copy(folder, content):
    samples.write_rosbags(folder / 'a', content, StoragePlugin.SQLITE3)
    (folder / 'a' / 'a.db3-wal').write_bytes(b'what was not written yet')

    def use(temporary='/dev/null/nothing'):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(tempfile, 'tempdir', str(temporary))
            read(folder / 'a')

    return use, lambda: folder


def another_robot(folder, _):
    path = Arm(Robot.load('arm26')).write(folder / 'a')

    def use(robot='musashi_left_arm'):
        if problem := misfit(Bag.open(path), robot):
            raise BagError(path, problem, '')

    return use, lambda: 'arm26'


#: the situations, with the part of the message that is the remedy
SITUATIONS = [
    (ros1_file, 'rosbags-convert --src FILE.bag --dst DIR --dst-typestore ros2_jazzy'),
    (ros1_messages_in_mcap, 'rosbags-convert --src FILE.bag --dst DIR --dst-typestore ros2_jazzy'),
    (disorder_between_topics, 'convert it with `rosbags-convert`'),
    (compressed_files, 'convert it with `rosbags-convert`'),
    (two_arms, 'choose one with --from-namespace'),
    (two_arms_in_bringup, 'choose one with --from-namespace'),
    (unknown_namespace, 'choose one of its namespaces with --from-namespace: /left_arm'),
    (type_of_another_topic, 'record the topic under another name'),
    (no_topic_to_play, '--topics all'),
    (late_start, 'choose a smaller --start'),
    (occupied_directory, 'name a new directory'),
    (long_name, 'choose another directory'),
    (no_space_for_a_copy, 'set TMPDIR to a folder with'),
    (another_robot, 'it fits arm26; pass --robot arm26'),
]


@pytest.mark.parametrize(
    ('situation', 'remedy'),
    [pytest.param(*each, id=each[0].__name__) for each in SITUATIONS],
)
def test_a_remedy_changes_the_outcome(situation, remedy, tmp_path, content):
    use, mend = situation(tmp_path, content)
    with pytest.raises(BagError) as refused:
        use()
    assert remedy in str(refused.value)
    use(mend())


def test_an_unfinished_recording_is_finished_by_the_command_that_the_check_prints(
    tmp_path, content
):
    samples.write_ours(tmp_path / 'a', content, finish=False)
    file = tmp_path / 'a' / 'a_0.mcap'
    file.write_bytes(file.read_bytes()[:-100])
    faults = check_bag(tmp_path / 'a').faults
    assert any('`record --recover BAG`' in fault for fault in faults)
    recover(tmp_path / 'a', tmp_path / 'b')
    assert not any('unfinished' in fault for fault in check_bag(tmp_path / 'b').faults)


#: options that contradict each other: the tool, the options, the advice, and the mended options
OPTIONS = [
    (replay, ['bag', '--rate', '2'], 'add --clock', ['bag', '--rate', '2', '--clock']),
    (replay, ['bag', '--wait-for', 'a'], 'add --clock', ['bag', '--wait-for', 'a', '--clock']),
    (replay, ['bag', '--check', '--loop'], 'remove --loop', ['bag', '--check']),
    (
        replay,
        ['bag', '--as-trajectory', '--skip-pauses', '--loop'],
        'remove --loop, --clock, --paused and --skip-pauses',
        ['bag', '--as-trajectory'],
    ),
    (
        replay,
        ['bag', '--as-trajectory', '--topics', 'imu'],
        'remove --topics imu',
        ['bag', '--as-trajectory'],
    ),
    (record, ['a', '-o', 'b'], 'state it only once', ['a']),
    (
        record,
        ['--recover', 'a', '--duration', '1'],
        'remove --topics and --duration',
        ['--recover', 'a'],
    ),
]


@pytest.mark.parametrize(('tool', 'arguments', 'remedy', 'mended'), OPTIONS)
def test_the_advice_on_contradicting_options_is_accepted(tool, arguments, remedy, mended, capsys):
    with pytest.raises(SystemExit):
        tool.parse(arguments)
    assert remedy in capsys.readouterr().err
    assert tool.parse(mended)
