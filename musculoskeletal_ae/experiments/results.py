# SPDX-License-Identifier: Apache-2.0
"""Output folder of `experiment`: result.json, plots, report and results table.

    python -m musculoskeletal_ae.experiments.results doc/results.md

This command rewrites the table of the page from the result.json files in the folder beside the page
(`results/` beside `results.md`). `experiment … --readme doc/results.md` copies its own result.json
files to that folder first.
"""

import base64
import json
import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined, UndefinedError
from msgspec import MsgspecError, Struct

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments.plots import DPI
from musculoskeletal_ae.experiments.runner import EXPERIMENTS
from musculoskeletal_ae.experiments.study import Measured, Rows, Study, round_numbers
from musculoskeletal_ae.files import read_table, write_whole
from musculoskeletal_ae.presets.preset import PAPER_PRESET
from musculoskeletal_ae.schema import Strict, convert

#: result.json of every experiment that was run, by its name
Results = Mapping[str, Mapping[str, Any]]

#: report the sum of these over the individuals instead of the mean: numbers of events, and the
#: durations that the individuals share
ALARMS = ('false_contacts', 'false_alarms', 'false_alarms_beside_cuts')
ISOLATIONS = ('wrong_isolations', 'acquittals')
MOTIONS = ('approaches', 'missed', 'stuck')
TOTALS = (*ALARMS, *ISOLATIONS, *MOTIONS, 'healthy_s', 'healthy_touch_s', 'counted_cuts')
#: lines of a page between which the results table is written
BEGIN, END = '<!-- results -->', '<!-- /results -->'
#: name of the template of report.html, a file in the folder of this module
TEMPLATE = 'report.html.jinja'
NOTHING = '–'


def write(
    study: Study, measured: Mapping[str, Mapping[int, Measured | str]], out: Path
) -> list[Path]:
    """Write result.json and the plots of every experiment to a folder.

    Plots are written as PNG and, except in a shortened run, also as PDF.

    Returns:
        The written files except the PDF files.

    Raises:
        MusculoskeletalError: If a number is not finite.
    """
    files = []
    for name, by_seed in measured.items():
        rows = {seed: row for seed, row in by_seed.items() if isinstance(row, Measured)}
        folder, result, plots = out / name, combine(study, rows), EXPERIMENTS[name].plots
        failed = {str(seed): text for seed, text in by_seed.items() if isinstance(text, str)}
        if failed:
            result['failed'] = failed
        every = {f'{draw.__name__}.png': draw(study, rows) for draw in plots if rows}
        drawn = {file: plot for file, plot in every.items() if plot is not None}
        result['plots'] = [{'file': file, 'caption': text} for file, (_, text) in drawn.items()]
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(result, indent=1, ensure_ascii=False)
        write_whole(folder / 'result.json', f'{text}\n'.encode())
        for file, (figure, _) in drawn.items():
            if study.quick:  # cutting off empty margins would take as long as drawing
                figure.savefig(folder / file, dpi=DPI)
                continue
            figure.savefig(folder / file, dpi=DPI, bbox_inches='tight')
            figure.set_layout_engine('none')  # keep the layout of the PNG
            # Without a creation date, the same numbers give the same PDF.
            vector = (folder / file).with_suffix('.pdf')
            figure.savefig(vector, bbox_inches='tight', metadata={'CreationDate': None})
        files += [folder / file for file in ('result.json', *drawn)]
    return files


class About(Strict, frozen=True):
    """Options of the run that measured a result."""

    robot: str
    preset: str
    reality: str
    minutes: float
    quick: bool
    seeds: tuple[int, ...]


class Plot(Strict, frozen=True):
    """A picture beside result.json, with the caption that the report shows."""

    file: str
    caption: str


class ExperimentResult(Struct, frozen=True):
    """Entries that every result.json has, besides the numbers of its experiment."""

    about: About
    seeds: dict[str, dict[str, Any]]  # numbers of each individual, by its seed
    plots: tuple[Plot, ...] = ()
    failed: dict[str, str] = {}  # reason of each failure, by the individual's seed


def read(folder: Path) -> Results:
    """Return the content of every result.json in a folder, by name of the experiment.

    A damaged file is skipped with a warning.
    """
    results: dict[str, Any] = {}
    for name in EXPERIMENTS:
        file = folder / name / 'result.json'
        if file.is_file():
            try:
                results[name] = _read_result(file)
            except MusculoskeletalError as error:
                print(f'warning: {error}; this experiment is left out', file=sys.stderr)
    return results


def _read_result(file: Path) -> dict[str, Any]:
    def fail(problem: str) -> MusculoskeletalError:
        return MusculoskeletalError(f'{file} is not a valid result of an experiment: {problem}')

    try:
        result: dict[str, Any] = msgspec.json.decode(file.read_bytes())
    except (MsgspecError, OSError, RecursionError) as error:
        raise fail(str(error)) from error
    convert(result, ExperimentResult, fail)
    return result


def combine(study: Study, rows: Rows) -> dict[str, Any]:
    """Combine the rows of all individuals for result.json: mean, settings, and each individual."""
    numbers = {str(seed): row.numbers for seed, row in rows.items()}
    about: dict[str, Any] = {'robot': study.robot.description.directory.name}
    about |= {key: getattr(study, key) for key in ('preset', 'reality', 'minutes', 'quick')}
    about['seeds'] = list(study.seeds)
    return round_numbers({**_mean(list(numbers.values())), 'about': about, 'seeds': numbers})


def _mean(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key in dict.fromkeys(key for row in rows for key in row):
        values = [row[key] for row in rows if row.get(key) is not None]
        if not values:
            result[key] = None
        elif isinstance(first := values[0], Mapping):
            result[key] = _mean(values)
        elif isinstance(first, str):
            result[key] = first if len(set(values)) == 1 else sorted(set(values))
        elif key.removeprefix(f'{PAPER_PRESET}_') in TOTALS:
            result[key] = sum(values)
        else:
            result[key] = np.mean(values, axis=0).tolist()
    return result


class Cells(NamedTuple):
    """The cells of one row of the results table, as text."""

    quantity: str
    published: str
    paper: str
    default: str
    bound: str
    aim: str
    verdict: str  # 'met', or by how much the goal is missed; '' without a goal or a number


class ResultRow(Strict, frozen=True):
    """One row of the results table, which shows a quantity of an experiment.

    A key is the path of a value in result.json, with a dot between the names.
    """

    quantity: str  # name of the quantity, with its unit
    default: str  # key of the value with the preset of the run
    published: str = NOTHING  # value that the paper reports for Musashi
    paper: str = ''  # key of the value of preset `paper`, whose name replaces {preset} in the key
    bound: str = ''  # key of the reference value, such as the error of an oracle
    aim: float | None = None  # goal: the highest value, or the lowest if `more_is_better`
    digits: int = 3
    more_is_better: bool = False
    worst: bool = False  # show the worst individual instead of the mean

    def number(self, result: Mapping[str, Any], key: str) -> float | None:
        """Return the value of a key in a result.json, or None if it was not measured."""
        if not self.worst:
            return flat(result).get(key)
        every = [flat(numbers).get(key) for numbers in result.get('seeds', {}).values()]
        known = [number for number in every if number is not None]
        worst = min if self.more_is_better else max
        return worst(known, default=None)

    def cells(self, result: Mapping[str, Any]) -> Cells:
        """Return the cells of this row, with the numbers of a result.json."""
        paper_key = self.paper.format(preset=PAPER_PRESET)
        numbers = [self.number(result, key) for key in (paper_key, self.default, self.bound)]
        paper, default, bound = (NOTHING if n is None else f'{n:.{self.digits}f}' for n in numbers)
        number, aim, verdict = numbers[1], NOTHING, ''
        if self.aim is not None:
            aim = f'{"≥" if self.more_is_better else "≤"} {self.aim:g}' if self.aim else '0'
            if number is not None:
                missed = self.aim - number if self.more_is_better else number - self.aim
                verdict = 'met' if missed <= 0.0 else f'missed by {missed:.{self.digits}f}'
        return Cells(self.quantity, self.published, paper, default, bound, aim, verdict)


#: rows of the results table, by experiment
ROWS = read_table(__file__, 'table.yaml', dict[str, tuple[ResultRow, ...]])


def table(results: Results) -> list[Cells]:
    """Return the rows of the results table for the experiments that were run."""
    return [
        row.cells(results[name])
        for name in EXPERIMENTS
        if name in results
        for row in ROWS.get(name, ())
    ]


def individuals(seeds: Sequence[int]) -> str:
    """Return the names of the individuals with these seeds, such as 'individuals 0–4'."""
    names = ', '.join(map(str, seeds))
    if len(seeds) > 2 and list(seeds) == list(range(seeds[0], seeds[-1] + 1)):
        names = f'{seeds[0]}–{seeds[-1]}'
    return f'individual{"s" * (len(seeds) > 1)} {names}'


def readme_table(results: Results) -> str:
    """Return the results table as Markdown, with an introduction and the failed experiments."""
    if not results:
        return '\n\nThere are no results yet; run `experiment all --readme doc/results.md`.\n\n'
    about = next(iter(results.values()))['about']
    text = (
        f'\n\n{about["robot"]}, means over emulated individuals, {about["minutes"]:g} minutes of '
        f'exploration. {NOTHING} means that the paper gives no number, or that there is nothing to '
        'compare. The reference of an estimate is least '
        'squares with the true routes and elastic constants. The reference of control is the '
        'least ‖T‖ with which the true body can hold the posture in which the arm came to rest. '
        'The reference of the simulator is a simulation of the true body without friction.\n\n'
        f'| | paper, on Musashi | preset `{PAPER_PRESET}` | preset `default` | reference | goal |\n'
        '|---|---|---|---|---|---|'
    )
    for name in filter(ROWS.get, results):
        whom = individuals(results[name]['about']['seeds'])
        text += f'\n| **`experiment {name}`**, {whom} | | | | | |'
        for each in table({name: results[name]}):
            text += f'\n| {each.quantity} | {each.published} | {each.paper} | **{each.default}** | '
            text += f'{each.bound} | {", ".join(filter(None, each[-2:]))} |'
    return ''.join([text, *(f'\n\nFailed: {line}' for line in failures(results)), '\n\n'])


def failures(results: Results) -> list[str]:
    """Return the failed experiments with their reasons, one line for each reason."""
    failed: dict[tuple[str, str], list[str]] = {}
    for name, result in results.items():
        for seed_reason in result.get('failed', {}).items():
            failed.setdefault(seed_reason, []).append(name)
    return [
        f'{", ".join(names)} of individual {seed}: {reason}'
        for (seed, reason), names in failed.items()
    ]


def copy_results(measured: Path, page: Path, names: Iterable[str]) -> list[Path]:
    """Copy result.json files of an output folder to the folder of a page; return the copies.

    Args:
        measured: Output folder of `experiment`.
        page: File of the page; its results are in the folder of the same name beside it.
        names: Names of the experiments; those without a result are left out.
    """
    kept, files = page.with_suffix(''), list[Path]()
    if measured.resolve() == kept.resolve():
        return files
    for name in names:
        result = measured / name / 'result.json'
        if result.is_file():
            files.append(kept / name / 'result.json')
            files[-1].parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(result, files[-1])
    return files


def update_readme(readme: Path, measured: Path | None = None) -> list[Path]:
    """Update the results table of a page; return the written files.

    Args:
        readme: File of the page; its results are in the folder of the same name beside it.
        measured: Output folder of `experiment`, from which results are first copied, or None if
            they are already there.

    Raises:
        OSError: If the page cannot be read or written.
        MusculoskeletalError: If the page lacks the marker before or after the table.
    """
    (head, rest), files = text_around_table(readme), list[Path]()
    if measured is not None:
        files += copy_results(measured, readme, read(measured))
    table_text = readme_table(read(readme.with_suffix('')))
    readme.write_text(f'{head}{BEGIN}{table_text}{END}{rest}', encoding='utf-8')
    return [*files, readme]


def text_around_table(readme: Path) -> tuple[str, str]:
    """Return the text of a page before and after the results table.

    Raises:
        MusculoskeletalError: If the page lacks the marker before or after the table.
    """
    text = readme.read_text(encoding='utf-8')
    head, _, rest = text.partition(BEGIN)
    rest = rest.partition(END)[2]
    if text.count(BEGIN) != 1 or text.count(END) != 1 or END in head:
        raise MusculoskeletalError(
            f'{readme}: expected the lines {BEGIN} and {END}, once each and in this order'
        )
    return head, rest


def write_report(folder: Path) -> Path:
    """Write report.html from all results in a folder, including those of earlier runs.

    Raises:
        MusculoskeletalError: If a result.json lacks numbers that the report shows.
    """
    file = folder / 'report.html'
    try:
        page = _page(folder, read(folder))
    except (UndefinedError, LookupError, TypeError, AttributeError) as error:
        problem = f'{file} was not written: a result.json in {folder} lacks a number: {error}'
        raise MusculoskeletalError(f'{problem}; use an empty output folder') from error
    file.write_text(page, encoding='utf-8')
    return file


def _page(folder: Path, results: Results) -> str:
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(flat=flat, cell=_cell, individuals=individuals)
    return environment.get_template(TEMPLATE).render(
        results=results,
        failures=failures(results),
        measured={name: result for name, result in results.items() if result['seeds']},
        experiments=EXPERIMENTS,
        about=next(iter(results.values()))['about'],
        table=[line for line in table(results) if line.default != NOTHING],
        images={
            f'{file.parent.name}/{file.name}': base64.b64encode(file.read_bytes()).decode('ascii')
            for file in folder.glob('*/*.png')
        },
    )


def flat(values: Mapping[str, Any], before: str = '') -> dict[str, Any]:
    """Return the values of nested mappings in a single dictionary.

    Its keys are the paths of the values, with a dot between the keys of each level. `before` is
    put before every path.
    """
    rows: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            rows.update(flat(value, f'{before}{key}.'))
        else:
            rows[f'{before}{key}'] = value
    return rows


def _cell(value: Any) -> str:
    if isinstance(value, list):
        return ' '.join(map(_cell, value))
    return f'{value:.4g}' if isinstance(value, float) else str(value)


if __name__ == '__main__':
    update_readme(Path(sys.argv[1]))
