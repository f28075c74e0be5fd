# SPDX-License-Identifier: Apache-2.0
"""Recordings of every kind are read: all messages in the order of their time."""

import shutil
import struct
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from rosbags.rosbag2 import StoragePlugin

from bags import bag_samples as samples
from bags.bare_file import FLOAT, ONE, write
from musculoskeletal_ae.bags import reader
from musculoskeletal_ae.bags.check import check_bag
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.exceptions import BagError


def expected(content):
    return [(sample.topic, *sample[2:]) for sample in content]


def read(path):
    bag = Bag.open(path)
    assert not bag.unfinished
    return [message[:4] for message in bag.messages()]


def change(bag, **entries):
    file = bag / 'metadata.yaml'
    document = yaml.safe_load(file.read_text())
    document['rosbag2_bagfile_information'].update(entries)
    file.write_text(yaml.safe_dump(document))


@pytest.mark.parametrize('kind', samples.BARE)
@pytest.mark.parametrize('with_definitions', [True, False])
def test_mcap_files_of_every_kind_are_read(kind, with_definitions, tmp_path, content):
    """A type is identified by its name if the bag contains no definition of it."""
    path = tmp_path / 'a.mcap'
    samples.write_mcap(path, content, with_definitions, **samples.BARE[kind])
    assert read(path) == expected(content)
    assert not any(topic.problem for topic in Bag.open(path).topics.values())


@pytest.mark.parametrize('storage', [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_bags_of_the_rosbags_library_are_read(storage, tmp_path, content):
    samples.write_rosbags(tmp_path / 'bag', content, storage)
    assert [(topic, time, data) for topic, time, _, data in read(tmp_path / 'bag')] == [
        (sample.topic, sample.log_time, sample.data) for sample in content
    ]
    assert 'checksums: none' in str(check_bag(tmp_path / 'bag'))


def test_a_sqlite3_file_that_was_not_closed_is_reported(tmp_path, content):
    samples.write_rosbags(tmp_path / 'bag', content, StoragePlugin.SQLITE3)
    (tmp_path / 'bag' / 'bag.db3-wal').write_bytes(b'what was not written yet')
    (reason,) = Bag.open(tmp_path / 'bag').unfinished
    assert 'bag.db3-wal' in reason


def test_records_that_a_reader_must_skip_are_skipped(tmp_path, content):
    """Records with the opcodes from 0x80 are private; the specification lets readers skip them."""
    samples.write_mcap(tmp_path / 'a.mcap', content, enable_data_crcs=False)
    data = (tmp_path / 'a.mcap').read_bytes()
    # length of the magic (8 bytes) and of the header record (opcode, length, content)
    head = 8 + 9 + struct.unpack_from('<Q', data, 9)[0]
    private = b'\x80' + struct.pack('<Q', 5) + b'hello'
    (tmp_path / 'b.mcap').write_bytes(data[:head] + private + data[head:])
    assert read(tmp_path / 'b.mcap') == expected(content)


def test_times_and_storage_in_the_metadata_are_not_needed(bag, content):
    change(
        bag,
        version=1,
        storage_identifier='',
        starting_time={'nanoseconds_since_epoch': 0},
        duration={'nanoseconds': 10**12},
        topics_with_message_count=[],
    )
    assert read(bag) == expected(content)


@pytest.mark.parametrize('text', [None, '', 'a: !!python/object/apply:os.abort []', '[' * 5000])
def test_without_usable_metadata_all_files_are_read_and_it_is_reported(text, bag, content):
    (bag / 'metadata.yaml').unlink()
    if text is not None:
        (bag / 'metadata.yaml').write_text(text)
    opened = Bag.open(bag)
    assert [message[:4] for message in opened.messages()] == expected(content)
    assert 'metadata.yaml cannot be used' in opened.unfinished[0]


def test_counts_that_differ_from_the_files_are_reported(bag, content):
    change(bag, message_count=7)
    opened = Bag.open(bag)
    assert opened.message_count == len(content)
    assert opened.unfinished == ['metadata.yaml counts 7 messages; there are 63']


@pytest.mark.parametrize('mode', ['FILE', 'message'])
def test_a_bag_that_rosbag2_compressed_itself_is_refused_with_a_remedy(mode, bag):
    change(bag, compression_mode=mode, compression_format='zstd')
    with pytest.raises(BagError, match=f"compression_mode '{mode}'; legal: none.*rosbags-convert"):
        Bag.open(bag)


def test_only_files_of_the_directory_itself_are_read(bag, tmp_path):
    shutil.move(bag / 'bag_0.mcap', tmp_path / 'bag_0.mcap')
    for name in ('../bag_0.mcap', str(tmp_path / 'bag_0.mcap')):
        change(bag, relative_file_paths=[name])
        with pytest.raises(BagError, match=r'bag/bag_0.mcap: cannot be read: No such file'):
            Bag.open(bag)


def test_a_bag_that_was_split_is_read_in_order(tmp_path, content):
    bag = tmp_path / 'bag'
    samples.write_ours(bag, content)
    # The times of both files overlap, as if messages had been waiting when the recorder began the
    # second file.
    samples.write_mcap(bag / 'a.mcap', content[:20] + content[30:40])
    samples.write_mcap(bag / 'b.mcap', content[20:30] + content[40:])
    change(bag, relative_file_paths=['b.mcap', 'a.mcap'])
    assert read(bag) == expected(content)


def test_topics_and_times_can_be_chosen(bag, content):
    start, stop = content[10].log_time, content[30].log_time
    wanted = {content[12].topic, content[29].topic}
    messages = Bag.open(bag).messages(wanted, start, stop)
    chosen = [sample for sample in content[10:31] if sample.topic in wanted]
    assert [message[:4] for message in messages] == expected(chosen)


def test_messages_are_ordered_by_time_and_equal_times_as_in_the_file(
    tmp_path, content, monkeypatch
):
    disordered = [
        sample._replace(log_time=samples.START + 10**8 * (-i % 7))
        for i, sample in enumerate(content)
    ]
    samples.write_mcap(tmp_path / 'a.mcap', disordered)
    in_order = sorted(disordered, key=lambda sample: sample.log_time)
    assert read(tmp_path / 'a.mcap') == expected(in_order)
    # A reader that may hold only a few messages returns them all, but not in exact order.
    monkeypatch.setattr(reader, 'MOST_HELD', 1000)
    assert sorted(read(tmp_path / 'a.mcap')) == sorted(expected(disordered))


def test_topics_one_after_the_other_are_refused_and_the_remedy_helps(tmp_path):
    data = [
        samples.Sample(f'/{a}/anomaly', FLOAT, t * 10**9, 0, ONE) for a in 'lr' for t in range(30)
    ]
    samples.write_mcap(tmp_path / 'a.mcap', data)
    with pytest.raises(BagError, match=r'29 s older.*legal: at most 10 s; .*rosbags-convert'):
        Bag.open(tmp_path / 'a.mcap')
    convert = Path(sys.executable).with_name('rosbags-convert')
    arguments = ['--src', tmp_path / 'a.mcap', '--dst', tmp_path / 'b', '--dst-storage', 'mcap']
    subprocess.run([convert, *arguments], check=True, capture_output=True)
    assert Bag.open(tmp_path / 'b').message_count == len(data)


def test_of_two_types_on_one_topic_none_is_guessed(tmp_path):
    path = tmp_path / 'bag'
    path.mkdir()
    write(path / 'a.mcap')
    write(path / 'b.mcap', schema='std_msgs/msg/String', text='string data')
    with pytest.raises(
        BagError, match='topic /anomaly has the types std_msgs/msg/Float64 and std_msgs'
    ):
        Bag.open(path)
