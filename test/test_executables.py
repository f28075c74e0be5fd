# SPDX-License-Identifier: Apache-2.0
"""Every executable: fast help, a clean end by Ctrl-C and SIGTERM, and no ignored option."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from graph import executable

from musculoskeletal_ae import executables
from musculoskeletal_ae.experiments import NAMES
from musculoskeletal_ae.nodes.parameters import COMBINED, PARAMETERS

ROOT = Path(__file__).resolve().parent.parent
NODES = [*PARAMETERS, *COMBINED]
TOOLS = {
    'check_driver': ['--robot', 'arm26'],
    'check_robot': ['arm26'],
    'experiment': ['all', '--quick', '--robot', 'arm26', '--out', '{folder}/results'],
    'export_mjcf': ['none.safetensors', '--robot', 'arm26', '--out', '{folder}/model'],
    'fit_series_elastic': ['config/testbed/one_muscle.csv'],
    'import_robot': ['config/arm26/robot.urdf', '--out', '{folder}/arm'],
    'record': ['-o', '{folder}/bag'],
    'render': ['--out', '{folder}/arm.png'],
    'replay': ['bags/rupture'],
    'train': ['--robot', 'arm26', '--out', '{folder}/mae.safetensors'],
    'view': ['--robot', 'arm26', '--port', '8765'],
}
#: signals, and their times after the start [s]: while modules are imported, while a node is
#: constructed, and while it runs
MOMENTS = [(signal.SIGINT, 0.3), (signal.SIGTERM, 0.9), (signal.SIGINT, 2.0), (signal.SIGTERM, 2.0)]


def run(name, *arguments, before='', **environment):
    """Run an executable in another process, after the Python statements `before`."""
    code = (
        f'import sys\nfrom musculoskeletal_ae import executables\n'
        f'sys.argv[0] = {name!r}\n{before}\nsys.exit(executables.{name}())'
    )
    return subprocess.run(
        [sys.executable, '-c', code, *arguments],
        capture_output=True,
        text=True,
        errors='replace',
        timeout=300,
        cwd=ROOT,
        env={**os.environ, **environment},
    )


def signalled(name, number, moment, *arguments):
    """Run an executable that sends itself a signal at a time [s] after its start."""
    timer = f'threading.Timer({moment}, os.kill, (os.getpid(), {number.value}))'
    start = f'import os, threading\ntimer = {timer}\ntimer.daemon = True\ntimer.start()'
    return run(name, *arguments, before=start)


def test_there_is_an_executable_for_every_node_and_tool():
    assert all(callable(getattr(executables, name)) for name in (*NODES, *TOOLS))
    assert all(executable(name) for name in (*NODES, *TOOLS))


# test/nodes/test_parameters.py checks the help of the other nodes.
@pytest.mark.parametrize('name', [*COMBINED, *TOOLS])
def test_help_loads_nothing_that_takes_long(name):
    # Help takes 0.1 to 0.4 s of CPU time, because no large module is imported. It must also work on
    # terminals that cannot show all letters, hence ASCII.
    heavy = "{'numba', 'torch', 'scipy', 'matplotlib'} & set(sys.modules)"
    done = run(
        name,
        '--help',
        before=f'import atexit\natexit.register(lambda: print("heavy", *{heavy}))',
        PYTHONIOENCODING='ascii:strict',
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == 'heavy'
    assert len(done.stdout) > 300


@pytest.mark.parametrize(('number', 'moment'), MOMENTS)
@pytest.mark.parametrize('name', ['combined', 'learner'])
def test_a_signal_ends_a_node_with_status_0_at_any_moment(name, moment, number):
    done = signalled(name, number, moment, '--ros-args', '-p', 'robot:=arm26')
    output = done.stdout + done.stderr
    assert done.returncode == 0, output
    assert not any(word in output for word in ('Traceback', 'Exception ignored', 'error')), output


@pytest.mark.parametrize('name', TOOLS)
def test_ctrl_c_ends_a_tool_without_a_traceback(name, tmp_path):
    arguments = [text.format(folder=tmp_path) for text in TOOLS[name]]
    done = signalled(name, signal.SIGINT, 0.9, *arguments)
    output = done.stdout + done.stderr
    assert not any(word in output for word in ('Traceback', 'Exception ignored')), output
    # Status 0: the tool had finished before the signal. Status 1: it had ended with an error, or
    # had recorded nothing.
    assert done.returncode in (0, 1, 130), output


@pytest.mark.parametrize('arguments', [['-p', 'robot:=arm26'], ['robot:=arm26']])
def test_an_option_that_no_node_has_is_an_error(arguments):
    done = run('estimator', *arguments)
    assert done.returncode == 2
    assert repr(arguments[0]) in done.stderr
    assert '--ros-args -p NAME:=VALUE' in done.stderr
    assert done.stderr.count('\n') == 1


@pytest.mark.parametrize(
    ('command', 'expected'),
    [
        ('estimator --ros-args -p robto:=arm26', "a parameter 'robto'; nearest: robot"),
        ('estimator --ros-args -p explore:=true', 'controller has'),
        ('estimator --ros-args -p rate:=fast', 'rate'),
        ('estimator --ros-args -p rate:=', 'rate:='),
        ('estimator --ros-args -p robot:=nowhere', "'nowhere'"),
        ('replay bag --ros-args -p out:=arm.png', 'put options of replay before --ros-args'),
    ],
)
def test_a_parameter_that_cannot_be_used_is_one_line(command, expected):
    name, *arguments = command.split()
    done = run(name, *arguments)
    assert done.returncode in (1, 2)
    assert expected in done.stderr and done.stderr.count('\n') == 1


def test_a_file_of_parameters_for_all_nodes_may_name_no_unknown_one(tmp_path):
    file = tmp_path / 'nodes.yaml'
    file.write_text('/**: {ros__parameters: {explore: true, temprature_limit: 50.0}}')
    done = run('estimator', '--ros-args', '--params-file', str(file))
    assert done.returncode == 1
    assert "'temprature_limit'; nearest: temperature_limit" in done.stderr


def test_a_node_that_has_ended_does_not_wait_for_python_to_collect_garbage():
    clean_up = 'import atexit; atexit.register(print, "cleaned up")'
    start = f'import os, signal, threading\n{clean_up}\n'
    start += 'timer = threading.Timer(2.0, os.kill, (os.getpid(), signal.SIGTERM))\ntimer.start()'
    done = run('sim', before=start)
    assert done.returncode == 0, done.stderr
    assert 'cleaned up' not in done.stdout


@pytest.mark.parametrize('encoding', ['iso-8859-1', 'ascii'])
def test_what_a_terminal_cannot_show_is_replaced(encoding):
    done = run('check_robot', 'arm26', PYTHONIOENCODING=f'{encoding}:strict')
    assert done.returncode == 0, done.stderr
    assert 'arm26: sound' in done.stdout
    assert ('?' in done.stdout) == (encoding == 'ascii')  # only ASCII lacks some of the letters


def test_the_experiments_are_those_that_the_help_names():
    from musculoskeletal_ae.experiments.runner import EXPERIMENTS

    assert tuple(EXPERIMENTS) == NAMES


@pytest.mark.skipif(os.getuid() != 0, reason='only root can run a process as another user')
def test_a_checkout_of_another_user_is_reported(tmp_path):
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
    assert f'{clone} cannot be written: it belongs to root' in done.stderr
    assert 'unbound' not in done.stderr
