# SPDX-License-Identifier: Apache-2.0
"""A day of learning in an hour or two: does the error stay down, do memory and time stay flat?

python -m bench soak [--hours 24] [--creep 1] [--moving 60] [--quick]

The emulated arm explores on and on; every message goes through the learner. To fit a day into an
hour or two it updates after every `--every`-th sample only (the first ones after each), where the
node updates after each: so many fewer updates are judged than a day would bring. With --moving it
moves for less of every five minutes, with --creep all wires get longer meanwhile. One line per
report: robot time, samples, held-out error, d's threshold, memory, time of an update.

Exit status 1 if the error ever rose by more than a fifth over its least, memory by more than a
fifth over what it was after two hours, or the median time of an update in the last quarter to more
than one and a half of that in the first.
"""

import os
import time
from pathlib import Path

import numpy as np
import torch

from bench.processes import memory
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.estimation.detectors.residual_distance import DISTANCE
from musculoskeletal_ae.experiments.recording import (
    HELD_OUT_STREAM,
    SAMPLE_TIME,
    estimation_error,
    record,
)
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.settings import STEPS
from musculoskeletal_ae.learning.trainer import Job, Trainer
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.robot import Robot

PART = 300.0  # [s] of robot time that is recorded and learned at once
REPORT = 1800.0  # [s] of robot time
#: the network is still finding the body out until then [s]
SETTLED = 1800.0
TOLERATED = 1.2
#: memory is compared with what it was then [s]: imports, the store and the reservoir fill it before
FILLED = 7200.0
SLOWER = 1.5  # the last quarter's updates against the first's


class RareTrainer(Trainer):
    """Takes a job after every so many samples only; the first ones after fewer.

    Attributes:
        every: So many.
        samples: That have come since the last job.
        seconds: CPU time of every update [s].
    """

    every, samples = 1, 0

    def begin(self, mae: Mae) -> None:
        """Go on from a network."""
        super().begin(mae)
        self.seconds: list[float] = []

    def submit(self, job: Job) -> None:
        """Learn."""
        begun, self.samples = time.process_time(), 0
        super().submit(job)
        self.seconds.append(time.process_time() - begun)

    @property
    def ready(self) -> bool:
        """Whether so many samples have come."""
        return self.samples >= min(self.every, 1 + len(self.seconds) // 4)


def judged(worst: float, filled: float, most: float, times: list[float]) -> list[str]:
    """Return what was not tolerable, in words.

    Args:
        worst: Highest error over the least before it.
        filled: Memory after two hours [MB]; 0 in a shorter run, which does not judge it.
        most: Highest memory since [MB].
        times: Time of every update, in order [s].
    """
    problems = []
    if worst > TOLERATED:
        problems.append(f'the error rose to {worst:.2f} of its least')
    if most > TOLERATED * filled:
        problems.append(f'memory rose from {filled:.0f} to {most:.0f} MB')
    quarter = len(times) // 4
    if quarter:
        first, last = np.median(times[:quarter]), np.median(times[-quarter:])
        if last > SLOWER * first:
            problems.append(f'an update took {first:.2f} s at first and {last:.2f} s at last')
    return problems


def main(argv: list[str]) -> int:
    """Run the soak."""
    parser = Parser('soak', 'Learns for a day: do error, memory and time stay down?')
    parser.add_robot()
    parser.add_argument('--hours', type=float, default=24.0, help='of robot time')
    parser.add_quick('two hours, to try things out')
    parser.add_argument('--every', type=int, default=20, help='samples between updates')
    parser.add_argument('--creep', type=float, default=0.0, help='of every wire [mm/h]')
    parser.add_argument('--moving', type=float, default=PART, help='of every five minutes [s]')
    parser.add_argument('--steps', type=int, default=STEPS, help='of training per update')
    parser.add_seed('of the individual')
    parser.add_argument('--initial', type=Path, help='checkpoint, instead of training one')
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    robot = Robot.load(args.robot)
    mae = checkpoint.load(args.initial, robot) if args.initial else initial_mae(robot).mae
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
        # A longer wire has to be wound in further, so that it reads as a shorter muscle.
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
                f'worst/least {worst:.3f}  threshold {threshold:.0f}  muscles reopened {reopened}  '
                f'{memory(os.getpid()):.0f} MB  '
                f'update {np.median(trainer.seconds[reported:]):.2f} s',
                flush=True,
            )
            reported = len(trainer.seconds)
    problems = judged(worst, filled, most, trainer.seconds)
    print('; '.join(problems) or 'all within what is tolerated')
    return int(bool(problems))
