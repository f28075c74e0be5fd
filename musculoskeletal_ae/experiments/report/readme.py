# SPDX-License-Identifier: Apache-2.0
"""The results table of the README, made from the result.json files that are committed.

python -m musculoskeletal_ae.experiments.report.readme README.md

writes it anew from doc/results beside the README; `experiment … --readme README.md` first puts what
it measured there.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments.report.rows import (
    NOTHING,
    ROWS,
    Results,
    aim,
    shown,
    value,
    verdict,
)
from musculoskeletal_ae.experiments.suite.registry import NAMES
from musculoskeletal_ae.experiments.suite.results import read

BEGIN, END = '<!-- results -->', '<!-- /results -->'
KEPT = Path('doc/results')


def results_in(folder: Path) -> Results:
    """Return every result.json below a folder, by experiment."""
    files = {name: folder / name / 'result.json' for name in NAMES}
    return {name: read(file) for name, file in files.items() if file.is_file()}


def table(results: Results) -> str:
    """Return the table as markdown."""
    if not results:
        return '\nNothing measured yet: `experiment all --readme README.md`.\n'
    lines = [
        '| | paper, on Musashi | preset `paper` | preset `default` | bound | aim |',
        '|---|---|---|---|---|---|',
    ]
    for row in ROWS:
        ours, theirs, bound = (
            shown(value(results, row, key), row.digits)
            for key in (row.default, row.paper, row.bound)
        )
        judged = verdict(results, row)
        goal = aim(row) + (f', {judged}' if judged else '')
        lines.append(
            f'| {row.quantity} | {row.printed} | {theirs} | **{ours}** | {bound} | {goal} |'
        )
    return '\n'.join(['', _about(results), '', *lines, ''])


def _about(results: Results) -> str:
    about = next(iter(results.values()))['about']
    seeds = ', '.join(map(str, about['seeds']))
    return (
        f'{about["robot"]}, emulated individuals {seeds}, {about["minutes"]:g} minutes of '
        f'exploration; {NOTHING}: not printed, or nothing to compare. Bound: least squares on the '
        'true body (estimate), the least ‖T‖ that can hold the target (control), the true body '
        'without friction (simulator).'
    )


def update_readme(measured: Path, readme: Path) -> list[Path]:
    """Keep the result.json files of a folder beside a README and write its table anew.

    Raises:
        MusculoskeletalError: If the README has no place for it.
    """
    kept = []
    for name in NAMES:
        source = measured / name / 'result.json'
        if source.is_file():
            goal = readme.parent / KEPT / name / 'result.json'
            goal.parent.mkdir(parents=True, exist_ok=True)
            if source.resolve() != goal.resolve():
                shutil.copyfile(source, goal)
            kept.append(goal)
    write_table(readme)
    return [*kept, readme]


def write_table(readme: Path) -> None:
    """Write the table between the markers of a README.

    Raises:
        MusculoskeletalError: If it has none.
    """
    text = readme.read_text(encoding='utf-8')
    if text.count(BEGIN) != 1 or text.count(END) != 1:
        raise MusculoskeletalError(f'{readme}: expected one {BEGIN} and one {END}')
    head, rest = text.split(BEGIN)
    tail = rest.split(END)[1]
    new = f'{head}{BEGIN}\n{table(results_in(readme.parent / KEPT))}\n{END}{tail}'
    readme.write_text(new, encoding='utf-8')


def main(argv: list[str] | None = None) -> int:
    """Write the table; exit status 1 if there is no place for it."""
    parser = argparse.ArgumentParser(prog='readme', description=__doc__)
    parser.add_argument('readme', type=Path)
    args = parser.parse_args(argv)
    try:
        write_table(args.readme)
    except (MusculoskeletalError, OSError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
