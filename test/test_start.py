# SPDX-License-Identifier: Apache-2.0
"""Every executable: help at once, no traceback on Ctrl-C, no option that is silently ignored."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from graph import Process, executable

from musculoskeletal_ae.experiments import NAMES
from musculoskeletal_ae.nodes.parameters import PARAMETERS

ROOT = Path(__file__).resolve().parent.parent
LISTS = re.findall(r"^\w+ = (\['.*'\])$", (ROOT / 'setup.py').read_text('utf-8'), re.M)
EXECUTABLES = [name for text in LISTS for name in re.findall(r"'(\w+)'", text)]
ARGUMENTS = {
    'check_robot': ['arm26'],
    'experiment': ['all', '--quick', '--robot', 'arm26', '--out', '{folder}/results'],
    'fit_series_elastic': ['config/testbed/one_muscle.csv'],
    'import_robot': ['config/arm26/robot.urdf', '--out', '{folder}/arm'],
    'record': ['-o', '{folder}/bag'],
    'render': ['--out', '{folder}/arm.png'],
    'replay': ['bags/rupture'],
    'train': ['--robot', 'arm26', '--out', '{folder}/mae.safetensors'],
}


def python(code, *arguments):
    """Run a program as an executable does, without what setuptools puts before it."""
    return subprocess.run(
        [
            sys.executable,
            '-c',
            f'import sys\nfrom musculoskeletal_ae import start\n{code}',
            *arguments,
        ],
        capture_output=True,
        text=True,
        timeout=300,
        cwd=ROOT,
    )


def test_there_are_executables():
    assert {*PARAMETERS, 'check_driver', 'train', 'experiment'} <= set(EXECUTABLES)


@pytest.mark.parametrize('name', EXECUTABLES)
def test_help_loads_nothing_that_takes_long(name):
    # All of them together take 0.1 to 0.4 s of CPU.
    heavy = "{'numba', 'torch', 'scipy', 'matplotlib'} & set(sys.modules)"
    done = python(
        f'import atexit\natexit.register(lambda: print("heavy", *{heavy}))\n'
        f'sys.argv = [{name!r}, "--help"]\nsys.exit(start.main())'
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == 'heavy'
    assert len(done.stdout) > 300


def test_who_simulates_loads_no_scipy_for_numba_and_may_load_it_later():
    done = python(
        'from musculoskeletal_ae.emulator.arm import EmulatedArm\n'
        'from musculoskeletal_ae.robot.robot import Robot\n'
        'EmulatedArm(Robot.load("arm26"), 0).step(0.001)\n'
        'print("loaded", *{"coverage", "scipy.linalg"} & set(sys.modules))\n'
        'import scipy.linalg.cython_blas'
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == 'loaded'


@pytest.mark.parametrize('name', EXECUTABLES)
@pytest.mark.parametrize('after', [0.05, 1.0])
def test_ctrl_c_shows_no_traceback(name, after, tmp_path):
    given = [text.format(folder=tmp_path) for text in ARGUMENTS.get(name, [])]
    done = python(
        'import os, signal, threading\n'
        f'timer = threading.Timer({after}, os.kill, (os.getpid(), signal.SIGINT))\n'
        f'timer.daemon = True\nsys.argv[0] = {name!r}\ntimer.start()\nsys.exit(start.main())',
        *given,
    )
    told = done.stdout + done.stderr
    assert 'Traceback' not in told and 'Exception ignored' not in told, told
    assert done.returncode in (0, 1, 130), told


@pytest.mark.parametrize('after', [0.0, 0.02, 0.05, 0.1])
def test_ctrl_c_shows_no_traceback_before_python_comes_to_the_first_line(after):
    file = Path(executable('estimator')[1])
    if '--block-signal' not in file.read_text('utf-8').splitlines()[0]:
        pytest.skip('this `env` cannot hold a signal back')
    # What a shell puts into the background ignores Ctrl-C; this is to behave as in the foreground.
    in_front = ['env', '--default-signal=INT', str(file)]
    process = Process('estimator', in_front)
    time.sleep(after)
    status, output = process.end(signal.SIGINT)
    assert 'Traceback' not in output
    assert status in (130, 0, -signal.SIGINT)  # the last: `env` itself


@pytest.mark.parametrize(
    'arguments', [['-p', 'robot:=arm26'], ['--fast'], ['arm26'], ['robot:=arm26']]
)
def test_an_option_that_no_node_has_is_an_error(arguments):
    done = subprocess.run(
        [*executable('estimator'), *arguments], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2
    assert repr(arguments[0]) in done.stderr
    assert '--ros-args -p NAME:=VALUE' in done.stderr
    assert done.stderr.count('\n') == 1


@pytest.mark.parametrize(
    ('command', 'told'),
    [
        ('estimator --ros-args -p robto:=arm26', "a parameter 'robto'; nearest: robot"),
        ('estimator --ros-args -p estimator:robto:=arm26', 'nearest: robot'),
        ('estimator --ros-args -p explore:=true', 'controller has'),
        ('replay bag --ros-args -p out:=arm.png', 'options of replay stand before --ros-args'),
    ],
)
def test_a_parameter_that_nothing_reads_is_an_error(command, told):
    name, *arguments = command.split()
    done = subprocess.run(
        [*executable(name), *arguments], capture_output=True, text=True, timeout=60
    )
    assert done.returncode in (1, 2)
    assert told in done.stderr and done.stderr.count('\n') == 1


def test_a_file_of_parameters_for_all_nodes_may_name_no_unknown_one(tmp_path):
    file = tmp_path / 'nodes.yaml'
    file.write_text('/**: {ros__parameters: {explore: true, temprature_limit: 50.0}}')
    command = [*executable('estimator'), '--ros-args', '--params-file', str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1
    assert "'temprature_limit'; nearest: temperature_limit" in done.stderr


def test_the_experiments_are_those_that_the_help_names():
    from musculoskeletal_ae.experiments.runner import EXPERIMENTS

    assert tuple(EXPERIMENTS) == NAMES


@pytest.mark.skipif(os.getuid() != 0, reason='only root can be somebody else')
def test_a_checkout_of_somebody_else_is_told_apart(tmp_path):
    clone = tmp_path / 'clone'
    (clone / '.ci').mkdir(parents=True)
    for name in ('.ci/environment.sh', 'requirements.txt'):
        (clone / name).write_bytes((ROOT / name).read_bytes())
    for folder in (*tmp_path.parents, tmp_path, clone, clone / '.ci'):
        if str(folder).startswith('/tmp/'):
            folder.chmod(0o755)
    script = f'set -u; repository={clone}; . {clone}/.ci/environment.sh; environment_setup'
    done = subprocess.run(
        ['setpriv', '--reuid', '65534', '--clear-groups', 'bash', '-c', script],
        capture_output=True,
        text=True,
        env={**os.environ, 'HOME': '/nonexistent'},
    )
    assert done.returncode == 1
    assert f'{clone} belongs to root' in done.stderr
    assert 'unbound' not in done.stderr
