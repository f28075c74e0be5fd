# SPDX-License-Identifier: Apache-2.0
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from bench import bag_samples as samples
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.writer import recover
from musculoskeletal_ae.exceptions import BagError, UnfinishedBagError
from musculoskeletal_ae.nodes import record


@pytest.fixture
def killed(tmp_path, content):
    """What is left of a recording after SIGKILL: chunks of ten messages, the last one cut."""
    samples.write_ours(tmp_path / 'bag', content, 'zstd', finish=False)
    file = tmp_path / 'bag' / 'bag_0.mcap'
    file.write_bytes(file.read_bytes()[:-100])
    return tmp_path / 'bag'


def read(path):
    return [message[:4] for message in Bag.open(path).messages()]


def expected(content):
    return [(sample.topic, *sample[2:]) for sample in content]


def test_a_killed_recording_is_unfinished_and_loses_only_the_last_chunk(killed, content):
    with pytest.raises(UnfinishedBagError, match=r'not completed.*ends at byte'):
        Bag.open(killed)
    messages = list(Bag.open(killed, unfinished=True).messages())
    assert [message[:4] for message in messages] == expected(content[:60])


def test_recovery_in_place_keeps_the_original(killed, content):
    before = (killed / 'bag_0.mcap').read_bytes()
    bag, count, backup, _ = recover(killed)
    assert (bag, count) == (killed, 60)
    assert read(killed) == expected(content[:60])
    assert (killed / 'bag_0.mcap').exists()
    assert (backup / 'bag_0.mcap').read_bytes() == before
    assert sorted(path.name for path in killed.parent.iterdir()) == ['bag', 'bag.unfinished']


def test_recovery_into_a_new_directory_leaves_the_original_alone(killed, content, tmp_path):
    assert recover(killed, tmp_path / 'new') == (tmp_path / 'new', 60, None, [])
    assert read(tmp_path / 'new') == expected(content[:60])
    with pytest.raises(UnfinishedBagError):
        Bag.open(killed)


@pytest.mark.parametrize('where', [[], ['-o', 'new']])
@pytest.mark.parametrize(('compression', 'written'), [('none', ''), ('zstd', 'zstd')])
def test_recovery_compresses_as_it_is_told(
    killed, tmp_path, monkeypatch, where, compression, written
):
    monkeypatch.chdir(tmp_path)
    arguments = ['--recover', str(killed), '--compression', compression, *where]
    assert record._work(record.parse(arguments), []) == 0
    (file,) = (tmp_path / 'new' if where else killed).glob('*.mcap')
    with file.open('rb') as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    assert {chunk.compression for chunk in chunks} == {written}


def test_a_bare_file_is_recovered_beside_it(killed):
    bag, count, *_ = recover(killed / 'bag_0.mcap')
    assert (bag, count) == (killed / 'bag_0_recovered', 60)
    assert Bag.open(bag).message_count == 60


def test_qos_survives(killed, tmp_path):
    recover(killed, tmp_path / 'new')
    topic = Bag.open(tmp_path / 'new').topics['/left_arm/robot_description']
    assert 'transient_local' in topic.qos


@pytest.mark.parametrize('text', [None, '', 'rosbag2_bagfile_information: {}'])
def test_a_sound_file_with_bad_metadata_is_recovered(text, bag, content):
    (bag / 'metadata.yaml').unlink()
    if text is not None:
        (bag / 'metadata.yaml').write_text(text)
    recover(bag)
    assert read(bag) == expected(content)


def test_a_finished_bag_is_left_alone(bag):
    with pytest.raises(BagError, match='there is nothing to recover'):
        recover(bag)
    assert [path.name for path in bag.parent.iterdir()] == ['bag']


def test_damage_is_not_taken_for_the_end(killed):
    file = killed / 'bag_0.mcap'
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    with pytest.raises(BagError, match=r'bag_0.mcap, byte \d+: '):
        recover(killed)
    assert [path.name for path in killed.parent.iterdir()] == ['bag']


def test_types_that_are_not_known_are_copied_as_they_are(tmp_path):
    with (tmp_path / 'a.mcap').open('wb') as file:
        writer = Writer(file)
        writer.start(profile='ros2')
        schema = writer.register_schema('other_msgs/msg/Thing', 'ros2msg', b'int32 x')
        writer.add_message(writer.register_channel('/thing', 'cdr', schema), 5, b'\x07', 4)
        writer.flush()
    assert recover(tmp_path / 'a.mcap', tmp_path / 'new')[1] == 1
    bag = Bag.open(tmp_path / 'new')
    assert [message[:4] for message in bag.messages()] == [('/thing', 5, 4, b'\x07')]
    assert bag.topics['/thing'].schema.data == b'int32 x'


def test_topics_that_are_not_in_cdr_are_left_out_and_named(tmp_path, monkeypatch, capsys):
    with (tmp_path / 'a.mcap').open('wb') as file:
        writer = Writer(file)
        writer.start(profile='ros2')
        schema = writer.register_schema('other_msgs/msg/Thing', 'ros2msg', b'int32 x')
        for name, encoding in (('/thing', 'cdr'), ('/text', 'json')):
            writer.add_message(writer.register_channel(name, encoding, schema), 5, b'{}', 4)
        writer.flush()
    monkeypatch.chdir(tmp_path)
    assert record._work(record.parse(['--recover', 'a.mcap', '-o', 'new']), []) == 0
    assert list(Bag.open('new').topics) == ['/thing']
    told = capsys.readouterr()
    assert told.out == '1 messages recovered to new\n'
    assert told.err == 'warning: a.mcap: left out, since they are not in CDR: /text\n'
