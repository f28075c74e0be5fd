# SPDX-License-Identifier: Apache-2.0
"""Learns public recordings of other people's tendon-driven robots, beside models that know none.

    python -m bench recordings --clones DIR [--out DIR] [--only NAME] [--counts N …] [--draws N]

DIR has one clone for each repository of `recordings_read.repositories`, named OWNER+NAME or NAME
(a working tree or a git directory). A repository without a clone is cloned into DIR if --fetch is
given, and left out otherwise. None of the data is stored. The results are result.json and
tables.md, which `python doc/make.py` writes into the documents. Each finished case is added to
result.json, so the bench may be interrupted, or measure a part; --again measures cases again that
are there.

`recordings_cases` divides each recording into training and test rows. All models of a case learn
the same rows, from lengths alone or from lengths and efforts:

- geometry: the network of the geometric model, without learning
- the regressions of `regression`, whose constants are chosen with the training rows alone
- statics of a soft link, where its payload is known (`Statics`)
- this package, as `train --from-csv` learns

No constant was chosen by an error on test rows, except those that doc/results.md names.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from bench.recordings_cases import COUNTS, DRAWS, Case, cases
from bench.recordings_learn import (
    Model,
    Statics,
    bend_gain,
    described,
    effort_slope,
    error,
    network,
    package,
    payload_share,
    regression,
    tensions,
)
from bench.recordings_read import Files, Recording, Repository, SoftLink, repositories
from bench.regression import BASELINES
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.options import Parser, whole

GEOMETRY, STATICS, PACKAGE = 'geometry', 'statics', 'this package'
LENGTHS, EFFORTS = 'lengths', 'lengths and efforts'


class Result(NamedTuple):
    """The error of one model in one draw of a case."""

    recording: str
    case: str
    samples: int
    draw: int
    inputs: str  # LENGTHS or EFFORTS
    model: str
    error_rad: float

    @property
    def place(self) -> tuple[str, str, int, str]:
        """Recording, case, draw and inputs, which all models of a measurement share."""
        return self.recording, self.case, self.draw, self.inputs


def models(case: Case, with_effort: bool) -> Iterator[tuple[str, Model]]:
    """Yield every model of a case with its name."""
    robot, mae = described(case.body, with_effort)
    yield GEOMETRY, network(mae, tensions(case.body, robot, case.training, with_effort))
    for name, fit in BASELINES.items():
        yield name, regression(fit, case.training, with_effort)
    if case.rests and not with_effort:
        yield STATICS, Statics(robot, [*case.rests]).posture
    yield PACKAGE, package(case, robot, mae, with_effort)


def measured(case: Case, with_effort: bool) -> list[Result]:
    """Return the errors of all models in a case."""
    inputs = EFFORTS if with_effort else LENGTHS
    results = []
    for name, model in models(case, with_effort):
        off = round(error(model, case.test), 5)
        results.append(
            Result(
                case.body.name, case.name, len(case.training.length), case.draw, inputs, name, off
            )
        )
    return results


def observations(recording: Recording) -> dict[str, Any]:
    """Return quantities by name that describe a recording without a model of θ, such as slopes."""
    shown: dict[str, Any] = {}
    if not isinstance(recording.link, SoftLink):
        return shown
    azimuths = np.array(recording.link.azimuths)
    if recording.link.name == 'soft_neck':
        none, half, whole = recording.runs
        gains = {run.name: bend_gain(run, azimuths) for run in recording.runs}
        slopes = {run.name: effort_slope(run, azimuths) for run in recording.runs}
        first = gains[none.name]
        shown['bend at the same lengths, as a multiple of that without payload'] = {
            name: round(gain / first, 3) for name, gain in gains.items()
        }
        shown['slope of the efforts over the commanded bend [1/m]'] = {
            name: round(slope, 1) for name, slope in slopes.items()
        }
        share = (slopes[none.name] - slopes[half.name]) / (slopes[none.name] - slopes[whole.name])
        shown['payload of the 500 g run by its efforts [kg]'] = round(share, 3)
    if recording.link.name == 'soft_arm':
        for with_theta in (False, True):
            for with_effort in (False, True):
                inputs = ['lengths'] + ['currents'] * with_effort + ['angles'] * with_theta
                share = payload_share(recording.runs, with_effort, with_theta)
                shown[f'R² of the payload by {", ".join(inputs)}'] = round(share, 3)
    return shown


def table(results: list[Result]) -> str:
    """Return the errors of one recording as a Markdown table.

    An error is the mean over the draws, with their standard deviation if there are several. The
    best model of each row is in bold. The last column has the error of the package divided by the
    smallest one of the other models.
    """
    errors, samples = dict[tuple[str, str], dict[str, list[float]]](), dict[str, int]()
    for result in results:
        row = errors.setdefault((result.case, result.inputs), {})
        row.setdefault(result.model, []).append(result.error_rad)
        samples[result.case] = result.samples
    order = [GEOMETRY, *BASELINES, STATICS, PACKAGE]
    names = [name for name in order if any(name in row for row in errors.values())]
    heads = ['mean error [rad]', 'inputs', *names, 'ratio']
    lines = [f'| {" | ".join(heads)} |', '|---' * len(heads) + '|']
    for (case, inputs), row in errors.items():
        means = {name: float(np.mean(values)) for name, values in row.items()}
        least = min(means.values())
        cells = [f'{case} ({samples[case]})' if case.startswith('rests') else case, inputs]
        for name in names:
            if name not in means:
                cells.append('–')
                continue
            text = f'{means[name]:.4f}' if means[name] < 1.0 else '> 1'
            text = f'**{text}**' if means[name] == least else text
            spread = np.std(row[name], ddof=1) if len(row[name]) > 1 else None
            cells.append(text if spread is None or means[name] > 1.0 else f'{text} ± {spread:.4f}')
        others = [mean for name, mean in means.items() if name != PACKAGE]
        cells.append(f'{means[PACKAGE] / min(others):.2f}')
        lines.append(f'| {" | ".join(cells)} |')
    return '\n'.join(lines)


def tables(document: dict[str, Any]) -> str:
    """Return the tables of a result.json of `bench recordings` as Markdown."""
    results = [Result(**row) for row in document['errors']]
    parts = []
    for repository in repositories():
        own = [result for result in results if result.recording == repository.recording]
        if own:
            link = f'[{repository.name}](https://github.com/{repository.name})'
            head = f'**{link}** ({repository.licence}): {repository.robot}.'
            parts.append(f'{head}\n\n{table(own)}')
    return '\n\n'.join(parts)


class Document:
    """The results in a folder: result.json, to which measurements are added, and tables.md."""

    def __init__(self, folder: Path) -> None:
        """Begin with the results that the folder has."""
        self._folder, self.results = folder, list[Result]()
        self.also = dict[str, Any]()
        if (file := folder / 'result.json').exists():
            content = json.loads(file.read_text('utf-8'))
            self.results = [Result(**row) for row in content['errors']]
            self.also = content['also']

    def has(self, case: Case, inputs: str) -> bool:
        """Return whether a case was measured."""
        place = case.body.name, case.name, case.draw, inputs
        return any(result.place == place for result in self.results)

    def add(self, results: list[Result]) -> None:
        """Add the results of a measurement in the place of older ones, and write all."""
        places = {result.place for result in results}
        self.results = [result for result in self.results if result.place not in places] + results
        self.write()

    def write(self) -> None:
        """Write the results, cases with payloads first, then by number of rows and by draw."""
        self.results.sort(key=self._order)
        document = {'errors': [result._asdict() for result in self.results], 'also': self.also}
        text = json.dumps(document, indent=1, ensure_ascii=False)
        self._folder.mkdir(parents=True, exist_ok=True)
        (self._folder / 'result.json').write_text(text + '\n', encoding='utf-8')
        (self._folder / 'tables.md').write_text(tables(document) + '\n', encoding='utf-8')

    @staticmethod
    def _order(result: Result) -> tuple[str, bool, int, str, str, int]:
        is_drawn = not result.case.startswith('rests')
        number = result.samples if is_drawn else 0
        name = result.case if is_drawn else ''
        return result.recording, is_drawn, number, name, result.inputs, result.draw


def clone_of(repository: Repository, clones: Path, fetch: bool) -> Path | None:
    """Return the path of a repository's clone; None if there is none.

    A missing clone is created first if `fetch` is true.
    """
    owner, short = repository.name.split('/')
    for name in (f'{owner}+{short}', short):
        for path in (clones / name / 'repo', clones / name):
            if path.is_dir():
                return path
    if not fetch:
        return None
    target = clones / f'{owner}+{short}'
    address = f'https://github.com/{repository.name}'
    done = subprocess.run(['git', 'clone', '--depth', '1', address, str(target)])
    if done.returncode:
        raise MusculoskeletalError(f'git cannot clone {address}; clone it into {target} yourself')
    return target


def main(argv: list[str]) -> int:
    """Learn and test all cases of repositories that have clones, and write the tables."""
    parser = Parser('recordings', "Learns from public recordings of other people's robots.")
    parser.add_argument('--clones', type=Path, required=True, help='directory with the clones')
    parser.add_argument('--fetch', action='store_true', help='clone missing data from GitHub')
    text = 'use only repositories whose name contains this text'
    parser.add_argument('--only', default='', metavar='TEXT', help=text)
    text = 'numbers of random rows to learn; 0: no random rows'
    parser.add_argument('--counts', type=whole(0, 10**6), nargs='+', default=[*COUNTS], help=text)
    text = 'number of random draws of each number of rows'
    parser.add_argument('--draws', type=whole(1, 100), default=DRAWS, help=text)
    text = 'which inputs to use; by default all that the recording has'
    parser.add_argument('--inputs', choices=(LENGTHS, EFFORTS), help=text)
    text = 'also measure again the cases that the output already has'
    parser.add_argument('--again', action='store_true', help=text)
    parser.add_out('DIR', default=Path('doc/results/recordings'))
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    document, is_any = Document(args.out), False
    for repository in repositories():
        clone = clone_of(repository, args.clones, args.fetch)
        if args.only not in repository.name or clone is None:
            reason = (
                'it is not cloned; add --fetch' if clone is None else 'it does not match --only'
            )
            print(f'{repository.name}: left out, because {reason}')
            continue
        is_any, recording = True, repository.read(Files(clone))
        document.also[repository.name] = observations(recording)
        counts = [count for count in args.counts if count]
        for case in cases(recording, counts, args.draws):
            for with_effort in (False, True) if case.training.effort.size else (False,):
                inputs = EFFORTS if with_effort else LENGTHS
                if args.inputs not in (None, inputs):
                    continue
                if document.has(case, inputs) and not args.again:
                    continue
                results = measured(case, with_effort)
                document.add(results)
                errors = ', '.join(f'{each.model} {each.error_rad:.4f}' for each in results)
                where = f'{case.body.name}: {case.name}, draw {case.draw}, {inputs}'
                print(f'{where}: {errors}', flush=True)
    if not is_any:
        raise MusculoskeletalError(
            f'no repository of the bench is cloned in {args.clones} and matches '
            '--only; add --fetch to clone them, or change --only'
        )
    document.write()
    print(tables({'errors': [result._asdict() for result in document.results]}))
    return 0
