# SPDX-License-Identifier: Apache-2.0
"""Learned individuals, cached in a folder for the benches that start from one."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.emulator.reality import KIN, make_arm
from musculoskeletal_ae.experiments.online_learning import teach
from musculoskeletal_ae.experiments.recording import (
    EXPLORATION_STREAM,
    SAMPLE_TIME,
    Recording,
    record,
)
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.training_process import Trainer
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.robot import Robot

#: Update at this interval [s], with this many training steps. The learned network is as accurate
#: as that of the node, but learning takes less CPU time.
SELDOM, STEPS = 20.0, 400


class Seldom(Trainer):
    """A trainer that updates less often than that of the node, which shortens long experiments."""

    _asked = 0

    @property
    def ready(self) -> bool:
        """Whether an update may begin: SELDOM seconds have passed, and enough data are new."""
        self._asked += 1
        if self._asked < SELDOM / SAMPLE_TIME or not super().ready:
            return False
        self._asked = 0
        return True


class Never(Trainer):
    """A trainer that never updates the network, so that the bench decides when to update."""

    ready = False


class LearnedArm(NamedTuple):
    """The network of a learned individual, the network that commanded it, and the recorded data."""

    mae: Mae
    driver: Mae  # network of the geometric model, which computes the commands
    exploring: Recording


def add_initial(parser: Parser) -> None:
    """Add `--initial`, a checkpoint to start from; None if it is not given."""
    text = 'initial checkpoint (default: train one)'
    parser.add_argument('--initial', type=Path, metavar='FILE', help=text)


def add_folder(parser: Parser, default: Path) -> None:
    """Add `--folder`, which keeps the networks that individuals have learned."""
    text = 'folder that keeps the learned networks'
    parser.add_argument('--folder', type=Path, metavar='DIR', default=default, help=text)


def initial_network(robot: Robot, file: Path | None) -> Mae:
    """Return the network that `--initial` names, or train that of the geometric model."""
    return initial_mae(robot) if file is None else checkpoint.load(file, robot)


def initial(robot: Robot, folder: Path) -> Mae:
    """Return the network of the geometric model; train it if `folder` does not contain it yet."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / 'initial.safetensors'
    if not file.exists():
        checkpoint.save(initial_mae(robot), file)
    return checkpoint.load(file, robot)


def learned_arm(
    robot: Robot, seed: int, folder: Path, minutes: float, reality: str = KIN
) -> LearnedArm:
    """Return the individual of `reality` and `seed` that has learned for `minutes` [min].

    If the cache in `folder` has the individual, it is read from there.
    """
    name = f'{seed}' if reality == KIN else f'{reality}_{seed}'
    driver, file = initial(robot, folder), folder / f'learned_{name}.safetensors'
    messages = folder / f'exploring_{name}.npz'
    if not file.exists():
        stream = EXPLORATION_STREAM + seed
        exploring = record(make_arm(robot, seed, reality), driver, stream, 60.0 * minutes)
        learner = Learner(robot, driver, seed=seed, steps=STEPS, trainer=Seldom)
        teach(learner, zip(*exploring, strict=True))
        np.savez(messages, *exploring)
        checkpoint.save(learner.mae, file)
    with np.load(messages) as arrays:
        return LearnedArm(checkpoint.load(file, robot), driver, Recording(*arrays.values()))
