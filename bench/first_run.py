# SPDX-License-Identifier: Apache-2.0
"""From nothing to an arm that learns: every command of doc/howto/your_robot.md, in a clean clone.

python -m bench first_run > doc/results/door/first_run.txt

The commands are those of the guide, in its order and in one shell without ROS or a home. The driver
is put into the background, and what would run until Ctrl-C is given a --duration. Only what is
committed is cloned. Ten minutes and 2 GB of wheels.
"""

import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

from musculoskeletal_ae.options import Parser

ROOT = Path(__file__).resolve().parents[1]
GUIDE = 'doc/howto/your_robot.md'
LEARNING, LOOKING = 90, 5  # [s] of bringup.sh with --explore, and without
LEARNED = 0.05  # [rad] that the error is below at the end
KEPT = ('LANG', 'ROS_DOMAIN_ID', 'PIP_CACHE_DIR', 'PIP_INDEX_URL', 'TMPDIR')


def commands() -> list[str]:
    """Return the guide's commands as they are run."""
    blocks = re.findall(r'```sh\n(.*?)```', (ROOT / GUIDE).read_text(encoding='utf-8'), re.S)
    lines = [line.partition(' #')[0].strip() for block in blocks for line in block.splitlines()]
    run = []
    for line in filter(None, lines):
        if line.startswith('./bringup.sh') and '--duration' not in line:
            line += f' --duration {LEARNING if "--explore" in line else LOOKING}'
        run.append(f'{line} &' if line.startswith('python ') else line)
    return run


def main(argv: list[str]) -> int:
    """Follow the guide; exit status 1 if a command fails or the arm does not learn."""
    Parser('first_run', 'From nothing to an arm that learns, by the guide.').parse_args(argv)
    with tempfile.TemporaryDirectory(prefix='first_run_') as folder:
        clone, home = Path(folder) / 'clone', Path(folder) / 'home'
        home.mkdir()
        subprocess.run(['git', 'clone', '-q', ROOT, clone], check=True)
        script = ["trap 'kill $(jobs -p); wait' EXIT", 'bad=0']
        for line in commands():
            script += [
                f"printf '\\n[%(%H:%M:%S)T] $ %s\\n' -1 {shlex.quote(line)}",
                line,
                'status=$?; printf "(exit status %s)\\n" $status; [ $status = 0 ] || bad=1',
            ]
        paths = os.environ['PATH'].split(os.pathsep)
        paths = [path for path in paths if not path.startswith(sys.prefix)]
        environment = {name: os.environ[name] for name in KEPT if name in os.environ}
        environment |= {'HOME': str(home), 'PATH': os.pathsep.join(paths)}
        shell = subprocess.Popen(
            ['bash', '-c', '\n'.join([*script, 'exit $bad'])],
            cwd=clone, env=environment, text=True,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        error = float('inf')
        for line in shell.stdout or ():
            print(line.replace(str(clone), '…').replace(str(home), '~'), end='', flush=True)
            if found := re.search(r' s  error ([\d.]+) rad', line):
                error = float(found[1])
        failed = shell.wait()
    print(f'\nlast error {error} rad, at most {LEARNED} is wanted')
    return 1 if failed or not error < LEARNED else 0
