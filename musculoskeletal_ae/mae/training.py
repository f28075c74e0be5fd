# SPDX-License-Identifier: Apache-2.0
"""Initial training of the Musculoskeletal AutoEncoder on the geometric model of a robot.

A preset trains in its own way: `default_training.py` is that of preset `default`. Here is what all
of them share: random states of the geometric model, mini-batches, where torch computes, the
checkpoint that comes of it, and how well it restores states that it has not been trained on.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import Network, to_mae
from musculoskeletal_ae.mae.residuals import AnomalyStatistics, anomaly, residuals
from musculoskeletal_ae.mae.units import Mask, State
from musculoskeletal_ae.presets.registry import preset_named
from musculoskeletal_ae.robot.robot import Robot

# Keeps the gradient of a norm finite at zero.
TINY = 1e-12
UNSEEN_STATES = 5000  # of the geometric model, for the residuals a new network starts with

#: told (step, loss, network, mini-batch) after every one
Progress = Callable[[int, float, Network, Array], None]

# -- samples -----------------------------------------------------------------------------------


def random_states(
    robot: Robot,
    count: int,
    rng: np.random.Generator,
    highest: Array | float,
    lowest: Array | float = 0.0,
    margin: float = 0.0,
) -> State:
    """Return random states of the geometric model, T_r uniform from lowest to highest [N].

    The highest tension is one for all, (M,) or (count, M); margin is the reach of θ_r beyond
    each joint limit, as a share of the range.
    """
    theta = robot.random_postures(count, rng, margin)
    tension = rng.uniform(lowest, highest, (count, robot.muscle_count))
    return State(theta, tension, robot.muscle_lengths(theta, tension))


def shuffled(samples: Array, batch: int, rng: np.random.Generator) -> Iterator[Array]:
    """Yield mini-batches of shuffled samples, epoch after epoch, without end."""
    while True:
        order = rng.permutation(len(samples))
        for i in range(0, max(len(order) - batch, 0) + 1, batch):
            yield samples[order[i : i + batch]]


def check_device(device: str) -> None:
    """Raise a MusculoskeletalError if torch computes nothing on a device."""
    try:
        torch.ones(1, device=device).sum().item()  # to be there is not yet to compute
    except (RuntimeError, AssertionError) as error:  # the latter of a torch built without it
        raise MusculoskeletalError(
            f'device {device!r}: torch {torch.__version__} computes nothing there; legal: cpu. '
            'For a GPU, install its driver and a torch that is built for it (pytorch.org)'
        ) from error


def train_on(device: str) -> None:
    """Let everything that is trained from now on be on one of `parameters.DEVICES`.

    Raises:
        MusculoskeletalError: If torch computes nothing there.
    """
    check_device(device)
    # Every call of torch passes a default device, which takes a fifth of a step, even on the CPU.
    torch.set_default_device(None if device == 'cpu' else device)


@contextmanager
def one_thread() -> Iterator[None]:
    """Use one core: matrices this small gain little from two, and lose much if one is busy."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class TrainedNetwork(NamedTuple):
    """What a preset's initial training returns."""

    network: Network
    losses: list[float]  # of every mini-batch
    by: str  # size of the mini-batches and optimiser, for people to read


class Trained(NamedTuple):
    """What `initial_mae` returns."""

    mae: Mae  # ready for a checkpoint
    losses: list[float]  # of every mini-batch


def initial_mae(
    robot: Robot,
    preset: str = 'default',
    seed: int = 0,
    progress: Progress | None = None,
    steps: int | None = None,
) -> Trained:
    """Train on the geometric model, with anomaly statistics of it that are not calibrated.

    Same seed, same network (on the same machine); `steps` overrides the preset's mini-batches.
    """
    chosen = preset_named(preset)
    steps = chosen.initial_steps(robot.groups) if steps is None else steps
    network, losses, by = chosen.train_initial(robot, seed, steps, progress)
    history = (
        f'initial training on the geometric model of {robot.description.directory.name}: '
        f'preset {preset}, seed {seed}, {len(losses)} mini-batches of {by}'
    )
    mae = to_mae(network, robot.joints, robot.muscles, preset, history)
    unseen = np.random.default_rng([seed, 1])
    _, tension, length = random_states(robot, UNSEEN_STATES, unseen, robot.tension.limit)
    error = residuals(mae.estimate(tension, length), tension, length)
    statistics = AnomalyStatistics.of(error, calibrated=False)
    statistics = replace(statistics, thresholds={'norm': float(anomaly(error).max())})
    return Trained(replace(mae, anomaly=statistics), losses)


# -- errors ------------------------------------------------------------------------------------

#: outputs with the unit and the factor from SI that errors are shown in
OUTPUTS = (('theta', 'rad', 1.0), ('tension', 'N', 1.0), ('length', 'mm', 1e3))


class PairError(NamedTuple):
    """Error of one output entered by one mask."""

    mask: Mask
    output: str  # 'theta', 'tension' or 'length'
    unit: str  # of the numbers
    norm: float  # mean over samples of the L2 norm
    elements: Array  # mean absolute error of each joint or muscle, (D,) or (M,)


def pair_errors(mae: Mae, states: State) -> list[PairError]:
    """Return the error of each of the nine (mask, output) pairs over given states."""
    result = []
    for mask in Mask:
        restored = mae.decode(mae.encode(mask, *states))
        for (output, unit, factor), got, true in zip(OUTPUTS, restored, states, strict=True):
            error = factor * (got - true)
            norm = float(np.linalg.norm(error, axis=1).mean())
            result.append(PairError(mask, output, unit, norm, np.abs(error).mean(axis=0)))
    return result
