# SPDX-License-Identifier: Apache-2.0
"""Divisions of the recordings into training and test rows.

Of each recording, COUNTS random rows of some poses, files or runs are learned, in DRAWS random
draws, and rows of others are the test. Further cases ask for more than the learned situations: they
are learned from rest samples, and tested with payloads or files that were not learned.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bench.recordings_read import Body, Recording, Run, SoftLink, fitted
from musculoskeletal_ae.arrays import Bools
from musculoskeletal_ae.learning.samples import CAPACITY

#: learn this many random rows; the last number is as many as the learner keeps
COUNTS = 20, 50, 100, 300, CAPACITY
DRAWS = 3  # draw the rows this many times
HALF = slice(0, None, 2)  # rests that are used for training: every other one
MOST_ROWS = 1500  # test random draws on at most about this many rows


class Case(NamedTuple):
    """One division of a recording into training and test data."""

    name: str
    body: Body
    training: Run
    test: Run
    draw: int = 0
    #: the runs of `training`, to which `Statics` is fitted; empty if it is not fitted
    rests: tuple[Run, ...] = ()


def joined(runs: list[Run]) -> Run:
    """Return the rows of several runs as one."""
    length, effort, theta = (
        np.concatenate([getattr(run, part) for run in runs])
        for part in ('length', 'effort', 'theta')
    )
    return Run('', float('nan'), length, effort, theta, runs[0].rests[:0])


def _learned_poses(run: Run) -> Bools:
    """Return which rows belong to every other pose, (N,).

    A pose extends from the end of the previous rest to the end of its own rest. The poses between,
    whose rests HALF leaves out, are for the test.
    """
    pose = np.searchsorted(run.rests[:, 1], np.arange(len(run.length)), side='right')
    return ~((pose % 2 == 1) & (pose < len(run.rests)))


def _neck(recording: Recording) -> Iterator[Case]:
    body, (none, half, whole) = recording.link, recording.runs
    own = none.at_rest(HALF)
    for test in (half, whole):
        yield Case(f'rests at 0 g → {test.name}', body, own, test)
    for first, second, test in ((none, whole, half), (none, half, whole), (half, whole, none)):
        rests = first.at_rest(HALF), second.at_rest(HALF)
        name = f'rests at {first.name}, {second.name} → {test.name}'
        yield Case(name, body, joined([*rests]), test, rests=rests)


def _arm(recording: Recording) -> Iterator[Case]:
    body, runs = recording.link, recording.runs
    bare, loaded = ([run for run in runs if run.load == load] for load in (0.0, 0.5))
    others = [run for run in runs if run.load not in (0.0, 0.5)]
    own = joined([run.at_rest() for run in bare[HALF]])
    yield Case('rests at 0 g → other files, 0 g', body, own, joined(bare[1::2]))
    rests = joined([run.at_rest() for run in bare + loaded])
    yield Case('rests at 0 g, 500 g → 200 g, 300 g', body, rests, joined(others))


#: cases with payloads or files that were not learned, of the recordings that have any
TRANSFERS: dict[str, Callable[[Recording], Iterator[Case]]] = {
    'soft_neck': _neck,
    'soft_arm': _arm,
}


def _pools(recording: Recording) -> tuple[str, Run, Run | None]:
    """Return the name of random draws, the rows that are drawn, and the test rows.

    The test rows are None if they are all rows that were not drawn. Rows with payload are left out.
    """
    runs = recording.runs
    if recording.link.name == 'soft_neck':
        learned = _learned_poses(runs[0])
        return 'random rows → other poses', runs[0].at(learned), runs[0].at(~learned)
    if recording.link.name == 'soft_arm':
        bare = [run for run in runs if not run.load > 0.0]
        return 'random rows → other files', joined(bare[HALF]), joined(bare[1::2])
    if recording.link.name == 'cable_platform':
        return 'random rests of one run → other runs', runs[0].at_rest(), joined(runs[1:])
    return 'random poses → all others', runs[0], None


def drawn(recording: Recording, count: int, draw: int) -> Case | None:
    """Return the case of `count` random rows; None if the recording has fewer.

    `draw` is the random seed. If the last of COUNTS exceeds the rows, all are learned, in one draw.
    """
    name, pool, test = _pools(recording)
    total = len(pool.length)
    if count == COUNTS[-1]:
        count = min(count, total)
    if count > total or (count == total and draw > 0):
        return None
    order = np.random.default_rng([draw, count]).permutation(total)
    body, training = recording.link, pool.at(order[:count])
    if test is None:
        test = pool.at(order[count:])
    if isinstance(body, SoftLink) and body.name == 'continuum_stand':
        # The publication does not state where the tendons run, so their routes are fitted.
        body, at_zero = fitted(body, training)
        training, test = (replace(run, length=run.length - at_zero) for run in (training, test))
    test = test.at(slice(None, None, max(1, len(test.length) // MOST_ROWS)))
    return Case(f'{count} {name}', body, training, test, draw)


def cases(recording: Recording, counts: list[int], draws: int) -> Iterator[Case]:
    """Yield the cases of a recording: payloads and files that were not learned, then random draws.

    All draws of a small count come before those of a larger one.
    """
    if transfers := TRANSFERS.get(recording.link.name):
        yield from transfers(recording)
    for count in counts:
        for draw in range(draws):
            if (case := drawn(recording, count, draw)) is not None:
                yield case
