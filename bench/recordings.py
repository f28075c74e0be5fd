# SPDX-License-Identifier: Apache-2.0
"""Trains models on public recordings of other tendon-driven robots, and compares their errors.

    python -m bench recordings --clones DIR [--out DIR] [--only NAME]

DIR has one clone for each repository of `recordings_read.repositories`, named OWNER+NAME or NAME
(a working tree or a git directory). A repository without a clone is cloned into DIR if --fetch is
given, and left out otherwise. None of the data is stored. The results are result.json and
tables.md, which `python doc/make.py` writes into doc/results.md.

Every model is trained on the rest samples of the training runs. It is tested on all rows of other
runs (neck), files (arm) or poses (stand). For neck and arm, polynomials are also fitted to all rows
of the training runs. All constants are in `recordings_learn`; none was chosen by an error on test
rows.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.recordings_baselines import baselines
from bench.recordings_learn import (
    Model,
    Statics,
    bend_gain,
    effort_slope,
    error,
    joined,
    package,
    payload_share,
    polynomial,
)
from bench.recordings_read import (
    Files,
    Recording,
    Repository,
    Run,
    SoftLink,
    fitted,
    repositories,
)
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.robot import Robot

HALF = slice(0, None, 2)  # rests that are used for training: every other one
ALL_ROWS = ', of all rows'
#: label of the one row that stands for all polynomials fitted to all rows of the training runs
OF_ALL_ROWS = 'best polynomial of all training rows (chosen by its test error)'


class Result(NamedTuple):
    """The error of one model on one split."""

    recording: str
    split: str
    samples: int
    model: str
    error_rad: float


class Split(NamedTuple):
    """One way to divide a recording into training and test data."""

    name: str
    training: Run  # the training data, which contain rest samples only
    test: Run  # the test data, with all rows
    #: `training` by run, to which `Statics` is fitted; empty if it is not fitted to this split
    rests: list[Run]
    #: all rows of the training runs or poses, not only rests; polynomials are fitted to them as
    #: well
    full: Run | None = None


def neck_splits(recording: Recording) -> Iterator[Split]:
    """Yield splits of the recording of the soft neck, a link that three tendons bend.

    The training data have one payload or two. The test data have the same payload in other poses,
    or another payload.
    """
    none, half, whole = recording.runs
    own = none.at_rest(HALF)
    # The rests of every other pose (HALF) are for training, so test on all rows of the poses
    # between. A pose extends from the end of the previous rest to the end of its own rest.
    pose = np.searchsorted(none.rests[:, 1], np.arange(len(none.length)), side='right')
    others = (pose % 2 == 1) & (pose < len(none.rests))
    yield Split('0 g → other poses, 0 g', own, none.at(others), [], none.at(~others))
    for test in (half, whole):
        yield Split(f'0 g → {test.name}', own, test, [], none)
    for first, second, test in ((none, whole, half), (none, half, whole), (half, whole, none)):
        rests = [first.at_rest(HALF), second.at_rest(HALF)]
        name = f'{first.name}, {second.name} → {test.name}'
        yield Split(name, joined(rests), test, rests, joined([first, second]))


def arm_splits(recording: Recording) -> Iterator[Split]:
    """Yield splits of the recording of the soft arm, a link that three tendons bend.

    The test data are other files with the same payload, or files with other payloads.
    """
    files = {load: [run for run in recording.runs if run.load == load] for load in (0.0, 0.5)}
    others = [run for run in recording.runs if run.load not in files]
    bare, held_out = files[0.0][0::2], files[0.0][1::2]
    own = joined([run.at_rest() for run in bare])
    yield Split('0 g → other files, 0 g', own, joined(held_out), [], joined(bare))
    both = files[0.0] + files[0.5]
    rests = joined([run.at_rest() for run in both])
    yield Split('0 g, 500 g → 200 g, 300 g', rests, joined(others), [], joined(both))


def stand_splits(recording: Recording) -> Iterator[Split]:
    """Yield splits of the recording of the test stand for a continuum robot.

    The training data are 20 or 100 poses. The test data are all other poses.
    """
    run = recording.runs[0]
    order = np.random.default_rng(0).permutation(len(run.length))
    for count in (20, 100):
        name = f'{count} poses → all others'
        yield Split(name, run.at(order[:count]), run.at(order[count:]), [])


def platform_splits(recording: Recording) -> Iterator[Split]:
    """Yield splits of the recordings of the cable platform.

    The training data are 20, 50 or all rests of one run. The test data are all rows of the others.
    """
    first, *others = recording.runs
    rests, test = first.at_rest(), joined(others)
    order = np.random.default_rng(0).permutation(len(rests.length))
    for count in (20, 50, len(order)):
        which = 'all' if count == len(order) else count
        training = rests.at(order[:count])
        yield Split(f'{which} rests of one run → other runs', training, test, [])


SPLITS: dict[str, Callable[[Recording], Iterator[Split]]] = {
    'soft_neck': neck_splits,
    'soft_arm': arm_splits,
    'continuum_stand': stand_splits,
    'cable_platform': platform_splits,
}


def models(
    recording: Recording, split: Split, directory: Path, learned: dict[tuple[str, bool], Model]
) -> Iterator[tuple[str, Model]]:
    """Yield every model of a split with its name.

    `learned` caches the models of the package, because several splits have the same training rows.
    """
    efforts = (False, True) if split.training.effort.size else (False,)
    for with_effort in efforts:
        what = 'lengths and efforts' if with_effort else 'lengths'
        for degree in (1, 2, 3):
            fit = polynomial(split.training, degree, with_effort)
            yield f'polynomial of degree {degree}, {what}', fit
        if split.full is not None:
            for degree in (1, 2, 3):
                fit = polynomial(split.full, degree, with_effort)
                yield f'polynomial of degree {degree}, {what}{ALL_ROWS}', fit
        for label, model in baselines(split.training, with_effort):
            yield f'{label}, {what}', model
    link, at_zero = recording.link, np.zeros(split.training.length.shape[1])
    if isinstance(link, SoftLink) and link.name == 'continuum_stand':
        link, at_zero = fitted(link, split.training)

    def shifted(run: Run) -> Run:
        return replace(run, length=run.length - at_zero)

    def of_shifted(model: Model) -> Model:
        return lambda run: model(shifted(run))

    for with_effort in efforts:
        key = split.name.partition(' → ')[0], with_effort
        if key not in learned:
            learned[key] = package(link, directory, shifted(split.training), with_effort)
        what = 'lengths and efforts' if with_effort else 'lengths'
        yield f'this package, {what}', of_shifted(learned[key])
    if not isinstance(link, SoftLink):
        geometric = package(link, directory, split.training, learns=False)
        yield 'network of the geometric model, lengths', geometric
    if split.rests:
        robot = Robot.load(link.write(directory))
        yield 'statics with learned springs, payload known', Statics(robot, split.rests).posture


def learn(repository: Repository, files: Files) -> tuple[list[Result], dict[str, Any]]:
    """Learn from one repository; return all models' errors, and `observations` on its runs."""
    recording = repository.read(files)
    name, results = recording.link.name, list[Result]()
    learned = dict[tuple[str, bool], Model]()
    with tempfile.TemporaryDirectory() as folder:
        for split in SPLITS[name](recording):
            for label, model in models(recording, split, Path(folder) / 'robot', learned):
                off = error(model, split.test)
                off = round(off, 4)
                results.append(Result(name, split.name, len(split.training.length), label, off))
                print(f'{name}: {split.name}: {label}: {off:.4f} rad', flush=True)
    return results, observations(recording)


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
        shown['bend for the same lengths, over that at 0 g'] = {
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

    The polynomials that were fitted to all rows share one row of the table, which contains the
    smallest of their errors for each split. The best model from the rest samples is in bold.
    """
    errors, samples = dict[tuple[str, str], float](), dict[str, int]()
    for result in results:
        label = OF_ALL_ROWS if result.model.endswith(ALL_ROWS) else result.model
        before = errors.get((result.split, label), np.inf)
        errors[result.split, label] = min(before, result.error_rad)
        samples[result.split] = result.samples
    labels = [*dict.fromkeys(label for _, label in errors if label != OF_ALL_ROWS)]
    best = {s: min(e for (k, m), e in errors.items() if k == s and m in labels) for s in samples}
    heads = [f'{split} ({count} rests)' for split, count in samples.items()]
    lines = [f'| mean error [rad] | {" | ".join(heads)} |', '|---' * (len(heads) + 1) + '|']
    if any(label == OF_ALL_ROWS for _, label in errors):
        labels.append(OF_ALL_ROWS)
    for label in labels:
        cells = []
        for split in samples:
            value = errors.get((split, label), np.nan)
            text = '–' if np.isnan(value) else f'{value:.3f}' if value < 1.0 else '> 1'
            cells.append(f'**{text}**' if value == best[split] else text)
        lines.append(f'| {label} | {" | ".join(cells)} |')
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
    """Train and test models on all repositories that have clones; return 1 if there is none."""
    parser = Parser('recordings', "Learns public recordings of other people's robots.")
    parser.add_argument('--clones', type=Path, required=True, help='directory with the clones')
    parser.add_argument('--fetch', action='store_true', help='clone missing data from GitHub')
    text = 'use only repositories whose name contains this text'
    parser.add_argument('--only', default='', metavar='TEXT', help=text)
    parser.add_out('DIR', default=Path('doc/results/recordings'))
    args = parser.parse_args(argv)
    rows, shown = list[dict[str, Any]](), dict[str, Any]()
    for repository in repositories():
        clone = clone_of(repository, args.clones, args.fetch)
        if args.only not in repository.name or clone is None:
            reason = (
                'it is not cloned; add --fetch' if clone is None else 'it does not match --only'
            )
            print(f'{repository.name}: left out, because {reason}')
            continue
        results, also = learn(repository, Files(clone))
        rows += [result._asdict() for result in results]
        shown[repository.name] = also
        for key, value in also.items():
            print(f'{key}: {value}')
    if not rows:
        raise MusculoskeletalError(
            f'no repository of the bench is cloned in {args.clones} and matches '
            '--only; add --fetch to clone them, or change --only'
        )
    args.out.mkdir(parents=True, exist_ok=True)
    document = {'errors': rows, 'also': shown}
    text = json.dumps(document, indent=1, ensure_ascii=False)
    (args.out / 'result.json').write_text(text + '\n', encoding='utf-8')
    (args.out / 'tables.md').write_text(tables(document) + '\n', encoding='utf-8')
    print(tables(document))
    return 0
