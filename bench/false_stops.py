# SPDX-License-Identifier: Apache-2.0
"""Counts false stops of healthy arms, on an idle computer or on a busy one.

    python -m bench false_stops [--robot …] [--seeds 5,…,14] [--hours 1] [--load 8] [--quick]

New individuals explore and learn for an hour of simulated time each, in the laboratory of
`bench/lab.py`: the cores of estimator, controller and learner run in one process and exchange
messages as their nodes do.

With --load, the computer is busy: the driver and each node wait for the processor, and messages are
lost or come late. The times of `bench/lab.py` are as long as those measured on two cores at a load
of 20. There, a process that computed for a few milliseconds 100 times a second took 13 ms on
average, and 46 ms in 1 % of all cases. Ten times in 150 s it did not run for 0.12 to 0.41 s.

The bench prints the false findings, doubted joint sensors and stops, the pauses (stops that end by
themselves, for example after 0.2 s without messages), the number of messages that the controller
lost, and the longest delay of a message. An individual's hour ends with its first finding, doubt or
stop. The exit status is 1 if there was one.
"""

from typing import NamedTuple

from bench.lab import CORES, SAMPLE_TIME, Lab
from bench.learned_arm import initial_network
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.emulator.reality import KIN, make_arm
from musculoskeletal_ae.experiments.workers import workers
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import Parser, number, positive
from musculoskeletal_ae.robot.robot import Robot


class Result(NamedTuple):
    """Results of one healthy arm: a false finding or stop, pauses, lost and late messages."""

    seconds: float  # simulated time [s]
    problem: str  # the false finding or stop that ended it, or ''
    pauses: int  # how often the arm paused
    lost: int  # number of muscle_states that the controller lost
    delay: float  # longest delay of muscle_states at the controller [s]
    samples: int  # number of samples that the learner took

    def line(self, seed: int) -> str:
        """Return the results of the individual `seed` as a line of the table."""
        return (
            f'{seed:>5} {self.seconds:>8.0f} {self.pauses:>7} {self.lost:>8} '
            f'{1000.0 * self.delay:>9.0f} {self.samples:>7}  {self.problem}'
        )


HEAD = (
    f'{"seed":>5} {"time [s]":>8} {"pauses":>7} {"lost":>8} {"late [ms]":>9} {"samples":>7}  '
    'false finding or stop'
)


class BusyLoop(Lab):
    """A laboratory with an arm that explores all the time, and counts its pauses."""

    def __init__(self, arm: Arm, initial: Mae, seed: int, load: float = 0.0) -> None:
        """Connect an arm at rest to the nodes.

        `seed` selects the exploration, and `load` is the number of other processes.
        """
        super().__init__(arm, initial, seed, load)
        self.pauses = 0

    @property
    def problem(self) -> str:
        """The false finding or stop as a text, or '' if there was none."""
        supervisor = self.controller.supervisor
        if self.estimator.cause:
            return f'finding: {self.estimator.cause}'
        if doubted := self.estimator.joint_trust.doubted:
            names = ', '.join(self.estimator.robot.joints[j] for j in doubted)
            return f'doubted joint sensors: {names}'
        condition = supervisor.condition
        return f'stop: {condition.text}' if supervisor.is_latched and condition else ''

    def watch(self, seconds: float) -> Result:
        """Explore for a time [s], or until the first false finding or stop."""
        for _ in range(round(seconds / SAMPLE_TIME)):
            if self.problem:
                break
            was_running = self.controller.supervisor.is_running
            self.step()
            supervisor = self.controller.supervisor
            self.pauses += was_running and not supervisor.is_running
            if supervisor.is_running and not supervisor.explores:
                self.controller.explore(True)
        muscles = self.controlling
        return Result(
            self.now, self.problem, self.pauses, muscles.lost, muscles.longest_delay,
            len(self.learner.samples),
        )  # fmt: skip


def watch(
    robot: Robot, reality: str, seed: int, initial: Mae, load: float, seconds: float
) -> Result:
    """Let an emulated arm explore for `seconds` [s], and return what happened.

    `reality` and `seed` select the arm; `load` is the number of processes that compete with it.
    """
    return BusyLoop(make_arm(robot, seed, reality), initial, seed, load).watch(seconds)


def main(argv: list[str]) -> int:
    """Print the table; exit status 1 if a healthy arm stopped."""
    parser = Parser('false_stops', (__doc__ or '').partition('\n')[0])
    parser.add_robot()
    parser.add_seeds(tuple(range(5, 15)))
    parser.add_argument(
        '--hours', type=positive, default=1.0, help='simulated time of each arm [h]'
    )
    parser.add_argument(
        '--load',
        type=number(0.0, 100.0),
        default=0.0,
        help=f'load of the simulated computer, which has {CORES} cores',
    )
    parser.add_argument(
        '--reality', default=KIN, help='emulator model: kin, foreign or an MJCF file'
    )
    parser.add_initial()
    parser.add_quick('a minute of each arm')
    parser.add_workers()
    options = parser.parse_args(argv)
    robot = Robot.load(options.robot)
    initial = initial_network(robot, options.initial)
    seconds = 60.0 if options.quick else 3600.0 * options.hours
    print(HEAD)
    problems = 0
    calls = [
        (robot, options.reality, seed, initial, options.load, seconds) for seed in options.seeds
    ]
    with workers(options.jobs, options.scheduler) as processes:
        for seed, result in zip(options.seeds, processes.in_order(watch, calls), strict=True):
            problems += bool(result.problem)
            print(result.line(seed), flush=True)
    print(f'{problems} false findings and stops')
    return int(problems > 0)
