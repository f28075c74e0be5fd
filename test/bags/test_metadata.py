# SPDX-License-Identifier: Apache-2.0
import pytest
import yaml

from bench import bag_samples as samples
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.exceptions import BagError, UnfinishedBagError


def change(bag, **entries):
    file = bag / 'metadata.yaml'
    content = yaml.safe_load(file.read_text())
    content['rosbag2_bagfile_information'].update(entries)
    file.write_text(yaml.safe_dump(content))


def info(bag):
    return yaml.safe_load((bag / 'metadata.yaml').read_text())['rosbag2_bagfile_information']


@pytest.mark.parametrize(
    ('entries', 'problem'),
    [
        ({'version': 10}, 'version 10 is none of 1 … 9'),
        ({'version': True}, 'Expected `int`, got `bool`.*version'),
        ({'storage_identifier': 'sqlite3'}, "'sqlite3' is not mcap[^;]*; use `ros2 bag convert`"),
        ({'compression_mode': 'FILE'}, 'compressed each file[^;]*; use `ros2 bag convert`, or'),
        ({'compression_mode': 'MESSAGE'}, 'compressed each message[^;]*; use `ros2 bag convert`'),
        ({'relative_file_paths': ['../other.mcap']}, 'files in the same directory'),
        ({'relative_file_paths': ['/etc/passwd']}, 'files in the same directory'),
        ({'relative_file_paths': []}, 'name each file once'),
        ({'relative_file_paths': ['gone.mcap']}, 'gone.mcap: cannot be read: No such file'),
        ({'message_count': 7}, 'message_count is not the sum'),
        ({'topics_with_message_count': None}, 'Expected `array`, got `null`.*topics_with'),
        ({'starting_time': {'nanoseconds_since_epoch': 0}}, 'another start or duration'),
        ({'duration': {'nanoseconds': 10**12}}, 'another start or duration'),
    ],
)
def test_metadata_that_cannot_be_right_is_refused(entries, problem, bag):
    change(bag, **entries)
    with pytest.raises(BagError, match=problem):
        Bag.open(bag)


def test_counts_that_differ_from_the_file_are_refused_and_the_topic_named(bag, content):
    topics = info(bag)['topics_with_message_count']
    topics[0]['message_count'] -= 1
    change(bag, topics_with_message_count=topics, message_count=len(content) - 1)
    name = topics[0]['topic_metadata']['name']
    with pytest.raises(BagError, match=f'topic {name} differs; .*record --recover'):
        Bag.open(bag)


@pytest.mark.parametrize(
    'text',
    ['', '[]', '{', '\t', 'a: !!python/object/apply:os.abort []', '[' * 5000, 'x' * (2 << 20)],
)
def test_what_is_no_metadata_is_refused(text, bag):
    (bag / 'metadata.yaml').write_text(text)
    with pytest.raises(BagError, match=r'metadata\.yaml: (cannot be used|is larger)'):
        Bag.open(bag)


def test_metadata_that_refers_to_itself_over_and_over_is_refused_at_once(bag):
    lines = ['a0: &a0 [x, x]'] + [
        f'a{i}: &a{i} [{", ".join([f"*a{i - 1}"] * 9)}]' for i in range(1, 40)
    ]
    lines.append('rosbag2_bagfile_information: {version: *a39}')
    (bag / 'metadata.yaml').write_text('\n'.join(lines))
    with pytest.raises(BagError, match='more than 100000 entries, aliases included'):
        Bag.open(bag)


@pytest.mark.parametrize('version', range(1, 9))
def test_older_versions_are_read(version, bag, content):
    change(bag, version=version)
    assert Bag.open(bag).message_count == len(content)


def test_a_bag_without_metadata_is_unfinished(bag, content):
    (bag / 'metadata.yaml').unlink()
    with pytest.raises(UnfinishedBagError, match=r'metadata\.yaml is missing'):
        Bag.open(bag)
    assert len(list(Bag.open(bag, unfinished=True).messages())) == len(content)


def test_a_bag_that_was_split_is_read_in_order(tmp_path, content):
    bag = tmp_path / 'bag'
    samples.write_ours(bag, content, 'none', finish=True)
    # Times of the two files overlap, as those of a recorder that splits while messages wait.
    samples.write_mcap(bag / 'a.mcap', content[:20] + content[30:40])
    samples.write_mcap(bag / 'b.mcap', content[20:30] + content[40:])
    change(bag, relative_file_paths=['a.mcap', 'b.mcap'])
    assert [m.data for m in Bag.open(bag).messages()] == [sample.data for sample in content]
