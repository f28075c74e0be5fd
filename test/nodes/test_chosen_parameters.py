# SPDX-License-Identifier: Apache-2.0
"""bringup.sh passes to check_driver the values that the nodes get."""

import subprocess
import sys
from pathlib import Path

import pytest

COMMON = ['--ros-args', '--params-file', str(Path(__file__).parents[2] / 'config' / 'nodes.yaml')]
RATE = ['rate', 'estimator', 'controller']
ZERO = ['zero_at_start', 'estimator']


def chosen(wanted, *arguments):
    module = ['-m', 'musculoskeletal_ae.executables', 'nodes.chosen_parameters']
    command = [sys.executable, *module, *wanted]
    return subprocess.run(
        [*command, *COMMON, *arguments], capture_output=True, text=True, timeout=300, check=False
    )


@pytest.mark.parametrize(
    ('wanted', 'file', 'arguments', 'value'),
    [
        pytest.param(RATE, '', [], '100.0', id='default'),
        pytest.param(
            RATE,
            '/**:\n  ros__parameters:\n    rate: 200.0',
            ['-p', 'estimator:on_anomaly:=stop'],
            '200.0',
            id='file without final newline',
        ),
        pytest.param(
            RATE,
            'driver: {ros__parameters: {rate: 500.0}}',
            ['-p', 'sim:rate:=300.0'],
            '100.0',
            id='other nodes',
        ),
        pytest.param(
            RATE,
            'estimator: {ros__parameters: {rate: 50.0}}',
            ['-p', 'controller:rate:=250.0'],
            '250.0',
            id='different values',
        ),
        pytest.param(
            ZERO, 'estimator: {ros__parameters: {zero_at_start: on}}', [], 'true', id='on'
        ),
        pytest.param(ZERO, '/**: {ros__parameters: {zero_at_start: False}}', [], 'false', id='off'),
    ],
)
def test_the_value_that_the_nodes_get_is_chosen(tmp_path, wanted, file, arguments, value):
    (tmp_path / 'parameters.yaml').write_text(file)
    given = ['--params-file', str(tmp_path / 'parameters.yaml')] if file else []
    done = chosen(wanted, *given, *arguments)
    assert (done.stdout.strip(), done.returncode) == (value, 0), done.stderr


@pytest.mark.parametrize('arguments', [['-p', 'estimator:rate:=200'], ['--params-file', '/none']])
def test_a_wrong_argument_is_named(arguments):
    done = chosen(RATE, *arguments)
    assert done.returncode == 2 and 'Traceback' not in done.stderr
    assert 'rate' in done.stderr or '/none' in done.stderr
