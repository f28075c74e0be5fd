# SPDX-License-Identifier: Apache-2.0
import math
import re

import numpy as np
import pytest
from robots import chain, copy_robot, read_muscles, write_muscles, write_robot

from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.robot.description import load_description
from musculoskeletal_ae.robot.directories import shipped_robots
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.urdf import MOST_PARTS, read_urdf


def refused(directory, *fragments):
    """Check that reading a robot directory raises an error that contains all these texts."""
    with pytest.raises(RobotDescriptionError) as error:
        load_description(directory)
    for fragment in fragments:
        assert fragment in str(error.value)


def put(path, value):
    """Return an edit of muscles.yaml that sets the entry at `path` to `value`."""

    def edit(document):
        at = document
        for key in path[:-1]:
            at = at[key]
        at[path[-1]] = value

    return edit


def drop(path):
    def edit(document):
        at = document
        for key in path[:-1]:
            at = at[key]
        del at[path[-1]]

    return edit


ROUTE = ('muscles', 0, 'route')
POINT = (*ROUTE, 1)
AT_POINT = '$.muscles[0].route[1]'

#: edits that make muscles.yaml illegal, and texts that the error must contain: the place of the
#: fault, the value and the legal values
BAD = {
    'unknown key': (put(['sped'], 1.0), ["$: unknown key 'sped'", 'joints, muscles']),
    'unknown key within': (put([*POINT, 'frame'], 1), [AT_POINT, "'frame'", 'link, xyz']),
    'key missing': (drop(['muscles', 0, 'name']), ['$.muscles[0]', "'name' is missing"]),
    'wrong type': (put(['muscles', 0, 'name'], 7), ['$.muscles[0].name', 'got int: 7']),
    'empty value': (put(['stiffness'], None), ['$.stiffness', 'expected float']),
    'not a number': (put([*POINT, 'xyz', 2], math.nan), [f'{AT_POINT}.xyz[2]', 'got nan']),
    'too large': (put([*POINT, 'xyz', 0], 10**400), [f'{AT_POINT}.xyz[0]', 'out of range']),
    'number as text': (put([*POINT, 'xyz', 0], '1e5'), ["got str: '1e5'", '1.0e+5']),
    'too few numbers': (put([*POINT, 'xyz'], [0.0, 1.0]), [f'{AT_POINT}.xyz', 'length 3, got 2']),
    'not positive': (put(['series_elastic', 'force'], 0.0), ['$.series_elastic.force', '> 0']),
    'no muscles': (put(['muscles'], []), ['$.muscles', 'length >= 1']),
    'name with a comma': (put(['muscles', 0, 'name'], 'a, b'), ["'a, b'", 'without a comma']),
    'name with a space': (put(['muscles', 0, 'name'], 'a '), ["'a '", 'without spaces around']),
    'an escape in a name': (put(['muscles', 0, 'name'], 'a\x9b1m'), ['printable characters']),
    'muscle twice': (put(['muscles', 1, 'name'], 'deltoid_anterior'), ['twice', 'unique']),
    'one-point route': (drop(POINT), ['$.muscles[0].route', 'length >= 2']),
    'the same point twice': (put(ROUTE, [{'link': 'hand', 'xyz': [0, 0, 0]}] * 2), ['2 different']),
    'unknown link': (put([*POINT, 'link'], 'hnad'), [AT_POINT, "'hnad'", 'torso, upper_arm']),
    'unknown joint': (put(['joints', 1], 'knee'), ['$.joints[1]', "'knee'", 'shoulder, elbow']),
    'fixed joint': (put(['joints', 1], 'wrist'), ["'wrist'", 'shoulder, elbow']),
    'tension order': (put(['tension', 'limit'], 20.0), ['bias < limit <= max', '20']),
    'end effector at rest': (
        put(['end_effector'], 'torso'),
        ["'torso'", 'that the joints move (upper_arm, forearm, hand)'],
    ),
    'end effector': (put(['end_effector'], 'claw'), ["'claw'", 'torso, upper_arm, forearm, hand']),
}


@pytest.mark.parametrize('case', BAD)
def test_a_bad_entry_is_refused_naming_file_place_and_what_is_legal(tmp_path, case):
    edit, fragments = BAD[case]
    directory = copy_robot('arm26', tmp_path)
    document = read_muscles(directory)
    edit(document)
    write_muscles(directory, document)
    refused(directory, 'muscles.yaml', *fragments)


@pytest.mark.parametrize(
    ('text', 'problem'),
    [
        ('', 'expected object, got null'),
        ('- 1', 'expected object, got array'),
        ('joints: [shoulder', 'not valid YAML'),
        ('!!python/object/apply:os.system [echo]', 'not valid YAML'),
        ('joints: 2020-13-45', 'not valid YAML'),
    ],
)
def test_a_file_that_is_no_mapping_is_refused(tmp_path, text, problem):
    directory = copy_robot('arm26', tmp_path)
    (directory / 'muscles.yaml').write_text(text)
    refused(directory, 'muscles.yaml', problem)


BAD_URDF = {
    'not XML': ('<robot', '<<robot', ['not valid XML']),
    'mass nan': ('<mass value="0.8"/>', '<mass value="nan"/>', ["'forearm'", 'mass value', 'nan']),
    'mass negative': ('<mass value="0.8"/>', '<mass value="-1"/>', ["'forearm'", '>= 0']),
    'two numbers': ('xyz="0 0 -0.28"', 'xyz="0 -0.28"', ["joint 'elbow'", '3 finite numbers']),
    'limits crossed': ('lower="-1.9199"', 'lower="1.0"', ["'elbow'", 'lower < upper']),
    'continuous': (
        'type="revolute"',
        'type="continuous"',
        ['is continuous; legal: revolute or prismatic', 'limits'],
    ),
    'no such parent': (
        'parent link="upper_arm"',
        'parent link="x"',
        ["joint 'elbow': parent", "'x'"],
    ),
    'mass missing': ('<mass value="0.8"/>', '', ["'forearm'", 'mass: expected value']),
    'no number to all': ('<mass value="0.8"/>', '<mass value="0_8"/>', ["'forearm'", '0_8']),
    'effort missing': ('effort="', 'force="', ["joint 'shoulder'", 'limit: expected effort']),
    'lower, upper and velocity missing': (
        '<limit lower="-1.3963" upper="0.6981" effort="20" velocity="6"/>',
        '<limit effort="20"/>',
        ["joint 'shoulder'", 'missing: lower, upper, velocity'],
    ),
    'joint type': ('type="revolute"', 'type="hinge"', ["joint 'shoulder'", 'prismatic', 'hinge']),
    'two joints above': (
        'child link="hand"',
        'child link="forearm"',
        ["'forearm'", 'no other joint'],
    ),
    'link twice': ('<link name="hand"', '<link name="torso"', ["link 'torso' comes 2 times"]),
    'two roots': ('<link name="hand"', '<link name="x"/><link name="hand"', ['torso, x']),
}


@pytest.mark.parametrize('case', BAD_URDF)
def test_a_bad_urdf_is_refused_naming_the_part(tmp_path, case):
    old, new, fragments = BAD_URDF[case]
    directory = copy_robot('arm26', tmp_path)
    file = directory / 'robot.urdf'
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    refused(directory, str(directory), *fragments)


@pytest.mark.parametrize('missing', ['robot.urdf', 'muscles.yaml'])
def test_a_missing_file_is_named(tmp_path, missing):
    directory = copy_robot('arm26', tmp_path)
    (directory / missing).unlink()
    with pytest.raises(RobotDescriptionError, match=missing):
        load_description(directory)


@pytest.mark.parametrize('robot', ['', 'musashi_right_leg', '/nowhere', '~nobody_here/x', 'a\0b'])
def test_a_robot_that_is_not_there_is_refused_naming_the_shipped_ones(robot):
    with pytest.raises(RobotDescriptionError, match='arm26, musashi_left_arm'):
        load_description(robot)


def test_the_same_description_is_read_from_a_name_and_from_a_directory():
    by_name = load_description('arm26')
    assert by_name.directory == shipped_robots()['arm26']
    by_directory = load_description(str(by_name.directory))
    assert by_directory.muscles == by_name.muscles


def test_defaults_apply_where_the_optional_keys_are_left_out(tmp_path):
    directory = write_robot(tmp_path)
    document = read_muscles(directory)
    assert not {'tension', 'stiffness', 'series_elastic'} & set(document)
    del document['end_effector']
    description = load_description(write_muscles(directory, document))
    tension = description.tension
    assert {*tension.bias} == {30.0} and {*tension.limit} == {200.0} and {*tension.max} == {500.0}
    assert {*description.stiffness} == {10000.0}
    assert description.end_effector == 'tool'  # by default, the last link of the chain
    assert (description.series_elastic.force > 0.0).all()


@pytest.mark.parametrize('names', [('zz', 'aa'), ('aa', 'zz')])
def test_of_links_on_the_last_joint_the_tip_is_the_end_effector_then_the_last(tmp_path, names):
    directory = write_robot(tmp_path)
    document, file = read_muscles(directory), directory / 'robot.urdf'
    del document['end_effector']
    write_muscles(directory, document)
    links = ''.join(f'<link name="{name}"/>' for name in names)
    fixed = '<joint name="to_{1}" type="fixed"><parent link="{0}"/><child link="{1}"/></joint>'
    text = file.read_text()
    for above, tip in (('tool', names[1]), (names[0], names[1]), (names[1], names[0])):
        below = names[0] if tip == names[1] else names[1]
        joints = fixed.format('tool', below) + fixed.format(above, tip)
        file.write_text(text.replace('</robot>', f'{links}{joints}</robot>'))
        assert load_description(str(directory)).end_effector == tip


@pytest.mark.parametrize('name', shipped_robots())
def test_shipped_robots_name_their_end_effectors(name):
    text = (shipped_robots()[name] / 'muscles.yaml').read_text()
    first = re.search(r'^end_effectors?: \[?(\w+)', text, re.M)[1]
    assert load_description(name).end_effector == first


def test_elastic_constants_of_one_muscle_override_those_of_all(tmp_path):
    directory = write_robot(tmp_path, series_elastic={'force': 80.0, 'rate': 25.0})
    document = read_muscles(directory)
    document['muscles'][2]['series_elastic'] = {'force': 60.0}
    elastic = load_description(write_muscles(directory, document)).series_elastic
    expected = np.full(8, 80.0)
    expected[2] = 60.0
    np.testing.assert_array_equal(elastic.force, expected)
    np.testing.assert_array_equal(elastic.rate, np.full(8, 25.0))


def test_shipped_arms_have_the_sizes_and_names_the_paper_gives_them():
    musashi = Robot.load('musashi_left_arm')
    assert musashi.joints == (
        'shoulder_roll',
        'shoulder_pitch',
        'shoulder_yaw',
        'elbow_pitch',
        'elbow_yaw',
    )
    assert musashi.muscle_count == 10
    arm = Robot.load('arm26')
    assert (arm.joint_count, arm.muscle_count) == (2, 6)
    arms = np.abs(arm.routes.muscle_jacobian(arm.random_postures(50, np.random.default_rng(0))))
    # Two muscles are biarticular: they have a moment arm at both joints.
    assert (np.median(arms, axis=0) > 0.003).all(axis=1).sum() == 2


@pytest.mark.parametrize(
    ('old', 'new'),
    [
        ('<robot ', '<robot xmlns:x="http://ros.org/wiki/xacro" '),
        ('</robot>', '<include filename="tool.urdf"/></robot>'),
        ('<mass value="0.8"/>', '<mass value="${weight}"/>'),
        ('parent link="upper_arm"', 'parent link="$(arg side)_arm"'),
    ],
)
def test_a_urdf_that_is_still_to_be_expanded_is_refused(tmp_path, old, new):
    file = copy_robot('arm26', tmp_path) / 'robot.urdf'
    text = file.read_text().replace(old, new)
    if 'xmlns' in new:
        text = text.replace('</robot>', '<x:macro name="tool" params="parent"/></robot>')
    file.write_text(text)
    refused(tmp_path, str(file), 'expand it to a new file first:  xacro FILE')


# -- malicious and strange URDFs ------------------------------------------------------------------


def in_arm26(old, new):
    return lambda text: text.replace(old, new, 1)


def with_inertia(*moments):
    values = ' '.join(f'{k}="{v}"' for k, v in zip(('ixx', 'ixy', 'iyy', 'izz'), moments))
    return lambda text: re.sub(
        r'<inertia [^>]*>', f'<inertia {values} ixz="0" iyz="0"/>', text, count=1
    )


STRANGE = {
    'a chain of 38 000 links': (lambda _: chain(38_000), 'at most 2000'),
    'a million levels': (lambda _: '<a>' * 500_000 + '</a>' * 500_000, 'levels'),
    'entities': (lambda text: '<!DOCTYPE r [<!ENTITY a "b">]>' + text, 'DOCTYPE'),
    'a negative moment': (with_inertia(-0.01, 0, 0.01, 0.01), 'principal moments'),
    'a product too large': (with_inertia(0.01, 0.02, 0.01, 0.01), 'principal moments'),
    'an absurd moment': (with_inertia(1e300, 0, 0.01, 0.01), 'of at most'),
    'an absurd place': (in_arm26('xyz="0 0 ', 'xyz="0 1e300 '), 'of at most'),
    'an axis of no direction': (in_arm26('<axis xyz="0 1 0"', '<axis xyz="0 0 0"'), 'nonzero'),
    "pinocchio's own name": (in_arm26('<joint name="', '<joint name="universe" id="'), 'rename'),
    'an escape in a name': (in_arm26('<link name="', '<link name="\x9b1m'), 'printable'),
}


@pytest.mark.parametrize('case', STRANGE)
def test_a_malicious_or_strange_urdf_is_refused(case, tmp_path):
    edit, problem = STRANGE[case]
    file = copy_robot('arm26', tmp_path) / 'robot.urdf'
    text = file.read_text()
    assert edit(text) != text
    file.write_text(edit(text))
    with pytest.raises(RobotDescriptionError, match=problem) as error:
        load_description(file.parent)
    assert str(file) in str(error.value) and str(error.value).isprintable()


def test_the_longest_chain_that_is_read_can_be_read(tmp_path):
    file = copy_robot('arm26', tmp_path) / 'robot.urdf'
    assert read_urdf(file, chain(MOST_PARTS // 2 - 1)).nframes > MOST_PARTS // 2


def test_a_model_file_in_place_of_a_robot_directory_gets_the_way_to_import_it(tmp_path):
    model = tmp_path / 'own.xml'
    model.write_text('<mujoco/>', encoding='utf-8')
    with pytest.raises(RobotDescriptionError, match=r'is a file; .* `import_robot FILE --out DIR`'):
        Robot.load(model)
