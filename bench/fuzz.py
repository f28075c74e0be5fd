# SPDX-License-Identifier: Apache-2.0
"""Damages bags at random and says how the reader takes it.

    python -m bench fuzz --count 10000 --seed 0

Each damaged bag must be read in full, or refused with a BagError; of one that is reported as
unfinished the messages must be the first ones. Where the recorder wrote no checksums, and that is
reported, only their number counts. Anything else, or more than 5 s, is a failure.
"""

import random
import resource
import shutil
import struct
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from bench import bag_samples as samples
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.exceptions import BagError
from musculoskeletal_ae.options import Parser, whole

LONGEST = 5.0  # [s] of the processor for one bag
MESSAGES = 50
_MEMORY = 3 << 30  # [bytes] of address space, of which libraries reserve most


class Base(NamedTuple):
    """A sound bag: its kind, and its files by name."""

    name: str
    files: dict[str, bytes]

    @property
    def mcap(self) -> str:
        """Name of the mcap file."""
        return next(name for name in self.files if name.endswith('.mcap'))


class Result(NamedTuple):
    """What happened: `full`, `prefix` or `refused`; anything else is a failure."""

    outcome: str
    seconds: float


def bases(folder: Path, content: list[samples.Sample]) -> list[Base]:
    """Return sound bags of every kind."""
    for compression in ('none', 'zstd'):
        samples.write_ours(folder / compression, content, compression, finish=True)
    samples.write_ours(folder / 'killed', content, 'zstd', finish=False)
    samples.write_rosbags(folder / 'rosbags', content)
    kinds = []
    for directory in sorted(path for path in folder.iterdir() if path.is_dir()):
        files = {file.name: file.read_bytes() for file in sorted(directory.iterdir())}
        kinds.append(Base(directory.name, files))
    for name, options in samples.BARE.items():
        samples.write_mcap(folder / 'bare.mcap', content, **options)
        kinds.append(Base(name, {'bare.mcap': (folder / 'bare.mcap').read_bytes()}))
    return kinds


def damage(data: bytes, other: bytes, rng: random.Random) -> bytes:
    """Return the bytes with one to three random faults."""
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
            # A length or a time: the nastiest numbers, preferably where a record's head is.
            value = rng.choice((0, 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63, 2**64 - 1, len(data)))
            heads = [i for i in range(max(0, at - 200), at) if data[i + 2 : i + 9] == bytes(7)]
            at = rng.choice(heads) if heads else at
            changed[at : at + 8] = struct.pack('<Q', value)
        if not changed:
            break
    return bytes(changed)


def attempt(path: Path, base: Base, content: list[samples.Sample], unfinished: bool) -> Result:
    """Open and read one bag to its end."""
    begin = time.process_time()
    expected = [(sample.topic, *sample[2:]) for sample in content]
    if base.name == 'rosbags':
        expected = [(sample.topic, sample.log_time, 0, sample.data) for sample in content]
    try:
        bag = Bag.open(path, unfinished=unfinished)
        messages = list(bag.messages())
        for message in messages:
            if not bag.topics[message.topic].refused:
                bag.decode(message)
    except BagError:
        outcome = 'refused'
    except Exception as error:  # noqa: BLE001 - whatever a damaged bag lets out is a finding
        outcome = f'crash: {type(error).__name__}: {error}'
    else:
        read = [message[:4] for message in messages]
        checked = all(file.checked for file in bag.files)
        if not checked:
            sound = len(read) == len(expected) or bool(bag.unfinished)
        else:
            sound = read == (expected[: len(read)] if bag.unfinished else expected)
        outcome = ('prefix' if bag.unfinished else 'full') if sound else 'wrong read'
    seconds = time.process_time() - begin
    return Result(outcome if seconds < LONGEST else f'hang: {seconds:.1f} s', seconds)


def fuzz(count: int, seed: int) -> tuple[Counter[str], list[str], float]:
    """Damage and read `count` bags.

    Returns:
        Outcomes by kind of bag, failures, and the longest time [s] for one bag.
    """
    outcomes: Counter[str] = Counter()
    failures = []
    slowest = 0.0
    content = samples.samples(MESSAGES, '/left_arm', seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sound = bases(folder, content)
        trial = folder / 'trial'
        for i in range(count):
            rng = random.Random(f'{seed}/{i}')  # noqa: S311 - must be repeatable
            base, other = sound[i % len(sound)], rng.choice(sound)
            victim = base.mcap
            if rng.random() < 0.15 and 'metadata.yaml' in base.files:
                victim = 'metadata.yaml'
            trial.mkdir()
            for file, data in base.files.items():
                strange = other.files[other.mcap]
                changed = damage(data, strange, rng) if file == victim else data
                (trial / file).write_bytes(changed)
            path = trial / 'bare.mcap' if 'bare.mcap' in base.files else trial
            result = attempt(path, base, content, unfinished=rng.random() < 0.5)
            slowest = max(slowest, result.seconds)
            outcomes[f'{base.name}: {result.outcome.split(":")[0]}'] += 1
            if result.outcome not in ('full', 'prefix', 'refused'):
                failures.append(f'trial {i}, {base.name}, {victim}: {result.outcome}')
            shutil.rmtree(trial)
    return outcomes, failures, slowest


def main(argv: list[str]) -> int:
    """Print a summary; exit status 1 if there was a failure."""
    parser = Parser('fuzz', 'Damages bags at random and reads them.')
    parser.add_argument('--count', type=whole(1, 10_000_000), default=10_000, help='bags')
    parser.add_seed('of the damage')
    options = parser.parse_args(argv)
    # A reader that asks for what a damaged length claims then fails instead of taking the machine.
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    begin = time.monotonic()
    outcomes, failures, slowest = fuzz(options.count, options.seed)
    for outcome, count in sorted(outcomes.items()):
        print(f'{outcome:<28} {count:>7}')
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f'{options.count} bags in {time.monotonic() - begin:.0f} s, slowest {slowest:.2f} s, '
        f'peak memory {peak:.0f} MiB, {len(failures)} failures'
    )
    print('\n'.join(failures[:20]))
    return 1 if failures else 0
