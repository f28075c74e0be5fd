# SPDX-License-Identifier: Apache-2.0
"""Attacks the running system with messages, requests, kills, faults and files; counts what breaks.

    python -m bench attack [--quick] [--seed 0]

The whole system runs on an emulated arm that explores. A stranger publishes on every topic that a
node listens to (heard messages changed, and such as were never sane), calls every service with odd
content, breaks sensors, wires and motors, and kills nodes; every command of the controller is
recorded and judged. Beside it hostile files are read, and, but for the quick form, a learner is
killed as in `kills`.

Prints a table: promise, how often it was tried, how often it was broken. Exit status 1 if any was.
What a stranger may do on an open graph is not tried: command the modules, whom they obey, within
their limits; ask for a stop; set a parameter to a legal value.
"""

import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench import attack_files, kills
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.options import Parser, whole
from musculoskeletal_ae.robot.robot import Robot

JITTER = 0.03  # [s] by which a loaded machine publishes a command later than it was made
RELIEF = 0.3  # [s] for which a tension that is being relieved was measured before
SILENT = 10.0  # [s] that a node under attack may keep /diagnostics waiting
GROWTH = 1.2  # of a node's memory, over what it was after five minutes
YOUNG = 300.0  # [s]
MOST_MEMORY = 500.0  # [MB] of any node at any time


class Size(NamedTuple):
    """How much is tried."""

    messages: int
    node_kills: int
    learner_kills: int
    files: int
    episodes: int


FULL = Size(messages=100_000, node_kills=40, learner_kills=12, files=600, episodes=60)
QUICK = Size(messages=2000, node_kills=2, learner_kills=0, files=42, episodes=2)


class Row(NamedTuple):
    """One promise, how often it was tried, and how it was broken."""

    promise: str
    tried: int
    broken: list[str]


class Steps(NamedTuple):
    """How the commands of the controller changed from one to the next."""

    count: int
    largest_in: float  # winding in, in one tick [m]
    largest_out: float  # paying out [m]
    too_fast: list[str]


def changes(time: Array, number: Array, value: Array, rate: float, relieved: Array) -> Steps:
    """Judge the commands of one life of the controller.

    Args:
        time: When each was published [s], (N,).
        number: Which message it was, (N,): some may have been missed.
        value: Muscle lengths [m], (N, M).
        rate: Fastest change [m/s].
        relieved: Whether a muscle's tension was being relieved, (N, M).
    """
    step, allowed = np.diff(value, axis=0), rate * (np.diff(time)[:, None] + JITTER)
    finite = np.isfinite(value).all()
    if not finite or not len(step):
        return Steps(len(value), 0.0, 0.0, [] if finite else ['a command that is not finite'])
    fast = (step < -allowed) | ((step > allowed) & ~relieved[1:])
    ticks = step[np.diff(number) == 1]
    return Steps(
        len(value),
        -float(ticks.min(initial=0.0)),
        float(ticks.max(initial=0.0)),
        [
            f'muscle {m} by {1e3 * step[i, m]:.1f} mm in {1e3 * (time[i + 1] - time[i]):.0f} ms'
            for i, m in zip(*np.nonzero(fast))
        ],
    )


def relieved(time: Array, loads: list[tuple[float, Array]], limit: Array, muscles: int) -> Array:
    """Say for commands at `time` [s] (N,) which muscles pulled more than `limit` [N], (N, M)."""
    if not loads:
        return np.zeros((len(time), muscles), dtype=bool)
    at, over = np.array([t for t, _ in loads]), np.array([load > limit for _, load in loads])
    counted = np.concatenate([np.zeros((1, muscles)), np.cumsum(over, axis=0)])
    begin, end = np.searchsorted(at, time - RELIEF), np.searchsorted(at, time, side='right')
    return np.asarray(counted[end] > counted[begin])


def attack_graph(folder: Path, initial: Path, size: Size, seed: int) -> list[Row]:
    """Attack the running system."""
    from bench.attack_graph import LENGTH, Attack

    messages = -(-size.messages // size.episodes)
    with Attack(folder, initial, seed) as attack:
        attack.spin(2.0)
        for episode in range(size.episodes):
            kills = (episode + 1) * size.node_kills // size.episodes
            attack.episode(messages, kills - attack.tried['kills'])
            print(f'episode {episode + 1} of {size.episodes}: {dict(attack.tried)}', flush=True)
        attack.moving()
        robot, tried, found = attack.robot, attack.tried, attack.findings
    steps = []
    for life in range(attack.life + 1):
        mine = [c for c in attack.commands if c.life == life and c.topic == LENGTH]
        if mine:
            at = np.array([command.time for command in mine])
            eased = relieved(at, attack.loads, robot.tension.limit, robot.muscle_count)
            value = np.array([command.value for command in mine])
            number = np.array([command.number for command in mine])
            steps.append(changes(at, number, value, Settings().rate_limit, eased))
    fast = [what for step in steps for what in step.too_fast]
    print(
        f'{sum(step.count for step in steps)} commands; largest change in one tick: '
        f'{1e3 * max(step.largest_in for step in steps):.2f} mm in, '
        f'{1e3 * max(step.largest_out for step in steps):.2f} mm out'
    )
    print(f'longest silence of a node: {max(attack.silences.values(), default=0.0):.1f} s')
    silent = [f'{name}: {s:.1f} s' for name, s in attack.silences.items() if s > SILENT]
    fat = []
    for name, process in attack.processes.items():
        most = max((memory for _, memory in process.memory), default=0.0)
        old = [memory for age, memory in process.memory if age > YOUNG] or [most]
        print(f'{name}: at most {most:.0f} MB, {old[0]:.0f} MB at five minutes or never so old')
        if most > MOST_MEMORY or max(old) > GROWTH * old[0]:
            fat.append(f'{name} from {old[0]:.0f} to {most:.0f} MB')
    sent = tried['messages'] + tried['requests']
    commands = sum(step.count for step in steps)
    return [
        Row('no message or request ends a node', sent, found.pop('no node ends', [])),
        Row('every node goes on and reports', sent, silent + found.pop('every node goes on', [])),
        Row('every node answers', tried['requests'], found.pop('every node answers', [])),
        Row('no command changes faster than allowed', commands, fast),
        Row('samples survive', tried['kills'], found.pop('samples survive', [])),
        Row('memory stays', len(attack.processes), fat),
        Row(
            'the arm moves again afterwards',
            size.episodes + 1,
            [what for broken in found.values() for what in broken],
        ),
    ]


def main(argv: list[str]) -> int:
    """Attack, and print the table."""
    parser = Parser('attack', 'Attacks the running system and counts what breaks.')
    parser.add_quick('a minute of it')
    parser.add_argument('--messages', type=whole(1, 10_000_000), help='instead of 100 000')
    parser.add_argument('--out', type=Path, help='folder of the logs (default: a temporary one)')
    parser.add_argument('--initial', type=Path, help='checkpoint, instead of training one')
    parser.add_seed('of what is done')
    options = parser.parse_args(argv)
    size, begun = QUICK if options.quick else FULL, time.monotonic()
    size = size._replace(messages=options.messages or size.messages)
    with tempfile.TemporaryDirectory() as name:
        folder = options.out or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        initial, robot = options.initial, Robot.load('arm26')
        if initial is None:
            initial = folder / 'initial.safetensors'
            checkpoint.save(initial_mae(robot).mae, initial)
        rows = attack_graph(folder, initial, size, options.seed)
        if count := size.learner_kills:
            lost = kills.run(robot, Path(name) / 'killed', initial, count, options.seed)
            rows.append(Row('a killed learner loses nothing', count, lost))
    tried, broken, outcomes = attack_files.attack(size.files, options.seed)
    print(', '.join(f'{count} {what}' for what, count in sorted(outcomes.items())))
    rows.append(Row('a file is used or refused, soon', tried, broken))
    print(f'\n{"promise":<44} {"tried":>8} {"broken":>8}')
    for row in rows:
        print(f'{row.promise:<44} {row.tried:>8} {len(row.broken):>8}')
        print(''.join(f'    {what[:400]}\n' for what in row.broken[:5]), end='')
    print(f'{time.monotonic() - begun:.0f} s')
    return int(any(row.broken for row in rows))
