# SPDX-License-Identifier: Apache-2.0
"""Bags: all messages in the order of their time, within bounds of memory and work."""

import shutil

import pytest
from mcap.writer import Writer

from bags.bare_file import FLOAT, ONE, write
from bench import bag_samples as samples
from bench import fuzz
from musculoskeletal_ae.bags import mcap_file
from musculoskeletal_ae.bags import reader as reader_module
from musculoskeletal_ae.bags.message_types import definition
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.exceptions import BagError


def expected(content):
    return [(sample.topic, *sample[2:]) for sample in content]


def read(path, **options):
    return [message[:4] for message in Bag.open(path, **options).messages()]


def test_bags_of_the_rosbags_library_are_read(tmp_path, content):
    samples.write_rosbags(tmp_path / 'bag', content)
    assert [message[0::3] for message in read(tmp_path / 'bag')] == [
        (sample.topic, sample.data) for sample in content
    ]


def test_topics_and_times_can_be_chosen(bag, content):
    start, stop = content[10].log_time, content[30].log_time
    wanted = {content[12].topic, content[29].topic}
    messages = Bag.open(bag).messages(wanted, start, stop)
    assert [message[:4] for message in messages] == expected(
        [sample for sample in content[10:31] if sample.topic in wanted]
    )


@pytest.fixture
def bytes_read(monkeypatch):
    """Count the bytes that are read from files and decompressed chunks."""
    total = [0]

    class Record(mcap_file._Record):
        def __init__(self, data):
            total[0] += len(data)
            super().__init__(data)

    monkeypatch.setattr(mcap_file, '_Record', Record)
    return total


def test_damaged_bags_of_all_kinds_are_read_in_full_or_refused(monkeypatch):
    monkeypatch.setattr(fuzz, 'LONGEST', float('inf'))
    outcomes, failures, _ = fuzz.fuzz(400, seed=3)
    assert not failures
    assert sum(n for outcome, n in outcomes.items() if outcome.endswith('refused')) > 200


def test_the_work_on_a_damaged_bag_is_no_more_than_on_a_sound_one(bytes_read, tmp_path, content):
    """Opening and reading each visit a byte of the file, and of its decompressed chunks, once."""
    (tmp_path / 'bases').mkdir()
    bases = fuzz.bases(tmp_path / 'bases', content)
    most = max(len(base.files[base.mcap]) for base in bases) + 1000  # of what damage inserts
    for trial in range(300):
        rng = fuzz.random.Random(trial)
        base = bases[trial % len(bases)]
        path = tmp_path / 'a.mcap'
        path.write_bytes(fuzz.damage(base.files[base.mcap], base.files[base.mcap], rng))
        bytes_read[0] = 0
        fuzz.attempt(path, base, content, unfinished=True)
        assert bytes_read[0] <= 4 * most


def test_the_fuzzer_starts_from_bags_that_are_read_in_full(tmp_path, content):
    for base in fuzz.bases(tmp_path, content):
        folder = tmp_path / 'one'
        folder.mkdir()
        for name, data in base.files.items():
            (folder / name).write_bytes(data)
        path = folder / 'bare.mcap' if 'bare.mcap' in base.files else folder
        outcome = fuzz.attempt(path, base, content, unfinished=True).outcome
        assert outcome == ('prefix' if base.name == 'killed' else 'full')
        shutil.rmtree(folder)


def test_what_does_not_exist_is_named_so(tmp_path):
    with pytest.raises(BagError, match=r'nothing: cannot be read: No such file .*name another bag'):
        Bag.open(tmp_path / 'nothing')
    with pytest.raises(BagError, match=r'neither metadata.yaml nor an mcap file'):
        Bag.open(tmp_path)


def test_unknown_types_are_kept_apart_and_never_decoded(tmp_path):
    bag = Bag.open(write(tmp_path / 'a.mcap', schema='other_msgs/msg/Thing', text='int32 x'))
    assert 'none of ROS 2 Jazzy' in bag.topics['/anomaly'].refused
    (message,) = bag.messages()
    with pytest.raises(BagError, match='cannot be decoded'):
        bag.decode(message)


def test_a_message_that_is_not_of_its_type_names_file_and_place(tmp_path):
    bag = Bag.open(write(tmp_path / 'a.mcap', data=ONE[:8]))
    with pytest.raises(
        BagError, match=r'a.mcap, byte \d+: a message of /anomaly cannot be decoded'
    ):
        bag.decode(next(bag.messages()))


def write_in_chunks(path, times):
    """Write a bare file with a chunk for each list of times."""
    with path.open('wb') as file:
        writer = Writer(file, enable_data_crcs=True)
        writer.start(profile='ros2')
        number = writer.register_schema(FLOAT, 'ros2msg', definition(FLOAT).encode())
        number = writer.register_channel('/anomaly', 'cdr', number)
        for chunk in times:
            for time in chunk:
                writer.add_message(number, time, ONE, time)
            writer.flush()
        writer.finish()
    return path


def test_messages_are_brought_into_order_holding_no_more_than_that_needs(tmp_path, monkeypatch):
    size = len(ONE) + reader_module._OVERHEAD
    monkeypatch.setattr(reader_module, '_MOST_HELD', 25 * size)
    overlapping = [range(10 * i, 10 * i + 20, 2) for i in range(100)]
    bag = Bag.open(write_in_chunks(tmp_path / 'a.mcap', overlapping))
    times = [message.log_time for message in bag.messages()]
    assert times == sorted(time for chunk in overlapping for time in chunk)
    backward = [range(i, 1000, 100) for i in range(10)]
    bag = Bag.open(write_in_chunks(tmp_path / 'b.mcap', backward))
    with pytest.raises(BagError, match='messages are out of order by more than'):
        list(bag.messages())


def test_one_chunk_always_fits_into_what_may_be_held():
    most_messages = mcap_file.LARGEST // 31  # bytes of a message without data
    held = most_messages * reader_module._OVERHEAD
    assert mcap_file.LARGEST < held < reader_module._MOST_HELD


def test_equal_times_keep_the_order_of_the_file(tmp_path, content):
    same = [
        sample._replace(log_time=content[0].log_time + i // 9) for i, sample in enumerate(content)
    ]
    samples.write_mcap(tmp_path / 'a.mcap', same)
    assert read(tmp_path / 'a.mcap') == expected(same)
