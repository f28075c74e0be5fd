# SPDX-License-Identifier: Apache-2.0
"""The table of parameters, and the declarations and pages that follow from it."""

import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from rclpy.exceptions import InvalidParameterValueException
from rclpy.parameter import Parameter as RosParameter
from robots import write_robot

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.nodes.controller import ControllerNode
from musculoskeletal_ae.nodes.declared_parameters import PARAMETERS, yaml_text
from musculoskeletal_ae.nodes.estimator import EstimatorNode
from musculoskeletal_ae.nodes.hardware_emulator import HardwareEmulatorNode
from musculoskeletal_ae.nodes.learner import LearnerNode
from musculoskeletal_ae.nodes.node_parameters import NodeParameters
from musculoskeletal_ae.nodes.sim import SimNode
from musculoskeletal_ae.parameters import Parameter

FILE = Path(__file__).resolve().parents[2] / 'config' / 'nodes.yaml'
NUMBERS = Parameter((0.0,), 'numbers')


def test_the_file_of_parameters_is_the_one_that_the_table_makes():
    assert FILE.read_text(encoding='utf-8') == yaml_text(), 'run: python doc/make.py'


@pytest.mark.parametrize('node', PARAMETERS)
def test_the_file_holds_every_parameter_of_every_node_with_its_default(node):
    # All nodes read this file, so a parameter must have the same default in all nodes that have it.
    held = yaml.safe_load(yaml_text())['/**']['ros__parameters']
    for name, parameter in PARAMETERS[node].items():
        default = parameter.default
        assert held[name] == (list(default) if isinstance(default, tuple) else default)


@pytest.mark.parametrize('node', PARAMETERS)
def test_help_tells_every_parameter_and_loads_nothing_heavy(node):
    code = f"""
import sys
sys.argv[1:] = ['--help']
from musculoskeletal_ae import executables
executables.{node}()
heavy = {{'matplotlib', 'numba', 'pinocchio', 'scipy', 'torch'}}
print('loaded', *sorted(heavy & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[-1] == 'loaded'
    assert lines[0].startswith(f'The node `{node}`: ')
    for name, parameter in PARAMETERS[node].items():
        matching = [line for line in lines if f' {name} (default: ' in line]
        assert len(matching) == 1
        assert matching[0].startswith(' *') is parameter.settable
        below = lines[lines.index(matching[0]) + 1]
        assert parameter.meaning in below and parameter.unit in below
        assert all(word in below for word in parameter.legal)
        if parameter.within:
            assert parameter.legal_values in below


@pytest.mark.parametrize('node', PARAMETERS)
def test_every_number_has_a_range_in_which_its_default_is(node):
    for name, parameter in PARAMETERS[node].items():
        default = parameter.default
        numbers = default if parameter.is_number_list else (default,)
        if all(isinstance(n, int | float) and not isinstance(n, bool) for n in numbers):
            assert parameter.within is not None, name
            low, high = parameter.within
            assert all(low <= number <= high for number in numbers), name


@pytest.mark.parametrize(
    'kind', [ControllerNode, EstimatorNode, HardwareEmulatorNode, LearnerNode, SimNode]
)
def test_every_parameter_that_is_settable_is_followed(graph, kind, monkeypatch):
    followed, on_change = set(), NodeParameters.on_change

    def noting(parameters, name, *setters):
        followed.add(name)
        on_change(parameters, name, *setters)

    monkeypatch.setattr(NodeParameters, 'on_change', noting)
    node = graph.host(kind, robot='arm26')
    settable = {name for name, p in PARAMETERS[node.get_name()].items() if p.settable}
    # No callback follows stop_recordings: the controller reads it at every stop.
    assert settable - {'stop_recordings'} == followed


@pytest.mark.parametrize(
    ('kind', 'name', 'value'),
    [
        (ControllerNode, 'joint_stiffness', [-1.0, -1.0]),
        (ControllerNode, 'max_age', float('nan')),
        (HardwareEmulatorNode, 'faults', ['melt']),
    ],
)
def test_a_value_that_is_not_legal_is_refused_at_the_start(graph, kind, name, value):
    with pytest.raises((MusculoskeletalError, InvalidParameterValueException), match=name):
        graph.host(kind, robot='arm26', **{name: value})


@pytest.mark.parametrize(
    ('kind', 'name'), [(HardwareEmulatorNode, 'faults'), (ControllerNode, 'joint_stiffness')]
)
def test_an_empty_list_at_the_start_is_an_empty_list(graph, kind, name, tmp_path):
    file = tmp_path / 'nodes.yaml'
    file.write_text(f'/**:\n  ros__parameters:\n    {name}: []\n')
    options = ['--ros-args', '--params-file', str(file), '-p', 'robot:=arm26']
    node = kind(context=graph.context, use_global_arguments=False, cli_args=options)
    try:
        assert node.parameter(name) == ()
    finally:
        node.destroy_node()


def test_an_arm_of_one_joint_may_stand_at_0_to_find_its_zeros(graph, tmp_path):
    robot = str(write_robot(tmp_path, joints=['swing']))
    assert graph.host(EstimatorNode, robot=robot).parameter('zero_posture') == ()
    graph.end(graph.hosted[0])
    node = graph.host(EstimatorNode, robot=robot, zero_posture=[0.0])
    assert node.parameter('zero_posture') == (0.0,)


@pytest.mark.parametrize(
    ('kind', 'parameters', 'kept'),
    [
        (
            EstimatorNode,
            {'on_anomaly': 'isolate', 'isolate_muscles': ['tail']},
            lambda node: node.core.suspects.isolates,
        ),
        # Setting `checkpoint` would replace the network in use, which may have learned much.
        (
            EstimatorNode,
            {'checkpoint': '', 'isolate_muscles': ['tail']},
            lambda node: id(node.core.mae),
        ),
        # Setting `method` would end the exploration.
        (
            ControllerNode,
            {'method': 'float', 'joint_stiffness': [1.0]},
            lambda node: node.core.supervisor.explores,
        ),
    ],
)
def test_of_parameters_set_together_none_is_taken_if_one_is_refused(
    graph, trained_file, kind, parameters, kept
):
    required = {'checkpoint': trained_file} if 'checkpoint' in parameters else {}
    node = graph.host(
        kind, robot='arm26', **required, **{'explore': True} if kind is ControllerNode else {}
    )
    before = kept(node)
    one, other = (
        RosParameter(name, value=value) for name, value in (parameters | required).items()
    )
    result = node.set_parameters_atomically([one, other])
    assert not result.successful and result.reason.startswith(f'parameter {other.name}: ')
    assert kept(node) == before
    assert node.set_parameters_atomically([one]).successful
    assert kept(node) != before


def test_a_word_that_is_not_legal_is_refused_with_those_that_are():
    with pytest.raises(MusculoskeletalError, match="'other'; legal: one, two"):
        Parameter('one', 'a word', legal=('one', 'two')).checked('other')


@pytest.mark.parametrize(
    ('parameter', 'wrong'),
    [
        (Parameter(1.0, 'a number', 'm', (0.0, 2.0)), [2.5, -0.1, float('nan'), '1', True, None]),
        (Parameter(1, 'a count', '', (0, 2)), [3, 1.5, '1', True]),
        (Parameter(True, 'a switch'), [1, 'true', None]),
        (Parameter('', 'a text'), [1, None, ['text']]),
        (Parameter(('',), 'names'), ['name', [1], None]),
    ],
)
def test_a_value_of_the_wrong_kind_or_out_of_range_is_refused_without_ros(parameter, wrong):
    for value in wrong:
        with pytest.raises(MusculoskeletalError, match='; legal: '):
            parameter.checked(value)
    assert parameter.checked(parameter.default) is not None


def test_empty_names_are_no_names():
    assert Parameter(('',), 'names').checked(['', 'biceps', '']) == ('biceps',)


def test_an_empty_list_of_numbers_is_the_byte_array_that_ros_makes_of_it():
    assert NUMBERS.checked([]) == NUMBERS.checked(b'') == ()
    assert NUMBERS.checked([1, 2.5]) == (1.0, 2.5)


@pytest.mark.parametrize(
    'value',
    [None, 3.0, '11', b'\x01', ['word'], [True], [float('nan')], [float('inf')]],
)
def test_what_is_no_list_of_finite_numbers_is_refused(value):
    with pytest.raises(MusculoskeletalError, match='finite numbers'):
        NUMBERS.checked(value)
