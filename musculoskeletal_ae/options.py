# SPDX-License-Identifier: Apache-2.0
"""Command lines of all tools: one parser, the arguments they share, and how they end.

A tool writes only what is its own, as `tools/import_robot.py` does. A wrong option is one line that
names the option, the value and what is legal, and status 2; so is `parser.error('--hold-out goes
with --from-bag')`. What the package refuses (a robot, a file) is one line and status 1. Help shows
defaults by itself. Types raise `ArgumentTypeError`, before which argparse puts the option.
"""

import argparse
import math
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.presets.registry import PRESETS
from musculoskeletal_ae.robot.directories import shipped_robots
from musculoskeletal_ae.stop_signals import INTERRUPTED

DEFAULT_ROBOT = 'musashi_left_arm'
PICTURES = ('.png', '.svg', '.pdf', '.jpg')
T = TypeVar('T')


def _type(convert: Callable[[str], T], legal: Callable[[T], bool], told: str) -> Callable[[str], T]:
    """Return a type that takes what `convert` makes of a text, where that is legal."""

    def checked(text: str) -> T:
        with suppress(ValueError):
            if legal(value := convert(text)):
                return value
        raise argparse.ArgumentTypeError(f'{text!r}: expected {told}')

    return checked


def whole(low: int, high: int) -> Callable[[str], int]:
    """Return a type for whole numbers within [low, high]."""
    return _type(int, lambda value: low <= value <= high, f'{low} to {high}')


def number(low: float, high: float) -> Callable[[str], float]:
    """Return a type for numbers within [low, high]."""
    return _type(float, lambda value: low <= value <= high, f'{low:g} to {high:g}')


def _listed(text: str) -> list[str]:
    return [part.strip() for part in text.split(',')]


not_negative = _type(float, lambda value: 0.0 <= value < math.inf, 'a number of at least 0')
positive = _type(float, lambda value: 0.0 < value < math.inf, 'a number above 0')
minutes = number(0.2, 600.0)  # of robot time
seed = whole(0, 2**63 - 1)
#: lists separated by commas: different seeds, finite numbers, different names
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
    f'a file in a directory that exists, with one of the endings {", ".join(PICTURES)}',
)
names = _type(lambda text: [*filter(None, dict.fromkeys(_listed(text)))], bool, 'a name')


class Parser(argparse.ArgumentParser):
    """A parser whose mistakes are one line and exit status 2."""

    def __init__(self, prog: str, description: str, epilog: str | None = None) -> None:
        super().__init__(prog, description=description, epilog=epilog)

    def add_argument(self, *names: Any, **options: Any) -> argparse.Action:
        """Add an argument; its default, if there is one, stands at the end of its help."""
        default = options.get('default')
        nothing = default is None or default is False or default in ([], argparse.SUPPRESS)
        if not nothing:
            shown = ','.join(map(str, default)) if isinstance(default, list | tuple) else default
            options['help'] = f'{options.get("help", "")} (default: {shown})'.strip()
        return super().add_argument(*names, **options)

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and end with status 2."""
        print(f'{self.prog}: error: {message} (see {self.prog} --help)', file=sys.stderr)
        sys.exit(2)

    def add_robot(self, flag: str = '--robot', default: str | None = DEFAULT_ROBOT) -> None:
        """Add the robot; without a default it must be given, and 'robot' makes it positional."""
        text = f'a directory, or one of: {", ".join(sorted(shipped_robots()))}'
        kind: dict[str, Any] = {'metavar': 'NAME|DIR', 'required': default is None}
        self.add_argument(
            flag, default=default, help=text, **(kind if flag.startswith('-') else {})
        )

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
        self,
        metavar: str,
        text: str = 'where to write',
        default: Path | None = None,
        read: Callable[[str], Path] = Path,
    ) -> None:
        """Add `--out`, a file or directory; without a default it must be given."""
        required = default is None
        self.add_argument(
            '--out', type=read, metavar=metavar, default=default, required=required, help=text
        )

    def add_plot(self, text: str) -> None:
        """Add `--plot`, a picture that `save_plot` saves where it is asked for."""
        self.add_argument('--plot', type=picture, metavar='FILE.png', help=f'draw {text}')


def save_plot(file: Path | None, draw: Callable[[], Any]) -> None:
    """Save the figure that `draw` returns, if one is wanted, and say where."""
    if file is not None:
        save_figure(draw(), file)
        print(f'plot: {file}')


def save_figure(figure: Any, file: Path) -> None:
    """Save a figure of matplotlib.

    Raises:
        MusculoskeletalError: If it cannot be written.
    """
    try:
        figure.savefig(file, dpi=110)
    except OSError as error:
        raise MusculoskeletalError(f'picture {file} cannot be written: {error}') from error


def exit_status(work: Callable[[], int | None], *also: type[Exception]) -> int:
    """Do a tool's work and return its exit status, without a traceback; None of `work` is 0.

    Errors of this package, of files and of the kinds in `also` are one line and status 1.
    """
    refused: tuple[type[Exception], ...] = (MusculoskeletalError, OSError, *also)
    try:
        return work() or 0
    except refused as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return INTERRUPTED
