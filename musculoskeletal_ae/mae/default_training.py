# SPDX-License-Identifier: Apache-2.0
"""Initial training of preset `default` on the geometric model of a robot.

    L = ‖θ − θ_calc‖ + ‖T − T_calc‖ + ‖l − l_calc‖ + ‖G − G_calc‖

Each norm is in units of the standard deviation of the data, so that all have similar weight. G is
the muscle Jacobian ∂l/∂θ of the lengths that the network reconstructs from θ and T; control needs
it. Each sample has a close neighbour, its twin. The error of G is the difference between the length
errors of sample and twin, divided by their distance. Every sample passes through all three masks.
Muon updates the matrices, with a step size that rises and then falls to zero.

HIDDEN and STEPS apply to an arm with 5 joints and 10 muscles. If groups of joints and muscles share
neither, each group gets its own block of the network. A large group is divided further if possible:
each finger of a hand gets a block that also has the inputs of the wrist. With one block for the
whole hand, the error after as many mini-batches would be 2.5 times as large, and a mini-batch would
take twice as long (MyoHand, 23 joints and 39 muscles, 1500 mini-batches: 0.123 instead of 0.050
rad).

The layers of a larger block grow in proportion to its D + M. If they grew by the square root, the
error of θ of a body with 17 joints and 40 muscles would be 0.0045 instead of 0.0030 rad per joint.
The number of mini-batches grows with D + M of the largest block to the power of 1.5, up to
MOST_STEPS. The error of estimates from T and l is then a tenth lower for the body with 17 joints
than for the arm with 5 joints; with growth in proportion to D + M, it would be higher.
"""

import math
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.network import Network
from musculoskeletal_ae.mae.optimiser import Optimiser
from musculoskeletal_ae.mae.training import (
    TINY,
    Progress,
    one_thread,
    random_states,
    rest_states,
    shuffled,
)
from musculoskeletal_ae.mae.units import LENGTH_SCALE, ActivationName, State, scale_vector
from musculoskeletal_ae.robot.equilibrium_states import has_followers
from musculoskeletal_ae.robot.groups import Group, parts
from musculoskeletal_ae.robot.robot import Robot

# The reference arm has 5 joints and 10 muscles.
HIDDEN = (200, 100)  # give the reference arm hidden layers of these sizes
ACTIVATION: ActivationName = 'silu'  # follows every layer except the latent and the last one
STEPS = 3000  # train the network of the reference arm on this many mini-batches
MOST_STEPS = 5000  # train the network of any body on at most this many mini-batches
BATCH = 128  # train on this many samples at once
SAMPLES = 200_000  # draw at most this many different samples
STEP_SIZE = 0.004  # train biases with this step size; `optimiser` derives that of the matrices
#: enlarge layers and steps for a body with more joints and muscles (D + M) than this
REFERENCE = 5 + 10
#: divide a group of joints and muscles into parts, if possible, if D + M exceeds this multiple of
#: REFERENCE
LARGE = 2
#: In the size D + M of a group, count at most this many muscles per joint: further muscles add
#: equations, but no unknowns.
COUNTED_MUSCLES = 2.5

#: Draw this fraction of samples with tensions beyond tension.limit, as payloads can cause. With
#: them, the estimator loses accuracy only gradually beyond the limit.
OVERLOAD_SHARE = 0.2
#: Let samples of θ exceed each joint limit by up to this fraction of the range. A network is least
#: accurate at the edge of its training data, and arms do rest at their limits.
POSTURE_MARGIN = 0.05
#: draw this share of the states of a robot with fewer muscles than joints from its equilibria
REST_SHARE = 0.5
#: Draw the twin of a sample, by which the muscle Jacobian is trained, at this distance from it, in
#: standard deviations of θ. Over this distance, routes are almost linear, and float32 still
#: resolves the difference.
TWIN_DISTANCE = 0.1
#: Standardise by no smaller standard deviation than this, in scaled units. A smaller one would
#: amplify the noise of a joint or muscle that hardly varies.
LEAST_SPREAD = 1e-4
RISE = 0.05  # let the step size rise during this first fraction of the training, then fall

# -- size --------------------------------------------------------------------------------------


def grown(number: int, groups: Iterable[Group], power: float = 1.0) -> int:
    """Return a number of units or steps, scaled up for the size of the largest group.

    Args:
        number: The number for the reference arm, D + M = REFERENCE.
        groups: The groups of joints and muscles.
        power: Power of D + M with which the number grows.
    """
    times = max(1.0, max(map(size, groups)) / REFERENCE)
    return round(number * times**power)


def size(group: Group) -> float:
    """Return the size D + M of a group, counting at most COUNTED_MUSCLES muscles per joint."""
    joints, muscles = map(len, group)
    return joints + min(muscles, COUNTED_MUSCLES * joints)


def default_steps(groups: Iterable[Group]) -> int:
    """Return how many mini-batches the initial training of one block per group needs."""
    return min(grown(STEPS, groups, 1.5), MOST_STEPS)


def divided(robot: Robot) -> tuple[tuple[Group, ...], tuple[int, ...]]:
    """Return the groups into which a robot is divided: each gets a block of the network.

    Returns:
        The groups, and for each block the index of its base, whose inputs it uses as well, such as
        that of the wrist for a finger. A block without a base has its own index.
    """
    result, bases = list[Group](), list[int]()
    for group in robot.groups:
        is_large = size(group) > LARGE * REFERENCE
        own = parts(robot.routes.crossed, group) if is_large else (group,)
        bases += [len(result)] * len(own)
        result += own
    return tuple(result), tuple(bases)


def blocks(groups: Iterable[Group]) -> dict[Group, tuple[int, ...]]:
    """Return the blocks of the network: for each group, the sizes of its hidden layers."""
    return {group: tuple(grown(units, [group]) for units in HIDDEN) for group in groups}


# -- samples -----------------------------------------------------------------------------------


def overload_states(robot: Robot, count: int, rng: np.random.Generator) -> State:
    """Return random states of the geometric model, some of which exceed the tension limit.

    `highest_tensions` describes the range of the tensions. If the robot has fewer muscles than
    joints somewhere, a share REST_SHARE of the states are equilibria (`rest_states`): from the
    equilibria, the network learns θ, and from the other states, it learns G around them.
    """
    highest = highest_tensions(robot, count, rng)
    anywhere = random_states(robot, count, rng, highest, margin=POSTURE_MARGIN)
    if not has_followers(robot):
        return anywhere
    at_rest = rest_states(robot, count, rng)
    is_at_rest = rng.uniform(size=(count, 1)) < REST_SHARE
    chosen = (np.where(is_at_rest, *pair) for pair in zip(at_rest, anywhere, strict=True))
    return State(*chosen)


def highest_tensions(robot: Robot, count: int, rng: np.random.Generator) -> Array:
    """Return the upper ends of the ranges from which random tensions are drawn [N], (count, M).

    In most samples, this is T_limit. In a random share OVERLOAD_SHARE, it is a random value between
    T_limit and T_max.
    """
    limit, most = robot.tension.limit, robot.tension.max
    overloaded = rng.uniform(size=(count, 1)) < OVERLOAD_SHARE
    return np.where(overloaded, limit + (most - limit) * rng.uniform(size=(count, 1)), limit)


def with_twins(robot: Robot, samples: Array, std: Array, rng: np.random.Generator) -> Array:
    """Return each sample with its twin, a close neighbour with the same T.

    Args:
        robot: The geometric model.
        samples: Scaled (θ, T, l), (N, D+2M).
        std: Standard deviations of the samples, (D+2M,). The twins' distance in θ, measured in
            these standard deviations, is TWIN_DISTANCE.
        rng: Draws the directions in θ.

    Returns:
        Samples and twins, (N, 2, D+2M).
    """
    joints, muscles = robot.joint_count, robot.muscle_count
    direction = rng.normal(size=(len(samples), joints))
    direction *= TWIN_DISTANCE / np.linalg.norm(direction, axis=1, keepdims=True)
    twin = samples.copy()
    twin[:, :joints] += direction * std[:joints]
    theta, tension, _ = np.split(twin / scale_vector(joints, muscles), [joints, -muscles], axis=1)
    twin[:, -muscles:] = LENGTH_SCALE * robot.muscle_lengths(theta, tension)
    return np.stack([samples, twin], axis=1)


# -- descent -----------------------------------------------------------------------------------


def loss(network: Network, samples: Tensor) -> Tensor:
    """Return the training loss L, averaged over the samples.

    `samples` contains scaled (θ, T, l) of each sample and of its twin, (N, 2, D+2M).
    """
    joints, muscles = network.joints, network.muscles
    rows, twins = samples[:, 0], samples[:, 1]  # (N, D+2M) each
    count = len(twins)
    # The samples through ①, ② and ③, then the twins through ①.
    mask = torch.arange(3).repeat_interleave(count)
    mask = torch.cat([mask, mask.new_zeros(count)])
    values = torch.cat([rows.repeat(3, 1), twins])  # (4N, D+2M)
    error = network.decoder(network.encode(values, mask))
    error = error - (values - network.mean) / network.std
    # A sample and its twin have different errors of l. Their difference, divided by the distance of
    # the two, is the error of ∂l/∂θ in the direction from one to the other.
    between = (error[-count:] - error[:count])[:, -muscles:] / TWIN_DISTANCE
    slope = (between.square().sum(dim=1) + TINY).sqrt().mean()
    parts = error[:-count].square().split([joints, muscles, muscles], dim=1)
    norms = torch.stack([(part.sum(dim=1) + TINY).sqrt().mean() for part in parts])  # (3,)
    return slope + norms @ torch.ones_like(norms)


def train(
    robot: Robot, seed: int = 0, steps: int = STEPS, progress: Progress | None = None
) -> Network:
    """Train a new network.

    Args:
        robot: The geometric model.
        seed: Random seed of states, weights and order of the samples.
        steps: Number of mini-batches.
        progress: Called after every mini-batch with step, loss, network and mini-batch; or None.
    """
    rng = np.random.default_rng(seed)
    samples = overload_states(robot, min(SAMPLES, steps * BATCH), rng).scaled()
    mean, std = samples.mean(axis=0), np.maximum(samples.std(axis=0), LEAST_SPREAD)
    samples = with_twins(robot, samples, std, rng)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        sizes = robot.joint_count, robot.muscle_count
        groups, bases = divided(robot)
        network = Network(*sizes, blocks(groups), ACTIVATION, mean, std, bases)
    optimiser = Optimiser(network, STEP_SIZE, muon=True)
    with one_thread():
        for step, batch in zip(range(steps), shuffled(samples, BATCH, rng)):
            value = loss(network, torch.as_tensor(batch, dtype=torch.float32))
            value.backward()
            optimiser.step(annealing(step / steps))
            if progress is not None:
                progress(step, value.item(), network, batch)
    return network


def annealing(progress: float) -> float:
    """Return the factor of the step size after a share `progress` of the training, in [0, 1).

    The factor rises from 0 to 1 at first, and then falls back to 0 as a cosine.
    """
    if progress < RISE:
        return progress / RISE
    return 0.5 * (1.0 + math.cos(math.pi * (progress - RISE) / (1.0 - RISE)))
