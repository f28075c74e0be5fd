# SPDX-License-Identifier: Apache-2.0
"""Kills a learner with SIGKILL at random moments and looks at what is on its disk afterwards.

python -m bench kills [--kills 50] [--seed 0]

A child process runs the `Learner` that the node runs, with its training process, on samples that a
seed draws, and says when it has accepted a sample and published a network. After each kill the next
child must have every sample that was accepted and a network no older than the last one published.
Exit status 1 if something was lost.
"""

import argparse
import copy
import subprocess
import sys
import tempfile
import threading
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from tqdm import tqdm

from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.samples import Sample, SampleStore
from musculoskeletal_ae.learning.trainer import TrainerProcess
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.robot import Robot

LONGEST = 6.0  # [s] until a child is killed: it starts, trains and saves within
SPACING = 0.02  # [s] between samples
STEPS = 20  # of training per update: many updates, many moments to be killed in
DEADLINE = 60.0  # [s] for a child to come up


def samples(robot: Robot, life: int) -> Iterator[Sample]:
    """Draw the samples of one child's life."""
    rng = np.random.default_rng([life, 0x51])
    while True:
        theta = robot.random_postures(1, rng)[0]
        tension = rng.uniform(robot.tension.bias, robot.tension.limit, robot.muscle_count)
        length = robot.muscle_lengths(theta, tension)
        yield Sample(theta, tension, length, np.zeros(robot.muscle_count))


def digest(store: SampleStore) -> int:
    """Return a checksum of all that is stored, in order."""
    sums = [zlib.crc32(np.concatenate(sample[:6]).tobytes()) for sample in store.samples]
    return zlib.crc32(np.array(sums, dtype=np.uint32).tobytes())


# -- the child ------------------------------------------------------------------------------------


def live(robot: Robot, directory: Path, initial: Path, life: int) -> None:
    """Learn until killed."""

    def say(*words: object) -> None:
        print(*words, flush=True)

    learner = Learner(robot, steps=STEPS, trainer=TrainerProcess, directory=directory)
    if learner.checkpoint is None:
        learner.begin(checkpoint.load(initial, robot))
    say('published', learner.mae.version)
    say('found', digest(learner.samples))
    for sample in samples(robot, life):
        learner.accept(sample)
        say('accepted')
        if learner.poll(time.monotonic()) is not None:
            say('published', learner.mae.version)
        time.sleep(SPACING)


# -- the parent -----------------------------------------------------------------------------------


class Child:
    """One life, and what it said."""

    def __init__(self, robot: Path, directory: Path, initial: Path, life: int) -> None:
        """Start it."""
        words = [sys.executable, '-m', 'bench', 'kills', '--robot', str(robot)]
        words += ['--live', str(life), '--directory', str(directory), '--initial', str(initial)]
        self._process = subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.lines: list[list[str]] = []
        self.up = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            # Without its end, a line was torn by the kill, and what it says was not said.
            if line.endswith('\n'):
                self.lines.append(line.split())
                if line.startswith('found'):
                    self.up.set()

    def kill(self) -> None:
        """End it as a power cut would."""
        self._process.kill()
        self._process.wait()
        self._reader.join()

    def trouble(self) -> str:
        """Return what it wrote to stderr."""
        assert self._process.stderr is not None
        return self._process.stderr.read()

    def said(self, word: str) -> list[int]:
        """Return the numbers that followed a word."""
        return [int(line[1]) for line in self.lines if line[0] == word and len(line) > 1]

    @property
    def accepted(self) -> int:
        """How many samples it accepted."""
        return sum(line[0] == 'accepted' for line in self.lines)


def run(robot: Robot, directory: Path, initial: Path, kills: int, seed: int) -> list[str]:
    """Kill so many children one after another; returns what was lost."""
    rng = np.random.default_rng(seed)
    # What may be on disk: a sample can be there before the child could say so.
    possible = [SampleStore()]
    lost: list[str] = []
    newest, published = 0, 0
    for life in tqdm(range(kills + 1), unit='kill', disable=None):
        last = life == kills
        child = Child(robot.description.directory, directory, initial, life)
        begun, wanted = time.monotonic(), rng.uniform(0.0, LONGEST)
        # Some are killed while they come up; the last has to.
        if last or wanted > 0.5 * LONGEST:
            child.up.wait(DEADLINE)
        time.sleep(max(0.0, begun + wanted - time.monotonic()))
        child.kill()
        versions = child.said('published')
        if found := child.said('found'):
            fitting = [store for store in possible if digest(store) == found[0]]
            if not fitting:
                lost.append(f'life {life}: the samples found are not those accepted before')
                break
            if versions[0] < newest:
                lost.append(f'life {life}: network {versions[0]} found, {newest} was published')
            possible = grown(fitting[0], robot, life, child.accepted)
        elif last:
            lost.append(f'the last learner did not come up: {child.trouble()}')
        newest, published = max([newest, *versions]), published + len(versions)
    accepted = possible[0].accepted
    print(f'{kills} kills, {accepted} samples accepted, {published} networks published: ', end='')
    print('; '.join(lost) or 'nothing lost')
    return lost


def grown(store: SampleStore, robot: Robot, life: int, accepted: int) -> list[SampleStore]:
    """Return the store after a life, without and with one sample more than was said."""
    drawn = samples(robot, life)
    for _ in range(accepted):
        store.add(next(drawn))
    more = copy.deepcopy(store)
    more.add(next(drawn))
    return [store, more]


def main(argv: list[str]) -> int:
    """Kill, and say what was lost."""
    parser = Parser('kills', 'Kills a learner at random moments: is anything lost?')
    parser.add_robot(default='arm26')
    parser.add_argument('--kills', type=int, default=50, help='how many')
    parser.add_seed('of the moments')
    parser.add_argument('--initial', type=Path, help='checkpoint, instead of training one')
    parser.add_argument('--live', type=int, help=argparse.SUPPRESS)
    parser.add_argument('--directory', type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    robot = Robot.load(args.robot)
    if args.live is not None:
        live(robot, args.directory, args.initial, args.live)
    with tempfile.TemporaryDirectory() as folder:
        initial = args.initial
        if initial is None:
            from musculoskeletal_ae.mae.training import initial_mae

            initial = Path(folder) / 'initial.safetensors'
            checkpoint.save(initial_mae(robot).mae, initial)
        return int(bool(run(robot, Path(folder) / 'state', initial, args.kills, args.seed)))
