# SPDX-License-Identifier: Apache-2.0
"""The recording of a killed recorder can be read, and be converted into a finished bag."""

import shutil
import sqlite3
from contextlib import closing

import pytest
from rosbags.rosbag2 import StoragePlugin

from bags import bag_samples as samples
from musculoskeletal_ae.bags.check import check_bag
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.exceptions import BagError
from musculoskeletal_ae.ros_tools import record

from .bare_file import write


def expected(content):
    return [(sample.topic, *sample[2:]) for sample in content]


def recover(path, *options):
    return record._work(record.parse(['--recover', str(path), *map(str, options)]), [])


@pytest.fixture
def killed(tmp_path, content):
    """Return a recording whose recorder was killed: its last chunk of messages is incomplete."""
    samples.write_ours(tmp_path / 'bag', content, finish=False)
    file = tmp_path / 'bag' / 'bag_0.mcap'
    file.write_bytes(file.read_bytes()[:-100])
    return tmp_path / 'bag'


def test_a_killed_recording_is_read_but_for_its_last_chunk_and_says_so(killed, content):
    bag = Bag.open(killed)
    assert [message[:4] for message in bag.messages()] == expected(content[:60])
    assert 'bag_0.mcap ends within a record' in bag.unfinished[0]
    assert any('unfinished' in fault and '--recover' in fault for fault in check_bag(killed).faults)


def test_an_interrupted_recovery_says_that_its_result_is_incomplete(killed, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(record, 'recover', interrupt)
    with pytest.raises(KeyboardInterrupt, match='bag_recovered is incomplete; remove it'):
        recover(killed)


@pytest.mark.parametrize('options', [[], ['-o', 'new'], ['new', '--compression', 'none']])
def test_recovery_writes_a_finished_bag_and_leaves_the_original_alone(
    killed, content, options, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    before = (killed / 'bag_0.mcap').read_bytes()
    assert recover('bag', *options) == 0
    target = 'new' if options else 'bag_recovered'
    assert capsys.readouterr().out == f'60 messages recovered to {target}\n'
    bag = Bag.open(tmp_path / target)
    assert [message[:4] for message in bag.messages()] == expected(content[:60])
    assert not bag.unfinished
    assert bag.topics['/left_arm/robot_description'].is_latched
    assert (killed / 'bag_0.mcap').read_bytes() == before


def test_messages_in_the_log_of_sqlite_are_recovered(tmp_path, content, capsys):
    """A killed recorder may leave its last messages in the write-ahead log only."""
    samples.write_rosbags(tmp_path / 'closed', content, StoragePlugin.SQLITE3)
    (file,) = (tmp_path / 'closed').glob('*.db3')
    with closing(sqlite3.connect(file)) as connection:
        connection.execute('PRAGMA journal_mode=wal')
        connection.execute('PRAGMA wal_autocheckpoint=0')
        rows = connection.execute('SELECT * FROM messages WHERE id > 20').fetchall()
        connection.execute('DELETE FROM messages WHERE id > 20')
        connection.commit()
        connection.execute('PRAGMA wal_checkpoint(TRUNCATE)')
        connection.executemany(
            f'INSERT INTO messages VALUES ({", ".join("?" * len(rows[0]))})', rows
        )
        connection.commit()
        shutil.copytree(tmp_path / 'closed', tmp_path / 'killed')
    before = {each.name: each.read_bytes() for each in (tmp_path / 'killed').iterdir()}
    assert recover(tmp_path / 'killed') == 0
    assert f'{len(content)} messages recovered' in capsys.readouterr().out
    bag = Bag.open(tmp_path / 'killed_recovered')
    assert [message.data for message in bag.messages()] == [sample.data for sample in content]
    assert {each.name: each.read_bytes() for each in (tmp_path / 'killed').iterdir()} == before


@pytest.mark.parametrize('share', [0.3, 0.5, 0.7])
def test_messages_beside_a_damaged_page_of_sqlite_are_recovered_with_a_warning(
    share, tmp_path, content, capsys
):
    many = [
        each._replace(log_time=each.log_time + n * 10**9) for n in range(20) for each in content
    ]
    samples.write_rosbags(tmp_path / 'bag', many, StoragePlugin.SQLITE3)
    (file,) = (tmp_path / 'bag').glob('*.db3')
    data = bytearray(file.read_bytes())
    size = int.from_bytes(data[16:18], 'big')  # of a page
    leaves = [place for place in range(0, len(data), size) if data[place] == 13]  # of tables
    damaged = leaves[int(share * len(leaves))]
    data[damaged : damaged + size] = bytes(size)
    file.write_bytes(data)
    with pytest.raises(BagError, match='or save what can be read with `record --recover BAG`'):
        Bag.open(tmp_path / 'bag')
    assert recover(tmp_path / 'bag') == 0
    assert f'{file.name} is damaged: messages that cannot be read are' in capsys.readouterr().err
    bag = Bag.open(tmp_path / 'bag_recovered')
    written = {(sample.topic, sample.log_time, sample.data) for sample in many}
    found = [(message.topic, message.log_time, message.data) for message in bag.messages()]
    assert set(found) <= written and 0.95 * len(many) < len(found) < len(many)
    assert file.read_bytes() == data


@pytest.mark.parametrize('namespace', [None, '/left_arm'])
def test_of_a_recording_without_a_complete_message_nothing_is_promised(
    namespace, tmp_path, content
):
    samples.write_ours(tmp_path / 'bag', content[:5], finish=False)
    file = tmp_path / 'bag' / 'bag_0.mcap'
    file.write_bytes(file.read_bytes()[:200])
    faults = '\n'.join(check_bag(tmp_path / 'bag', None, namespace).faults)
    assert 'contains no complete message; record again' in faults
    assert '--recover' not in faults and '--from-namespace' not in faults
    with pytest.raises(BagError, match='contains no complete message; record again'):
        recover(tmp_path / 'bag')
    assert not (tmp_path / 'bag_recovered').exists()


@pytest.mark.parametrize('text', ['', 'rosbag2_bagfile_information: {}'])
def test_recovery_mends_metadata(text, bag, content):
    (bag / 'metadata.yaml').write_text(text)
    assert recover(bag) == 0
    mended = Bag.open(bag.with_name('bag_recovered'))
    assert mended.message_count == len(content) and not mended.unfinished


def test_damage_is_not_taken_for_the_end(killed):
    file = killed / 'bag_0.mcap'
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    with pytest.raises(BagError, match=r'bag_0.mcap: '):
        recover(killed)


def test_types_that_are_not_known_are_copied_as_they_are(tmp_path):
    write(tmp_path / 'a.mcap', schema='other_msgs/msg/Thing', text='int32 x')
    assert recover(tmp_path / 'a.mcap') == 0
    bag = Bag.open(tmp_path / 'a_recovered')
    assert [message[:4] for message in bag.messages()] == [
        message[:4] for message in Bag.open(tmp_path / 'a.mcap').messages()
    ]
    assert bag.topics['/anomaly'].schema.data == b'int32 x'


def test_topics_that_are_not_in_cdr_are_left_out_and_named(tmp_path, capsys):
    write(tmp_path / 'a.mcap', message_encoding='json')
    assert recover(tmp_path / 'a.mcap') == 0
    assert 'topics that are not in CDR were not recovered: /anomaly' in capsys.readouterr().err
