# SPDX-License-Identifier: Apache-2.0
"""The package in plain Python: `pip install .` installs all dependencies; the example runs."""

import ast
import os
import re
import subprocess
import sys
from functools import cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, distribution
from itertools import takewhile
from pathlib import Path

import pytest

from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.robot.robot import Robot

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / 'musculoskeletal_ae'
#: folders of the package, and the extra of setup.cfg that installs what they import
EXTRAS = {'view': 'view', 'experiments': 'experiments', 'importing': 'experiments'}

ROS_FOLDERS = ('nodes', 'ros', 'ros_tools')  # the only folders that import ROS


@cache
def imported(file):
    """Return the packages whose import is at the top level of a Python file."""
    names = set()
    for node in ast.parse(file.read_text('utf-8')).body:
        if isinstance(node, ast.Import):
            names |= {alias.name.partition('.')[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add((node.module or '').partition('.')[0])
    return names - sys.stdlib_module_names - {'musculoskeletal_ae', ''}


def imported_by(files):
    """Return the packages whose import is at the top level of one of several Python files."""
    return set().union(*map(imported, files))


def extra_of(file):
    """Return the extra of setup.cfg that installs the imports of a file; '' if it needs none.

    MuJoCo belongs to the extra `experiments`; the example shows that learning works without it.
    """
    return 'experiments' if 'mujoco' in imported(file) else EXTRAS.get(file.parent.name, '')


@cache
def modules_of(name):
    """Return the packages that an installed distribution contains."""
    if name == 'pin':
        return {'pinocchio'}  # the wheel has it in a folder that `pinocchio_wheel` finds
    try:
        files = distribution(name).files or ()
    except PackageNotFoundError:  # a sourced Jazzy has other distributions
        return set()
    return {file.parts[0].partition('.')[0] for file in files}


def brought(requirements):
    """Return the packages that the required distributions contain."""
    return set().union(*(modules_of(re.split('[~<=>;]', each)[0]) for each in requirements))


@pytest.fixture(scope='module')
def described():
    """Return the distribution that setup.py describes."""
    import_module('setuptools')  # provides `distutils`, which Python 3.12 and later lack
    core = import_module('distutils.core')
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        return core.run_setup('setup.py', stop_after='init')


def test_what_the_package_imports_is_required(described):
    files = [file for file in PACKAGE.rglob('*.py') if file.parent.name not in ROS_FOLDERS]
    always = described.install_requires
    for extra, added in {'': [], **described.extras_require}.items():
        needed = imported_by(file for file in files if extra_of(file) == extra)
        assert needed <= brought([*always, *added]), extra


def test_the_tests_import_only_what_the_requirements_of_the_tests_bring():
    lines = [
        line
        for file in ('requirements.txt', '.ci/requirements-test.txt', '.ci/requirements-ros.txt')
        for line in (ROOT / file).read_text('utf-8').splitlines()
        if not line.startswith('#')
    ]
    tests = ROOT / 'test'
    own = {path.stem for path in (*tests.rglob('*.py'), *(ROOT / 'doc').glob('*.py'))}
    own |= {path.name for path in tests.iterdir()} | {'bench'}
    missing = imported_by(tests.rglob('*.py')) - own - brought(lines)
    # rclpy and the message packages need no entry: a sourced Jazzy or the ROS wheels provide them.
    of_ros = ('_msgs', '_srvs', '_interfaces', 'rclpy')
    assert {module for module in missing if not module.endswith(of_ros)} == set()


def test_the_example_learns_without_ros_and_saves_what_it_has_learned_when_it_is_interrupted(
    tmp_path,
):
    blocked = ('rclpy', 'std_msgs', 'sensor_msgs', 'geometry_msgs', 'viser', 'mujoco', 'matplotlib')
    # Both runs take place in one process, because the imports take most of the time.
    program = (
        'import runpy, sys\n'
        f'sys.modules.update(dict.fromkeys({blocked}))\n'
        'for postures, out in ("4", "a.safetensors"), ("1000", "b.safetensors"):\n'
        '    sys.argv[1:] = ["--postures", postures, "--steps", "30", "--out", out]\n'
        f'    runpy.run_path({str(ROOT / "examples" / "learn_in_python.py")!r})\n'
    )
    with subprocess.Popen(
        [sys.executable, '-c', program],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, 'PYTHONPATH': str(ROOT)},
    ) as example:  # fmt: skip
        lines = [*takewhile(lambda line: 'posture 1 of 1000' not in line, example.stdout)]
        example.terminate()
        _, printed = example.communicate(timeout=60)
    learned = tmp_path / 'b.interrupted.safetensors'
    assert example.returncode == 130, printed
    assert printed.strip() == f'interrupted: {learned.name} has the network learned so far'
    checkpoint.load(learned, Robot.load('arm26'))
    assert not (tmp_path / 'b.safetensors').exists()

    checkpoint.load(tmp_path / 'a.safetensors', Robot.load('arm26'))
    assert any(line.startswith('training on the geometric model: step 0 ') for line in lines)
    assert sum(' of 4: error ' in line for line in lines) == 4  # a line for each posture
    (errors,) = (line for line in lines if line.startswith('error in the last postures'))
    before, after = (float(word) for word in errors.split() if word.startswith('0.'))
    assert after < before


def test_bringup_and_the_recordings_are_installed_with_the_package(described, monkeypatch):
    monkeypatch.chdir(ROOT)
    files = dict(described.data_files)
    assert files['lib/musculoskeletal_ae'] == ['bringup.sh']
    sourced = re.findall(r'\. "\$repository/(\.ci/\S+)"', Path('bringup.sh').read_text('utf-8'))
    assert sourced and {*sourced, '.ci/compile.py'} == {*files['share/musculoskeletal_ae/.ci']}
    installed = {name for names in files.values() for name in names}
    recordings = {file.as_posix() for file in Path('bags').glob('*/*')}
    assert recordings and recordings <= installed
