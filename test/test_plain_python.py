# SPDX-License-Identifier: Apache-2.0
"""The package in plain Python: `pip install .` installs all dependencies; the example runs."""

import ast
import os
import subprocess
import sys
from functools import cache
from importlib import import_module
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.robot.robot import Robot

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / 'musculoskeletal_ae'
#: folders of the package, and the extra of setup.cfg that installs what they import
EXTRAS = {'view': 'view', 'experiments': 'experiments', 'importing': 'experiments'}


def imported(files):
    """Return the top-level modules that files import when they are imported."""
    names = set()
    for file in files:
        for node in ast.parse(file.read_text('utf-8')).body:
            if isinstance(node, ast.Import):
                names |= {alias.name.partition('.')[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names.add((node.module or '').partition('.')[0])
    return names - sys.stdlib_module_names - {'musculoskeletal_ae', ''}


def extra_of(file):
    """Return the extra of setup.cfg that installs the imports of a file; '' if it needs none.

    MuJoCo belongs to the extra `experiments`; the example shows that learning works without it.
    """
    return 'experiments' if 'mujoco' in imported([file]) else EXTRAS.get(file.parent.name, '')


distributions = cache(packages_distributions)  # cached, because a call takes a second


def distribution(module):
    """Return the name of the distribution that installs a module; for pinocchio it is `pin`."""
    return 'pin' if module == 'pinocchio' else distributions()[module][0].lower()


@pytest.fixture(scope='module')
def requirements():
    """Return the names of required distributions by extra; '' for those always required."""
    program = (
        'import json, sys; from distutils.core import run_setup\n'
        'from unittest import mock\n'
        'd = run_setup("setup.py", stop_after="init")\n'
        'print(json.dumps({"": d.install_requires, **d.extras_require}))'
    )
    done = subprocess.run(
        [sys.executable, '-c', f'import setuptools; {program}'],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    listed = ast.literal_eval(done.stdout.splitlines()[-1])
    return {
        extra: {each.partition('~=')[0].lower() for each in all_} for extra, all_ in listed.items()
    }


@pytest.mark.parametrize('extra', ['', 'view', 'experiments'])
def test_what_the_package_imports_is_required(requirements, extra):
    files = [
        file
        for file in PACKAGE.rglob('*.py')
        if file.parent.name != 'nodes' and extra_of(file) == extra
    ]
    needed = {distribution(module) for module in imported(files)}
    assert needed <= requirements[''] | requirements[extra]


def test_the_tests_import_only_what_the_requirements_of_the_tests_bring():
    listed = ''.join(
        (ROOT / file).read_text('utf-8')
        for file in ('requirements.txt', '.ci/requirements-test.txt', '.ci/requirements-ros.txt')
    ).lower()
    tests = ROOT / 'test'
    own = {path.stem for path in (*tests.rglob('*.py'), *(ROOT / 'doc').glob('*.py'))}
    own |= {path.name for path in tests.iterdir()} | {'bench'}
    brought = {module: distribution(module) for module in imported(tests.rglob('*.py')) - own}
    # rclpy and the message packages need no entry: a sourced Jazzy or the ROS wheels provide them.
    of_ros = ('_msgs', '_srvs', '_interfaces', 'rclpy')
    missing = {m for m, name in brought.items() if name not in listed and not m.endswith(of_ros)}
    assert missing == set()


def test_the_example_learns_without_ros(tmp_path):
    blocked = ('rclpy', 'std_msgs', 'sensor_msgs', 'geometry_msgs', 'viser', 'mujoco', 'matplotlib')
    program = (
        'import runpy, sys\n'
        f'sys.modules.update(dict.fromkeys({blocked}))\n'
        f'sys.argv[0] = {str(ROOT / "examples" / "learn_in_python.py")!r}\n'
        'runpy.run_path(sys.argv[0])'
    )
    options = ['--postures', '4', '--steps', '100', '--out', str(tmp_path / 'a.safetensors')]
    done = subprocess.run(
        [sys.executable, '-c', program, *options],
        cwd=tmp_path, capture_output=True, text=True, timeout=900, check=False,
        env={**os.environ, 'PYTHONPATH': str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    *progress, last = done.stdout.splitlines()
    before, after = (float(word) for word in last.split() if word.startswith('0.'))
    assert after < before
    assert any(line.startswith('training on the geometric model: step 0 ') for line in progress)
    assert sum(line.startswith('posture ') for line in progress) == 4  # a line for each posture
    assert (tmp_path / 'a.safetensors').exists()


def test_the_example_saves_what_it_has_learned_when_it_is_interrupted(tmp_path):
    options = ['--postures', '1000', '--steps', '100', '--out', str(tmp_path / 'a.safetensors')]
    with subprocess.Popen(
        [sys.executable, ROOT / 'examples' / 'learn_in_python.py', *options],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, 'PYTHONPATH': str(ROOT)},
    ) as example:  # fmt: skip
        assert any(line.startswith('posture 3 ') for line in example.stdout)
        example.terminate()
        _, printed = example.communicate(timeout=60)
    assert example.returncode == 130
    learned = tmp_path / 'a.interrupted.safetensors'
    assert printed.strip() == f'interrupted: {learned} has the network learned so far'
    checkpoint.load(learned, Robot.load('arm26'))
    assert not (tmp_path / 'a.safetensors').exists()


def test_bringup_and_the_recordings_are_installed_with_the_package(monkeypatch):
    import_module('setuptools')  # provides `distutils`, which Python 3.12 and later lack
    core = import_module('distutils.core')
    monkeypatch.chdir(ROOT)
    files = dict(core.run_setup('setup.py', stop_after='init').data_files)
    assert files['lib/musculoskeletal_ae'] == ['bringup.sh']
    assert files['share/musculoskeletal_ae/.ci'] == ['.ci/environment.sh', '.ci/compile.py']
    installed = {name for names in files.values() for name in names}
    recordings = {file.as_posix() for file in Path('bags').glob('*/*')}
    assert recordings and recordings <= installed
