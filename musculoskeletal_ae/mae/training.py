# SPDX-License-Identifier: Apache-2.0
"""Training of the Musculoskeletal AutoEncoder.

    L_initial = w_θ ‖θ − θ_calc‖₂ + w_T ‖T − T_calc‖₂ + w_l ‖l − l_calc‖₂

(paper, section "Initial Training"). `fit` knows nothing of where samples come from, so initial
training and online learning share it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae import samples
from musculoskeletal_ae.mae.network import Network
from musculoskeletal_ae.mae.optimisers import Adam, Muon
from musculoskeletal_ae.presets import TrainingSettings, preset_named
from musculoskeletal_ae.robot.robot import Robot

# Keeps the gradient of a norm finite at zero.
TINY = 1e-12
# A joint or muscle that hardly varies is not blown up beyond this, in scaled units.
LEAST_SPREAD = 1e-4
#: step size of Muon's matrices for a step size of 1 of the biases
MUON_MATRIX_RATIO = 12.5


#: told (step, loss) after every mini-batch
Progress = Callable[[int, float], None]


def loss(
    network: Network,
    values: Tensor,
    mask: Tensor,
    settings: TrainingSettings,
    twins: int = 0,
) -> Tensor:
    """Return the mean of L_initial over a mini-batch of scaled (θ, T, l) and mask indices.

    Args:
        network: The network.
        values: Scaled (θ, T, l), shape (N, D+2M).
        mask: Indices of masks, shape (N,).
        settings: Weights.
        twins: The last so many rows are neighbours of the first so many, all entered by ①.
    """
    joints, muscles = network.joints, network.muscles
    error = network.decode_standard(network.encode(values, mask))
    error = error - (values - network.mean) / network.std  # (N, D+2M)
    result = error.new_zeros(())
    if twins:
        # The slope of the error between neighbours is the error of the slope.
        between = (error[-twins:] - error[:twins])[:, -muscles:] / samples.TWIN_DISTANCE
        result = settings.slope_weight * (between.square().sum(dim=1) + TINY).sqrt().mean()
        error = error[:-twins]
    if not settings.standard_norms:
        error = error * network.std
    parts = error.square().split([joints, muscles, muscles], dim=1)
    norms = torch.stack([(part.sum(dim=1) + TINY).sqrt().mean() for part in parts])  # (3,)
    return result + norms @ norms.new_tensor(settings.weights)


def fit(
    network: Network,
    batches: Iterator[Array],
    settings: TrainingSettings,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[float]:
    """Train a network in place, from whatever weights it has.

    Args:
        network: The network.
        batches: Gives mini-batches of scaled (θ, T, l), shape (N, D+2M), at least
            `settings.steps` of them.
        settings: How to train.
        seed: Draws the masks where a sample is entered by one only.
        progress: Told (step, loss) after every mini-batch.

    Returns:
        The loss of every mini-batch.
    """
    generator = torch.Generator().manual_seed(seed)
    optimiser: Adam | Muon
    if settings.optimiser == 'muon':
        optimiser = Muon(network, MUON_MATRIX_RATIO * settings.step_size, settings.step_size)
    else:
        optimiser = Adam(network, settings.step_size)
    losses = []
    with one_thread():
        for step in range(settings.steps):
            values = torch.as_tensor(
                next(batches), dtype=torch.float32
            )  # (N, D+2M) or (N, 2, D+2M)
            twins = len(values) if settings.slope_weight > 0.0 and values.ndim == 3 else 0
            own = values[:, 0] if values.ndim == 3 else values  # (N, D+2M)
            if settings.every_mask:
                mask = torch.arange(3).repeat_interleave(len(own))
                rows = own.repeat(3, 1)  # (3N, D+2M)
            else:
                mask = torch.randint(3, (len(own),), generator=generator)
                rows = own
            if twins:
                mask = torch.cat([mask, mask.new_zeros(twins)])
                rows = torch.cat([rows, values[:, 1]])  # (4N, D+2M)
            value = loss(network, rows, mask, settings, twins)
            value.backward()
            optimiser.step(annealing(step / settings.steps) if settings.annealed else 1.0)
            losses.append(value.item())
            if progress is not None:
                progress(step, losses[-1])
    return losses


def annealing(progress: float, rise: float = 0.05) -> float:
    """Return the factor of the step size at a share of the training in [0, 1)."""
    if progress < rise:
        return progress / rise
    return 0.5 * (1.0 + math.cos(math.pi * (progress - rise) / (1.0 - rise)))


def initial_training(
    robot: Robot,
    preset: str = 'default',
    seed: int = 0,
    progress: Progress | None = None,
    steps: int | None = None,
) -> tuple[Network, list[float]]:
    """Train a new network on the geometric model of a robot.

    Args:
        robot: The nominal body.
        preset: 'paper' or 'default'.
        seed: Same seed, same network (on the same machine).
        progress: Told (step, loss) after every mini-batch.
        steps: Fewer or more mini-batches than the preset's.

    Returns:
        The network, and the loss of every mini-batch.
    """
    chosen = preset_named(preset)
    settings = chosen.training
    if steps is not None:
        settings = replace(settings, steps=steps)
    rng = np.random.default_rng(seed)
    width = robot.joint_count + 2 * robot.muscle_count
    mean, std = np.zeros(width), np.ones(width)
    if chosen.network.standardise:
        drawn = samples.overload_samples(robot, settings.samples, rng)
        mean, std = drawn.mean(axis=0), np.maximum(drawn.std(axis=0), LEAST_SPREAD)
        if settings.slope_weight > 0.0:
            drawn = samples.with_twins(drawn, std, robot.joint_count, robot.muscle_lengths, rng)
    else:
        drawn = samples.geometric_samples(robot, settings.samples, rng, robot.tension.max)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = Network(robot.joint_count, robot.muscle_count, chosen.network, mean, std)
    batches = samples.shuffled(drawn, settings.batch, rng)
    return network, fit(network, batches, settings, seed, progress)


@contextmanager
def one_thread() -> Iterator[None]:
    """Use one core: matrices this small gain little from two, and lose much if one is busy."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
