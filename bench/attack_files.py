# SPDX-License-Identifier: Apache-2.0
"""Hostile files: malformed robots, tables, networks, states and recordings.

The package must use each file or refuse it with one line, within limits of time and memory. A child
process reads the files; if one crashes the interpreter, the bench records that and continues.
"""

import json
import os
import random
import resource
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from robots import chain

from musculoskeletal_ae.exceptions import MusculoskeletalError

LONGEST = 5.0  # report a file whose reading takes more CPU time than this [s]
#: report a file whose reading raises the peak memory of the process by more than this [MB]
MOST_MEMORY = 300
NASTY: tuple[object, ...] = (
    0.0, -1.0, 1e-300, 1e300, -1e300, float('nan'), float('inf'), 2**70, '', '\x1b[2J', [], {},
)  # fmt: skip
KINDS = ('urdf', 'muscles', 'table', 'checkpoint', 'state', 'metadata', 'mcap')


class Attempt(NamedTuple):
    """Outcome of reading one file: `used`, `refused`, or a description of what went wrong."""

    kind: str
    outcome: str
    seconds: float  # CPU time of reading the file [s]
    memory: float  # memory that reading the file added to the process's peak [MB]

    @property
    def broken(self) -> bool:
        """Whether the file was neither used nor refused, or took too much time or memory."""
        sound = self.outcome in ('used', 'refused')
        return not sound or self.seconds > LONGEST or self.memory > MOST_MEMORY


# -- making hostile files -------------------------------------------------------------------------


def strange_file(file: Path, rng: random.Random) -> None:
    """Replace a file by a pipe, link, folder, random data or another kind of wrong file."""
    file.unlink(missing_ok=True)
    kind = rng.randrange(7)
    if kind == 0:
        os.mkfifo(file)
    elif kind == 1:
        file.symlink_to(rng.choice(['/dev/zero', '/dev/tty', '/dev/random', file.name]))
    elif kind == 2:
        file.mkdir()
    elif kind == 3:
        file.write_bytes(rng.randbytes(rng.choice([0, 1, 1000, 1_000_000])))
    elif kind == 4:
        with file.open('wb') as stream:
            stream.truncate(rng.choice([1 << 22, 1 << 30]))  # sparse: takes no disk space
    elif kind == 5:
        file.write_text(rng.choice(['a,b\n' * 1_000_000, '[' * 400_000, '{"a":' * 400_000]))
    else:
        file.write_bytes('<ä/>'.encode('latin-1'))


def changed_tree(value: object, rng: random.Random) -> object:
    """Return `value`, a tree of lists and mappings, with an entry replaced, dropped or repeated."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        return {**value, key: changed_tree(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.9:
        i = rng.randrange(len(value))
        middle = rng.choice([[changed_tree(value[i], rng)]] * 6 + [[], [value[i]] * 3000])
        return [*value[:i], *middle, *value[i + 1 :]]
    return rng.choice(NASTY)


def bomb(rng: random.Random) -> str:
    """Return YAML that could take far more time or memory to read than its size suggests."""
    inner = rng.choice(['[{}]', '{{<<: [{}]}}'])
    lines = [f'a{i}: &a{i} ' + inner.format(', '.join([f'*a{i - 1}'] * 9)) for i in range(1, 30)]
    keys = '\n'.join(f'k{i}: {i}' for i in range(8000))
    return rng.choice(['\n'.join(['a0: &a0 {k: x}', *lines]), keys, 'a: 1' + ':00' * 100_000])


def changed_numbers(text: str, rng: random.Random) -> str:
    """Return an XML text with the value of one attribute replaced."""
    parts = text.split('"')
    parts[rng.randrange(1, len(parts), 2)] = rng.choice(
        ['nan', '-1', '1e300', '0', '', '0 0', '1 ' * 10_000, '\x9b1m', '1e-300', '-0.001 0 0']
    )
    return '"'.join(parts)


def damage(data: bytes, other: bytes, rng: random.Random) -> bytes:
    """Return `data` with one to three random faults.

    A fault deletes, changes or repeats bytes, or overwrites them with bytes of `other`.
    """
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        at = rng.randrange(len(changed) + 1)
        size = min(rng.choice((1, 4, 8, 9, 30, 300)), len(changed) - at)
        kind = rng.randrange(9)
        if kind == 0:
            del changed[at:]
        elif kind == 1 and size:
            for _ in range(rng.choice((1, 1, 2, 8))):
                changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
        elif kind == 2:
            changed[at : at + size] = rng.randbytes(size)
        elif kind == 3:
            changed[at : at + size] = bytes(size)
        elif kind == 4:
            del changed[at : at + size]
        elif kind == 5:
            changed[at:at] = rng.randbytes(size)
        elif kind == 6:
            changed[at:at] = changed[at : at + size]
        elif kind == 7:
            start = rng.randrange(len(other))
            changed[at : at + size] = other[start : start + size]
        else:
            # Replace a length or a time by an extreme value, preferably in a record's header.
            value = rng.choice((0, 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63, 2**64 - 1, len(data)))
            heads = [i for i in range(max(0, at - 200), at) if data[i + 2 : i + 9] == bytes(7)]
            at = rng.choice(heads) if heads else at
            changed[at : at + 8] = struct.pack('<Q', value)
        if not changed:
            break
    return bytes(changed)


# -- reading hostile files ------------------------------------------------------------------------


class Reader:
    """Writes hostile files of every kind to a folder, and reads them as the package does."""

    def __init__(self, folder: Path) -> None:
        """Write the valid files, of which damaged copies are read later."""
        from musculoskeletal_ae.body_model.observations import Sample
        from musculoskeletal_ae.learning.samples import SampleStore
        from musculoskeletal_ae.learning.state_directory import NEWEST, StateStore
        from musculoskeletal_ae.mae import checkpoint
        from musculoskeletal_ae.mae.initial_training import initial_mae
        from musculoskeletal_ae.robot.robot import Robot

        self.folder, self.robot = folder, Robot.load('arm26')
        self.sound = self.robot.description.directory
        self.network = checkpoint.to_bytes(initial_mae(self.robot, steps=2))
        store, state = SampleStore(), StateStore(folder / 'state', self.robot)
        state.load(store)
        for theta in self.robot.random_postures(5, np.random.default_rng(0)):
            tension = np.full(self.robot.muscle_count, 50.0)
            length = self.robot.muscle_lengths(theta, tension)
            store.add(Sample(theta, tension, length, np.zeros(self.robot.muscle_count)))
        state.keep(store, self.network)
        state.close()
        self.state = (folder / 'state' / NEWEST).read_bytes()
        bag = _write_bag(folder / 'bag')
        self.bag = {file.name: file.read_bytes() for file in sorted(bag.iterdir())}

    def attempt(self, kind: str, rng: random.Random) -> Callable[[], object]:
        """Write one hostile file of a kind; return the function that reads it."""
        trial = self.folder / 'trial'
        shutil.rmtree(trial, ignore_errors=True)
        if kind in ('urdf', 'muscles', 'table'):
            return self._robot(kind, trial, rng)
        trial.mkdir()
        if kind == 'checkpoint':
            return self._checkpoint(trial / 'network.safetensors', rng)
        if kind == 'state':
            return self._state(trial, rng)
        return self._bag(kind, trial, rng)

    def _robot(self, kind: str, trial: Path, rng: random.Random) -> Callable[[], object]:
        from musculoskeletal_ae.design.checks import check_robot
        from musculoskeletal_ae.robot.robot import Robot

        shutil.copytree(self.sound, trial)
        names = {'urdf': 'robot.urdf', 'muscles': 'muscles.yaml', 'table': 'moment_arms.csv'}
        file = trial / names[kind]
        data, way = file.read_bytes(), rng.random()
        if way < 0.25:
            strange_file(file, rng)
        elif way < 0.5:
            file.write_bytes(damage(data, rng.randbytes(300), rng))
        elif kind == 'muscles':
            tree = changed_tree(yaml.safe_load(data), rng)
            text = yaml.safe_dump(tree) if way < 0.9 else data.decode() + bomb(rng)
            file.write_text(text)
        elif kind == 'urdf':
            long = way > 0.95
            file.write_text(chain(38_000) if long else changed_numbers(data.decode(), rng))
        else:
            file.write_text(data.decode() + rng.choice(['x\n', 'a,b,c\n', 'é,é,nan\n' * 100_000]))
        return lambda: check_robot(Robot.load(trial), postures=5)

    def _checkpoint(self, file: Path, rng: random.Random) -> Callable[[], object]:
        from musculoskeletal_ae.mae import checkpoint

        size = int.from_bytes(self.network[:8], 'little')
        way = rng.random()
        if way < 0.2:
            strange_file(file, rng)
        elif way < 0.6:
            head = json.loads(self.network[8 : 8 + size])
            text = json.dumps(changed_tree(head, rng)).encode()
            tensors = self.network[8 + size :]
            file.write_bytes(len(text).to_bytes(8, 'little') + text + tensors)
        else:
            file.write_bytes(damage(self.network, rng.randbytes(300), rng))
        return lambda: checkpoint.load(file, self.robot)

    def _state(self, trial: Path, rng: random.Random) -> Callable[[], object]:
        from musculoskeletal_ae.learning.samples import SampleStore
        from musculoskeletal_ae.learning.state_directory import NEWEST, PREVIOUS, StateStore

        for name in rng.choice([(NEWEST,), (PREVIOUS,), (NEWEST, PREVIOUS)]):
            if rng.random() < 0.3:
                strange_file(trial / name, rng)
            else:
                (trial / name).write_bytes(damage(self.state, rng.randbytes(300), rng))

        def read() -> None:
            state = StateStore(trial, self.robot)
            state.load(SampleStore())
            state.close()

        return read

    def _bag(self, kind: str, trial: Path, rng: random.Random) -> Callable[[], object]:
        from musculoskeletal_ae.bags.reader import Bag

        for file, data in self.bag.items():
            (trial / file).write_bytes(data)
        victim = trial / ('bag_0.mcap' if kind == 'mcap' else 'metadata.yaml')
        way = rng.random()
        if way < 0.3:
            strange_file(victim, rng)
        elif way < 0.6 and kind == 'metadata':
            tree = changed_tree(yaml.safe_load(victim.read_bytes()), rng)
            victim.write_text(rng.choice([yaml.safe_dump(tree), bomb(rng)]))
        else:
            data = victim.read_bytes()
            victim.write_bytes(damage(data, data, rng))

        def read() -> None:
            bag = Bag.open(trial)
            for message in bag.messages():
                bag.decode(message)

        return read


def _write_bag(path: Path) -> Path:
    """Write a recording of a hundred messages in ten chunks."""
    from musculoskeletal_ae.bags.metadata import offered_qos
    from musculoskeletal_ae.bags.writer import BagWriter

    with BagWriter(path) as writer:
        writer.add_topic('/arm/anomaly', 'std_msgs/msg/Float64', [offered_qos(latched=False)])
        for i in range(100):
            message = b'\0\1\0\0' + struct.pack('<d', 0.01 * i)
            writer.write('/arm/anomaly', i * 10_000_000, i * 10_000_000, message)
            if i % 10 == 9:
                writer.flush()
    return path


def attempts(start: int, count: int, seed: int, folder: Path) -> Iterator[Attempt]:
    """Write and read the hostile files `start` to `count` − 1; yield the outcome of each.

    `seed` selects the files, which are written to `folder`.
    """
    reader = Reader(folder)
    for i in range(start, count):
        kind = KINDS[i % len(KINDS)]
        read = reader.attempt(kind, random.Random(f'{seed}/{i}'))  # noqa: S311 - repeatable
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        begun = time.process_time()
        print(json.dumps(['begun', i, kind]), flush=True)
        try:
            read()
            outcome = 'used'
        except MusculoskeletalError as error:
            outcome = 'refused' if str(error).isprintable() else 'escapes in the refusal'
        except Exception as error:  # noqa: BLE001 - every escaped exception is a finding
            outcome = f'{type(error).__name__}: {error}'[:200]
        memory = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 / 1e6
        yield Attempt(kind, outcome, time.process_time() - begun, memory)


def attack(count: int, seed: int) -> tuple[int, list[str], Counter[str]]:
    """Attack the package with `count` hostile files, which child processes read.

    `seed` selects the files.

    Returns:
        The number of files, a text for each broken promise, and the number of each outcome.
    """
    findings, outcomes, done = [], Counter[str](), 0
    while done < count:
        with tempfile.TemporaryDirectory() as folder:
            words = [sys.executable, '-m', 'bench.attack_files', str(done), str(count), str(seed)]
            child = subprocess.Popen(
                [*words, folder], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
            )
            assert child.stdout is not None and child.stderr is not None
            begun, last = done, ''
            for line in child.stdout:
                event = json.loads(line)
                if event[0] == 'begun':
                    last = f'file {event[1]}, {event[2]}'
                    continue
                result, done = Attempt(*event), done + 1
                outcomes[f'{result.kind}: {result.outcome.split(":")[0]}'] += 1
                if result.broken:
                    findings.append(f'{last}: {result}')
            if child.wait() != 0:
                findings.append(f'{last}: status {child.returncode}, {child.stderr.read()[-300:]}')
                done += 1 if last else count
                if done == begun:
                    break
    return min(done, count), findings, outcomes


def _child(start: str, count: str, seed: str, folder: str) -> None:
    # Without these limits, one file could exhaust the memory of the machine or block the bench. If
    # a limit is reached, the bench reports this as a finding.
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
    resource.setrlimit(resource.RLIMIT_CPU, (3600, 3600))
    import faulthandler

    faulthandler.enable()
    for result in attempts(int(start), int(count), int(seed), Path(folder)):
        print(json.dumps(result), flush=True)
        faulthandler.dump_traceback_later(300.0, exit=True)


if __name__ == '__main__':
    _child(*sys.argv[1:])
