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
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments import NAMES
from musculoskeletal_ae.nodes.declared_parameters import COMBINED, PARAMETERS, check_names

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
#: tools that every run of the tests interrupts: `train` does not use ROS, `record` does, and `view`
#: serves a page. The other tools resemble one of them, so they are `thorough` cases.
INTERRUPTED = 'record', 'train', 'view'
#: nodes, with signals and their times after the start [s]: while modules are imported, while the
#: node is constructed, and while it runs. The learner also has a process for training.
SIGNALS = [
    ('combined', signal.SIGINT, 0.3),
    ('combined', signal.SIGTERM, 0.9),
]
FURTHER_SIGNALS = [
    ('combined', signal.SIGINT, 2.0),
    ('learner', signal.SIGTERM, 2.0),
    ('combined', signal.SIGTERM, 2.0),
    ('learner', signal.SIGINT, 0.3),
    ('learner', signal.SIGTERM, 0.9),
    ('learner', signal.SIGINT, 2.0),
]


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
    """Run an executable that sends itself a signal at a time [s] after its start.

    If it ends as Python programs usually do, it prints that it is cleaned up.
    """
    timer = f'threading.Timer({moment}, os.kill, (os.getpid(), {number.value}))'
    start = f'import os, threading\ntimer = {timer}\ntimer.daemon = True\ntimer.start()\n'
    start += 'import atexit\natexit.register(print, "cleaned up")'
    return run(name, *arguments, before=start)


def test_there_is_an_executable_for_every_node_and_tool():
    assert all(callable(getattr(executables, name)) for name in (*NODES, *TOOLS))
    assert all(executable(name) for name in (*NODES, *TOOLS))


# test/nodes/test_parameters.py checks the help of the other nodes.
def test_help_loads_nothing_that_takes_long():
    # Help takes 0.1 to 0.4 s of CPU time, because no large module is imported. It must also work on
    # terminals that cannot show all letters, hence ASCII.
    program = f"""
import sys
from musculoskeletal_ae import executables
for name in {[*COMBINED, *TOOLS]}:
    sys.argv[:] = [name, '--help']
    try:
        status = getattr(executables, name)()
    except SystemExit as ended:
        status = ended.code
    print('end of', name, status, *{{'numba', 'torch', 'scipy', 'matplotlib'}} & set(sys.modules))
"""
    done = subprocess.run(
        [sys.executable, '-c', program],
        capture_output=True,
        text=True,
        env={**os.environ, 'PYTHONIOENCODING': 'ascii:strict'},
    )
    assert done.returncode == 0, done.stderr
    rest = done.stdout
    for name in (*COMBINED, *TOOLS):
        text, end, rest = rest.partition(f'end of {name} 0\n')
        assert end, rest
        assert len(text) > 300


@pytest.mark.parametrize(
    ('name', 'number', 'moment'),
    [*SIGNALS, *(pytest.param(*each, marks=pytest.mark.thorough) for each in FURTHER_SIGNALS)],
)
def test_a_signal_ends_a_node_at_once_with_status_0_at_any_moment(name, number, moment):
    done = signalled(name, number, moment, '--ros-args', '-p', 'robot:=arm26')
    output = done.stdout + done.stderr
    assert done.returncode == 0, output
    # A node does not wait until Python has collected garbage.
    unwanted = 'Traceback', 'Exception ignored', 'error', 'cleaned up'
    assert not any(word in output for word in unwanted), output


@pytest.mark.parametrize(
    'name',
    [
        pytest.param(name, marks=[] if name in INTERRUPTED else pytest.mark.thorough)
        for name in TOOLS
    ],
)
def test_ctrl_c_ends_a_tool_without_a_traceback(name, tmp_path):
    arguments = [text.format(folder=tmp_path) for text in TOOLS[name]]
    done = signalled(name, signal.SIGINT, 0.9, *arguments)
    output = done.stdout + done.stderr
    assert not any(word in output for word in ('Traceback', 'Exception ignored')), output
    # Status 0: the tool had finished before the signal. Status 1: it had ended with an error, or
    # had recorded nothing.
    assert done.returncode in (0, 1, 130), output


def test_a_home_that_cannot_be_written_is_named_and_the_advice_helps(tmp_path):
    arguments = 'record', '-o', str(tmp_path / 'bag'), '--duration', '0.1'
    refused = run(*arguments, HOME='/dev/null', ROS_HOME='', ROS_LOG_DIR='')
    assert refused.returncode == 1
    assert "'/dev/null/.ros/log'" in refused.stderr and '--ros-args' not in refused.stderr
    assert 'set ROS_LOG_DIR to a folder that can be written' in refused.stderr
    mended = run(*arguments, HOME='/dev/null', ROS_HOME='', ROS_LOG_DIR=str(tmp_path / 'log'))
    assert 'nothing was recorded' in mended.stderr and 'error' not in mended.stderr


def test_an_option_that_no_node_has_is_an_error():
    done = run('estimator', '-p', 'robot:=arm26')
    assert done.returncode == 2
    assert "'-p'" in done.stderr
    assert '--ros-args -p NAME:=VALUE' in done.stderr
    assert done.stderr.count('\n') == 1


@pytest.mark.parametrize(
    ('command', 'expected'),
    [
        ('estimator --ros-args -p robto:=arm26', "a parameter 'robto'; nearest: robot"),
        ('estimator --ros-args -p rate:=fast', 'rate'),
        ('estimator --ros-args -p rate:=', 'rate:='),
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


def test_a_parameter_of_another_node_is_refused():
    with pytest.raises(MusculoskeletalError, match='controller has'):
        check_names(['robot', 'explore'], 'estimator')


def test_what_a_terminal_cannot_show_is_replaced():
    done = run('check_robot', 'arm26', PYTHONIOENCODING='ascii:strict')
    assert done.returncode == 0, done.stderr
    assert 'arm26: sound' in done.stdout and '?' in done.stdout


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
