# SPDX-License-Identifier: Apache-2.0
"""Command lines of all tools: the parser, the arguments they share, and their exit status.

A tool adds only its own arguments (see `tools/import_robot.py`). An invalid option prints one line
with the option, the value and the legal values, and ends with status 2. `parser.error` does the
same for combinations of options. An error of this package, such as an unusable robot or file,
prints one line and ends with status 1.
"""

import argparse
import errno
import math
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.output import output_problem
from musculoskeletal_ae.presets.preset import DEFAULT, PRESET_NAMES
from musculoskeletal_ae.process_signals import INTERRUPTED
from musculoskeletal_ae.robot.directories import shipped_robots

DEFAULT_ROBOT = 'musashi_left_arm'  # robot that a command uses without --robot
DEFAULT_SEED = 0  # random seed that a command uses without --seed
#: exit status after the reader of the output has closed it, the same as for other tools: 128 +
#: SIGPIPE
CLOSED = 141
PICTURES = ('.png', '.svg', '.pdf', '.jpg')
CHAIN = 'joints', 'muscles', 'without', 'base', 'end'  # options that `Parser.add_chain` adds
T = TypeVar('T')


def _type(
    convert: Callable[[str], T], is_legal: Callable[[T], bool], expected: str
) -> Callable[[str], T]:
    """Return an argparse type that converts a text and rejects values that are not legal.

    The message for a rejected value names the legal values in `expected`.
    """

    def checked(text: str) -> T:
        with suppress(ValueError):
            if is_legal(value := convert(text)):
                return value
        raise argparse.ArgumentTypeError(f'{text!r}: expected {expected}')

    return checked


def whole(low: int, high: int) -> Callable[[str], int]:
    """Return an argparse type that accepts whole numbers from `low` to `high`."""
    return _type(int, lambda value: low <= value <= high, f'{low} to {high}')


def number(low: float, high: float) -> Callable[[str], float]:
    """Return an argparse type that accepts numbers from `low` to `high`."""
    return _type(float, lambda value: low <= value <= high, f'{low:g} to {high:g}')


def _listed(text: str) -> list[str]:
    return [part.strip() for part in text.split(',')]


not_negative = _type(float, lambda value: 0.0 <= value < math.inf, 'a number of at least 0')
positive = _type(float, lambda value: 0.0 < value < math.inf, 'a number above 0')
minutes = number(0.2, 600.0)  # argparse type for a duration of the emulated arm [min]
seed = whole(0, 2**63 - 1)
# `seeds`, `numbers` and `names` are lists separated by commas.
seeds = _type(
    lambda text: tuple(map(int, _listed(text))),
    lambda values: min(values) >= 0 and len(set(values)) == len(values),
    'different whole numbers, as in 0,1,2',
)
numbers = _type(
    lambda text: [*map(float, _listed(text))],
    lambda values: all(map(math.isfinite, values)),
    'numbers, as in 0,-0.5,1',
)
picture = _type(
    Path,
    lambda file: file.suffix.lower() in PICTURES and file.parent.is_dir(),
    f'a file in an existing directory that ends in one of {", ".join(PICTURES)}',
)
names = _type(lambda text: [*filter(None, dict.fromkeys(_listed(text)))], bool, 'a name')


class Parser(argparse.ArgumentParser):
    """A parser that reports an error in one line and exits with status 2."""

    def __init__(self, prog: str, description: str, epilog: str | None = None) -> None:
        super().__init__(prog, description=description, epilog=epilog)

    def add_argument(self, *names: Any, **options: Any) -> argparse.Action:
        """Add an argument, and append its default to its help."""
        default = options.get('default')
        has_default = not (default is None or default is False)
        if has_default and default not in ([], argparse.SUPPRESS):
            text = ','.join(map(str, default)) if isinstance(default, list | tuple) else default
            options['help'] = f'{options.get("help", "")} (default: {text})'.strip()
        return super().add_argument(*names, **options)

    def error(self, message: str) -> NoReturn:
        """Print the error and exit with status 2."""
        print(f'{self.prog}: error: {message} (see {self.prog} --help)', file=sys.stderr)
        sys.exit(2)

    def add_robot(self, flag: str = '--robot', default: str | None = DEFAULT_ROBOT) -> None:
        """Add the argument that names the robot.

        Args:
            flag: Name of the argument; without a leading "-", the argument is positional.
            default: The default; None makes the argument required.
        """
        text = f'a directory, or one of: {", ".join(sorted(shipped_robots()))}'
        kind: dict[str, Any] = {'metavar': 'NAME|DIR', 'required': default is None}
        self.add_argument(
            flag, default=default, help=text, **(kind if flag.startswith('-') else {})
        )

    def add_preset(self, text: str = 'network, learning and solver') -> None:
        """Add `--preset`; the text says what the preset determines."""
        self.add_argument('--preset', choices=PRESET_NAMES, default=DEFAULT, help=text)

    def add_seed(self, text: str) -> None:
        """Add `--seed`; the text completes "random seed …" in the help."""
        self.add_argument('--seed', type=seed, default=DEFAULT_SEED, help=f'random seed {text}')

    def add_seeds(
        self, default: tuple[int, ...] | None, text: str = 'seeds of the emulated individuals'
    ) -> None:
        """Add `--seeds`: one seed for each emulated individual."""
        self.add_argument('--seeds', type=seeds, default=default, metavar='N,…', help=text)

    def add_reality(self) -> None:
        """Add `--reality`, which selects the emulator model."""
        text = 'emulator model: `kin` shares the mechanics of this package; `foreign` uses MuJoCo'
        self.add_argument('--reality', choices=('kin', 'foreign'), default='kin', help=text)

    def add_minutes(self, text: str, default: float | None) -> None:
        """Add `--minutes`, a duration in robot time [min]; `text` is its help text."""
        self.add_argument('--minutes', type=minutes, default=default, help=text)

    def add_quick(self, text: str) -> None:
        """Add `--quick`; the text says what the tool then skips."""
        self.add_argument('--quick', action='store_true', help=text)

    def add_workers(self) -> None:
        """Add `--jobs` and `--scheduler`, which say where independent parts of the work run."""
        text = 'number of processes on this machine (default: one for each core)'
        self.add_argument('--jobs', type=whole(1, 256), help=text)
        self.set_defaults(jobs=len(os.sched_getaffinity(0)))
        text = 'scheduler of a Dask cluster to use instead, such as tcp://192.168.0.2:8786'
        self.add_argument('--scheduler', metavar='ADDRESS', help=text)

    def add_out(
        self,
        metavar: str,
        text: str = 'where to write',
        default: Path | None = None,
        read: Callable[[str], Path] = Path,
        is_optional: bool = False,
    ) -> None:
        """Add `--out`, a file or directory; it is required unless it has a default or is optional.

        `metavar` and `text` appear in its help. `read` converts and checks the argument. If
        `is_optional`, the value is None unless the user states it.
        """
        required = default is None and not is_optional
        self.add_argument(
            '--out', type=read, metavar=metavar, default=default, required=required, help=text
        )

    def add_chain(self) -> None:
        """Add the options that select a part of a model to import (CHAIN)."""
        for kind in ('joints', 'muscles'):
            text = f'{kind} to keep'
            self.add_argument(f'--{kind}', type=names, default=[], metavar='NAME,…', help=text)
        text = 'muscles to leave out'
        self.add_argument('--without', type=names, default=[], metavar='NAME,…', help=text)
        self.add_argument('--base', metavar='LINK', help='root link of the chain to keep')
        text = 'end effector: a link, a site, or LINK_tip, the far end of a link with a shape; '
        text += 'joints outside the chain to it are held fixed'
        self.add_argument('--end', metavar='NAME', help=text)

    def add_plot(self, text: str) -> None:
        """Add `--plot`, the image file that `save_plot` writes; `text` says what it shows."""
        self.add_argument('--plot', type=picture, metavar='FILE.png', help=f'draw {text}')


def exit_status(
    work: Callable[[], int | None], *also: type[Exception], out: Path | None = None
) -> int:
    """Run a tool's work and return its exit status; None counts as 0.

    For MusculoskeletalError, OSError and the exceptions in `also`, print one line and return 1.
    After Ctrl-C, print one line and return INTERRUPTED. The line is the text of the
    KeyboardInterrupt, or says whether `out`, the file or directory of results, was written.

    A tool does its work whatever happens to its output (`output.py`). If the reader of stdout has
    closed it, as `head` does, print nothing and return CLOSED; if stdout could not be written for
    another reason, print one line and return 1. If the work returns another status than 0, that
    status is returned.
    """
    refused: tuple[type[Exception], ...] = (MusculoskeletalError, OSError, *also)
    before = _versions(out)
    try:
        return work() or _output_status()
    except refused as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt as stop:
        if stop.args:
            kept = f': {stop}'
        elif out is None:
            kept = ''
        else:
            kept = f'; {out} was {"not " if _versions(out) == before else ""}written'
        print(f'interrupted{kept}', file=sys.stderr)
        return INTERRUPTED


def chain_of(args: argparse.Namespace) -> dict[str, Any]:
    """Return the options that select a part of a model (`Parser.add_chain`), by name."""
    return {name: getattr(args, name) for name in CHAIN}


def _output_status() -> int:
    """Return the exit status of a tool whose work is done: whether its output was written."""
    problem = output_problem()
    if problem is None:
        return 0
    if problem.errno == errno.EPIPE:
        return CLOSED
    print(f'error: the output was not written: {problem.strerror}', file=sys.stderr)
    return 1


def _versions(out: Path | None) -> dict[Path, int]:
    """Return the modification time [ns] of a file, or of each file in a directory.

    The result is {} if `out` is None or cannot be read.
    """
    if out is None:
        return {}
    with suppress(OSError):
        files = sorted(out.iterdir()) if out.is_dir() else [out]
        return {file: file.stat().st_mtime_ns for file in files}
    return {}
