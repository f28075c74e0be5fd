# SPDX-License-Identifier: Apache-2.0
"""motors.yaml, the part of a robot directory that connects the motors of a ros2_control robot."""

import numpy as np
import pytest
import yaml
from robots import arm_with_motors

from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.robot.description import load_description
from musculoskeletal_ae.robot.motors import NO_MOTORS, MotorTopics, motor_topics, read_motors

MUSCLES = 'flexor', 'extensor', 'abductor'
CONTENT = {
    'state_topic': '/joint_states',
    'command_topic': 'tendons/commands',
    'command_order': ['m2', 'extensor', 'm0'],
    'spool_radius': 0.01,
    'direction': -1,
    'motors': {
        'flexor': {'joint': 'm0', 'zero': 1.0, 'effort_zero': 0.1},
        'abductor': {'joint': 'm2', 'spool_radius': 0.02, 'tension_per_effort': -50},
    },
}


def read(folder, content):
    (folder / 'motors.yaml').write_text(yaml.safe_dump(content), encoding='utf-8')
    return read_motors(folder, MUSCLES)


def test_a_motor_has_its_own_values_otherwise_those_of_the_file_otherwise_the_defaults(tmp_path):
    motors = read(tmp_path, CONTENT)
    assert motors.topics == MotorTopics('/joint_states', 'tendons/commands')
    assert motors.joints == ('m0', 'extensor', 'm2')
    assert motors.command_order == ('m2', 'extensor', 'm0')
    np.testing.assert_array_equal(motors.spool_radius, [0.01, 0.01, 0.02])
    np.testing.assert_array_equal(motors.direction, [-1.0, -1.0, -1.0])
    np.testing.assert_array_equal(motors.zero, [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(motors.tension_per_effort, [1.0, 1.0, -50.0])
    np.testing.assert_array_equal(motors.effort_zero, [0.1, 0.0, 0.0])


def test_with_a_topic_alone_positions_are_lengths_and_efforts_are_tensions(tmp_path):
    motors = read(tmp_path, {'state_topic': 'joint_states'})
    assert motors.joints == motors.command_order == MUSCLES
    assert motors.topics.commands == ''
    for values in (motors.spool_radius, motors.direction, motors.tension_per_effort):
        np.testing.assert_array_equal(values, np.ones(3))
    np.testing.assert_array_equal([motors.zero, motors.effort_zero], np.zeros((2, 3)))


@pytest.mark.parametrize(
    ('changes', 'problem'),
    [
        ({'state_topic': None}, r'\$.state_topic: expected str, got null'),
        ({'state_topic': 'joint states'}, "'joint states' is no name of a topic; legal: words"),
        ({'command_topic': '/a//b'}, "command_topic: '/a//b' is no name of a topic"),
        ({'spool_radiu': 0.01}, "unknown key 'spool_radiu'; legal keys: .*spool_radius"),
        ({'spool_radius': 0.0}, r'\$.spool_radius: expected float >= 0.0001'),
        ({'direction': 0.5}, 'direction: expected 1 or -1, got 0.5'),
        ({'tension_per_effort': 0}, 'tension_per_effort: expected a number other than 0'),
        ({'motors': {'tail': {}}}, "unknown muscle 'tail'; legal: flexor, extensor, abductor"),
        ({'motors': {'flexor': {'joint': 'extensor'}}}, "'extensor' winds two muscles"),
        (
            {'command_order': ['m0', 'm2']},
            "command_order: 'extensor' is missing, unknown or repeated; expected each of m0",
        ),
        ({'command_order': ['m0', 'm2', 'x']}, 'command_order: '),
        ({'command_order': ['m0', 'm2', 'extensor', 'm0']}, "command_order: 'm0'"),
    ],
)
def test_a_wrong_file_is_refused_with_the_entry_and_the_legal_values(tmp_path, changes, problem):
    with pytest.raises(RobotDescriptionError, match=problem) as error:
        read(tmp_path, CONTENT | changes)
    assert str(tmp_path / 'motors.yaml') in str(error.value)
    assert 'doc/howto/ros2_control.md' in str(error.value)


def test_a_file_without_a_mapping_is_refused(tmp_path):
    (tmp_path / 'motors.yaml').write_text('just a text')
    with pytest.raises(RobotDescriptionError, match='expected object, got str'):
        read_motors(tmp_path, MUSCLES)


def test_the_description_of_a_robot_has_its_motors_and_a_robot_with_a_driver_has_none(tmp_path):
    directory = arm_with_motors(tmp_path, state_topic='joint_states')
    description = load_description(directory)
    assert description.motors.joints == description.muscles
    assert any('states on joint_states, commands on no topic' in n for n in description.notes)
    assert motor_topics(directory) == description.motor_topics == MotorTopics('joint_states')
    assert load_description('arm26').motors is None
    assert motor_topics('arm26') == load_description('arm26').motor_topics == NO_MOTORS
