# SPDX-License-Identifier: Apache-2.0
"""Compares muscle modules by control (stiffness or position) and by source of tension.

    python -m bench actuation [--robot musashi_left_arm] [--seeds 0,1,2,3,4] [--held 4] [--quick]

Each emulated individual explores and learns with every kind of module, from the same initial
network. With the learned network, the bench measures:

- estimate: mean ‖θ_est − θ‖ in further exploration, before and after learning,
- control: mean ‖θ_target − θ‖ of `proposed` at random holdable postures, --held seconds after each
  target (a motion for which the tensions of stiffness-controlled muscles would not suffice is
  slowed, and can take up to 9 s),
- rupture: several muscles rupture in turn while the arm explores. The columns are the share of
  ruptures after which a muscle is isolated within 10 s, the share after which only the ruptured
  muscle is isolated, and the mean time from a rupture to the first isolation (10 s if there is
  none),
- max/limit: the highest true tension as a multiple of `tension.limit`, except after a rupture,
- wrong: the number of isolations and stops although the arm is healthy.

Tensions are the true ones of the emulated arm, whatever its sensors measure.
"""

from collections import defaultdict
from typing import NamedTuple

import numpy as np
from robots import with_modules

from bench.learned_arm import add_initial, initial_network
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.emulator.reality import FOREIGN, KIN, make_arm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments import online_learning
from musculoskeletal_ae.experiments.recording import EXPLORATION_STREAM, SAMPLE_TIME, ClosedLoop
from musculoskeletal_ae.experiments.resilience import IsolatingLoop
from musculoskeletal_ae.experiments.workers import workers
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion.explored_postures import TRIES, holdable_postures
from musculoskeletal_ae.options import Parser, names, positive
from musculoskeletal_ae.robot.robot import Robot

#: explore and learn for EXPLORED, and then measure in a held-out motion of HELD_OUT [s]
EXPLORED, HELD_OUT = 300.0, 60.0
#: move to this many targets, and by default hold each for this time [s]
TARGETS, HELD = 5, 4.0
RUPTURES = 3  # rupture this many muscles, one after another
MOVING = 4.0  # explore for this time before a rupture [s]
LATEST = 10.0  # wait at most this long for an isolation after a rupture [s]
#: kinds of muscle modules, each with the entries of muscles.yaml that describe it
KINDS = {
    'stiffness': {'actuation': 'stiffness'},
    'position': {'actuation': 'position'},
    'position-current': {'actuation': 'position', 'tension_source': 'current'},
    'position-none': {'actuation': 'position', 'tension_source': 'none'},
}
HEAD = (
    f'{"reality":<8} {"seed":>4} {"modules":<18} {"before":>7} {"after":>7} {"control":>8} '
    f'{"ruptures":>9} {"named":>6} {"found":>6} {"max/limit":>9} {"wrong":>6} {"samples":>8}\n'
    f'{"":<8} {"":>4} {"":<18} {"[rad]":>7} {"[rad]":>7} {"[rad]":>8} {"isolated":>9} {"":>6} '
    f'{"[s]":>6}'
)


class Result(NamedTuple):
    """Results of one individual with one kind of module."""

    before: float
    after: float
    control: float
    isolated: float  # share of the ruptures after which a muscle was isolated
    named: float  # share of the ruptures after which only the ruptured muscle was isolated
    finding_time: float  # mean time from a rupture to the first isolation, LATEST without one [s]
    highest: float  # highest tension, as a multiple of tension.limit
    wrong: float
    samples: float


def with_kind(robot: Robot, kind: str) -> Robot:
    """Return the robot with muscle modules of the kind `kind` in KINDS."""
    return Robot(with_modules(robot.description, **KINDS[kind]))


class Watched:
    """Records the highest true tension of an arm, as a multiple of its limit."""

    def __init__(self, arm: Arm) -> None:
        self._arm, self.highest = arm, 0.0

    def note(self) -> None:
        """Record the present tensions: raise `highest` if one of them exceeds it."""
        share = self._arm.tension / self._arm.robot.tension.limit
        self.highest = max(self.highest, float(share.max()))


def learn(
    arm: Arm, initial: Mae, seed: int, seconds: float, watched: Watched
) -> tuple[Learner, int]:
    """Learn from an exploration; return the learner and the number of stops of the controller.

    `seed` selects the exploration, which takes `seconds` [s]. `watched` records the tensions.
    """
    loop = ClosedLoop(arm, initial, None, EXPLORATION_STREAM + seed)
    learner = Learner(arm.robot, initial, 'default', seed)
    for count, row in enumerate(online_learning.explore(loop, learner, seconds)):
        learner.step(count * SAMPLE_TIME, row[1], row[3], row[2])
        watched.note()
    return learner, loop.stops


def estimate(arm: Arm, mae: Mae, seed: int, seconds: float, watched: Watched) -> tuple[float, int]:
    """Estimate θ in an exploration; return the mean error [rad] and the number of mistakes.

    `seed` selects the exploration, which takes `seconds` [s]. `watched` records the tensions.

    Each isolation of a muscle is a mistake, because the arm is healthy. A stop that lasts at the
    end is another one.
    """
    loop = IsolatingLoop(arm, mae, EXPLORATION_STREAM + 50 + seed)
    loop.run(1.0)
    loop.core.explore(True)
    errors = []
    for _ in range(round(seconds / SAMPLE_TIME)):
        loop.step()
        errors.append(loop.error)
        watched.note()
    wrong = sum(bool(isolated) for isolated, _ in loop.verdicts)
    return float(np.mean(errors)), wrong + (not loop.core.supervisor.is_running)


def control(
    arm: Arm, mae: Mae, seed: int, targets: int, held: float, watched: Watched
) -> tuple[float, int]:
    """Control an arm to `targets` random holdable postures, with `held` seconds for each.

    Returns:
        The mean distance between the target and the posture that the arm reached [rad], and the
        number of stops.
    """
    robot, rng = arm.robot, np.random.default_rng([seed, 0xAC])
    postures = (robot.random_postures(1, rng)[0] for _ in range(TRIES))
    errors, stops, loop = [], 0, ClosedLoop(arm, mae)
    loop.wait(0.1)
    for theta, _ in holdable_postures(robot, postures, targets, arm.individual.muscle_jacobian):
        if not loop.core.supervisor.is_running:
            stops += 1
            loop = ClosedLoop(arm, mae)
            loop.wait(0.1)
        loop.target(theta)
        for _ in range(round(held / SAMPLE_TIME)):
            loop.step()
            watched.note()
        errors.append(float(np.linalg.norm(arm.theta - theta)))
    return float(np.mean(errors)), stops


def ruptures(arm: Arm, mae: Mae, seed: int, count: int) -> tuple[float, float, float]:
    """Rupture `count` muscles in turn.

    Returns:
        The share of ruptures after which any muscle was isolated, the share after which only the
        ruptured muscle was isolated, and the mean time from a rupture to the first isolation [s].
        A rupture without isolation counts in this mean with LATEST, the longest wait.
    """
    isolated, named, times = 0, 0, []
    for m in np.random.default_rng([seed, 0x2B]).permutation(arm.robot.muscle_count)[:count]:
        arm.reset()
        loop = IsolatingLoop(arm, mae, EXPLORATION_STREAM + seed + int(m))
        loop.run(1.0)
        loop.core.explore(True)
        loop.run(MOVING)
        arm.set_faults([f'rupture:{arm.robot.muscles[m]}'])
        finding_time = LATEST
        for step in range(round(LATEST / SAMPLE_TIME)):
            loop.step()
            if finding_time == LATEST and loop.isolated:
                finding_time = step * SAMPLE_TIME
            if loop.verdicts:
                break
        times.append(finding_time)
        last = loop.verdicts[-1][0] if loop.verdicts else ()
        isolated += bool(last)
        named += last == (m,)
        arm.set_faults([])
    return isolated / count, named / count, float(np.mean(times))


def measure(
    robot: Robot, kind: str, initial: Mae, reality: str, seed: int, share: float, held: float
) -> Result:
    """Measure one individual with one kind of module.

    `reality` and `seed` name the individual. `share` scales the durations and counts; `held` is the
    time for each target [s].
    """
    own = with_kind(robot, kind)
    arm = make_arm(own, seed, reality)
    watched = Watched(arm)
    before, wrong_before = estimate(arm, initial, seed, share * HELD_OUT, watched)
    arm.reset()
    learner, stops = learn(arm, initial, seed, share * EXPLORED, watched)
    mae = learner.mae or initial
    arm.reset()
    after, wrong = estimate(arm, mae, seed, share * HELD_OUT, watched)
    arm.reset()
    distance, stopped = control(arm, mae, seed, max(2, round(share * TARGETS)), held, watched)
    shares_and_time = ruptures(arm, mae, seed, max(2, round(share * RUPTURES)))
    wrong += wrong_before + stops + stopped
    return Result(
        before, after, distance, *shares_and_time, watched.highest, wrong, len(learner.samples)
    )


def line(reality: str, seed: str, kind: str, result: Result) -> str:
    """Return a line of the table: results of an individual, or means, with one kind of module."""
    return (
        f'{reality:<8} {seed:>4} {kind:<18} {result.before:>7.3f} {result.after:>7.3f} '
        f'{result.control:>8.3f} {result.isolated:>9.2f} {result.named:>6.2f} '
        f'{result.finding_time:>6.2f} {result.highest:>9.2f} {result.wrong:>6.1f} '
        f'{result.samples:>8.0f}'
    )


def main(argv: list[str]) -> int:
    """Measure every individual with every kind of module, and print the table."""
    parser = Parser('actuation', (__doc__ or '').partition('\n')[0])
    parser.add_robot()
    parser.add_seeds(tuple(range(5)))
    parser.add_quick('a quarter of the time')
    add = parser.add_argument
    add('--realities', type=names, default=(KIN, FOREIGN), help='emulator models: kin, foreign')
    add('--modules', type=names, default=tuple(KINDS), help=f'modules: {", ".join(KINDS)}')
    add('--seconds', type=positive, default=EXPLORED, help='duration of the exploration [s]')
    add('--held', type=positive, default=HELD, help='hold each target this long [s]')
    add_initial(parser)
    parser.add_workers()
    options = parser.parse_args(argv)
    if wrong := set(options.modules) - set(KINDS):
        raise MusculoskeletalError(
            f'--modules: unknown kinds {", ".join(sorted(wrong))}; legal: {", ".join(KINDS)}'
        )
    share = (0.25 if options.quick else 1.0) * options.seconds / EXPLORED
    robot = Robot.load(options.robot)
    initial = initial_network(robot, options.initial)
    print(HEAD)
    cases = [
        (reality, seed, kind)
        for reality in options.realities
        for seed in options.seeds
        for kind in options.modules
    ]
    rows = defaultdict[tuple[str, str], list[Result]](list)
    calls = [
        (robot, kind, initial, reality, seed, share, options.held) for reality, seed, kind in cases
    ]
    with workers(options.jobs, options.scheduler) as processes:
        results = processes.in_order(measure, calls)
        for (reality, seed, kind), result in zip(cases, results, strict=True):
            rows[reality, kind].append(result)
            print(line(reality, str(seed), kind, result), flush=True)
    for (reality, kind), every in rows.items():
        mean = Result(*np.nanmean(every, axis=0))
        highest = max(result.highest for result in every)
        print(line(reality, 'mean', kind, mean._replace(highest=highest)), flush=True)
    return 0
