# SPDX-License-Identifier: Apache-2.0
"""The page that compares every figure and number of the paper with the results of this package.

    python -m musculoskeletal_ae.experiments.paper_page doc/results/paper.md

This command rewrites the page from the results and pictures in the folder beside the page (`paper/`
beside `paper.md`). `experiment paper --page doc/results/paper.md` copies its own results and plots
to that folder first. The text is in paper.md.jinja, and the rows of the tables are in paper.yaml.
"""

import sys
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments import PAPER
from musculoskeletal_ae.experiments.results import (
    NOTHING,
    ResultRow,
    Results,
    copy_results,
    flat,
    individuals,
    read,
)
from musculoskeletal_ae.files import read_table, write_whole
from musculoskeletal_ae.presets.preset import PAPER_PRESET

TEMPLATE = 'paper.md.jinja'  # name of the page's template, a file in the folder of this module
#: rows of the tables, by the name of the table in the template
TABLES = read_table(__file__, 'paper.yaml', dict[str, tuple[ResultRow, ...]])
#: pictures of the page: file name, and the plot of an experiment that it shows
PICTURES = {
    'figure_5': ('online_learning', 'online_learning'),
    'figure_6': ('body_change', 'length_against_angle'),
    'figure_7': ('body_change', 'length_against_tension'),
    'figure_7_worn': ('body_change', 'worn_muscles'),
    'figure_8': ('estimation', 'appearance'),
    'figure_9': ('estimation', 'deactivated'),
    'figure_10': ('control', 'control'),
    'figure_11': ('simulation', 'simulation_pictures'),
    'figure_12': ('simulation', 'simulation_errors'),
    'figure_13': ('loss_change', 'loss_change_pictures'),
    'figure_13_motion': ('loss_change', 'loss_change'),
    'layers': ('layers', 'layers'),
}
LARGEST = 60_000  # shrink a picture to at most this size [bytes]
WIDEST = 1000  # shrink a picture to at most this width [pixels]
COLOURS = 128  # reduce pictures to this many colours; a small palette makes small files
SMALLER = 0.9  # multiply the width of a picture repeatedly by this until its file is small enough


def update_page(page: Path, measured: Path | None = None) -> list[Path]:
    """Update the page; return the files that were written.

    Args:
        page: File of the page; results and pictures are in the folder of the same name beside it.
        measured: Output folder of `experiment`, from which results and pictures are first copied,
            or None if they are already there.
    """
    folder, files = page.with_suffix(''), list[Path]()
    if measured is not None:
        files += copy_results(measured, page, PAPER)
        for picture, (name, plot) in PICTURES.items():
            drawn = measured / name / f'{plot}.png'
            if drawn.is_file():
                files.append(folder / f'{picture}.png')
                write_whole(files[-1], _reduced(drawn))
    page.write_text(text(read(folder), folder), encoding='utf-8')
    return [*files, page]


def text(results: Results, folder: Path) -> str:
    """Return the page for the results and pictures in a folder.

    Raises:
        MusculoskeletalError: If there are no results.
    """
    if not results:
        command = f'experiment paper --page {folder}.md'
        raise MusculoskeletalError(f'{folder} has no results; first run: {command}')
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=False,  # noqa: S701 (Markdown, not HTML)
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    captions = {
        (name, plot['file']): plot['caption']
        for name, result in results.items()
        for plot in result.get('plots', ())
    }

    def picture(name: str) -> str:
        experiment, plot = PICTURES[name]
        if not (folder / f'{name}.png').is_file():
            return ''
        caption = captions.get((experiment, f'{plot}.png'), '').replace('`', '')
        title = name.replace('_', ' ').capitalize()
        return f'![{title}]({folder.name}/{name}.png)\n\n{caption}\n'

    return environment.get_template(TEMPLATE).render(
        results=results,
        flat={name: flat(result) for name, result in results.items()},
        individuals=individuals,
        minutes=next(iter(results.values()))['about']['minutes'],
        picture=picture,
        rows=rows,
        number=number,
    )


def rows(results: Results, name: str, table: str = '') -> str:
    """Return a table of an experiment as Markdown, or '' if the experiment was not run.

    Args:
        results: All results.
        name: Name of the experiment.
        table: Name of the table in paper.yaml, by default that of the experiment.
    """
    if name not in results:
        return ''
    result = results[name]
    heading = f'preset `{PAPER_PRESET}` | preset `{result["about"]["preset"]}`'
    lines = [f'| {_who(result)} | paper, on Musashi | {heading} |', '|---|---|---|---|']
    for row in TABLES[table or name]:
        cells = row.cells(result)
        lines.append(f'| {cells.quantity} | {cells.published} | {cells.paper} | {cells.default} |')
    return '\n'.join(lines)


def number(values: Mapping[str, Any], key: str, digits: int = 3) -> str:
    """Return the number with this key as text, or a dash if it was not measured."""
    value = values.get(key)
    return NOTHING if value is None else f'{value:.{digits}f}'


def _who(result: Mapping[str, Any]) -> str:
    return individuals([int(seed) for seed, numbers in result['seeds'].items() if numbers])


def _reduced(file: Path) -> bytes:
    """Return a picture as a PNG with a colour palette, reduced to at most LARGEST bytes."""
    from PIL import Image  # matplotlib depends on it

    with Image.open(file) as opened:
        picture = opened.convert('RGB')
    width = min(WIDEST, picture.width)
    while True:
        size = width, round(width * picture.height / picture.width)
        stream = BytesIO()
        resized = picture.resize(size, Image.Resampling.LANCZOS)
        # This method keeps the colours of thin lines; the usual one mixes them with white.
        small = resized.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
        small.save(stream, 'PNG', optimize=True)
        if len(stream.getvalue()) <= LARGEST:
            return stream.getvalue()
        width = int(SMALLER * width)


if __name__ == '__main__':
    update_page(Path(sys.argv[1]))
