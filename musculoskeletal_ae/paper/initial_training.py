# SPDX-License-Identifier: Apache-2.0
"""Initial training on the geometric model (§III-B).

    (θ, T, l) = (θ_r, T_r, f_geo(θ_r) − L_e(f_geo,abs(θ_r), T_r))                            (2)
    L_initial = w_θ ‖θ − θ_calc‖₂ + w_T ‖T − T_calc‖₂ + w_l ‖l − l_calc‖₂                    (3)

The paper does not state the distributions. We chose θ_r uniform within the joint limits, and T_r of
each muscle uniform in [0, T_max].
"""

import numpy as np
import torch
from torch import Tensor

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.network import Network
from musculoskeletal_ae.mae.optimiser import Optimiser
from musculoskeletal_ae.mae.training import TINY, Progress, one_thread, shuffled
from musculoskeletal_ae.mae.units import State
from musculoskeletal_ae.paper.constants import (
    HIDDEN,
    INITIAL_BATCH,
    INITIAL_SAMPLES,
    INITIAL_STEPS,
    STEP_SIZE,
    WEIGHTS,
)
from musculoskeletal_ae.paper.network import new_network
from musculoskeletal_ae.robot.robot import Robot


def random_states(robot: Robot, count: int, rng: np.random.Generator) -> State:
    """Return `count` random states of the geometric model (2)."""
    theta = robot.random_postures(count, rng)
    tension = rng.uniform(0.0, robot.tension.max, (count, robot.muscle_count))
    absolute = robot.routes.absolute_lengths(theta)  # f_geo,abs
    relative = absolute - robot.routes.length_at_zero  # f_geo
    length = relative - robot.series_elastic.elongation(absolute, tension)
    return State(theta, tension, length)


def loss(network: Network, values: Tensor, mask: Tensor) -> Tensor:
    """Return L_initial (3), averaged over the states.

    Args:
        network: The network.
        values: Scaled states, (N, D+2M).
        mask: Index of the mask ①, ② or ③ under which each state is encoded, 0 to 2, (N,).
    """
    error = network(values, mask) - values
    parts = error.square().split([network.joints, network.muscles, network.muscles], dim=1)
    # TINY keeps the gradient of a norm finite where the error is zero.
    norms = torch.stack([(part.sum(dim=1) + TINY).sqrt().mean() for part in parts])  # (3,)
    return norms @ norms.new_tensor(WEIGHTS)


def train(
    robot: Robot,
    seed: int = 0,
    steps: int = INITIAL_STEPS,
    progress: Progress | None = None,
    hidden: tuple[int, ...] = HIDDEN,
) -> Network:
    """Train a new network by Adam, with the mask ①, ② or ③ of each sample chosen at random.

    Args:
        robot: The geometric model.
        seed: Seed of the states, weights, masks and the order of the samples.
        steps: Total number of mini-batches.
        progress: Function that is called after every mini-batch; see `Progress`.
        hidden: Numbers of units in the encoder's hidden layers.
    """
    rng = np.random.default_rng(seed)
    count = min(INITIAL_SAMPLES, steps * INITIAL_BATCH)
    samples: Array = random_states(robot, count, rng).scaled()
    network = new_network(robot.joint_count, robot.muscle_count, seed, hidden)
    optimiser = Optimiser(network, STEP_SIZE, muon=False)
    generator = torch.Generator(torch.get_default_device()).manual_seed(seed)
    with one_thread():
        for step, batch in zip(range(steps), shuffled(samples, INITIAL_BATCH, rng)):
            values = torch.as_tensor(batch, dtype=torch.float32)
            mask = torch.randint(3, (len(values),), generator=generator)
            value = loss(network, values, mask)
            value.backward()
            optimiser.step()
            if progress is not None:
                progress(step, value.item(), network, batch)
    return network
