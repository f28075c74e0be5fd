# SPDX-License-Identifier: Apache-2.0
"""`train --mujoco`: imports a MuJoCo model, and learns from an emulated arm of it, without ROS.

The emulated arm is an individual that deviates from the file (`emulator/foreign/deviation.py`). It
explores in closed loop, as fast as the computer can.
"""

import sys
import time
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.design.contacts import movable_joints
from musculoskeletal_ae.design.prospects import prospects
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.exceptions import DivergedError, MusculoskeletalError
from musculoskeletal_ae.experiments.online_learning import explore, teach
from musculoskeletal_ae.experiments.recording import (
    EXPLORATION_STREAM,
    HELD_OUT_STREAM,
    SAMPLE_TIME,
    ClosedLoop,
    make_error_function,
    record,
)
from musculoskeletal_ae.exporting.exported_mjcf import export_into
from musculoskeletal_ae.importing import convert
from musculoskeletal_ae.importing.source import compare, listed
from musculoskeletal_ae.learning.convergence import MOST_UPDATES
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.recordings import complete
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.training import train_on
from musculoskeletal_ae.options import chain_of
from musculoskeletal_ae.progress_bar import ProgressBar
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tools.model_training import train_on_model

HELD_OUT = 60.0  # measure the error on a held-out motion of this duration [s]


class Learned(NamedTuple):
    """Result of `learn`: the network, its errors, and the course of the exploration."""

    mae: Mae  # the learned network
    before: float  # error of the initial network on the held-out motion [rad]
    after: float  # error of the learned network on the held-out motion [rad]
    #: joints that contacts keep from most of their range (`design/contacts.py`); errors are those
    #: of the other joints, unless there are none
    still: tuple[str, ...]
    samples: int  # number of samples that were learned
    minutes: float  # duration of the exploration [min]
    speed: float  # speed of the exploration, as a multiple of real time
    problem: str  # what ended the exploration early; empty if nothing did


def train(args: Namespace) -> None:
    """Train on a MuJoCo file: import, explore and learn; write network, robot and learned model.

    Raises:
        MusculoskeletalError: If the file cannot be imported, or if the muscles of the model can
            hold it in nearly no posture.
    """
    robot_folder = args.out.with_name(f'{args.out.stem}_robot')
    model_folder = args.out.with_name(f'{args.out.stem}_model')
    for folder in (robot_folder, model_folder):
        if folder.exists():
            raise MusculoskeletalError(
                f'{folder} exists already; remove it, or choose another --out'
            )
    train_on(args.device)
    robot = _imported(args, robot_folder)
    initial = train_on_model(robot, args)[0]
    learned = learn(robot, initial, robot_folder / 'model.xml', args.seed, args.minutes)
    checkpoint.save(learned.mae, args.out)
    speed, count = f'{learned.speed:.1f} times real time', f'{learned.samples} samples'
    if learned.problem:
        print(f'warning: {learned.problem}; what was learned before is kept', file=sys.stderr)
    print(f'{learned.minutes:.3g} min of exploration at {speed}, {count}')
    errors = f'{learned.before:.4f} → {learned.after:.4f} {robot.units.distance_unit}'
    print(f'error on {HELD_OUT:g} s of held-out motion: {errors}')
    if learned.still:
        print(f'not movable because of contacts, and not in this error: {listed(learned.still)}')
    report = export_into(robot, learned.mae, args.mujoco, model_folder, args.seed)
    print(next(line for line in report.splitlines() if line.startswith('muscles that keep')))
    print(f'robot: {robot_folder}')
    print(f'learned model: {model_folder / args.mujoco.name} (report.txt beside it)')
    print(f'checkpoint: {args.out}')


def learn(robot: Robot, initial: Mae, model: Path, seed: int, minutes: float) -> Learned:
    """Let the emulated arm of an imported file explore and learn.

    During the exploration, each rest causes an update, as on a real arm. Afterwards, the network is
    trained until it represents the body that was fitted to all samples, as after a recording. If
    the emulated arm diverges, the exploration ends early. The network keeps what it has learned
    before.

    Args:
        robot: The imported robot.
        initial: Its initial network.
        model: The `model.xml` that the import wrote.
        seed: Selects the emulated arm, which deviates from the file.
        minutes: Duration of the exploration [min].

    Raises:
        DivergedError: If the emulated arm diverges during the held-out motion.
    """

    def new_arm() -> Arm:
        return make_arm(robot, seed, str(model), deviates=True)

    held_out = record(new_arm(), initial, HELD_OUT_STREAM + seed, HELD_OUT)
    learner = Learner(robot, initial, initial.preset, seed)
    settings = Settings(preset=initial.preset)
    loop = ClosedLoop(new_arm(), initial, settings, EXPLORATION_STREAM + seed)
    start, problem = time.perf_counter(), ''
    try:
        teach(learner, _shown(loop, learner, 60.0 * minutes))
    except DivergedError as error:
        minutes, problem = loop.time / 60.0, str(error)
    speed = 60.0 * minutes / (time.perf_counter() - start)
    title = 'training the network on the learned body'
    with ProgressBar(title, MOST_UPDATES, ends_early=True) as bar:
        complete(learner, bar.add)
    movable = movable_joints(robot)
    error_of = make_error_function(held_out, joints=movable if movable.any() else None)
    before, after, samples = error_of(initial), error_of(learner.mae), len(learner.samples)
    still = tuple(robot.joints[j] for j in np.flatnonzero(~movable))
    return Learned(learner.mae, before, after, still, samples, minutes, speed, problem)


def _imported(args: Namespace, folder: Path) -> Robot:
    """Import the file, and print the report; refuse a robot that cannot explore."""
    robot, source = convert.import_robot(args.mujoco, folder, **chain_of(args))
    found = prospects(robot)
    print(*found.lines(), sep='\n', flush=True)
    if found.is_pointless:
        raise MusculoskeletalError(
            f'{args.mujoco}: the muscles cannot hold the arm, so nothing was trained'
        )
    for note in source.notes:
        print(note)
    print(convert.length_verdict(compare(source, robot)), flush=True)
    return robot


def _shown(loop: ClosedLoop, learner: Learner, duration: float) -> Iterator[tuple[Array, ...]]:
    """Yield the messages of an exploration, and show the progress."""
    with ProgressBar('exploring', duration, lambda: f'{len(learner.samples)} samples') as bar:
        bar.announce(f' for {duration:g} s')
        for row in explore(loop, learner, duration):
            yield row
            bar.add(SAMPLE_TIME)
