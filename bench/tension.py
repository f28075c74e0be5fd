# SPDX-License-Identifier: Apache-2.0
"""Measures how long tensions of healthy arms exceed their limit, from the first second on.

    python -m bench tension [--robot musashi_left_arm] [--seeds 5,…,14] [--quick]

New individuals start with the initial network, in closed loop with estimator, controller and
learner, in one process. Each explores for a minute and learns at the same time. Then the learner is
off: each individual moves to random targets with every control method and the initial network, and
holds them. The bench prints:

- the highest measured tension as a multiple of `tension.limit`,
- the longest uninterrupted time above `ALLOWED` times the limit,
- the total times above `ALLOWED` times the limit, and above the limit,
- the number of stops,
- for exploration, the number of samples and the held-out error of the network.

Exit status 1 if a tension was above `ALLOWED` times its limit for longer than `LONGEST`, or if a
healthy arm stopped.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from bench.learned_arm import add_initial, initial_network
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import METHODS, Settings
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.emulator.reality import KIN, make_arm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments import online_learning
from musculoskeletal_ae.experiments.recording import (
    EXPLORATION_STREAM,
    HELD_OUT_STREAM,
    SAMPLE_TIME,
    ClosedLoop,
    Recording,
    estimation_error,
    record,
)
from musculoskeletal_ae.experiments.workers import workers
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion.explored_postures import TRIES, holdable_postures
from musculoskeletal_ae.options import Parser, names, positive
from musculoskeletal_ae.robot.robot import Robot

#: Report a tension that exceeds ALLOWED times tension.limit for longer than LONGEST [s].
ALLOWED, LONGEST = 1.1, 0.5
EXPLORED = 60.0  # let each individual explore for this time [s]
#: move to this many targets with each method, and stay at each for this time [s]
TARGETS, HELD = 4, 4.0
HELD_OUT = 60.0  # measure the error on a held-out motion of this duration [s]
HEAD = (
    f'{"seed":>5} {"what":<12} {"max/limit":>9} {"longest":>8} {"above":>7} {"above":>7} '
    f'{"stops":>5} {"samples":>7} {"error":>7}\n'
    f'{"":>5} {"":<12} {"":>9} {f"> {ALLOWED} [s]":>8} {f"{ALLOWED} [s]":>7} {"1 [s]":>7} '
    f'{"":>5} {"":>7} {"[rad]":>7}'
)


class Excess(NamedTuple):
    """Measures of how far and how long tensions exceeded their limit."""

    highest: float  # highest tension, relative to tension.limit
    longest: float  # longest uninterrupted time of a tension above ALLOWED · T_limit [s]
    allowed: float  # largest total time of a muscle above ALLOWED · T_limit [s]
    limit: float  # largest total time of a muscle above the limit [s]


def excess(share: Array, dt: float) -> Excess:
    """Return how far and how long measured tensions exceeded their limit.

    Args:
        share: Tensions as multiples of the limit, (N, M).
        dt: Time between two rows [s].
    """
    longest, run = 0.0, np.zeros(share.shape[1])
    for row in share > ALLOWED:
        run = np.where(row, run + dt, 0.0)
        longest = max(longest, float(run.max()))
    above = [float((share > level).sum(axis=0).max()) * dt for level in (ALLOWED, 1.0)]
    return Excess(float(share.max(initial=0.0)), longest, above[0], above[1])


class Observed:
    """A control loop that records measured tensions."""

    def __init__(self, arm: Arm, mae: Mae, settings: Settings, seed: int) -> None:
        self.loop = ClosedLoop(arm, mae, settings, EXPLORATION_STREAM + seed)
        self.shares: list[Array] = []

    def run(self, step: Callable[[], tuple[Array, ...]], seconds: float) -> None:
        """Call `step` for a time [s], and record the tensions after each call."""
        limit = self.loop.arm.robot.tension.limit
        for _ in range(round(seconds / SAMPLE_TIME)):
            self.shares.append(step()[3] / limit)

    @property
    def excess(self) -> Excess:
        """Return how far and how long the recorded tensions exceeded their limit."""
        return excess(np.array(self.shares), SAMPLE_TIME)


def explore(
    arm: Arm, initial: Mae, seed: int, seconds: float, held_out: Recording
) -> tuple[Excess, int, int, float]:
    """Explore and learn for `seconds` [s]; `seed` selects the exploration.

    Returns:
        How tensions exceeded their limit, the number of stops, the number of samples, and the mean
        estimation error on `held_out` after learning [rad].
    """
    observed = Observed(arm, initial, Settings(), seed)
    loop, learner = observed.loop, Learner(arm.robot, initial, 'default', seed)
    for count, row in enumerate(online_learning.explore(loop, learner, seconds)):
        learner.step(count * SAMPLE_TIME, row[1], row[3], row[2])
        observed.shares.append(row[3] / arm.robot.tension.limit)
    error = estimation_error(learner.mae, held_out, 10)
    return observed.excess, loop.stops, len(learner.samples), error


def go(arm: Arm, initial: Mae, seed: int, method: str, targets: int) -> tuple[Excess, int]:
    """Go to random targets with one control method, and hold them.

    `seed` selects the targets.

    Returns:
        How tensions exceeded their limit, and the number of stops.
    """
    observed = Observed(arm, initial, Settings(method=method), seed)
    robot, loop = arm.robot, observed.loop
    rng = np.random.default_rng([seed, 0x7E])
    postures = (robot.random_postures(1, rng)[0] for _ in range(TRIES))
    stops = 0
    observed.run(loop.step, 0.1)
    for theta, _ in holdable_postures(robot, postures, targets):
        if method != 'float':
            loop.target(theta)
        observed.run(loop.step, HELD if method not in ('first', 'second') else 2.0 * HELD)
        if not loop.core.supervisor.is_running:
            stops += 1
            loop.core.reset(np.inf)
    return observed.excess, stops


def line(seed: int, what: str, excess: Excess, stops: int, rest: str = '') -> str:
    """Return a line of the table: what an individual did, and how far it exceeded its limits."""
    return (
        f'{seed:>5} {what:<12} {excess.highest:>9.3f} {excess.longest:>8.2f} '
        f'{excess.allowed:>7.2f} {excess.limit:>7.2f} {stops:>5}{rest}'
    )


def measure(
    robot: Robot,
    reality: str,
    initial: Mae,
    seed: int,
    methods: Sequence[str],
    share: float,
    seconds: float,
) -> list[tuple[str, Excess, int, tuple[int, float] | None]]:
    """Measure one individual while it explores, and while it moves to targets by each method.

    `reality` and `seed` select the individual. Every run begins with a new arm and the network
    `initial`. The arm explores for `share` · `seconds` [s]; `share` also scales the number of
    targets.

    Returns:
        For each run: what the arm did, the excess of its tensions, and the number of its stops. For
        the exploration also the number of samples and the error after learning [rad], else None.
    """
    held_out = record(make_arm(robot, seed, reality), initial, HELD_OUT_STREAM, share * HELD_OUT)
    results = list[tuple[str, Excess, int, tuple[int, float] | None]]()
    if seconds * share >= SAMPLE_TIME:
        arm = make_arm(robot, seed, reality)
        excess, stops, samples, error = explore(arm, initial, seed, share * seconds, held_out)
        results.append(('exploring', excess, stops, (samples, error)))
    for method in methods:
        arm = make_arm(robot, seed, reality)
        count = max(1, round(share * TARGETS))
        results.append((method, *go(arm, initial, seed, method, count), None))
    return results


def main(argv: list[str]) -> int:
    """Measure every individual, and print the table."""
    parser = Parser('tension', (__doc__ or '').partition('\n')[0])
    parser.add_robot()
    parser.add_seeds(tuple(range(5, 15)))
    parser.add_quick('a quarter of the time')
    parser.add_argument(
        '--reality', default=KIN, help='emulator model: kin, foreign or an MJCF file'
    )
    parser.add_argument(
        '--methods',
        type=names,
        default=tuple(METHODS),
        help='control methods to compare, or - for none',
    )
    parser.add_argument(
        '--seconds', type=positive, default=EXPLORED, help='time of exploration [s]'
    )
    add_initial(parser)
    parser.add_workers()
    options = parser.parse_args(argv)
    share = 0.25 if options.quick else 1.0
    robot = Robot.load(options.robot)
    initial = initial_network(robot, options.initial)
    methods = [] if '-' in options.methods else options.methods
    if wrong := set(methods) - set(METHODS):
        raise MusculoskeletalError(
            f'--methods: unknown methods {", ".join(sorted(wrong))}; legal: {", ".join(METHODS)}, -'
        )
    print(HEAD)
    failures, worst, rows = 0, Excess(0.0, 0.0, 0.0, 0.0), []
    calls = [
        (robot, options.reality, initial, seed, methods, share, options.seconds)
        for seed in options.seeds
    ]
    with workers(options.jobs, options.scheduler) as processes:
        for seed, results in zip(options.seeds, processes.in_order(measure, calls), strict=True):
            for what, excess, stops, learned in results:
                rest = ''
                if learned is not None:
                    rows.append(learned)
                    rest = f' {learned[0]:>7} {learned[1]:>7.3f}'
                print(line(seed, what, excess, stops, rest), flush=True)
                failures += (excess.longest > LONGEST) + stops
                worst = Excess(*np.maximum(worst, excess))
    means = np.mean(rows, axis=0) if rows else (np.nan, np.nan)
    print(line(-1, 'worst, mean', worst, failures, f' {means[0]:>7.0f} {means[1]:>7.3f}'))
    return int(failures > 0)
