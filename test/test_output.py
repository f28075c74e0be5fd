# SPDX-License-Identifier: Apache-2.0
"""Every executable does its work, or ends, whatever happens to its output."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_executables import NODES, TOOLS

from musculoskeletal_ae.options import CLOSED

thorough = pytest.mark.thorough
ROOT = Path(__file__).resolve().parent.parent
EXECUTABLES = [*NODES, *TOOLS]
#: what happens to stdout (and for some to stderr), and the exit status of a tool that has done its
#: work, but whose text was not written
OUTPUTS = {
    'without stdout and stderr': ('exec "$@" >&- 2>&-', 0),
    'on a full disk': ('exec "$@" >/dev/full', 1),
    'on a full disk, with stderr': ('exec "$@" >/dev/full 2>&1', 1),
    'read by a program that has ended': ('exec "$@"', CLOSED),
}
#: tools that work without a ROS graph and without training: arguments, and a file of their result
WORK = {
    'check_robot': (['arm26'], None),
    'import_robot': (['config/arm26/robot.urdf', '--out', '{folder}/arm'], 'arm/muscles.yaml'),
    'fit_series_elastic': (['config/testbed/one_muscle.csv'], None),
    'record': (['--recover', 'bags/teaching', '-o', '{folder}/bag'], 'bag/metadata.yaml'),
    'replay': (['--check', 'bags/teaching'], None),
}
RUN = """
import sys
from musculoskeletal_ae import executables
name = sys.argv[0] = sys.argv.pop(1)
sys.exit(getattr(executables, name)())
"""
ALL_HELP = """
import json, os, sys
from musculoskeletal_ae import executables
ended = {}
for name in sys.argv[2:]:
    if not (child := os.fork()):
        sys.argv[:] = [name, '--help']
        status = 99
        try:
            status = getattr(executables, name)()
        except SystemExit as ended:
            status = ended.code
        finally:
            os._exit(status)
    ended[name] = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
with open(sys.argv[1], 'w') as file:
    json.dump(ended, file)
"""


def ended(output, *command):
    """Run a Python program with its output in one of the conditions of OUTPUTS."""
    redirect, _ = OUTPUTS[output]
    reader, writer = os.pipe()
    os.close(reader)  # so that whatever still leads to the pipe cannot be written
    try:
        return subprocess.run(
            ['bash', '-c', redirect, 'bash', sys.executable, '-c', *map(str, command)],
            stdout=writer,
            stderr=subprocess.PIPE,
            text=True,
            timeout=300,
            cwd=ROOT,
            check=False,
        )
    finally:
        os.close(writer)


# Each executable prints its help in one of the conditions; further combinations are `thorough`.
@pytest.mark.parametrize(
    ('output', 'names'),
    [
        *((output, EXECUTABLES[n :: len(OUTPUTS)]) for n, output in enumerate(OUTPUTS)),
        *(pytest.param(output, EXECUTABLES, marks=thorough) for output in OUTPUTS),
    ],
)
def test_help_of_every_executable_ends(output, names, tmp_path):
    done = ended(output, ALL_HELP, tmp_path / 'ended', *names)
    assert json.loads((tmp_path / 'ended').read_text()) == dict.fromkeys(names, 0)
    assert not done.stderr


@pytest.mark.parametrize(
    ('name', 'output'),
    [
        pytest.param(name, output, marks=[] if place == number % len(OUTPUTS) else thorough)
        for number, name in enumerate(WORK)
        for place, output in enumerate(OUTPUTS)
    ],
)
def test_a_tool_does_its_work_and_its_status_says_whether_its_text_was_written(
    name, output, tmp_path
):
    arguments, result = WORK[name]
    done = ended(output, RUN, name, *(text.format(folder=tmp_path) for text in arguments))
    assert done.returncode == OUTPUTS[output][1], done.stderr
    assert 'Traceback' not in done.stderr and 'Exception ignored' not in done.stderr
    assert ('error: the output was not written' in done.stderr) == (output == 'on a full disk')
    assert result is None or (tmp_path / result).is_file()


def test_a_file_that_is_opened_without_stdout_does_not_get_its_text(tmp_path):
    code = f"""
from musculoskeletal_ae.output import secure_output
secure_output()
file = open({str(tmp_path / 'file')!r}, 'w')
print('text for the terminal', flush=True)
"""
    ended('without stdout and stderr', code)
    assert (tmp_path / 'file').read_text() == ''
