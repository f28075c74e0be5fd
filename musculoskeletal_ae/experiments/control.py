# SPDX-License-Identifier: Apache-2.0
"""How well control works: the paper's protocol on emulated arms, and claims on the nominal body.

The protocol (paper, section "Control Using Musculoskeletal AutoEncoder", experiment): 5 random
θ_eval, each approached from 5 random postures, by every method; mean and variance of
‖θ_eval − θ‖ and mean ‖T‖ at the end, beside the least ‖T‖ that could hold θ_eval.

python -m musculoskeletal_ae.experiments.control --checkpoint FILE --paper-checkpoint FILE
    [--robot NAME|DIR] [--nominal | --seeds 0,1,2] [--quick]
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

from bench.control_nominal import nominal_tables
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments.control_loop import ControlLoop
from musculoskeletal_ae.experiments.holdable import holdable_postures
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

#: name → (method, preset); with preset `paper` the paper's network is used as well
PROTOCOL = {
    'geometric': ('geometric', 'default'),
    'first': ('first', 'default'),
    'second': ('second', 'default'),
    'proposed': ('proposed', 'default'),
    'proposed_paper': ('proposed', 'paper'),
}
# `second` is done after 5 s + 2 s; all methods are read at the same time.
DURATION = 8.0  # [s]


@dataclass(frozen=True)
class Approach:
    """One approach of θ_eval: what was left of the way [rad], and ‖T‖ there [N]."""

    error: float
    tension: float


@dataclass(frozen=True)
class ControlResult:
    """The protocol on one arm.

    Attributes:
        approaches: For each method its approaches, all starts of the first θ_eval first.
        qp_bound: Least ‖T‖ of the true body that holds each θ_eval [N].
    """

    approaches: dict[str, list[Approach]]
    qp_bound: list[float]

    def summary(self) -> dict[str, dict[str, float]]:
        """Return mean error, its variance and mean ‖T‖ of each method, as result.json has them."""
        return {
            method: {
                'error_rad': float(np.mean([a.error for a in approaches])),
                'error_var': float(np.var([a.error for a in approaches])),
                'tension_n': float(np.mean([a.tension for a in approaches])),
            }
            for method, approaches in self.approaches.items()
        }


def approach(
    arm: EmulatedArm, mae: Mae, settings: Settings, start: Array, theta: Array
) -> Approach:
    """Let the arm go from rest at `start` to θ."""
    arm.reset(start)
    loop = ControlLoop(arm, mae, settings)
    loop.target(theta)
    loop.run(DURATION)
    if loop.core.safety.cause:
        raise MusculoskeletalError(f'control stopped: {loop.core.safety.cause}')
    error = float(np.linalg.norm(arm.theta - theta))
    return Approach(error, float(np.linalg.norm(arm.tension)))


def control_protocol(
    arm: EmulatedArm, mae: Mae, paper: Mae, seed: int, postures: int = 5, starts: int = 5
) -> ControlResult:
    """Run the protocol on one arm.

    Args:
        arm: The arm.
        mae: Network of preset default, learnt or not; of preset paper the other one.
        paper: See `mae`.
        seed: Draws θ_eval and the starts.
        postures: How many θ_eval.
        starts: How many starts for each.
    """
    robot, rng = arm.robot, np.random.default_rng([seed, 0xC0])
    evaluated = holdable_postures(robot, arm.individual, postures, rng)
    approaches: dict[str, list[Approach]] = {name: [] for name in PROTOCOL}
    for theta, _ in evaluated:
        for start in robot.random_postures(starts, rng):
            for name, (method, preset) in PROTOCOL.items():
                settings = Settings(method=method, preset=preset)
                network = paper if preset == 'paper' else mae
                approaches[name].append(approach(arm, network, settings, start, theta))
    return ControlResult(approaches, [float(np.linalg.norm(least)) for _, least in evaluated])


def main(argv: list[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog='control', description=__doc__)
    parser.add_argument('--robot', default='musashi_left_arm')
    parser.add_argument('--checkpoint', required=True, help='of preset default')
    parser.add_argument('--paper-checkpoint', required=True, help='of preset paper')
    parser.add_argument('--nominal', action='store_true', help='claims on the nominal body')
    parser.add_argument('--seeds', default='0', help='emulated arms, e.g. 0,1,2')
    parser.add_argument('--quick', action='store_true', help='few postures')
    args = parser.parse_args(argv)
    robot = Robot.load(args.robot)
    mae = checkpoint.load(args.checkpoint, robot)
    paper = checkpoint.load(args.paper_checkpoint, robot)
    if args.nominal:
        print(nominal_tables(robot, mae, paper, quick=args.quick))
        return
    count = 1 if args.quick else 5
    for seed in map(int, args.seeds.split(',')):
        result = control_protocol(EmulatedArm(robot, seed), mae, paper, seed, count, count)
        print(f'arm {seed}: QP bound {np.mean(result.qp_bound):.1f} N')
        for name, row in result.summary().items():
            print(
                f'  {name:16s} error {row["error_rad"]:.4f} rad, variance {row["error_var"]:.5f}, '
                f'‖T‖ {row["tension_n"]:.1f} N'
            )


if __name__ == '__main__':
    main()
