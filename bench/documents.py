# SPDX-License-Identifier: Apache-2.0
"""Runs every command of README, tutorials and how-to guides in a fresh clone.

    python -m bench documents [PAGE …] [--keep DIR]

The commands are those of the ```sh blocks, in order, with one shell for each page. The bench
understands these marks in a page:

- `Ctrl-C ends it` in the comment of a command: the command runs in the background. It ends at the
  next marked command of the same script, or at the end of the page. The next command starts when
  `bringup.sh` has printed its first status line.
- `<!-- bench: skip REASON -->` above a block: the block is listed but not run.
- `<!-- bench: ros2 -->` above a block of doc/howto/install.md: the block builds the command `ros2`.
  If `ros2` is not installed, the block runs before the first command that needs it.

`REPOSITORY` stands for a clone of the committed state. The shell has no ROS and a separate home. A
page ends at its first command that fails; the exit status is then 1. The first page installs about
2 GB of wheels. All pages take about 20 minutes if pip has the wheels in its cache. On a busy
machine, `check_driver` correctly reports gaps in the messages of the driver.
"""

import os
import re
import shlex
import subprocess
import sys
import tempfile
from argparse import Namespace
from pathlib import Path
from typing import NamedTuple

from musculoskeletal_ae.options import Parser

ROOT = Path(__file__).resolve().parents[1]
PAGES = (
    'README.md',
    *(str(file.relative_to(ROOT)) for file in sorted(ROOT.glob('doc/tutorials/*.md'))),
    *(str(file.relative_to(ROOT)) for file in sorted(ROOT.glob('doc/howto/*.md'))),
)
#: text in the comment of a command that the bench runs in the background
BACKGROUND = 'Ctrl-C ends it'
#: variables that the commands get from the environment, besides those of pip
KEPT = ('LANG', 'ROS_DOMAIN_ID', 'GIT_CONFIG_GLOBAL', 'TMPDIR')
START_PATIENCE = 1800  # wait at most this long for the first status line, installation included [s]
#: wait at most this long for all commands of a page after the first status line [s]
COMMAND_PATIENCE = 900
#: end a `ros2` command after this time [s]; if the system has ended, the command would never end
ANSWER_PATIENCE = 300
#: keep these files that `bringup.sh` installs into a clone; remove all others that a page creates
INSTALLED = ('/.venv', '/.cache', '/build', '/install', '/log', '__pycache__', '*.egg-info')
NAME = 'musculoskeletal_ae'
INSTALL, ROS2 = 'doc/howto/install.md', 'ros2'
FUNCTIONS = f"""
exec 2>&1
declare -A running=()
stop() {{ # SCRIPT: ends the command in the background that runs this script
  local pid=${{running[$1]-}}
  [ -n "$pid" ] || return 0
  kill -INT -- -"$pid" 2>/dev/null
  wait "$pid"
  unset "running[$1]"
}}
trap 'for script in "${{!running[@]}}"; do stop "$script"; done' EXIT
ask() {{ # COMMAND: fails if the command fails, does not end, or prints a refusal
  # As the pages say, a command is repeated while the daemon of `ros2` has not discovered the topic,
  # and after 10 s if a muscle was being verified.
  local status
  for _ in 1 2 3; do
    eval "timeout {ANSWER_PATIENCE} $1" | tee answer.log
    status=${{PIPESTATUS[0]}}
    if grep -q 'being verified' answer.log; then sleep 10; continue; fi
    grep -q 'does not appear to be published yet' answer.log || break
  done
  [ "$status" = 0 ] &&
    ! grep -qE 'success(ful)?=False|[Ss]etting parameter failed' answer.log
}}
background() {{ # SCRIPT COMMAND
  stop "$1"
  local log
  log=$(mktemp)
  set -m
  eval "$2" >"$log" 2>&1 &
  running[$1]=$!
  set +m
  [[ $1 == *bringup.sh ]] || {{ sleep 5; kill -0 "${{running[$1]}}"; return; }}
  for ((second = 0; second < {START_PATIENCE}; second++)); do
    grep -q ' s  ' "$log" && {{ tail -n 1 "$log"; return 0; }}
    kill -0 "${{running[$1]}}" 2>/dev/null || break
    sleep 1
  done
  tail -n 20 "$log"
  return 1
}}
"""


class Command(NamedTuple):
    """One command of a page, and how the bench has to run it."""

    line: str
    is_background: bool
    skipped_because: str  # reason why the command is skipped; '' if it is run


def commands(page: Path) -> list[Command]:
    """Return the commands of a page in their order."""
    commands = []
    for mark, block in _blocks(page):
        reason = (
            'needed only if there is no ros2 command'
            if mark == ROS2
            else mark.removeprefix('skip ')
        )
        for command in _joined(block.splitlines()):
            line = re.sub(r'\s+#.*', '', command)
            if line:
                commands.append(Command(line, BACKGROUND in command, reason))
    return commands


def _blocks(page: Path) -> list[tuple[str, str]]:
    """Return the mark and the text of each ```sh block of a page.

    The mark is the text of the comment `<!-- bench: … -->` above the block, or '' if there is none.
    """
    pattern = r'(?:<!-- bench: (?P<mark>[^>]*?) -->\s*)?^ *```sh\n(?P<block>.*?)^ *```'
    text = page.read_text('utf-8')
    return [(m['mark'] or '', m['block']) for m in re.finditer(pattern, text, re.S | re.M)]


def _joined(lines: list[str]) -> list[str]:
    """Join lines that end in a backslash or inside quotes; drop lines that are comments."""
    joined: list[str] = []
    for line in map(str.strip, lines):
        is_open = joined and (joined[-1].endswith('\\') or joined[-1].count('"') % 2)
        if is_open:
            joined[-1] = f'{joined[-1].removesuffix(chr(92))} {line}'
        elif line and not line.startswith('#'):
            joined.append(line)
    return joined


def script(page: Path, repository: str) -> str:
    """Return a shell script that runs the commands of a page, with `repository` for REPOSITORY."""
    lines, has_ros2 = [FUNCTIONS], False
    (build_ros2,) = (block for mark, block in _blocks(ROOT / INSTALL) if mark == ROS2)
    for command in commands(page):
        line = command.line.replace('REPOSITORY', repository)
        shown = f'$ {line}' + f'   (skipped: {command.skipped_because})' * bool(
            command.skipped_because
        )
        if command.line.startswith('ros2 ') and not command.skipped_because and not has_ros2:
            lines.append(f'command -v ros2 >/dev/null || {{\n{build_ros2}}}')
            has_ros2 = True
        lines.append(f"printf '\\n[%(%H:%M:%S)T] %s\\n' -1 {shlex.quote(shown)}")
        if command.skipped_because:
            continue
        if command.is_background:
            line = f'background {shlex.quote(line.split()[0])} {shlex.quote(line)}'
        if command.line.startswith('ros2 '):
            line = f'ask {shlex.quote(line)}'
        lines += [line, 'status=$?; [ $status = 0 ] || { echo "exit status $status"; exit 1; }']
    return '\n'.join(lines)


def follow(page: str, clone: Path, home: Path, repository: Path) -> bool:
    """Follow a page: run its commands in a clone; return whether every one succeeded."""
    print(f'\n== {page}', flush=True)
    paths = os.environ['PATH'].split(os.pathsep)
    paths = [path for path in paths if not path.startswith(sys.prefix)]
    environment = {
        name: value for name, value in os.environ.items() if name in KEPT or name.startswith('PIP_')
    }
    environment |= {'HOME': str(home), 'PATH': os.pathsep.join(paths)}
    folder = clone.parent if page == 'README.md' else clone
    if not clone.exists() and folder == clone:
        subprocess.run(['git', 'clone', '-q', repository, clone], check=True)
    patience = str(START_PATIENCE + COMMAND_PATIENCE)
    with subprocess.Popen(
        ['timeout', patience, 'bash', '-c', script(ROOT / page, str(repository))],
        cwd=folder, env=environment, text=True, errors='replace',
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    ) as shell:  # fmt: skip
        for line in shell.stdout or ():
            print(line.replace(str(clone), '…').replace(str(home), '~'), end='', flush=True)
    keep = (f'--exclude={name}' for name in INSTALLED)
    subprocess.run(['git', 'clean', '-fdqx', *keep], cwd=clone, check=True)
    return shell.returncode == 0


def _parse(argv: list[str]) -> Namespace:
    parser = Parser('documents', 'Runs every command of the documents in a fresh clone.')
    parser.add_argument('pages', nargs='*', metavar='PAGE', help='documents to run (default: all)')
    parser.add_argument('--list', action='store_true', help='list the commands and run none')
    parser.add_argument(
        '--keep',
        type=Path,
        metavar='DIR',
        help='folder for the clone, which is kept (default: a temporary one)',
    )
    return parser.parse_args(argv)


def main(argv: list[str]) -> int:
    """Run the commands of the pages; return 1 if a command failed."""
    options = _parse(argv)
    pages = options.pages or PAGES
    if options.list:
        for page in pages:
            for command in commands(ROOT / page):
                note = f'   (skipped: {command.skipped_because})' if command.skipped_because else ''
                print(f'{page}: {command.line}{" &" * command.is_background}{note}')
        return 0
    with tempfile.TemporaryDirectory(prefix='documents_') as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        repository, clone, home = folder / f'{NAME}.git', folder / NAME, folder / 'home'
        home.mkdir(exist_ok=True)
        if not repository.exists():
            subprocess.run(['git', 'clone', '-q', '--bare', ROOT, repository], check=True)
        failed = [page for page in pages if not follow(page, clone, home, repository)]
    print(f'failed: {", ".join(failed)}' if failed else 'every command succeeded')
    return 1 if failed else 0
