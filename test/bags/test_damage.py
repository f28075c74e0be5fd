# SPDX-License-Identifier: Apache-2.0
"""Damaged recordings are read in full, read partly with a report, or rejected with one error."""

import random
import struct

import pytest
from rosbags.rosbag2 import StoragePlugin

from bags import bag_samples as samples
from bags.bare_file import FLOAT, ONE, write
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.exceptions import BagError

TRIALS = 20  # number of damaged copies of each kind of bag
NUMBERS = (0, 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63, 2**64 - 1)


@pytest.fixture(scope='module', params=['ours', 'killed', 'rosbags', 'sqlite3', *samples.BARE])
def recording(request, tmp_path_factory, content):
    """Return a recording of one kind and the files in it."""
    path = tmp_path_factory.mktemp('recording') / 'bag'
    if request.param in samples.BARE:
        path.mkdir()
        samples.write_mcap(path / 'bag.mcap', content, **samples.BARE[request.param])
    elif request.param == 'rosbags':
        samples.write_rosbags(path, content)
    elif request.param == 'sqlite3':
        samples.write_rosbags(path, content, StoragePlugin.SQLITE3)
    else:
        samples.write_ours(path, content, finish=request.param == 'ours')
    return path, {file.name: file.read_bytes() for file in path.iterdir()}


def damage(data, rng):
    """Return `data` truncated, or with bytes changed, removed or inserted in one place."""
    changed = bytearray(data)
    at = rng.randrange(len(changed))
    size = rng.choice((1, 4, 8, 30, 300))
    kind = rng.randrange(6)
    if kind == 0:
        del changed[at:]
    elif kind == 1:
        changed[at] ^= 1 << rng.randrange(8)
    elif kind == 2:
        changed[at : at + size] = rng.randbytes(len(changed[at : at + size]))
    elif kind == 3:
        del changed[at : at + size]
    elif kind == 4:
        changed[at:at] = rng.randbytes(size)
    else:  # replace 8 bytes that may be a length or a time by an extreme value
        changed[at : at + 8] = struct.pack('<Q', rng.choice(NUMBERS))
    return bytes(changed)


def read(path):
    bag = Bag.open(path)
    messages = list(bag.messages())
    for message in messages:
        if not bag.topics[message.topic].problem:
            bag.decode(message)
    return bag, [(message.topic, message.log_time, message.data) for message in messages]


def test_damage_is_never_read_without_a_word(recording, content, tmp_path):
    _, files = recording
    expected = [(sample.topic, sample.log_time, sample.data) for sample in content]
    victims = sorted(files, key=lambda name: name == 'metadata.yaml')
    for trial in range(TRIALS):
        rng = random.Random(trial)
        victim = rng.choice([*victims[:1] * 6, victims[-1]])
        for name, data in files.items():
            (tmp_path / name).write_bytes(damage(data, rng) if name == victim else data)
        try:
            bag, messages = read(tmp_path)
        except BagError:
            continue
        if all(file.has_checksums for file in bag.files):
            assert messages == (expected[: len(messages)] if bag.unfinished else expected), trial
        else:  # without checksums, changed data cannot be noticed, but a missing message must be
            assert bag.unfinished or len(messages) == len(expected), trial


def test_a_truncated_file_is_read_up_to_its_end_and_reported(content, tmp_path):
    file = tmp_path / 'a.mcap'
    samples.write_mcap(file, content)
    whole = file.read_bytes()
    expected = [(sample.topic, sample.log_time, sample.data) for sample in content]
    for size in range(100, len(whole), len(whole) // 60):
        file.write_bytes(whole[:size])
        bag, messages = read(file)
        assert f'at byte {size}' in bag.unfinished[0]
        assert messages == expected[: len(messages)]
    assert len(messages) == len(expected)  # the longest piece lacks only the summary of the file


def test_no_flipped_bit_changes_what_is_read(content, tmp_path):
    file = tmp_path / 'a.mcap'
    samples.write_mcap(file, content)
    whole = file.read_bytes()
    expected = read(file)[1]
    rng = random.Random(0)
    for _ in range(100):
        changed = bytearray(whole)
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
        file.write_bytes(changed)
        try:
            bag, messages = read(file)
        except BagError:
            continue
        assert messages == (expected[: len(messages)] if bag.unfinished else expected)


@pytest.mark.parametrize(
    ('data', 'problem'),
    [
        (b'', 'the file is empty; record again'),
        (b'# Recordings\n', 'is neither an mcap nor a sqlite3 file'),
        (b'\x89MCAP0\r\n\x01\x20', 'it ends within its first record'),
        (b'SQLite format 3\0' + bytes(1000), 'cannot be read as a recording'),
    ],
)
def test_a_file_that_is_no_recording_is_refused(data, problem, tmp_path):
    (tmp_path / 'a.db3').write_bytes(data)
    with pytest.raises(BagError, match=rf'a.db3: .*{problem}'):
        Bag.open(tmp_path / 'a.db3')


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(BagError, match=r'nothing: cannot be read: No such file .*name another bag'):
        Bag.open(tmp_path / 'nothing')
    with pytest.raises(BagError, match=r'neither a readable metadata.yaml nor mcap'):
        Bag.open(tmp_path)


def test_a_bag_that_misses_one_of_its_files_is_refused(bag):
    (bag / 'bag_0.mcap').unlink()
    with pytest.raises(BagError, match=r'bag_0.mcap: cannot be read: No such file'):
        Bag.open(bag)


def test_a_file_that_becomes_shorter_while_it_is_read_is_refused(content, tmp_path):
    path = tmp_path / 'a.mcap'
    samples.write_mcap(path, content)
    messages = Bag.open(path).messages()
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(BagError, match=r'a.mcap: cannot be read as a recording'):
        list(messages)


def test_a_few_kilobytes_do_not_become_hours_of_work(tmp_path):
    still = [samples.Sample('/anomaly', FLOAT, 5, 5, ONE + bytes(1000))] * 12_000
    options = {'chunk_size': 1 << 24, 'index_types': samples.IndexType.NONE}
    samples.write_mcap(tmp_path / 'a.mcap', still, **options)
    with pytest.raises(BagError, match='bytes decompress to more than'):
        Bag.open(tmp_path / 'a.mcap')


def test_a_chunk_that_decompresses_to_more_than_it_announces_is_refused(tmp_path):
    path = write(tmp_path / 'a.mcap', data=ONE + bytes(1 << 20))
    data = bytearray(path.read_bytes())
    size = data.index(b'\x06', 17) + 25
    data[size : size + 8] = struct.pack('<Q', 1000)
    path.write_bytes(data)
    with pytest.raises(BagError, match='does not decompress to 1000 bytes'):
        Bag.open(path)


def test_a_recording_whose_times_run_backwards_is_refused_at_once(tmp_path):
    times = range(10**12, 99 * 10**10, -(10**7))
    back = [samples.Sample('/anomaly', FLOAT, time, time, ONE) for time in times]
    samples.write_mcap(tmp_path / 'a.mcap', back)
    with pytest.raises(BagError, match=r'log times of /anomaly go back by 1\.0\d* s; legal'):
        Bag.open(tmp_path / 'a.mcap')


@pytest.mark.parametrize('data', [ONE[:8], b'', b'\x01\x02\x03\x04'])
def test_a_message_that_is_not_of_its_type_names_file_and_topic(data, tmp_path):
    bag = Bag.open(write(tmp_path / 'a.mcap', data=data))
    (message,) = bag.messages()
    with pytest.raises(BagError, match=rf'a.mcap: .*a message of /anomaly is not a valid {FLOAT}'):
        bag.decode(message)
