# SPDX-License-Identifier: Apache-2.0
"""Kills a learner by SIGKILL at random times, and checks its saved state.

A child process runs the `Learner` of the node, with its training process, on random samples. It
reports each accepted sample and each published network. After a kill, the next child must load all
accepted samples, and a network that is not older than the last published one.
"""

import copy
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from tqdm import tqdm

from musculoskeletal_ae.body_model.observations import Sample
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.learning.training_process import TrainerProcess
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.robot.robot import Robot

#: kill a child no later than this after its start [s]; by then, it has started, trained and saved
LONGEST = 6.0
SPACING = 0.02  # let the learner accept a sample at this interval [s]
#: train for this many steps in an update; they are few, so that a kill interrupts many saves
STEPS = 20
DEADLINE = 60.0  # wait at most this long for a child to start [s]


def samples(robot: Robot, life: int) -> Iterator[Sample]:
    """Yield the random samples that child process number `life` accepts."""
    rng = np.random.default_rng([life, 0x51])
    while True:
        theta = robot.random_postures(1, rng)[0]
        tension = rng.uniform(robot.tension.bias, robot.tension.limit, robot.muscle_count)
        length = robot.muscle_lengths(theta, tension)
        yield Sample(theta, tension, length, np.zeros(robot.muscle_count))


def digest(store: SampleStore) -> int:
    """Return a checksum of all stored samples, in order."""
    sums = [zlib.crc32(np.concatenate(sample[:6]).tobytes()) for sample in store.samples]
    return zlib.crc32(np.array(sums, dtype=np.uint32).tobytes())


# -- the child ------------------------------------------------------------------------------------


def live(robot: Robot, directory: Path, initial: Path, life: int) -> None:
    """Run a learner that accepts one random sample after another, until the process is killed.

    It prints a line for each sample that it has accepted and for each network that it publishes.
    `life` is the number of this process.
    """

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
    """A process that runs a learner, with its reports so far."""

    def __init__(self, robot: Path, directory: Path, initial: Path, life: int) -> None:
        """Start child number `life`, which continues from the state that `directory` keeps."""
        words = [sys.executable, '-m', 'bench.attack_kills', str(robot), str(directory)]
        words += [str(initial), str(life)]
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
            # Do not count a line without a newline, which the kill has interrupted.
            if line.endswith('\n'):
                self.lines.append(line.split())
                if line.startswith('found'):
                    self.up.set()

    def kill(self) -> None:
        """Kill the process by SIGKILL, which gives it no time to save anything."""
        self._process.kill()
        self._process.wait()
        self._reader.join()

    def trouble(self) -> str:
        """Return the error output of the process."""
        assert self._process.stderr is not None
        return self._process.stderr.read()

    def numbers_after(self, word: str) -> list[int]:
        """Return the number in each line of the child's output that begins with `word`."""
        return [int(line[1]) for line in self.lines if line[0] == word and len(line) > 1]

    @property
    def accepted(self) -> int:
        """Number of samples that the process has accepted."""
        return sum(line[0] == 'accepted' for line in self.lines)


def run(robot: Robot, directory: Path, initial: Path, kills: int, seed: int) -> list[str]:
    """Kill `kills` learners one after another; return a line for each loss of saved data.

    Each learner is checked against what the earlier ones had reported. A last learner follows,
    which shows what was left after the last kill.
    """
    rng = np.random.default_rng(seed)
    # All stores that may be on disk: the kill may come after a sample was saved and before the
    # child has reported it.
    possible = [SampleStore()]
    lost: list[str] = []
    newest, published = 0, 0
    for life in tqdm(range(kills + 1), unit='kill', disable=None):
        last = life == kills
        child = Child(robot.description.directory, directory, initial, life)
        begun, wanted = time.monotonic(), rng.uniform(0.0, LONGEST)
        # Late kills hit a child that has started. Early ones may hit it while it starts, but the
        # last child must start, because it shows what the others have saved.
        if last or wanted > 0.5 * LONGEST:
            child.up.wait(DEADLINE)
        time.sleep(max(0.0, begun + wanted - time.monotonic()))
        child.kill()
        versions = child.numbers_after('published')
        if digests := child.numbers_after('found'):
            fitting = [store for store in possible if digest(store) == digests[0]]
            if not fitting:
                lost.append(
                    f'learner {life}: it loaded samples that differ from those that the earlier '
                    'learners had accepted'
                )
                break
            if versions[0] < newest:
                lost.append(
                    f'learner {life}: it loaded network {versions[0]}, but {newest} was published '
                    'before'
                )
            possible = grown(fitting[0], robot, life, child.accepted)
        elif last:
            lost.append(f'the last learner did not start: {child.trouble()}')
        newest, published = max([newest, *versions]), published + len(versions)
    accepted = possible[0].accepted
    print(f'{kills} kills, {accepted} samples accepted, {published} networks published: ', end='')
    print('; '.join(lost) or 'nothing lost')
    return lost


def grown(store: SampleStore, robot: Robot, life: int, accepted: int) -> list[SampleStore]:
    """Return the two stores that a killed child may leave on disk.

    One has the samples that the child reported as accepted. The other has one more, because the
    kill may come between saving a sample and reporting it.
    """
    drawn = samples(robot, life)
    for _ in range(accepted):
        store.add(next(drawn))
    more = copy.deepcopy(store)
    more.add(next(drawn))
    return [store, more]


if __name__ == '__main__':
    live(Robot.load(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4]))
