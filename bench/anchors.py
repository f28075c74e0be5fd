# SPDX-License-Identifier: Apache-2.0
"""What tells an arm without joint sensors where it is: stops, and a posture that somebody states.

python -m bench anchors [--robot …] [--seeds 0,1] [--minutes 10] [--folder DIR]

One exploration teaches learners that read no joint angle. Printed is the error [rad] on the motion
never learned from:

- none: as shipped (`joint_source: none`).
- no stops: as if a joint that muscles push against its stop were anywhere.
- stated: somebody puts the arm in its first posture and states the angles, each off by 0.03 rad
  (`joint_source: marker`).
- zeroed: as shipped; then all lengths are shifted so that the network finds the arm in a stated
  posture, as `estimator/zero` does: the mean over ten postures.

What a marker and an accelerometer are worth is told by `experiment sensors`.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np
import torch

from bench.learned_arm import STEPS, LearnedArm, Seldom, learned_arm
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.experiments.online_learning import teach
from musculoskeletal_ae.experiments.recording import (
    HELD_OUT_STREAM,
    Recording,
    end_tensions,
    estimation_error,
    judge,
    record,
)
from musculoskeletal_ae.learning import postures
from musculoskeletal_ae.learning.learner import MARKER, NONE, Learner
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.robot import Robot

HELD_OUT = 300.0  # [s]
STATED = 0.03  # by how much each angle of a stated posture is off [rad]
POSTURES = 10  # that lengths are shifted in
STILL, CHANGE = 50, 2e-4  # messages in which a length changes by less [m]: a rest


def taught(arm: LearnedArm, robot: Robot, seed: int, stated: bool = False) -> Mae:
    """Return what is learned from the exploration without a joint angle, or with one posture's."""
    off = STATED * np.random.default_rng([seed, 0xA7]).choice([-1.0, 1.0], robot.joint_count)
    source = MARKER if stated else NONE
    learner = Learner(
        robot, arm.driver, seed=seed, steps=STEPS, training=Seldom, joint_source=source
    )

    def see(learner: Learner, _n: int, true: Array, _read: Array) -> Array | None:
        return true + off if stated and not len(learner.samples) else None

    teach(learner, zip(*arm.exploring, strict=True), see)
    return learner.mae


def zeroed(mae: Mae, exploring: Recording, held_out: Recording, seed: int) -> float:
    """Return the error with lengths shifted in a stated posture, the mean over some."""
    rng, length = np.random.default_rng([seed, 0xA8]), exploring.length
    still = STILL + np.flatnonzero((np.abs(length[STILL:] - length[:-STILL]) < CHANGE).all(axis=1))
    errors, tension = list[float](), end_tensions(mae, exploring)
    for n in rng.choice(still, POSTURES):
        stated = exploring.theta[n] + STATED * rng.choice([-1.0, 1.0], exploring.theta.shape[1])
        offset = mae.lengths(stated, tension[n]) - length[n]
        errors.append(estimation_error(mae, held_out._replace(length=held_out.length + offset)))
    return float(np.mean(errors))


def measure(robot: Robot, seed: int, folder: Path, minutes: float) -> dict[str, float]:
    """Return the errors of one individual [rad]."""
    arm = learned_arm(robot, seed, folder, minutes)
    held_out = record(EmulatedArm(robot, seed), arm.driver, HELD_OUT_STREAM, HELD_OUT)
    error = judge(held_out)
    none = taught(arm, robot, seed)
    with patch.object(postures, 'NEAR_STOP', -np.inf):
        no_stops = taught(arm, robot, seed)
    networks = {'before': arm.driver, 'all joint sensors': arm.mae, 'none': none}
    networks |= {'no stops': no_stops, 'stated': taught(arm, robot, seed, stated=True)}
    return {
        **{title: error(mae) for title, mae in networks.items()},
        'zeroed': zeroed(none, arm.exploring, held_out, seed),
    }


def main(argv: list[str]) -> None:
    """Print a line for each individual."""
    parser = Parser('anchors', 'What stops and a stated posture are worth without joint sensors.')
    parser.add_robot()
    parser.add_seeds((0, 1))
    parser.add_minutes('duration of the exploration', 10.0)
    parser.add_argument('--folder', type=Path, help='keeps what was learned for the next run')
    args = parser.parse_args(argv)
    torch.set_num_threads(1)

    robot = Robot.load(args.robot)
    with TemporaryDirectory() as scratch:
        for seed in args.seeds:
            errors = measure(robot, seed, args.folder or Path(scratch), args.minutes)
            said = ', '.join(f'{title} {error:.4f}' for title, error in errors.items())
            print(f'individual {seed}: {said} rad', flush=True)
