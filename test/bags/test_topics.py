# SPDX-License-Identifier: Apache-2.0
import random
import re
from pathlib import Path

import pytest

from bags import bag_samples as samples
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.topics import (
    SENT,
    TOPICS,
    interface_topics,
    latched_topics,
    namespaces,
    select,
)
from musculoskeletal_ae.exceptions import BagError

# By default, `replay` plays the topics in DEFAULT, and `record` leaves out those in LEFT_OUT
# (doc/reference/file_formats.md).
DEFAULT = {
    'joint_states',
    'muscle_states',
    'imu',
    'marker_pose',
    'robot_description',
    'target_joint_states',
    'joint_trajectory',
    'target_pose',
    'target_twist',
    'muscle_length_command',
    'muscle_tension_command',
    'sim/external_wrench',
    'sim/fixed_joint_states',
}
LEFT_OUT = {'estimated/markers', 'muscle_joint_states'}
STRING = 'std_msgs/msg/String'


def make(path, *topics):
    rng = random.Random(0)
    content = [
        samples.Sample(name, kind, i, i, samples.encode(samples.filled(kind, rng), kind))
        for i, (name, kind) in enumerate(topics)
    ]
    samples.write_mcap(path / 'a.mcap', content)
    return Bag.open(path / 'a.mcap')


def ours(*names):
    return [(name, TOPICS[relative].type) for name, relative in names]


def test_the_topics_are_those_of_the_interface():
    text = (Path(__file__).parents[2] / 'doc' / 'reference' / 'topics_and_services.md').read_text(
        'utf-8'
    )
    table = text.partition('| topic | type |')[2].partition('\n\n')[0]
    documented = {
        name for row in table.splitlines()[2:] for name in re.findall('`(.*?)`', row.split('|')[1])
    }
    assert documented - LEFT_OUT == {*TOPICS}


@pytest.mark.parametrize(
    ('names', 'namespace'),
    [
        (['/muscle_states', '/sim/joint_states', '/diagnostics'], ''),
        (
            ['/left_arm/muscle_states', '/left_arm/sim/joint_states', '/diagnostics', '/tf'],
            '/left_arm',
        ),
        (['/a/b/anomaly'], '/a/b'),
        (['/sim/joint_states'], ''),
        (['/sim/joint_states', '/sim/muscle_length_command'], '/sim'),
        (['/sim/sim/joint_states'], '/sim'),
        (['/diagnostics', '/tf', '/camera/image'], ''),
        ([], ''),
    ],
)
def test_the_namespace_is_the_one_that_explains_all_topics(names, namespace):
    assert namespaces(names) == [namespace]


def test_of_several_namespaces_none_is_guessed():
    names = ['/left/muscle_states', '/right/muscle_states', '/joint_states']
    assert namespaces(names) == ['', '/left', '/right']


def test_what_hardware_vision_user_and_controller_sent_is_played_by_default(bag):
    chosen = select(Bag.open(bag), ['default'], None, keep_names=False)
    assert set(chosen.values()) == DEFAULT == set(SENT)
    assert set(chosen) == {f'/left_arm/{name}' for name in DEFAULT}


def test_all_adds_what_nodes_compute(bag):
    assert set(select(Bag.open(bag), ['all'], None, keep_names=False).values()) == set(TOPICS)


def test_kept_names_are_the_recorded_ones(bag):
    chosen = select(Bag.open(bag), ['default'], None, keep_names=True)
    assert all(name == to for name, to in chosen.items())
    assert '/left_arm/muscle_states' in chosen


def test_topics_are_chosen_by_relative_or_recorded_name(tmp_path):
    bag = make(tmp_path, *ours(('/l/anomaly', 'anomaly')), ('/l/note', STRING), ('/other', STRING))
    assert select(bag, ['anomaly', '/l/note', '/other'], None, False) == {
        '/l/anomaly': 'anomaly',
        '/l/note': 'note',
        '/other': '/other',
    }
    with pytest.raises(BagError, match=r'topic nothing is not in the bag; it has: /l/anomaly, '):
        select(bag, ['nothing'], None, False)


def test_a_namespace_that_is_not_there_is_refused_with_those_that_are(tmp_path):
    bag = make(tmp_path, *ours(('/left/anomaly', 'anomaly')))
    with pytest.raises(BagError, match=r"no topic under '/right/'.* --from-namespace: /left"):
        select(bag, ['default'], 'right', False)


def test_names_outside_the_namespace_stay_absolute(tmp_path):
    names = ('/left/sim/markers', 'sim/markers'), ('/diagnostics', '/diagnostics')
    bag = make(tmp_path, *ours(*names), ('/left_foot/x', STRING))
    assert select(bag, ['/left/sim/markers', '/diagnostics', '/left_foot/x'], None, False) == {
        '/left/sim/markers': 'sim/markers',
        '/diagnostics': '/diagnostics',
        '/left_foot/x': '/left_foot/x',
    }


def test_one_of_two_arms_can_be_chosen_or_both_kept(tmp_path):
    names = [('/l/muscle_states', 'muscle_states'), ('/r/muscle_states', 'muscle_states')]
    bag = make(tmp_path, *ours(*names))
    with pytest.raises(BagError, match='several namespaces: /l, /r; choose one with --from-name'):
        select(bag, ['all'], None, False)
    for name in ('/r', 'r/', 'r'):
        assert select(bag, ['all'], name, False) == {'/r/muscle_states': 'muscle_states'}
    assert len(select(bag, ['all'], None, True)) == 2


def test_a_bag_of_other_topics_says_what_it_has(tmp_path):
    bag = make(tmp_path, ('/camera/note', STRING))
    with pytest.raises(BagError, match=r'no topic to replay by default; it has: /camera/note'):
        select(bag, ['default'], None, False)


def test_a_topic_of_the_wrong_type_is_refused(tmp_path):
    bag = make(tmp_path, ('/muscle_states', STRING))
    for use in (interface_topics, lambda bag: select(bag, ['all'], None, False)):
        with pytest.raises(BagError, match=r"/muscle_states .* type .*String'.* legal .*'std_msgs"):
            use(bag)


def test_topics_of_the_interface_are_latched_whatever_the_recorder_noted(tmp_path, content):
    samples.write_mcap(tmp_path / 'a.mcap', content)
    assert '/left_arm/mae_checkpoint' in latched_topics(Bag.open(tmp_path / 'a.mcap'))


def test_what_an_arm_lacks_is_taken_from_the_namespace_around_it(tmp_path):
    names = [('/left/arm/muscle_states', 'muscle_states'), ('/joint_states', 'joint_states')]
    bag = make(tmp_path, *ours(*names, ('/left/imu', 'imu')))
    expected = {
        '/left/arm/muscle_states': 'muscle_states', '/joint_states': 'joint_states',
        '/left/imu': 'imu',
    }  # fmt: skip
    assert select(bag, ['default'], None, False) == expected
    assert select(bag, ['default'], '/left/arm', False) == expected
    assert set(interface_topics(bag)) == {'muscle_states', 'joint_states', 'imu'}


def test_a_topic_that_an_arm_has_is_not_taken_from_around_it(tmp_path):
    names = [('/left/joint_states', 'joint_states'), ('/joint_states', 'joint_states')]
    bag = make(tmp_path, *ours(*names, ('/left/muscle_states', 'muscle_states')))
    with pytest.raises(BagError, match='several namespaces'):
        select(bag, ['default'], None, False)
    chosen = select(bag, ['default'], 'left', False)
    assert set(chosen) == {'/left/joint_states', '/left/muscle_states'}
