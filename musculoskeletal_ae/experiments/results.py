# SPDX-License-Identifier: Apache-2.0
"""What a call leaves in its folder: result.json and plots of every experiment, the results table.

python -m musculoskeletal_ae.experiments.results doc/experiments.md

writes the table of a page anew from the result.json files in doc/results; `experiment … --readme
doc/experiments.md` first puts what it measured there.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments.plots import DPI
from musculoskeletal_ae.experiments.runner import EXPERIMENTS
from musculoskeletal_ae.experiments.study import Measured, Rows, Study
from musculoskeletal_ae.experiments.table import Cells, markdown

#: result.json of every experiment that was run, by name
Results = Mapping[str, Mapping[str, Any]]

#: counted in all, not per individual: the hour of healthy motion is spread over the seeds
ALARMS = ('false_contacts', 'false_alarms', 'false_alarms_beside_cuts', 'paper_false_alarms')
ISOLATIONS = ('wrong_isolations', 'acquittals')
TOTALS = (*ALARMS, *ISOLATIONS, 'healthy_s', 'healthy_touch_s', 'counted_cuts')
DIGITS = 6  # significant; more is noise
BEGIN, END = '<!-- results -->', '<!-- /results -->'  # of the results table
KEPT = Path('doc/results')


def write(
    study: Study, measured: Mapping[str, Mapping[int, Measured | str]], out: Path
) -> list[Path]:
    """Write result.json and plots of every experiment below a folder; return the files.

    Raises:
        MusculoskeletalError: If a number is not finite.
    """
    files = []
    for name, said in measured.items():
        rows = {seed: row for seed, row in said.items() if isinstance(row, Measured)}
        folder, result, plots = out / name, combined(study, rows), EXPERIMENTS[name].plots
        if failed := {str(seed): text for seed, text in said.items() if isinstance(text, str)}:
            result['failed'] = failed
        drawn = {f'{draw.__name__}.png': draw(study, rows) for draw in plots if rows}
        result['plots'] = [{'file': file, 'caption': text} for file, (_, text) in drawn.items()]
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(result, indent=1, ensure_ascii=False)
        (folder / 'result.json').write_text(text + '\n', encoding='utf-8')
        for file, (figure, _) in drawn.items():
            figure.savefig(folder / file, dpi=DPI, bbox_inches='tight')
            # For a paper; without a date, so that the same numbers give the same file.
            vector = (folder / file).with_suffix('.pdf')
            figure.savefig(vector, bbox_inches='tight', metadata={'CreationDate': None})
        files += [folder / file for file in ('result.json', *drawn)]
    return files


def read(folder: Path) -> Results:
    """Return every result.json below a folder, by experiment."""
    files = {name: folder / name / 'result.json' for name in EXPERIMENTS}
    return {
        name: json.loads(file.read_text(encoding='utf-8'))
        for name, file in files.items()
        if file.is_file()
    }


def combined(study: Study, rows: Rows) -> dict[str, Any]:
    """Return result.json of one experiment, without its plots."""
    numbers = {str(seed): row.numbers for seed, row in rows.items()}
    about = {
        'robot': study.robot.description.directory.name,
        'preset': study.preset,
        'reality': study.reality,
        'minutes': study.minutes,
        'quick': study.quick,
        'seeds': list(study.seeds),
    }
    whole: dict[str, Any] = {**_mean(list(numbers.values())), 'about': about, 'seeds': numbers}
    return {key: rounded(value) for key, value in whole.items()}


def _mean(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key in dict.fromkeys(key for row in rows for key in row):
        values = [row[key] for row in rows if key in row]
        first = values[0]
        if isinstance(first, Mapping):
            result[key] = _mean(values)
        elif None in values:
            result[key] = None
        elif isinstance(first, str):
            result[key] = first if len(set(values)) == 1 else sorted(set(values))
        elif key in TOTALS:
            result[key] = sum(values)
        else:
            result[key] = np.mean(values, axis=0).tolist()
    return result


def rounded(value: Any) -> Any:
    """Return the same with floats shortened; JSON cannot say what is not finite."""
    if isinstance(value, Mapping):
        return {key: rounded(part) for key, part in value.items()}
    if isinstance(value, list):
        return [rounded(part) for part in value]
    if isinstance(value, float):
        if not math.isfinite(value):
            raise MusculoskeletalError('an experiment brought a number that is not finite')
        return float(f'{value:.{DIGITS}g}')
    return value


def table(results: Results) -> list[Cells]:
    """Return the lines of the results table, of the experiments that were run."""
    return [
        row.cells(results[name])
        for name, experiment in EXPERIMENTS.items()
        if name in results
        for row in experiment.rows
    ]


def readme_table(results: Results) -> str:
    """Return what stands between the markers of a page."""
    if not results:
        return '\n\nNothing measured yet: `experiment all --readme doc/experiments.md`.\n\n'
    lost = ''.join(f'\n\nFailed: {line}' for line in failures(results))
    return f'\n\n{markdown(next(iter(results.values()))["about"], table(results))}{lost}\n\n'


def failures(results: Results) -> list[str]:
    """Return what failed, and why, a line for each reason."""
    lost: dict[tuple[str, str], list[str]] = {}
    for name, result in results.items():
        for seed_reason in result.get('failed', {}).items():
            lost.setdefault(seed_reason, []).append(name)
    return [f'{", ".join(names)} of individual {at}: {why}' for (at, why), names in lost.items()]


def update_readme(readme: Path, measured: Path | None = None) -> list[Path]:
    """Write the table of a README from the results kept beside it; return the files written.

    The result.json files of the folder `measured` are kept first.

    Raises:
        MusculoskeletalError: If the README has no place between markers.
    """
    text, files = readme.read_text(encoding='utf-8'), list[Path]()
    kept = readme.parent / (KEPT.name if readme.parent.resolve().name == 'doc' else KEPT)
    if text.count(BEGIN) != 1 or text.count(END) != 1:
        raise MusculoskeletalError(f'{readme}: expected one {BEGIN} and one {END}')
    if measured is not None and measured.resolve() != kept.resolve():
        for name in read(measured):
            files.append(kept / name / 'result.json')
            files[-1].parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(measured / name / 'result.json', files[-1])
    head, rest = text.split(BEGIN)
    table_text = readme_table(read(kept))
    readme.write_text(f'{head}{BEGIN}{table_text}{END}{rest.split(END)[1]}', encoding='utf-8')
    return [*files, readme]


if __name__ == '__main__':
    update_readme(Path(sys.argv[1]))
