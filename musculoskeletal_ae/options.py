# SPDX-License-Identifier: Apache-2.0
"""Command lines of all tools: one parser, the arguments they share, and how they end.

A tool writes only what is its own:

    def main(argv: list[str] | None = None) -> int:
        parser = Parser('train', 'Trains the autoencoder and writes a checkpoint.')
        parser.add_robot()
        parser.add_out('FILE.safetensors')
        parser.add_seed('of the training data and the weights')
        parser.add_argument('--jobs', type=whole(1, 256), help='processes')
        args = parser.parse_args(argv)
        return exit_status(lambda: train(args))

A wrong option is one line that names the option, the value and what is legal, and status 2; so is
`parser.error('--hold-out goes with --from-bag')`. What the package refuses (a robot, a file) is one
line and status 1. Help shows defaults by itself. Types raise `ArgumentTypeError`, before which
argparse puts the option.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.presets import PRESETS
from musculoskeletal_ae.robot.directories import shipped_robots

DEFAULT_ROBOT = 'musashi_left_arm'


def whole(low: int, high: int) -> Callable[[str], int]:
    """Return a type for whole numbers within [low, high]."""

    def convert(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f'{text!r}: expected {low} to {high}')
        return value

    return convert


def number(low: float, high: float) -> Callable[[str], float]:
    """Return a type for numbers within [low, high]."""
    return lambda text: _number(text, low, high, f'{text!r}: expected {low:g} to {high:g}')


def not_negative(text: str) -> float:
    """Return a finite number that is not negative."""
    return _number(text, 0.0, sys.float_info.max, f'{text!r} is not a number of at least 0')


def positive(text: str) -> float:
    """Return a positive, finite number."""
    return _number(text, math.ulp(0.0), sys.float_info.max, f'{text!r} is not a number above 0')


def _number(text: str, low: float, high: float, problem: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(problem)
    return value


minutes = number(0.2, 600.0)  # of robot time
seed = whole(0, 2**63 - 1)


def seeds(text: str) -> tuple[int, ...]:
    """Return the different seeds of a list separated by commas."""
    try:
        values = tuple(int(part) for part in text.split(','))
    except ValueError:
        values = (-1,)
    if min(values) < 0 or len(set(values)) < len(values):
        raise argparse.ArgumentTypeError(f'{text!r}: expected different whole numbers, as in 0,1,2')
    return values


def numbers(text: str) -> list[float]:
    """Return the finite numbers of a list separated by commas."""
    try:
        values = [float(part) for part in text.split(',')]
    except ValueError:
        values = [math.nan]
    if not all(map(math.isfinite, values)):
        raise argparse.ArgumentTypeError(f'{text!r}: expected numbers, as in 0,-0.5,1')
    return values


def names(text: str) -> list[str]:
    """Return the different names in a list separated by commas."""
    listed = [name.strip() for name in text.split(',') if name.strip()]
    if not listed:
        raise argparse.ArgumentTypeError('no name is given')
    return list(dict.fromkeys(listed))


class _Formatter(argparse.HelpFormatter):
    """Puts the default behind the help of every option that has one."""

    def _get_help_string(self, action: argparse.Action) -> str:
        text, default = action.help or '', action.default
        if default is None or default is False or default == [] or default == argparse.SUPPRESS:
            return text
        shown = ','.join(map(str, default)) if isinstance(default, list | tuple) else str(default)
        return f'{text} (default: {shown.replace("%", "%%")})'.strip()


class Parser(argparse.ArgumentParser):
    """A parser whose mistakes are one line and exit status 2."""

    def __init__(self, prog: str, description: str, epilog: str | None = None) -> None:
        """Parse the options of the tool `prog`."""
        super().__init__(prog, description=description, epilog=epilog, formatter_class=_Formatter)

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and end with status 2."""
        print(f'{self.prog}: error: {message} (see {self.prog} --help)', file=sys.stderr)
        sys.exit(2)

    def add_robot(self, flag: str = '--robot', default: str | None = DEFAULT_ROBOT) -> None:
        """Add the robot, by name or directory; without a default it must be given.

        The flag 'robot' makes it positional.
        """
        text = f'a directory, or one of: {", ".join(sorted(shipped_robots()))}'
        kind: dict[str, Any] = {'metavar': 'NAME|DIR', 'required': default is None}
        self.add_argument(
            flag, default=default, help=text, **(kind if flag.startswith('-') else {})
        )

    def add_checkpoint(
        self, text: str = 'trained network', flag: str = '--checkpoint', required: bool = False
    ) -> None:
        """Add a checkpoint file, None where it is not given."""
        self.add_argument(flag, type=Path, metavar='FILE', required=required, help=text)

    def add_preset(self, text: str = 'network, learning and solver') -> None:
        """Add `--preset`."""
        self.add_argument('--preset', choices=tuple(PRESETS), default='default', help=text)

    def add_seed(self, text: str) -> None:
        """Add `--seed`; the text says what it is the random seed of."""
        self.add_argument('--seed', type=seed, default=0, help=f'random seed {text}')

    def add_seeds(self, default: tuple[int, ...] | None, text: str = 'individual arms') -> None:
        """Add `--seeds`, the individual arms."""
        self.add_argument('--seeds', type=seeds, default=default, metavar='N,…', help=text)

    def add_reality(self) -> None:
        """Add `--reality`, the body of the individual arms."""
        text = 'the first body, or a second one, of MuJoCo, whose mechanics are foreign too'
        self.add_argument('--reality', choices=('kin', 'foreign'), default='kin', help=text)

    def add_minutes(self, text: str, default: float | None) -> None:
        """Add `--minutes` of robot time; the text says what happens in them."""
        self.add_argument('--minutes', type=minutes, default=default, help=text)

    def add_quick(self, text: str) -> None:
        """Add `--quick`; the text says what is left out."""
        self.add_argument('--quick', action='store_true', help=text)

    def add_out(
        self, metavar: str, text: str = 'where to write', default: Path | None = None
    ) -> None:
        """Add `--out`, a file or directory; without a default it must be given."""
        required = default is None
        self.add_argument(
            '--out', type=Path, metavar=metavar, default=default, required=required, help=text
        )

    def add_plot(self, text: str, default: str) -> None:
        """Add `--plot`, a picture that `save_plot` saves, and `--no-plot`."""
        shown = f'{text} (default: {default})'
        self.add_argument('--plot', type=Path, metavar='FILE.png', help=shown)
        self.add_argument('--no-plot', action='store_true', help='write no plot')


def save_plot(file: Path | None, save: Callable[[Path], None]) -> None:
    """Save a plot, if one is wanted, and say where; an error says that it cannot be written."""
    if file is None:
        return
    try:
        save(file)
    except (OSError, ValueError) as error:  # a ValueError is an ending of no picture
        raise MusculoskeletalError(f'plot {file} cannot be written: {error}') from error
    print(f'plot: {file}')


def exit_status(
    work: Callable[[], int | None], *also: type[Exception], interrupted: int = 130
) -> int:
    """Do a tool's work and return its exit status, without a traceback; None of `work` is 0.

    Errors of this package, of files and of the kinds in `also` are one line and status 1; Ctrl-C
    gives the status `interrupted`.
    """
    refused: tuple[type[Exception], ...] = (MusculoskeletalError, OSError, *also)
    try:
        return work() or 0
    except refused as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return interrupted
