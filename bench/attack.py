# SPDX-License-Identifier: Apache-2.0
"""Attacks the running system with messages, requests, kills, faults and files; counts what breaks.

    python -m bench attack [--quick] [--seeds 0,1,2,3,4] [--kinds 'false zeros',…]
    python -m bench attack --parts kills,files

The whole system runs on an emulated arm, once for each seed. Each run has three parts:

1. Known attacks (`attack_kinds`), in several variants, while the arm holds and while it explores.
   They are divided among the seeds. After each attack, the bench takes the steps that /diagnostics
   advises until the arm moves on.
2. Random events: targets, services, faults, suspended and killed nodes, false states of the body.
3. Messages of a hostile node. It publishes on every topic that a node subscribes to (modified
   genuine messages, and random ones), and calls every service with illegal content.

Every command, tension and status is recorded and checked. The bench also kills learners, which
must lose nothing that they had saved (`attack_kills`; not with `--quick`), and reads hostile files
(`attack_files`). `--parts` selects some of these: graph, kills, files.

The bench prints a table: promise, number of trials, number of violations, with the times of the
nodes' logs. The exit status is 1 if there is any violation. The hostile node does not do what every
node on an open graph may do: command the modules within their limits, request a stop, or set a
parameter to a legal value.
"""

import random
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench import attack_files, attack_kills
from bench.learned_arm import add_initial
from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.options import Parser, names, numbers, whole
from musculoskeletal_ae.robot.robot import Robot

if TYPE_CHECKING:
    from bench.attack_graph import Attack

#: accept a delay of up to this between computing and publishing a command on a loaded machine [s]
JITTER = 0.03
RELIEF = 0.3  # let paying out exceed the rate limit for this time after an excess tension [s]
SILENT = 10.0  # report a node under attack that has not reported on /diagnostics for this time [s]
GROWTH = 1.2  # report a node whose memory exceeds this multiple of its memory at the age YOUNG
YOUNG = 300.0  # compare later memory of a node with that at this age [s]
#: Report a tension that exceeds ABOVE times tension.limit for longer than MOMENT [s].
ABOVE, MOMENT = 1.1, 0.5
STILL = 0.002  # report a muscle of a stopped arm that is wound in by more than this [m]
MOST_MEMORY = 500.0  # report a node that ever uses more memory than this [MB]


class Size(NamedTuple):
    """Numbers of trials of each kind, over all seeds, and the rate of the arm."""

    attacks: int | None  # number of known attacks, or None for all of them
    events: int
    messages: int
    node_kills: int
    learner_kills: int
    files: int
    episodes: int
    rate: float = 100.0  # rate of the muscle modules' messages [Hz]


FULL = Size(None, 2000, messages=100_000, node_kills=40, learner_kills=50, files=600, episodes=20)
QUICK = Size(1, 2, messages=300, node_kills=1, learner_kills=0, files=7, episodes=1, rate=50.0)
SEEDS = 0, 1, 2, 3, 4
GRAPH, KILLS, FILES = PARTS = 'graph', 'kills', 'files'
EVENTS_IN_A_ROW = 50  # recover the arm after this many random events


class Row(NamedTuple):
    """One promise, the number of its trials, and its violations."""

    promise: str
    tried: int
    broken: list[str]


class Steps(NamedTuple):
    """The largest changes of one controller's commands, and the changes that were too fast."""

    commands: int  # number of commands that the controller published
    largest_in: float  # largest length by which a command winds a muscle in within one tick [m]
    largest_out: float  # largest length by which a command pays a muscle out within one tick [m]
    too_fast: list[str]


def changes(time: Array, number: Array, value: Array, rate: float, relieved: Bools) -> Steps:
    """Check how fast the commands of one controller process changed, against the legal rate.

    Args:
        time: Times of publishing [s], (N,).
        number: Sequence numbers of the commands, (N,); some messages may be missing.
        value: Commanded muscle lengths [m], (N, M).
        rate: Largest legal rate [m/s].
        relieved: Whether the controller may pay a muscle out faster because its tension had
            exceeded the limit, (N, M).
    """
    step, allowed = np.diff(value, axis=0), rate * (np.diff(time)[:, None] + JITTER)
    finite = np.isfinite(value).all()
    if not finite or not len(step):
        return Steps(len(value), 0.0, 0.0, [] if finite else ['a command was not finite'])
    fast = (step < -allowed) | ((step > allowed) & ~relieved[1:])
    ticks = step[np.diff(number) == 1]
    return Steps(
        len(value),
        -float(ticks.min(initial=0.0)),
        float(ticks.max(initial=0.0)),
        [
            f'the command of muscle {m} changed by {1e3 * step[i, m]:.1f} mm'
            f' in {1e3 * (time[i + 1] - time[i]):.0f} ms, at {time[i + 1]:.2f} s'
            for i, m in zip(*np.nonzero(fast))
        ],
    )


def relieved(time: Array, loads: list[tuple[float, Array]], limit: Array, muscles: int) -> Bools:
    """Return for each command which muscles exceeded their tension limit shortly before it.

    The period before a command is RELIEF seconds long.

    Args:
        time: Times of the commands [s], (N,).
        loads: Pairs of a time [s] and the tensions measured at that time [N], (M,).
        limit: Tension limit of each muscle [N], (M,).
        muscles: Number of muscles M.

    Returns:
        A mask, (N, M).
    """
    if not loads:
        return np.zeros((len(time), muscles), dtype=bool)
    at, over = np.array([t for t, _ in loads]), np.array([load > limit for _, load in loads])
    counted = np.concatenate([np.zeros((1, muscles)), np.cumsum(over, axis=0)])
    begin, end = np.searchsorted(at, time - RELIEF), np.searchsorted(at, time, side='right')
    return np.asarray(counted[end] > counted[begin])


def overloads(loads: list[tuple[float, Array]], highest: Array | float) -> Array:
    """Return the longest uninterrupted time [s] for which each tension was above `highest` [N].

    `loads` are pairs of a time [s] and the tensions measured at that time [N], (M,). The result
    is (M,), or (0,) if `loads` is empty.
    """
    if not loads:
        return np.zeros(0)
    longest, since = np.zeros(len(loads[0][1])), np.full(len(loads[0][1]), np.inf)
    for at, load in loads:
        since = np.where(load > highest, np.minimum(since, at), np.inf)
        longest = np.maximum(longest, np.where(np.isfinite(since), at - since, 0.0))
    return longest


def wound_in(time: Array, value: Array, begin: float, end: float) -> float:
    """Return the largest length [m] by which a muscle was wound in from `begin` to `end` [s].

    `value` are the commanded lengths [m], (N, M), at the times `time` [s], (N,).
    """
    during = value[(time > begin) & (time < end)]
    if len(during) < 2:
        return 0.0
    return float((np.maximum.accumulate(during, axis=0) - during).max())


def without(times: Array, intervals: list[tuple[float, float]]) -> Bools:
    """Return a mask of the times that lie outside all intervals (begin, end)."""
    outside = np.ones(len(times), dtype=bool)
    for begin, end in intervals:
        outside &= (times < begin) | (times > end)
    return outside


def attack_graph(
    folder: Path, initial: Path, size: Size, seed: int, planned: list[tuple[str, int, str]]
) -> list[Row]:
    """Run the system for one seed and attack it; return the promises with their violations.

    `planned` lists the known attacks: for each the kind, the number of the variant, and the state
    of the arm. Random events and hostile messages follow.
    """
    from bench.attack_graph import Attack
    from bench.attack_kinds import Scene, random_event

    folder.mkdir(parents=True, exist_ok=True)
    with Attack(folder, initial, seed, size.rate) as attack:
        scene = Scene(attack)
        attack.spin(2.0)
        for number, (kind, shape, moment) in enumerate(planned):
            begun = time.monotonic()
            scene.play(kind, shape, moment)
            took = time.monotonic() - begun
            print(f'  {number + 1} of {len(planned)}: {scene.what}: {took:.0f} s', flush=True)
        begun = time.monotonic()
        while attack.tried['events'] < size.events:
            scene.what = 'random events'
            if scene.bring('exploring'):
                for _ in range(min(EVENTS_IN_A_ROW, size.events - attack.tried['events'])):
                    random_event(scene)
                attack.set_faults([])
                scene.recover('exploring')
            else:
                break
        print(f'  {attack.tried["events"]} events: {time.monotonic() - begun:.0f} s', flush=True)
        begun = time.monotonic()
        for episode in range(size.episodes):
            kills = size.node_kills // size.episodes
            attack.episode(-(-size.messages // size.episodes), kills)
            print(f'  episode {episode + 1} of {size.episodes}', flush=True)
        print(f'  messages: {time.monotonic() - begun:.0f} s', flush=True)
        attack.moving()
    return evaluate(attack)


def evaluate(attack: 'Attack') -> list[Row]:
    """Check the data that the attack recorded; return each promise with its violations."""
    from bench.attack_graph import LENGTH

    robot, tried, violations = attack.robot, attack.tried, attack.findings
    fast, wound, count = list[str](), list[str](), 0
    stops = [
        (begin, end, mode)
        for (begin, mode), (end, _) in zip(attack.modes, [*attack.modes[1:], (np.inf, '')])
        if mode.startswith('stopped')
    ]
    for life in range(attack.life + 1):
        mine = [c for c in attack.commands if c.life == life and c.topic == LENGTH]
        if not mine:
            continue
        at = np.array([command.time for command in mine])
        kept = without(at, attack.foreign)
        at, mine = at[kept], [command for command, is_kept in zip(mine, kept) if is_kept]
        if not mine:
            continue
        eased = relieved(at, attack.loads, robot.tension.limit, robot.muscle_count)
        value = np.array([command.value for command in mine])
        number = np.array([command.number for command in mine])
        steps = changes(at, number, value, Settings().rate_limit, eased)
        count += steps.commands
        fast += steps.too_fast
        for begin, end, mode in stops:
            if (length := wound_in(at, value, begin + JITTER, end)) > STILL:
                wound.append(f'{1e3 * length:.1f} mm in {mode}, from {begin:.2f} s')
    # Leave out tensions while other nodes command the modules or pull at the hand, or while sensor
    # data are wrong.
    excluded = [*attack.lying, *attack.foreign, *attack.pulled]
    true = [load for load in attack.loads if without(np.array([load[0]]), excluded)[0]]
    highest, when = max(((float(load.max()), at) for at, load in true), default=(0.0, 0.0))
    tense = [
        f'{robot.muscles[m]} for {seconds:.1f} s, highest tension {highest:.0f} N at {when:.2f} s'
        for m, seconds in enumerate(overloads(true, ABOVE * robot.tension.limit))
        if seconds > MOMENT
    ]
    silent = [f'{name}: {s:.1f} s' for name, s in attack.silences.items() if s > SILENT]
    fat = []
    for name, process in attack.processes.items():
        most = max((memory for _, memory in process.memory), default=0.0)
        old = [memory for age, memory in process.memory if age > YOUNG] or [most]
        if most > MOST_MEMORY or max(old) > GROWTH * old[0]:
            fat.append(f'{name} from {old[0]:.0f} to {most:.0f} MB')
    sent = tried['messages'] + tried['requests']
    take = violations.pop
    return [
        Row('no message, request or event ends a node', sent, take('no node ends', [])),
        Row('every node goes on to report', sent, silent + take('every node goes on', [])),
        Row('every node answers', tried['requests'], take('every node answers', [])),
        Row('no command changes faster than allowed', count, fast),
        Row('tension above 1.1 × limit lasts 0.5 s at most', len(true), tense),
        Row('a stopped arm is not wound in', len(stops), wound),
        Row(
            'no node reports OK for 2 s or longer while something is wrong',
            tried['status'],
            take('no OK while something is wrong', []),
        ),
        Row(
            'the remedy in /diagnostics recovers the arm',
            tried['attacks'],
            take('the remedy helps', []),
        ),
        Row('no sample is lost', tried['kills'], take('samples survive', [])),
        Row('memory does not grow', len(attack.processes), fat),
        Row(
            'the arm moves again after an attack',
            tried['attacks'] + tried['events'],
            [what for broken in violations.values() for what in broken],
        ),
    ]


def together(rows: list[Row]) -> list[Row]:
    """Merge the rows of all seeds into one for each promise."""
    merged: dict[str, Row] = {}
    for row in rows:
        before = merged.get(row.promise, Row(row.promise, 0, []))
        merged[row.promise] = Row(
            row.promise, before.tried + row.tried, [*before.broken, *row.broken]
        )
    return list(merged.values())


def main(argv: list[str]) -> int:
    """Run the attacks, and print the table."""
    from bench.attack_kinds import KINDS, all_attacks

    parser = Parser('attack', 'Attacks the running system and counts the promises that it breaks.')
    parser.add_quick('attack for about half a minute only')
    parser.add_argument(
        '--messages',
        type=whole(1, 10_000_000),
        help='number of hostile messages (default: 100 000; with --quick 300)',
    )
    text = 'number of random events (default: 2000; with --quick 2)'
    parser.add_argument('--events', type=whole(0, 10_000_000), help=text)
    parser.add_out('DIR', 'folder of the logs (default: a temporary one)', is_optional=True)
    add_initial(parser)
    text = 'random seeds (default: 0,1,2,3,4; with --quick 0)'
    parser.add_argument('--seeds', type=numbers, help=text)
    parser.add_argument('--kinds', type=names, help='names of the attacks to run (default: all)')
    parser.add_argument('--parts', type=names, default=PARTS, help='parts of the bench to run')
    options = parser.parse_args(argv)
    if unknown := set(options.parts) - set(PARTS):
        parser.error(f'--parts: unknown parts {", ".join(unknown)}; legal: {", ".join(PARTS)}')
    size, begun = QUICK if options.quick else FULL, time.monotonic()
    events = size.events if options.events is None else options.events
    size = size._replace(events=events, messages=options.messages or size.messages)
    seeds = [int(seed) for seed in options.seeds or (SEEDS[:1] if options.quick else SEEDS)]
    with tempfile.TemporaryDirectory() as name:
        folder = options.out or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        initial, robot = options.initial, Robot.load('arm26')
        if initial is None:
            initial = folder / 'initial.safetensors'
            checkpoint.save(initial_mae(robot), initial)
        planned = [each for each in all_attacks() if each[0] in (options.kinds or KINDS)]
        random.Random(seeds[0]).shuffle(planned)  # noqa: S311 - must be repeatable
        planned, rows = planned[: size.attacks], []
        share = size._replace(
            events=-(-size.events // len(seeds)),
            messages=-(-size.messages // len(seeds)),
            node_kills=-(-size.node_kills // len(seeds)),
            episodes=-(-size.episodes // len(seeds)),
        )
        for number, seed in enumerate(seeds if GRAPH in options.parts else ()):
            print(f'seed {seed}', flush=True)
            mine = planned[number :: len(seeds)]
            rows += attack_graph(folder / f'seed_{seed}', initial, share, seed, mine)
            print_rows(together(rows))
        rows = together(rows)
        if KILLS in options.parts and (count := size.learner_kills):
            lost = attack_kills.run(robot, Path(name) / 'killed', initial, count, seeds[0])
            rows.append(Row('a killed learner loses nothing', count, lost))
    if FILES in options.parts:
        tried, broken, outcomes = attack_files.attack(size.files, seeds[0])
        print(', '.join(f'{count} {what}' for what, count in sorted(outcomes.items())))
        rows.append(
            Row('each damaged file is loaded or refused, within the time limit', tried, broken)
        )
    print_rows(rows)
    print(f'{time.monotonic() - begun:.0f} s')
    return int(any(row.broken for row in rows))


def print_rows(rows: list[Row]) -> None:
    """Print the promises with their trials and violations."""
    print(f'\n{"promise":<46} {"tried":>8} {"broken":>8}')
    for row in rows:
        print(f'{row.promise:<46} {row.tried:>8} {len(row.broken):>8}')
        print(''.join(f'    {what[:400]}\n' for what in row.broken[:5]), end='', flush=True)
