# SPDX-License-Identifier: Apache-2.0
"""Learns for an emulated day, and checks that error, memory and update time stay bounded.

python -m bench soak [--hours 24] [--creep 1] [--moving 60] [--quick]

The emulated arm explores continuously, and every message goes through the learner. The node updates
after each sample. To fit a day into one or two hours, the bench updates only after every
`--every`-th sample, and more often at the beginning. It therefore covers fewer updates than a day
has. With --moving the arm moves for only a part of every five minutes. With --creep all tendons
lengthen over time. Each report is one line: robot time, samples, held-out error, threshold of d
(the measure that detects faulty muscles), memory, time of an update.

Exit status 1 in any of these cases:

- The error rose by more than a fifth over its earlier minimum.
- The memory rose by more than a fifth over its value after two hours.
- The median time of an update rose by more than half from the first to the last quarter.
"""

import os
import time

import numpy as np
import torch

from bench.learned_arm import add_initial, initial_network
from bench.processes import memory
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.estimation.detectors.residual_distance import DISTANCE
from musculoskeletal_ae.experiments.recording import (
    HELD_OUT_STREAM,
    SAMPLE_TIME,
    estimation_error,
    record,
)
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.scheduler import STEPS, Job
from musculoskeletal_ae.learning.training_process import Trainer
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.robot import Robot

PART = 300.0  # record this much robot time at once, then learn from it [s]
REPORT = 1800.0  # print a line at this interval of robot time [s]
#: check the error from this robot time on [s]; before, the network has just begun to learn
SETTLED = 1800.0
#: report an error, or a memory, that exceeds its earlier value by more than this factor
TOLERATED = 1.2
#: check the memory from this robot time on [s]; before, imports, the sample store and the reservoir
#: of messages fill it
FILLED = 7200.0
#: report slow updates if their median time in the last quarter exceeds this multiple of that in the
#: first quarter
SLOWER = 1.5


class RareTrainer(Trainer):
    """A trainer that updates only after every `every`-th sample, and more often at the beginning.

    Attributes:
        every: Number of samples between updates.
        samples: Number of samples since the last update.
        seconds: CPU times of all updates [s].
    """

    every, samples = 1, 0

    def begin(self, mae: Mae) -> None:
        """Begin with a network, and discard the recorded times."""
        super().begin(mae)
        self.seconds: list[float] = []

    def submit(self, job: Job) -> None:
        """Run an update, and record its CPU time."""
        begun, self.samples = time.process_time(), 0
        super().submit(job)
        self.seconds.append(time.process_time() - begun)

    @property
    def ready(self) -> bool:
        """Whether enough samples have arrived for the next update."""
        return self.samples >= min(self.every, 1 + len(self.seconds) // 4)


def failures_of(worst: float, filled: float, most: float, times: list[float]) -> list[str]:
    """Return descriptions of the violated limits.

    Args:
        worst: Largest ratio of the error to its earlier minimum.
        filled: Memory after two hours [MB]; 0 in a shorter run, which does not check it.
        most: Largest memory since then [MB].
        times: Times of all updates, in order [s].
    """
    problems = []
    if worst > TOLERATED:
        problems.append(
            f'the error rose to {worst:.2f} times its minimum; legal: at most {TOLERATED:g}'
        )
    if most > TOLERATED * filled:
        problems.append(
            f'memory rose from {filled:.0f} to {most:.0f} MB; legal: at most '
            f'{TOLERATED * filled:.0f} MB'
        )
    quarter = len(times) // 4
    if quarter:
        first, last = np.median(times[:quarter]), np.median(times[-quarter:])
        if last > SLOWER * first:
            problems.append(
                f'an update took {first:.2f} s at the beginning and {last:.2f} s at the end; '
                f'legal: at most {SLOWER * first:.2f} s'
            )
    return problems


def main(argv: list[str]) -> int:
    """Run the endurance test; return the exit status."""
    parser = Parser(
        'soak', 'Learns for an emulated day, and checks error, memory and time of an update.'
    )
    parser.add_robot()
    parser.add_argument('--hours', type=float, default=24.0, help='robot time [h]')
    parser.add_quick('two hours, to try things out')
    parser.add_argument(
        '--every', type=int, default=20, help='number of samples between two updates'
    )
    parser.add_argument(
        '--creep', type=float, default=0.0, help='lengthening of every tendon [mm/h]'
    )
    parser.add_argument(
        '--moving', type=float, default=PART, help='time of motion in every five minutes [s]'
    )
    parser.add_argument(
        '--steps', type=int, default=STEPS, help='number of training steps of an update'
    )
    parser.add_seed('of the individual')
    add_initial(parser)
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    robot = Robot.load(args.robot)
    mae = initial_network(robot, args.initial)
    held_out = record(EmulatedArm(robot, args.seed), mae, HELD_OUT_STREAM, PART)
    learner = Learner(robot, mae, seed=args.seed, steps=args.steps, trainer=RareTrainer)
    trainer = learner.trainer
    assert isinstance(trainer, RareTrainer)
    trainer.every = args.every
    arm = EmulatedArm(robot, args.seed)
    least, worst, reopened = np.inf, 0.0, 0
    reported = 0
    filled = most = 0.0
    for part in range(round(3600.0 * (2.0 if args.quick else args.hours) / PART)):
        # A tendon that has crept must be wound in further, so its sensor reads a shorter length.
        crept = np.full(robot.muscle_count, -1e-3 * args.creep * PART / 3600.0 * part)
        arm.set_length_offset(crept)
        stream = record(arm, learner.mae, part, args.moving)
        for n, row in enumerate(zip(stream.tension, stream.length, stream.theta_sensor)):
            tension, length, theta = row
            accepted, update = learner.samples.accepted, learner.last_update
            learner.step(PART * part + n * SAMPLE_TIME, theta, tension, length)
            trainer.samples += learner.samples.accepted - accepted
            if learner.last_update is not None and learner.last_update is not update:
                reopened += bool(learner.last_update.changed)
        now = PART * (part + 1)
        shifted = held_out._replace(length=held_out.length + crept)
        error = estimation_error(learner.mae, shifted, 10)
        if now >= SETTLED:
            least, worst = min(least, error), max(worst, error / least)
        if now == FILLED:
            filled = memory(os.getpid())
        if now >= FILLED:
            most = max(most, memory(os.getpid()))
        if now % REPORT == 0.0:
            anomaly = learner.mae.anomaly
            threshold = anomaly.thresholds.get(DISTANCE, np.nan) if anomaly else np.nan
            print(
                f'{now / 3600.0:5.1f} h  samples {len(learner.samples)} '
                f'({learner.samples.accepted} accepted)  error {error:.4f} rad  '
                f'largest/smallest error {worst:.3f}  threshold {threshold:.0f}  '
                f'muscles relearned {reopened}  '
                f'{memory(os.getpid()):.0f} MB  '
                f'update {np.median(trainer.seconds[reported:]):.2f} s',
                flush=True,
            )
            reported = len(trainer.seconds)
    problems = failures_of(worst, filled, most, trainer.seconds)
    print('; '.join(problems) or 'all within the limits')
    return int(bool(problems))
