# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import io
import re
import shutil
import struct
import sys

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from musculoskeletal_ae.bags import fuzz, records, samples
from musculoskeletal_ae.bags.definitions import definition
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.exceptions import BagError, UnfinishedBagError

FLOAT = 'std_msgs/msg/Float64'
ONE = b'\x00\x01\x00\x00' + struct.pack('<d', 1.0)


def expected(content):
    return [(sample.topic, *sample[2:]) for sample in content]


def read(path, **options):
    return [message[:4] for message in Bag.open(path, **options).messages()]


def write(path, schema=FLOAT, text=None, topic='/anomaly', data=ONE, profile='ros2', **channel):
    """Write a bare file with one message."""
    with path.open('wb') as file:
        writer = Writer(file, enable_data_crcs=True)
        writer.start(profile=profile)
        text = definition(FLOAT) if text is None else text
        number = writer.register_schema(schema, channel.pop('encoding', 'ros2msg'), text.encode())
        options = {'message_encoding': 'cdr', **channel}
        number = writer.register_channel(topic, schema_id=number, **options)
        writer.add_message(number, 5, data, 4)
        writer.finish()
    return path


@pytest.mark.parametrize('kind', samples.BARE)
def test_bare_files_of_every_kind_are_read(kind, tmp_path, content):
    samples.write_mcap(tmp_path / 'a.mcap', content, **samples.BARE[kind])
    assert read(tmp_path / 'a.mcap') == expected(content)
    assert Bag.open(tmp_path / 'a.mcap').scans[0].summarised == (kind != 'no summary')


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


def test_a_cut_file_says_when_nothing_protects_what_is_left(tmp_path, content):
    for kind, protected in (('zstd chunks', True), ('no chunks', False)):
        file = tmp_path / 'a.mcap'
        samples.write_mcap(file, content, **samples.BARE[kind])
        assert Bag.open(file).scans[0].checked
        file.write_bytes(file.read_bytes()[:5000])
        reasons = ''.join(Bag.open(file, unfinished=True).unfinished)
        assert ('no checksum' not in reasons) == protected


@settings(max_examples=60, suppress_health_check=list(HealthCheck), deadline=None)
@given(data=st.data())
def test_a_file_cut_anywhere_is_unfinished_and_its_beginning_is_read(tmp_path, content, data):
    file = tmp_path / 'a.mcap'
    samples.write_mcap(file, content)
    whole = file.read_bytes()
    size = data.draw(st.integers(len(records.MAGIC), len(whole) - 1))
    file.write_bytes(whole[:size])
    with pytest.raises(UnfinishedBagError, match=f'ends at byte {size}.*record --recover'):
        Bag.open(file)
    bag = Bag.open(file, unfinished=True)
    assert bag.unfinished
    found = [message[:4] for message in bag.messages()]
    assert found == expected(content)[: len(found)]


@settings(max_examples=150, suppress_health_check=list(HealthCheck), deadline=None)
@given(data=st.data())
def test_no_flipped_bit_changes_what_is_read(tmp_path, content, data):
    file = tmp_path / 'a.mcap'
    samples.write_mcap(file, content)
    changed = bytearray(file.read_bytes())
    changed[data.draw(st.integers(0, len(changed) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    file.write_bytes(changed)
    try:
        found = read(file)
    except BagError:
        return
    assert found == expected(content)


def test_damaged_bags_of_all_kinds_are_read_in_full_or_refused():
    outcomes, failures, slowest = fuzz.fuzz(400, seed=3)
    assert not failures
    assert slowest < fuzz.LONGEST
    assert sum(n for outcome, n in outcomes.items() if outcome.endswith('refused')) > 200


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


@pytest.mark.parametrize(
    ('data', 'problem'),
    [
        (b'', 'the file is empty'),
        (b'SQLite format 3', 'this is no mcap file'),
        (b'\x89MC', 'this is no mcap file'),
    ],
)
def test_what_is_no_mcap_file_is_named_so(data, problem, tmp_path):
    (tmp_path / 'a.mcap').write_bytes(data)
    with pytest.raises(BagError, match=rf'a.mcap, byte 0: {problem}'):
        Bag.open(tmp_path / 'a.mcap')


def test_what_does_not_exist_is_named_so(tmp_path):
    with pytest.raises(BagError, match='nothing: does not exist'):
        Bag.open(tmp_path / 'nothing')
    with pytest.raises(BagError, match=r'neither metadata.yaml nor an mcap file'):
        Bag.open(tmp_path)


@pytest.mark.parametrize(
    ('options', 'problem'),
    [
        ({'text': 'float32 data\n'}, 'has other fields for std_msgs/Float64'),
        ({'text': 'float64 data\nstring more\n'}, 'has other fields'),
        ({'text': ''}, 'has other fields'),
        ({'text': 'float64 data[__import__("os")]\n'}, 'has other fields'),
        ({'schema': 'std_msgs/msg/String'}, 'has other fields for std_msgs/String'),
        ({'encoding': 'ros2idl'}, "is written in 'ros2idl'"),
        ({'metadata': {'topic_type_hash': 'RIHS01_0'}}, "has the hash 'RIHS01_0'"),
    ],
)
def test_definitions_that_lie_are_refused(options, problem, tmp_path):
    file = write(tmp_path / 'a.mcap', **options)
    with pytest.raises(BagError, match=rf'a.mcap, byte \d+: .*{re.escape(problem)}'):
        Bag.open(file)


def test_no_code_is_made_of_a_definition(tmp_path, monkeypatch):
    text = 'float64 data\n' + '=' * 80 + '\nMSG: std_msgs/Evil\nint32 x=__import__("os").abort()\n'
    for library in (
        'rosbags.typesys.msg.get_types_from_msg',
        'rosbags.typesys.store.Typestore.register',
    ):
        monkeypatch.setattr(library, lambda *_, **__: pytest.fail('compiled'), raising=True)
    bag = Bag.open(write(tmp_path / 'a.mcap', text=text))
    assert [bag.decode(message).data for message in bag.messages()] == [1.0]
    assert 'rosbags.usertypes' not in sys.modules


@pytest.mark.parametrize(
    ('options', 'problem'),
    [
        ({'topic': '/not a name'}, 'is not the name of a topic'),
        ({'topic': '/../etc'}, 'is not the name of a topic'),
        ({'profile': 'ros1'}, "profile 'ros1' is not ros2"),
        ({'data': b'\x01\x02\x03\x04'}, 'a message is not in CDR'),
        ({'data': b''}, 'a message is not in CDR'),
    ],
)
def test_what_ros_does_not_write_is_refused(options, problem, tmp_path):
    with pytest.raises(BagError, match=problem):
        Bag.open(write(tmp_path / 'a.mcap', **options))


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


def _replace_after(data, at, value):
    return data[:at] + value + data[at + len(value) :]


@pytest.mark.parametrize('compression', [CompressionType.ZSTD, CompressionType.LZ4])
def test_huge_claimed_sizes_are_refused_without_taking_memory(compression, tmp_path):
    resource = pytest.importorskip('resource')
    file = io.BytesIO()
    writer = Writer(file, compression=compression)
    writer.start(profile='ros2')
    schema = writer.register_schema(FLOAT, 'ros2msg', definition(FLOAT).encode())
    channel = writer.register_channel('/anomaly', 'cdr', schema)
    for i in range(200):
        writer.add_message(channel, i, ONE, i)
    writer.finish()
    data = file.getvalue()
    chunk = data.index(b'\x06', 8 + 9)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for at, problem in (
        (chunk + 1, 'a record claims'),
        (chunk + 9 + 16, 'bytes when decompressed'),
    ):
        for huge in (1 << 40, (1 << 64) - 1):
            path = tmp_path / 'a.mcap'
            path.write_bytes(_replace_after(data, at, struct.pack('<Q', huge)))
            with pytest.raises(BagError, match=problem):
                Bag.open(path, unfinished=True)
    # A claim within what is legal costs no more than what really comes out.
    path.write_bytes(_replace_after(data, chunk + 25, struct.pack('<Q', records.LARGEST)))
    with pytest.raises(BagError, match='does not have the'):
        Bag.open(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # [KiB]


def test_a_chunk_that_decompresses_to_more_than_it_claims_is_refused(tmp_path):
    path = tmp_path / 'a.mcap'
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start(profile='ros2')
        schema = writer.register_schema(FLOAT, 'ros2msg', definition(FLOAT).encode())
        channel = writer.register_channel('/anomaly', 'cdr', schema)
        for i in range(30):
            writer.add_message(channel, i, ONE + bytes(1 << 20), i)
            writer.flush()
        writer.finish()
    data = path.read_bytes()
    at = data.index(b'\x06', 17) + 25
    path.write_bytes(_replace_after(data, at, struct.pack('<Q', 1000)))
    with pytest.raises(BagError, match='does not have the 1000 bytes'):
        Bag.open(path)
