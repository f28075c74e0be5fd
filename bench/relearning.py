# SPDX-License-Identifier: Apache-2.0
"""Muscles that come back: one re-tied, one added, learned anew from ten samples while others stay.

python -m bench relearning [--robot …] [--seeds 0,1] [--muscles 2] [--quick]

- re-tied: after ten minutes of learning one length sensor shifts by 20 mm and its muscle is named
  to `learner/relearn`.
- added: a learner of the robot without that muscle, taught by the same messages, leaves its state
  to one of the whole robot, which starts from the network of the geometric model.

Errors are of the held-out motion [rad]: at once, when what was kept is learned, and after so many
new samples; `whole` is what the learner of all muscles had from the beginning.
"""

import copy
import tempfile
from collections.abc import Sequence
from itertools import count
from pathlib import Path

import numpy as np
import yaml

from bench.learning_changes import AFTER_STREAM, HELD_OUT_TIME, row, streams
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.experiments.online_learning import teach
from musculoskeletal_ae.experiments.recording import (
    EXPLORATION_STREAM,
    SAMPLE_TIME,
    Recording,
    estimation_error,
)
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.options import Parser, seeds
from musculoskeletal_ae.robot.robot import Robot

OFFSET = 0.020  # [m]
NEW = (3, 10, 30)  # samples after which the error is read


def without(robot: Robot, muscle: int, directory: Path) -> Robot:
    """Return a robot without one muscle, written to a directory."""
    source = robot.description.directory
    document = yaml.safe_load((source / 'muscles.yaml').read_text('utf-8'))
    del document['muscles'][muscle]
    (directory / 'muscles.yaml').write_text(yaml.safe_dump(document), 'utf-8')
    (directory / 'robot.urdf').write_bytes((source / 'robot.urdf').read_bytes())
    return Robot.load(directory)


def fewer(stream: Recording, muscle: int) -> Recording:
    """Return a stream without a muscle."""
    muscles = (np.delete(column, muscle, axis=1) for column in stream[2:])
    return Recording(*stream[:2], *muscles)


def teach_until(learner: Learner, stream: Recording, start: float, samples: int) -> int:
    """Feed messages until so many are accepted ever; return how many messages that took."""
    for n, (_, theta, length, tension, _) in enumerate(zip(*stream, strict=True)):
        if learner.samples.accepted >= samples:
            return n
        learner.step(start + n * SAMPLE_TIME, theta, tension, length)
    return len(stream.theta)


def learned(learner: Learner, after: Recording, held_out: Recording, start: float) -> list[float]:
    """Return the held-out errors after NEW samples."""
    errors, before = list[float](), learner.samples.accepted
    for new in NEW:
        n = teach_until(learner, after, start, before + new)
        start += n * SAMPLE_TIME
        after = after.part(slice(n, None))
        errors.append(estimation_error(learner.mae, held_out))
    return errors


def report(robot: Robot, seed: int, muscles: Sequence[int], quick: bool) -> str:
    """Return the tables of one individual."""
    minutes, held_out = (3.0, 30.0) if quick else (10.0, HELD_OUT_TIME)
    mae, steps = initial_mae(robot, 'default').mae, len(NEW)
    arm = EmulatedArm(robot, seed)
    before = streams(arm, mae, EXPLORATION_STREAM + seed, minutes, held_out)
    after = streams(arm, mae, AFTER_STREAM + seed, minutes, 10.0).exploring
    learner = Learner(robot, mae, seed=seed)
    teach(learner, zip(*before.exploring, strict=True))
    whole = estimation_error(learner.mae, before.held_out)
    samples = learner.samples.accepted
    head = ''.join(f'{text:>9s}' for text in ('at once', 'kept', *(f'{n} new' for n in NEW)))
    lines = [f'individual {seed}, {samples} samples: whole {whole:.4f} rad; {steps} readings']
    for muscle in muscles:
        lines.append(f'  {robot.muscles[muscle]:28s}{head}')
        shift = OFFSET * np.eye(robot.muscle_count)[muscle]
        retied, judged = (s._replace(length=s.length + shift) for s in (after, before.held_out))
        told = copy.deepcopy(learner)
        errors = [estimation_error(told.mae, judged)]
        told.relearn([muscle])
        told.poll(1000.0)
        errors.append(estimation_error(told.mae, judged))
        lines.append(row('re-tied', errors + learned(told, retied, judged, 1001.0)))
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            small = without(robot, muscle, folder)
            state = folder / 'state'
            one = Learner(small, initial_mae(small, 'default').mae, seed=seed, directory=state)
            teach(one, zip(*fewer(before.exploring, muscle), strict=True))
            had = estimation_error(one.mae, fewer(before.held_out, muscle))
            one.close()
            two = Learner(robot, mae, seed=seed, directory=state)
            errors = [estimation_error(two.mae, before.held_out)]
            for now in count(1000, 2):
                updates = two.updates
                two.poll(now)
                if two.updates == updates:
                    break
            errors.append(estimation_error(two.mae, before.held_out))
            errors += learned(two, after, before.held_out, 1e6)
            lines.append(row('added', errors) + f'   {updates} updates, without it {had:.4f}')
            two.close()
    return '\n'.join(lines)


def main(argv: list[str]) -> None:
    """Print the tables."""
    parser = Parser('relearning', 'Prints what a re-tied and an added muscle cost.')
    parser.add_robot()
    parser.add_seeds((0, 1))
    parser.add_argument('--muscles', type=seeds, default='2', help='their numbers, from 0')
    parser.add_quick('three minutes instead of ten')
    args = parser.parse_args(argv)

    robot = Robot.load(args.robot)
    for seed in args.seeds:
        print(report(robot, seed, args.muscles, args.quick), flush=True)
