# SPDX-License-Identifier: Apache-2.0
"""Initial training of the Musculoskeletal AutoEncoder on the geometric model of a robot.

    (θ, T, l) = (θ_r, T_r, f_geo(θ_r) − L_e(f_geo,abs(θ_r), T_r))
    L_initial = w_θ ‖θ − θ_calc‖₂ + w_T ‖T − T_calc‖₂ + w_l ‖l − l_calc‖₂

(paper, section "Initial Training"): random states of the geometric model, the loss, the descent,
and how well the result restores states it has not seen. `fit` knows nothing of where samples come
from.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from msgspec import structs
from torch import Tensor

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import Network, to_mae
from musculoskeletal_ae.mae.optimiser import Optimiser
from musculoskeletal_ae.mae.residuals import AnomalyStatistics, anomaly, residuals
from musculoskeletal_ae.mae.units import LENGTH_SCALE, Mask, State, scale_vector
from musculoskeletal_ae.presets import TrainingSettings, preset_named
from musculoskeletal_ae.robot.robot import Robot

# Share of samples, in preset default, with tensions beyond what is planned: a payload pulls muscles
# there, and an estimator that has seen a few such states degrades gently.
OVERLOAD_SHARE = 0.2
# Reach of θ beyond each joint limit in preset default, as a share of the range: a network is least
# accurate at the edge of what it saw, and arms do rest at their limits.
POSTURE_MARGIN = 0.05
# Between twins, in units of the spread of θ: small against the bends of a route, and large enough
# that float32 resolves the difference.
TWIN_DISTANCE = 0.1
RISE = 0.05  # share of the training in which the step size rises
# Keeps the gradient of a norm finite at zero.
TINY = 1e-12
# A joint or muscle that hardly varies is not blown up beyond this, in scaled units.
LEAST_SPREAD = 1e-4
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


def training_states(robot: Robot, preset: str, count: int, rng: np.random.Generator) -> State:
    """Return random states as a preset trains on."""
    if preset_named(preset).network.standardise:
        return overload_states(robot, count, rng)
    return random_states(robot, count, rng, robot.tension.max)


def overload_states(robot: Robot, count: int, rng: np.random.Generator) -> State:
    """Return random states mostly within tension.limit, some beyond it, up to tension.max."""
    highest = highest_tensions(robot, count, rng)
    return random_states(robot, count, rng, highest, margin=POSTURE_MARGIN)


def highest_tensions(robot: Robot, count: int, rng: np.random.Generator) -> Array:
    """Return tension.limit (count, M) [N], or in some rows more, up to tension.max."""
    limit, most = robot.tension.limit, robot.tension.max
    overloaded = rng.uniform(size=(count, 1)) < OVERLOAD_SHARE
    return np.where(overloaded, limit + (most - limit) * rng.uniform(size=(count, 1)), limit)


def with_twins(robot: Robot, samples: Array, std: Array, rng: np.random.Generator) -> Array:
    """Return samples, scaled (θ, T, l) (N, D+2M), with a neighbour each, (N, 2, D+2M).

    It has the same T, and a θ that is off by TWIN_DISTANCE in units of the spread, std (D+2M,).
    """
    joints, muscles = robot.joint_count, robot.muscle_count
    direction = rng.normal(size=(len(samples), joints))
    direction *= TWIN_DISTANCE / np.linalg.norm(direction, axis=1, keepdims=True)
    twin = samples.copy()
    twin[:, :joints] += direction * std[:joints]
    theta, tension, _ = np.split(twin / scale_vector(joints, muscles), [joints, -muscles], axis=1)
    twin[:, -muscles:] = LENGTH_SCALE * robot.muscle_lengths(theta, tension)
    return np.stack([samples, twin], axis=1)


def shuffled(samples: Array, batch: int, rng: np.random.Generator) -> Iterator[Array]:
    """Yield mini-batches of shuffled samples, epoch after epoch, without end."""
    while True:
        order = rng.permutation(len(samples))
        for i in range(0, max(len(order) - batch, 0) + 1, batch):
            yield samples[order[i : i + batch]]


# -- descent -----------------------------------------------------------------------------------


def loss(
    network: Network, values: Tensor, mask: Tensor, settings: TrainingSettings, twins: int = 0
) -> Tensor:
    """Return the mean of L_initial over scaled (θ, T, l) (N, D+2M), entered by mask indices (N,).

    The last `twins` rows are neighbours of the first `twins`, all of them entered by ①.
    """
    joints, muscles = network.joints, network.muscles
    error = network.decoder(network.encode(values, mask))
    error = error - (values - network.mean) / network.std  # (N, D+2M)
    result = error.new_zeros(())
    if twins:
        # The slope of the error between neighbours is the error of the slope.
        between = (error[-twins:] - error[:twins])[:, -muscles:] / TWIN_DISTANCE
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
    """Train a network in place, from whatever weights it has; return the loss of each mini-batch.

    These are `settings.steps` of scaled (θ, T, l), shape (N, D+2M), or (N, 2, D+2M) of samples and
    their twins. The seed draws the masks where a sample is entered by one only.
    """
    generator = torch.Generator(torch.get_default_device()).manual_seed(seed)
    optimiser = Optimiser(network, settings.step_size, muon=settings.optimiser == 'muon')
    losses = []
    with one_thread():
        for step in range(settings.steps):
            batch = next(batches)
            values = torch.as_tensor(batch, dtype=torch.float32)
            twin = values[:, 1] if values.ndim == 3 else values[:0]  # (N or 0, D+2M)
            rows = values[:, 0] if values.ndim == 3 else values  # (N, D+2M)
            if settings.every_mask:
                mask = torch.arange(3).repeat_interleave(len(rows))
                rows = rows.repeat(3, 1)  # (3N, D+2M)
            else:
                mask = torch.randint(3, (len(rows),), generator=generator)
            mask = torch.cat([mask, mask.new_zeros(len(twin))])
            value = loss(network, torch.cat([rows, twin]), mask, settings, len(twin))
            value.backward()
            optimiser.step(annealing(step / settings.steps) if settings.annealed else 1.0)
            losses.append(value.item())
            if progress is not None:
                progress(step, losses[-1], network, batch)
    return losses


def annealing(progress: float) -> float:
    """Return the factor of the step size at a share of the training in [0, 1)."""
    if progress < RISE:
        return progress / RISE
    return 0.5 * (1.0 + math.cos(math.pi * (progress - RISE) / (1.0 - RISE)))


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
    """Let everything that is trained from now on be on one of `presets.DEVICES`.

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


class Trained(NamedTuple):
    """What `initial_mae` gives."""

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
    count = chosen.steps(robot.groups) if steps is None else steps
    settings = structs.replace(chosen.training, steps=count)
    rng = np.random.default_rng(seed)
    drawn = min(settings.samples, count * settings.batch)  # of a short training: in one epoch
    samples = training_states(robot, preset, drawn, rng).scaled()
    if chosen.network.standardise:
        mean, std = samples.mean(axis=0), np.maximum(samples.std(axis=0), LEAST_SPREAD)
    else:
        mean, std = np.zeros(samples.shape[1]), np.ones(samples.shape[1])
    if settings.slope_weight > 0.0:
        samples = with_twins(robot, samples, std, rng)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        sizes = robot.joint_count, robot.muscle_count
        network = Network(*sizes, chosen.network, mean, std, chosen.blocks(robot.groups))
    losses = fit(network, shuffled(samples, settings.batch, rng), settings, seed, progress)
    history = (
        f'initial training on the geometric model of {robot.description.directory.name}: '
        f'preset {preset}, seed {seed}, {len(losses)} mini-batches of {settings.batch} '
        f'by {settings.optimiser}'
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
