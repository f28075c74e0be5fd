# SPDX-License-Identifier: Apache-2.0
"""`train --from-bag`: learn the body from recordings instead of from a moving arm."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.streams import Pairs, read_streams
from musculoskeletal_ae.exceptions import BagError
from musculoskeletal_ae.learning.offline import error, learn
from musculoskeletal_ae.learning.online import OnlineLearner
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot


def read(path: Path, robot: Robot) -> Pairs:
    """Return the paired messages of a bag; says what was left out.

    Raises:
        BagError: If it is damaged, or holds no θ and (T, l) that belong together.
    """
    bag = Bag.open(path, unfinished=True)
    for reason in bag.unfinished:
        print(f'warning: {path}: unfinished: {reason}', file=sys.stderr)
    streams = read_streams(bag, robot)
    for reason, count in streams.rejected.items():
        print(f'warning: {path}: {count} messages rejected, {reason}', file=sys.stderr)
    pairs = streams.pairs()
    if not len(pairs.time):
        problem = 'holds no joint_states and muscle_states that belong together'
        raise BagError(path, None, problem, 'record both topics of this robot')
    return pairs


def train_from_bags(
    robot: Robot, learner: OnlineLearner, recordings: dict[Path, Pairs], held_out: list[Path]
) -> Mae:
    """Learn from recordings in their order, print errors before and after, return the network.

    Args:
        robot: Whose arm was recorded.
        learner: Starts from its network.
        recordings: As `read` gives them, by path.
        held_out: Those that are only judged.
    """
    mae = learner.mae
    before = {path: error(mae, pairs) for path, pairs in recordings.items()}
    for path in recordings:
        if path in held_out:
            continue
        seconds = recordings[path].time[-1] - recordings[path].time[0]
        with tqdm(total=round(seconds, 1), unit=' s', desc=path.name, disable=None) as bar:
            learn(robot, learner, recordings[path], bar.update)
    samples = len(learner.collector.store)
    print(f'{samples} samples, {learner.updates} updates')
    for path, pairs in recordings.items():
        kind = 'held out' if path in held_out else 'learned from'
        after = error(learner.mae, pairs)
        print(f'{path} ({kind}): {before[path]:.4f} → {after:.4f} rad against its joint sensors')
    return replace(learner.mae, version=mae.version + learner.updates)
