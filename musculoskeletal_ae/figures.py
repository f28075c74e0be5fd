# SPDX-License-Identifier: Apache-2.0
"""Save figures of matplotlib to the files that a user names."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from musculoskeletal_ae.exceptions import MusculoskeletalError


def save_plot(file: Path | None, draw: Callable[[], Any]) -> None:
    """Save the figure that `draw` returns, and print the file's name.

    If `file` is None, do nothing.
    """
    if file is not None:
        save_figure(draw(), file)
        print(f'plot: {file}')


def save_figure(figure: Any, file: Path) -> None:
    """Save a matplotlib figure.

    Raises:
        MusculoskeletalError: If the file cannot be written.
    """
    try:
        figure.savefig(file, dpi=110)
    except OSError as error:
        raise MusculoskeletalError(f'picture {file} cannot be written: {error}') from error
