# SPDX-License-Identifier: Apache-2.0
"""The results table: the paper's number, ours with both presets, bound and aim; in the README too.

python -m musculoskeletal_ae.experiments.table README.md

writes the README's table anew from the result.json files in doc/results beside it; `experiment …
--readme README.md` first puts what it measured there.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments.results import Results, read

NOTHING = '–'
BEGIN, END = '<!-- results -->', '<!-- /results -->'
KEPT = Path('doc/results')


class Row(NamedTuple):
    """One quantity. Keys are paths into result.json, parts joined by dots.

    Attributes:
        experiment: Whose result.json.
        quantity: What it is, with its unit.
        printed: What the paper says, on Musashi.
        paper: Key of the value with preset paper, or ''.
        default: Key of the value with the preset of the run.
        bound: Key of what nothing can beat, or ''.
        aim: Highest value aimed at (lowest, if `more_is_better`), or None.
        digits: Decimals shown.
        more_is_better: Whether the aim is a lower limit.
        worst: Whether the worst individual is shown instead of the mean.
    """

    experiment: str
    quantity: str
    printed: str
    paper: str
    default: str
    bound: str = ''
    aim: float | None = None
    digits: int = 3
    more_is_better: bool = False
    worst: bool = False

    def number(self, results: Results, key: str) -> float | None:
        """Return what was measured, or None."""
        result: Mapping[str, Any] = results.get(self.experiment, {})
        if self.worst and result:
            every = [_at(each, key) for each in result['seeds'].values()]
            known = [number for number in every if number is not None]
            return (min if self.more_is_better else max)(known, default=None)
        return _at(result, key)

    def cell(self, results: Results, key: str) -> str:
        """Return a number as the tables have it."""
        number = self.number(results, key)
        return NOTHING if number is None else f'{number:.{self.digits}f}'

    def missed(self, results: Results) -> float | None:
        """Return by how much the aim is missed, 0 or less if it is met; None without either."""
        number = self.number(results, self.default)
        if self.aim is None or number is None:
            return None
        return self.aim - number if self.more_is_better else number - self.aim

    @property
    def aim_cell(self) -> str:
        """The aim as the tables have it."""
        if not self.aim:
            return NOTHING if self.aim is None else '0'
        return f'{"≥" if self.more_is_better else "≤"} {self.aim:g}'

    def verdict(self, results: Results) -> str:
        """Return whether the aim is met, and by how much it is missed otherwise."""
        missed = self.missed(results)
        if missed is None:
            return ''
        return 'met' if missed <= 0.0 else f'missed by {missed:.{self.digits}f}'


def _at(result: Mapping[str, Any], key: str) -> float | None:
    """Return the number at a path, or None if there is none."""
    value: Any = result
    for part in key.split('.'):
        if part not in value:
            return None
        value = value[part]
    return float(value)


ROWS = (
    Row('online_learning', 'estimate, held-out motion, before learning [rad]', '0.414',
        'paper_before_rad', 'before_rad', 'oracle_rad'),
    Row('online_learning', 'estimate, held-out motion, after learning [rad]', '0.186',
        'paper_after_rad', 'after_rad', 'oracle_rad', 0.10),
    Row('online_learning', 'error while exploring, exponential fit, start [rad]', '0.324',
        'paper_fit_start_rad', 'fit_start_rad'),
    Row('online_learning', 'error while exploring, exponential fit, end [rad]', '0.154',
        'paper_fit_end_rad', 'fit_end_rad'),
    Row('online_learning', 'samples at rest until the error is halved', NOTHING,
        'paper_samples_to_halve', 'samples_to_halve', digits=0),
    Row('estimation', 'estimate after learning, 3.6 kg in the hand [rad]', '≈ 0.186',
        '', 'after_payload_rad', '', 0.10),
    Row('estimation', 'time until a cut muscle is noticed, slowest muscle [s]', NOTHING,
        '', 'detection_worst_s', '', 0.5, 2, worst=True),
    Row('estimation', 'cut muscle named rightly [share]', NOTHING,
        '', 'named_share', '', 0.9, 2, more_is_better=True),
    Row('estimation', 'false alarms in the healthy time', NOTHING,
        '', 'false_alarms', '', 0.0, 0),
    Row('estimation', 'AUROC of the detector', NOTHING, '', 'auroc', '', None, 4),
    Row('control', '`proposed`, distance from θ_eval [rad]', 'as `second`',
        'proposed_paper.error_rad', 'proposed.error_rad', '', 0.06),
    Row('control', '`proposed`, ‖T‖ [N]', 'below `first`, `second`',
        'proposed_paper.tension_n', 'proposed.tension_n', 'qp_bound_n', digits=0),
    Row('control', '`proposed`, ‖T‖ beside the QP bound [ratio]', NOTHING,
        'proposed_paper.tension_to_bound', 'proposed.tension_to_bound', '', 1.1, 2),
    Row('simulation', 'simulator, joint angles, before learning [rad]', '0.335',
        'paper_before_rad', 'before_rad', 'frictionless_rad'),
    Row('simulation', 'simulator, joint angles, after learning [rad]', '0.162',
        'paper_after_rad', 'after_rad', 'frictionless_rad', 0.10),
    Row('simulation', 'simulator, tensions, before learning [N]', '105',
        'paper_before_n', 'before_n', 'frictionless_n', digits=0),
    Row('simulation', 'simulator, tensions, after learning [N]', '92.2',
        'paper_after_n', 'after_n', 'frictionless_n', 40.0, 0),
)  # fmt: skip


def markdown(results: Results) -> str:
    """Return the table as the README has it."""
    if not results:
        return '\nNothing measured yet: `experiment all --readme README.md`.\n'
    about = next(iter(results.values()))['about']
    text = (
        f'{about["robot"]}, emulated individuals {", ".join(map(str, about["seeds"]))}, '
        f'{about["minutes"]:g} minutes of exploration; {NOTHING}: not printed, or nothing to '
        'compare. Bound: least squares on the true body (estimate), the least ‖T‖ that can hold '
        'the target (control), the true body without friction (simulator).'
    )
    lines = [
        '| | paper, on Musashi | preset `paper` | preset `default` | bound | aim |',
        '|---|---|---|---|---|---|',
    ]
    for row in ROWS:
        paper, default, bound = (row.cell(results, k) for k in (row.paper, row.default, row.bound))
        aim = ', '.join(filter(None, (row.aim_cell, row.verdict(results))))
        lines.append(
            f'| {row.quantity} | {row.printed} | {paper} | **{default}** | {bound} | {aim} |'
        )
    return '\n'.join(['', text, '', *lines, ''])


def update_readme(readme: Path, measured: Path | None = None) -> list[Path]:
    """Write the table of a README from the results kept beside it; return the files written.

    Args:
        readme: Has a place between markers.
        measured: A folder whose result.json files are kept first.

    Raises:
        MusculoskeletalError: If the README has no place for the table.
    """
    text, kept, files = readme.read_text(encoding='utf-8'), readme.parent / KEPT, []
    if text.count(BEGIN) != 1 or text.count(END) != 1:
        raise MusculoskeletalError(f'{readme}: expected one {BEGIN} and one {END}')
    if measured is not None and measured.resolve() != kept.resolve():
        for name in read(measured):
            files.append(kept / name / 'result.json')
            files[-1].parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(measured / name / 'result.json', files[-1])
    head, rest = text.split(BEGIN)
    tail = rest.split(END)[1]
    readme.write_text(f'{head}{BEGIN}\n{markdown(read(kept))}\n{END}{tail}', encoding='utf-8')
    return [*files, readme]


if __name__ == '__main__':
    update_readme(Path(sys.argv[1]))
