# SPDX-License-Identifier: Apache-2.0
"""Training of the Musculoskeletal AutoEncoder.

    L_initial = w_θ ‖θ − θ_calc‖₂ + w_T ‖T − T_calc‖₂ + w_l ‖l − l_calc‖₂

(paper, section "Initial Training"). `fit` knows nothing of where samples come from, so initial
training and online learning share it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from musculoskeletal_ae.mae import samples
from musculoskeletal_ae.mae.network import PRESETS, Network
from musculoskeletal_ae.robot.robot import Robot

Array = NDArray[np.float64]

# Keeps the gradient of a norm finite at zero.
TINY = 1e-12


@dataclass(frozen=True)
class TrainingSettings:
    """How to train.

    Attributes:
        steps: Mini-batches in all.
        batch: Samples in a mini-batch.
        every_mask: Enter each sample by all three masks instead of one at random.
        step_size: Adam's.
        schedule: 'constant', or 'one-cycle': up for a twentieth, then down to zero by a cosine.
        weights: w_θ, w_T, w_l.
        standard_norms: Take each norm in units of the spread of the data.
        epoch_samples: Draw so many samples once and shuffle them; 0 draws afresh for every batch.
    """

    steps: int
    batch: int
    every_mask: bool
    step_size: float
    schedule: str
    weights: tuple[float, float, float]
    standard_norms: bool
    epoch_samples: int = 0


# The paper prints 30 epochs and w = (1, 10, 10). Its "number of batches 100" is read as the size
# of a mini-batch of 10 000 samples; the step size is Adam's own default.
TRAINING_PRESETS = {
    'paper': TrainingSettings(
        steps=3000,
        batch=100,
        every_mask=False,
        step_size=1e-3,
        schedule='constant',
        weights=(1.0, 10.0, 10.0),
        standard_norms=False,
        epoch_samples=10_000,
    ),
    'default': TrainingSettings(
        steps=6000,
        batch=256,
        every_mask=True,
        step_size=4e-3,
        schedule='one-cycle',
        weights=(1.0, 1.0, 1.0),
        standard_norms=True,
    ),
}

#: gives the next mini-batch of scaled (θ, T, l), shape (count, D+2M)
Sampler = Callable[[int], Array]
#: told (step, loss) after every mini-batch
Progress = Callable[[int, float], None]


def loss(network: Network, values: Tensor, mask: Tensor, settings: TrainingSettings) -> Tensor:
    """Return the mean of L_initial over a mini-batch of (values, mask)."""
    joints, muscles = network.joints, network.muscles
    error = network.decode_standard(network.encode(values, mask))
    error = error - (values - network.mean) / network.std  # (N, D+2M)
    if not settings.standard_norms:
        error = error * network.std
    parts = error.square().split([joints, muscles, muscles], dim=1)
    norms = torch.stack([(part.sum(dim=1) + TINY).sqrt().mean() for part in parts])  # (3,)
    return norms @ norms.new_tensor(settings.weights)


def fit(
    network: Network,
    sampler: Sampler,
    settings: TrainingSettings,
    generator: torch.Generator,
    progress: Progress | None = None,
) -> list[float]:
    """Train a network in place, from whatever weights it has.

    Args:
        network: The network.
        sampler: Gives mini-batches of scaled (θ, T, l).
        settings: How to train.
        generator: Draws the masks.
        progress: Told (step, loss) after every mini-batch.

    Returns:
        The loss of every mini-batch.
    """
    optimiser = torch.optim.Adam(network.parameters(), lr=settings.step_size, fused=True)
    schedule = None
    if settings.schedule == 'one-cycle':
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, settings.step_size, settings.steps, pct_start=0.05, cycle_momentum=False
        )
    losses = []
    for step in range(settings.steps):
        values = torch.as_tensor(sampler(settings.batch), dtype=torch.float32)  # (N, D+2M)
        if settings.every_mask:
            mask = torch.arange(3).repeat_interleave(len(values))
            values = values.repeat(3, 1)  # (3N, D+2M)
        else:
            mask = torch.randint(3, (len(values),), generator=generator)
        optimiser.zero_grad()
        value = loss(network, values, mask, settings)
        value.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        if schedule is not None:
            schedule.step()
        losses.append(value.item())
        if progress is not None:
            progress(step, losses[-1])
    return losses


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
    settings = TRAINING_PRESETS[preset]
    if steps is not None:
        settings = replace(settings, steps=steps)
    rng = np.random.default_rng(seed)
    sampler: Sampler
    if settings.epoch_samples:
        drawn = samples.geometric_samples(robot, settings.epoch_samples, rng, robot.tension.max)
        batches = samples.epochs(drawn, rng, settings.batch)
        sampler = lambda _: next(batches)  # noqa: E731
    else:
        sampler = samples.GeometricSampler(robot, rng)
    width = robot.joint_count + 2 * robot.muscle_count
    mean, std = np.zeros(width), np.ones(width)
    if PRESETS[preset].standardise:
        drawn = samples.overload_samples(robot, 20_000, rng)
        # A muscle that crosses no joint of this arm still has a length; its spread may be tiny.
        mean, std = drawn.mean(axis=0), np.maximum(drawn.std(axis=0), 1e-6)
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = Network(robot.joint_count, robot.muscle_count, PRESETS[preset], mean, std)
    return network, fit(network, sampler, settings, generator, progress)
