# SPDX-License-Identifier: Apache-2.0
"""Common parts of the training of all presets, on the geometric model of a robot.

The parts are random states of the geometric model, mini-batches, the choice of the torch device,
and the errors on held-out states. `default_training.py` contains the training of preset `default`,
and `initial_training.py` runs the training of the chosen preset.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import torch

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import Network
from musculoskeletal_ae.mae.units import Mask, State
from musculoskeletal_ae.robot.equilibrium_states import equilibrium_states, has_followers
from musculoskeletal_ae.robot.robot import Robot

TINY = 1e-12  # add this to the square of a norm, so that its gradient is finite at zero

#: called with (step, loss, network, mini-batch) after every mini-batch
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
    """Return random states of the geometric model.

    Args:
        robot: The geometric model.
        count: Number of states N.
        rng: Draws the states.
        highest: Upper end of the uniform distribution of T [N]; a number, (M,) or (N, M).
        lowest: Lower end of the uniform distribution of T [N]; a number, (M,) or (N, M).
        margin: How far θ may exceed each joint limit, as a fraction of the joint's range.
    """
    theta = robot.random_postures(count, rng, margin)
    tension = rng.uniform(lowest, highest, (count, robot.muscle_count))
    return State(theta, tension, robot.muscle_lengths(theta, tension))


def rest_states(robot: Robot, count: int, rng: np.random.Generator) -> State:
    """Return random states in which the robot can rest, with T up to T_limit.

    A robot with enough muscles can rest anywhere; others rest in equilibria only
    (`robot/equilibrium_states.py`).
    """
    found = equilibrium_states(robot, count, rng) if has_followers(robot) else None
    if found is None:
        return random_states(robot, count, rng, robot.tension.limit)
    return State(*found, robot.muscle_lengths(*found))


def shuffled(samples: Array, batch: int, rng: np.random.Generator) -> Iterator[Array]:
    """Yield mini-batches of the samples forever, shuffled again in each epoch."""
    while True:
        order = rng.permutation(len(samples))
        for i in range(0, max(len(order) - batch, 0) + 1, batch):
            yield samples[order[i : i + batch]]


def train_on(device: str) -> None:
    """Train on a torch device from now on: `cpu` or `cuda`.

    Raises:
        MusculoskeletalError: If torch cannot use the device; the text names the remedy.
    """
    try:
        # An available device may still fail to compute, so compute something.
        torch.ones(1, device=device).sum().item()
    except (RuntimeError, AssertionError) as error:  # torch without CUDA raises AssertionError
        raise MusculoskeletalError(
            f'device {device!r}: torch {torch.__version__} cannot use it; legal: cpu. '
            'For a GPU, install its driver and a build of torch that supports it (pytorch.org)'
        ) from error
    # Set no default device for the CPU: while one is set, every call of torch is slower, and a
    # training step takes a fifth longer.
    torch.set_default_device(None if device == 'cpu' else device)


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch to one thread within a `with` block.

    Products of small matrices are hardly faster on two cores, and much slower if one of the cores
    is busy.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


# -- errors ------------------------------------------------------------------------------------

#: name of each output, unit in which its errors are reported, and factor from SI units to this unit
OUTPUTS = (('theta', 'rad', 1.0), ('tension', 'N', 1.0), ('length', 'mm', 1e3))


class PairError(NamedTuple):
    """Error of one output that the network reconstructs with one mask."""

    mask: Mask
    output: str  # 'theta', 'tension' or 'length'
    unit: str  # unit of `norm` and `elements`
    norm: float  # mean over the states of the error's Euclidean norm
    elements: Array  # mean absolute error of each joint or muscle, (D,) or (M,)


def pair_errors(mae: Mae, states: State) -> list[PairError]:
    """Return the mean errors over N states, for all nine pairs of mask and output.

    The network reconstructs each of the true `states` from the two quantities that a mask selects.
    """
    result = []
    for mask in Mask:
        reconstructed = mae.decode(mae.encode(mask, *states))
        for (output, unit, factor), got, true in zip(OUTPUTS, reconstructed, states, strict=True):
            error = factor * (got - true)
            norm = float(np.linalg.norm(error, axis=1).mean())
            result.append(PairError(mask, output, unit, norm, np.abs(error).mean(axis=0)))
    return result
