# SPDX-License-Identifier: Apache-2.0
"""One mcap file: read in full, as a stated prefix, or refused with the place of the damage."""

import io
import struct

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from bags.bare_file import FLOAT, ONE, write
from bench import bag_samples as samples
from musculoskeletal_ae.bags import mcap_file
from musculoskeletal_ae.bags.message_types import definition
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.exceptions import BagError, UnfinishedBagError


def expected(content):
    return [(sample.topic, *sample[2:]) for sample in content]


def read(path, **options):
    return [message[:4] for message in Bag.open(path, **options).messages()]


@pytest.mark.parametrize('kind', samples.BARE)
def test_bare_files_of_every_kind_are_read(kind, tmp_path, content):
    samples.write_mcap(tmp_path / 'a.mcap', content, **samples.BARE[kind])
    assert read(tmp_path / 'a.mcap') == expected(content)
    assert Bag.open(tmp_path / 'a.mcap').files[0].summarised == (kind != 'no summary')


def test_a_cut_file_says_when_nothing_protects_what_is_left(tmp_path, content):
    for kind, protected in (('zstd chunks', True), ('no chunks', False)):
        file = tmp_path / 'a.mcap'
        samples.write_mcap(file, content, **samples.BARE[kind])
        assert Bag.open(file).files[0].checked
        file.write_bytes(file.read_bytes()[:5000])
        reasons = ''.join(Bag.open(file, unfinished=True).unfinished)
        assert ('no checksum' not in reasons) == protected


@settings(max_examples=60, suppress_health_check=list(HealthCheck), deadline=None)
@given(data=st.data())
def test_a_file_cut_anywhere_is_unfinished_and_its_beginning_is_read(tmp_path, content, data):
    file = tmp_path / 'a.mcap'
    samples.write_mcap(file, content)
    whole = file.read_bytes()
    size = data.draw(st.integers(len(mcap_file._MAGIC), len(whole) - 1))
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
        (chunk + 1, 'exceeds the limit'),
        (chunk + 9 + 16, 'bytes when decompressed'),
    ):
        for huge in (1 << 40, (1 << 64) - 1):
            path = tmp_path / 'a.mcap'
            path.write_bytes(_replace_after(data, at, struct.pack('<Q', huge)))
            with pytest.raises(BagError, match=problem):
                Bag.open(path, unfinished=True)
    # A claim within what is legal costs no more than what really comes out.
    path.write_bytes(_replace_after(data, chunk + 25, struct.pack('<Q', mcap_file.LARGEST)))
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


def test_records_that_do_not_belong_or_fit_are_refused(tmp_path):
    """The library would pass over them: a chunk of an unknown kind, a schema longer than it is."""
    path = write(tmp_path / 'a.mcap', file={'use_chunking': False, 'enable_data_crcs': False})
    data = path.read_bytes()
    message = data.index(ONE) - 31
    schema = data.index(b'\x03', 17)
    for at, value, problem in (
        (message, b'\x7f', 'record 0x7f does not belong here'),
        (schema + 9 + 2, struct.pack('<I', 1000), 'the lengths in a record do not fit'),
        (message + 1, struct.pack('<Q', 10), 'the lengths in a record do not fit'),
        (message + 1, bytes(8), 'the lengths in a record do not fit'),
    ):
        path.write_bytes(_replace_after(data, at, value))
        with pytest.raises(BagError, match=rf'a.mcap, byte {message if at >= message else schema}'):
            Bag.open(path, unfinished=True)
        with pytest.raises(BagError, match=problem):
            Bag.open(path, unfinished=True)


def test_a_lost_message_is_noticed_where_no_checksum_protects_it(tmp_path, content):
    path = tmp_path / 'a.mcap'
    samples.write_mcap(path, content, use_chunking=False, enable_crcs=False)
    data = path.read_bytes()
    at = data.index(content[30].data) - 31
    whole = 31 + len(content[30].data)
    for count, problem in ((0, f'{len(content) - 1} were read'), (2, f'{len(content) + 1} were')):
        lost = data[at : at + whole] * count
        changed = bytearray(data[:at] + lost + data[at + whole :])
        # The checksum of the data, which would notice it first, is set to "none".
        end = changed.index(b'\x0f' + struct.pack('<Q', 4))
        changed[end + 9 : end + 13] = bytes(4)
        path.write_bytes(changed)
        with pytest.raises(BagError, match=problem):
            Bag.open(path)


@pytest.mark.parametrize('change', ['shorter', 'another channel', 'gone'])
def test_a_file_that_changes_while_it_is_read_is_refused(change, tmp_path, content):
    path = tmp_path / 'a.mcap'
    samples.write_mcap(path, content, use_chunking=False)
    messages = Bag.open(path).messages()
    if change == 'shorter':
        path.write_bytes(path.read_bytes()[:5000])
    elif change == 'gone':
        path.unlink()
    else:
        data = path.read_bytes()
        at = data.index(content[30].data) - 22
        path.write_bytes(_replace_after(data, at, b'\xff\xff'))
    with pytest.raises(BagError, match=r'a.mcap, byte \d+: has changed'):
        list(messages)
