# SPDX-License-Identifier: Apache-2.0
"""Time of each step of the core beside the same step in plain torch, in one run.

python -m bench.timings [--robot NAME|DIR] [--preset NAME]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from bench.timings_control import control_rows
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.methods import first_command
from musculoskeletal_ae.mae.evaluation import unseen_states
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import Network, from_mae, to_mae
from musculoskeletal_ae.mae.training import initial_training
from musculoskeletal_ae.mae.units import Mask, scale_vector
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.simulation import Simulation

MANY = 4096


@dataclass(frozen=True)
class Row:
    """One line of the table; without a torch side where there is nothing to compare.

    A call that does the work of several counts as so many.
    """

    name: str
    ours: Callable[[], object]
    torch_eager: Callable[[], object] | None = None
    several: int = 1


def microseconds(function: Callable[[], object], calls: int = 100, rounds: int = 20) -> float:
    """Return the time of one call [µs]: the median of rounds, so that a busy core counts little."""
    function()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        for _ in range(calls):
            function()
        times.append((time.perf_counter() - start) / calls)
    return 1e6 * float(np.median(times))


def row_time(row: Row, function: Callable[[], object]) -> float:
    """Return the time [µs] of one side of a row."""
    return microseconds(function, max(1, 100 // row.several)) / row.several


def mae_rows(robot: Robot, preset: str) -> list[Row]:
    """Return the steps of the network itself; weights do not matter for time."""
    network, _ = initial_training(robot, preset, steps=1)
    mae = to_mae(network, robot.joints, robot.muscles, preset, 'benchmark')
    eager = from_mae(mae)
    states = unseen_states(robot, 1, np.random.default_rng(0), 0.0, robot.tension.limit)
    theta, tension, length = (part[0] for part in states)
    z = mae.encode(Mask.THETA_TENSION, theta, tension)
    scaled = torch.as_tensor(mae.decode_scaled(z), dtype=torch.float32)[None]
    latent = torch.as_tensor(z, dtype=torch.float32)
    gradient = np.ones(len(mae.mean))
    masks = {mask: torch.tensor([i]) for i, mask in enumerate(Mask)}
    return [
        Row(
            'estimate: θ, T, l from ②',
            lambda: mae.estimate(tension, length),
            _no_grad(lambda: eager(scaled, masks[Mask.TENSION_LENGTH])),
        ),
        Row(
            'lengths from ①',
            lambda: mae.lengths(theta, tension),
            _no_grad(lambda: eager(scaled, masks[Mask.THETA_TENSION])),
        ),
        Row(
            'decode and gradient by z',
            lambda: mae.decode_pullback(z)[1](gradient),
            lambda: _eager_gradient(eager, latent),
        ),
        Row(
            'decode and Jacobian by z',
            lambda: mae.decode_jacobian_scaled(z),
            lambda: torch.autograd.functional.jacobian(eager.decode, latent),
        ),
        Row('muscle Jacobian G from ①', lambda: mae.muscle_jacobian(theta, tension)),
        Row(
            'the same by forward difference', lambda: mae.muscle_jacobian_difference(theta, tension)
        ),
        *(Row(*row) for row in control_rows(robot, mae, eager)),
    ]


class EagerLengths:
    """Lengths and their pullback by torch's autograd, for the same simulation step."""

    def __init__(self, mae: Mae) -> None:
        """Take the weights of a network."""
        self._network, self.lengths = from_mae(mae), mae.lengths
        self._scale = torch.tensor(scale_vector(len(mae.joints), len(mae.muscles)))
        self._joints, self._muscles = len(mae.joints), len(mae.muscles)

    def lengths_with_pullback(
        self, theta: Array, tension: Array
    ) -> tuple[Array, Callable[[Array], Array]]:
        """Return what `Mae.lengths_with_pullback` does."""
        angles = torch.tensor(theta, requires_grad=True)
        given = torch.cat((angles, torch.tensor(tension), torch.zeros(tension.shape)), dim=1)
        mask = torch.zeros(len(theta), dtype=torch.long)
        restored = self._network((given * self._scale).float(), mask) / self._scale
        length = restored[:, self._joints + self._muscles :]

        def pullback(gradient: Array) -> Array:
            return torch.autograd.grad(length, angles, torch.tensor(gradient))[0].numpy()

        return length.detach().numpy().astype(float), pullback


def simulation_rows(robot: Robot, preset: str) -> list[Row]:
    """Return one step of the simulator (its preset default), one arm and many at once."""
    network, _ = initial_training(robot, preset, steps=200)
    mae = to_mae(network, robot.joints, robot.muscles, preset, 'benchmark')
    rng = np.random.default_rng(0)

    def step(arms: int, body: Any) -> Callable[[], object]:
        simulated = Simulation(robot, body, arms=arms)
        theta = robot.random_postures(arms, rng)
        tension = rng.uniform(robot.tension.bias, robot.tension.limit, (arms, robot.muscle_count))
        simulated.command = first_command(robot, mae, theta, tension)
        simulated.wrench[:, 2] = -10.0
        return lambda: simulated.step(0.01)

    eager = EagerLengths(mae)
    return [
        Row('simulation step', step(1, mae), step(1, eager)),
        Row(f'the same, each of {MANY} in one batch', step(MANY, mae), step(MANY, eager), MANY),
    ]


def _no_grad(function: Callable[[], object]) -> Callable[[], object]:
    def call() -> object:
        with torch.no_grad():
            return function()

    return call


def _eager_gradient(network: Network, latent: torch.Tensor) -> object:
    leaf = latent.clone().requires_grad_()
    return torch.autograd.grad(network.decode(leaf).sum(), leaf)


def main(argv: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, prog='benchmark')
    parser.add_argument('--robot', default='musashi_left_arm')
    parser.add_argument('--preset', default='default', choices=('default', 'paper'))
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    robot = Robot.load(args.robot)
    print(f'{args.robot}, preset {args.preset}, µs of one call (median), torch on one thread')
    print(f'{"":<34}{"ours":>10}{"torch eager":>14}')
    for row in mae_rows(robot, args.preset) + simulation_rows(robot, args.preset):
        eager = '' if row.torch_eager is None else f'{row_time(row, row.torch_eager):.1f}'
        print(f'{row.name:<34}{row_time(row, row.ours):>10.1f}{eager:>14}')


if __name__ == '__main__':
    main()
