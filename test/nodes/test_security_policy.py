# SPDX-License-Identifier: Apache-2.0
"""config/security_policy.xml grants exactly the rights that the running nodes use."""

import importlib.util
import os
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from graph import executable

from musculoskeletal_ae.ros.latched_values import request_topic

POLICY = Path(__file__).parents[2] / 'config' / 'security_policy.xml'
NODES = ['controller', 'estimator', 'hardware_emulator', 'learner', 'sim']


def rights(node: str, kind: str, action: str) -> set[str]:
    path = f".//profile[@node='{node}']/{kind}[@{action}='ALLOW']/*"
    return {entry.text for entry in ET.parse(POLICY).findall(path)}


def of_actions(node: str, *parts: str) -> set[str]:
    """Return the topics or services that the actions of a node consist of.

    The set is empty if control_msgs, the package of the actions, is not installed.
    """
    if importlib.util.find_spec('control_msgs') is None:
        return set()
    actions = rights(node, 'actions', 'execute')
    return {f'{action}/_action/{part}' for action in actions for part in parts}


@pytest.mark.parametrize('name', NODES)
def test_a_node_uses_exactly_the_rights_of_the_policy(graph, name, tmp_path):
    module = importlib.import_module(f'musculoskeletal_ae.nodes.{name}')
    kind = getattr(module, ''.join(word.title() for word in name.split('_')) + 'Node')
    extra = {
        'learner': {'state_directory': str(tmp_path)},
        'estimator': {'mirror_muscles': True},
        'hardware_emulator': {'sensors': ['joints', 'imu:forearm']},
    }
    node = graph.host(kind, robot='arm26', **extra.get(name, {}))
    private = f'{graph.namespace}/{name}/'

    def names(entries):
        return {
            entry.replace(private, '~/').replace(f'{graph.namespace}/', '') for entry, _ in entries
        }

    own = name, graph.namespace
    used = names(node.get_publisher_names_and_types_by_node(*own))
    allowed = {topic.replace(f'{name}/', '~/') for topic in rights(name, 'topics', 'publish')}
    allowed |= of_actions(name, 'feedback', 'status')
    # A node requests a latched value again only after a second node has published its topic.
    assert {topic for topic in allowed if not topic.endswith(request_topic(''))} <= used <= allowed
    used = names(node.get_subscriber_names_and_types_by_node(*own))
    allowed = {topic.replace(f'{name}/', '~/') for topic in rights(name, 'topics', 'subscribe')}
    # A node subscribes to /clock only with use_sim_time, to vision_joint_states only if a camera is
    # the source of joint angles, and to /diagnostics once the graph has had a node of the same name
    assert allowed - {'/clock', 'vision_joint_states', '/diagnostics'} <= used <= allowed
    used = names(node.get_service_names_and_types_by_node(*own))
    of_goals = of_actions(name, 'cancel_goal', 'get_result', 'send_goal')
    assert used == rights(name, 'services', 'reply') | of_goals
    used = names(node.get_client_names_and_types_by_node(*own))
    assert used == rights(name, 'services', 'request')


def test_commands_checkpoints_and_targets_have_one_source():
    for topic, source in (
        ('muscle_length_command', 'controller'),
        ('muscle_tension_command', 'controller'),
        ('mae_checkpoint', 'learner'),
        ('accepted_checkpoint', 'estimator'),
        ('rejected_checkpoint', 'estimator'),
        ('target_joint_states', 'operator'),
        ('joint_trajectory', 'operator'),
        ('target_pose', 'operator'),
        ('target_twist', 'operator'),
    ):
        allowed = [n for n in (*NODES, 'operator') if topic in rights(n, 'topics', 'publish')]
        assert allowed == [source]


@pytest.mark.parametrize(
    'command',
    [['bringup_status'], pytest.param(['record', '/nowhere/bag'], marks=pytest.mark.thorough)],
)
def test_security_without_keys_says_what_to_set(command):
    environment = {**os.environ, 'ROS_SECURITY_ENABLE': 'true', 'ROS_SECURITY_STRATEGY': 'Enforce'}
    environment.pop('ROS_SECURITY_KEYSTORE', None)
    done = subprocess.run(
        [*executable(command[0]), *command[1:]],
        env=environment, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode in (1, 2)
    assert 'set ROS_SECURITY_KEYSTORE' in done.stderr and 'error not set' not in done.stderr
