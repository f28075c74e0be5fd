# SPDX-License-Identifier: Apache-2.0
"""Compares interpretations of the paper's simulation L_sim,1 on development individuals.

    experiment online_learning --seeds 0,1 --keep FOLDER
    python -m bench paper_readings FOLDER --seeds 0,1

The paper leaves two things open. It does not print the unit of the torque τ that the weight
w₆ = 0.001 belongs to, and its English and Japanese texts differ in what the length l_sim is. For
each interpretation ("reading"), the simulator of preset `paper` follows the commands of the
held-out motion with the networks before and after learning, as `experiment simulation` does. The
bench prints a Markdown table of the mean errors, and of the share of tensions at T_bias.

In the table, l_sim is "sent" for the commanded length l_target, "in the simulation" for
l_target − l_comp(T_sim), and "measured" for the measured length of the arm.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.control.command import msc_compensation
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, Recording
from musculoskeletal_ae.experiments.study import Study
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.units import LENGTH_SCALE, TENSION_SCALE, Mask
from musculoskeletal_ae.options import Parser, exit_status, positive
from musculoskeletal_ae.paper.constants import LENGTH_WEIGHT, TENSION_WEIGHT, TORQUE_WEIGHT
from musculoskeletal_ae.paper.control import muscle_jacobian
from musculoskeletal_ae.paper.latent_descent import Term, descend
from musculoskeletal_ae.paper.simulation import SEARCH
from musculoskeletal_ae.robot.robot import Robot

SENT, IN_SIMULATION, MEASURED = 'sent', 'in the simulation', 'measured'
UNITS = {'N·m': 1.0, '0.1 N·m': 10.0, 'N·cm': 100.0, 'N·mm': 1000.0}  # number of units in 1 N·m


class Reading(NamedTuple):
    """One interpretation of what the paper states about L_sim,1."""

    unit: str = 'N·mm'
    length: str = SENT
    epochs: int = SEARCH.epochs
    clips: bool = True  # whether θ and T are kept within their limits
    preset: str = 'paper'  # preset of the networks that simulate

    @property
    def text(self) -> str:
        """The row's heading."""
        words = [f'τ in {self.unit}, l_sim {self.length}']
        words += [f'{self.epochs} epochs'] * (self.epochs != SEARCH.epochs)
        words += ['θ and T without limits'] * (not self.clips)
        words += [f'networks of preset `{self.preset}`'] * (self.preset != 'paper')
        return ', '.join(words)


READINGS = (
    *(Reading(unit) for unit in UNITS),
    *(Reading(unit, length) for length in (IN_SIMULATION, MEASURED) for unit in ('N·m', 'N·mm')),
    Reading(epochs=30),
    Reading(clips=False),
    Reading(preset='default'),
    Reading(length=IN_SIMULATION, preset='default'),
)


def errors(robot: Robot, mae: Mae, reading: Reading, motion: Recording) -> tuple[float, ...]:
    """Return the mean errors in θ [rad] and T [N], and the share of tensions at T_bias."""
    joints, muscles, bias = robot.joint_count, robot.muscle_count, robot.tension.bias
    row = np.eye(joints + 2 * muscles)
    tension_rows, length_rows = row[joints : joints + muscles], row[joints + muscles :]
    theta, tension = motion.theta[0], np.full(muscles, bias)
    search, unit, rows = SEARCH._replace(epochs=reading.epochs), UNITS[reading.unit], []
    for n, command in enumerate(motion.command):
        length = {
            SENT: command,
            IN_SIMULATION: command - msc_compensation(robot, tension),
            MEASURED: motion.length[n],
        }[reading.length]
        torque = robot.kinematics.holding_torque(theta)
        jacobian = muscle_jacobian(mae, theta, tension)
        torque_matrix = unit * jacobian.T @ tension_rows / TENSION_SCALE
        terms = (
            Term(TENSION_WEIGHT, tension_rows, np.zeros(muscles)),
            Term(LENGTH_WEIGHT, length_rows, LENGTH_SCALE * length),
            Term(TORQUE_WEIGHT, torque_matrix, -unit * torque),
        )
        start = mae.encode(Mask.TENSION_LENGTH, tension=tension, length=length)
        theta, tension, _ = mae.decode(descend(mae, start, terms, search))
        if reading.clips:
            theta = np.clip(theta, robot.lower, robot.upper)
            tension = np.clip(tension, bias, robot.tension.max)
        error = np.linalg.norm(theta - motion.theta[n]), np.linalg.norm(tension - motion.tension[n])
        rows.append((*error, np.mean(tension <= bias + 0.01)))
    return tuple(np.mean(rows, axis=0).tolist())


def main(argv: list[str] | None = None) -> int:
    """Print the table; exit status 1 if the folder lacks a network."""
    parser = Parser('paper_readings', "Compares interpretations of the paper's simulation.")
    text = 'folder that `experiment online_learning --keep FOLDER` has written'
    parser.add_argument('folder', type=Path, help=text)
    parser.add_robot()
    parser.add_seeds((0, 1))
    parser.add_argument('--seconds', type=positive, default=60.0, help='duration of the motion [s]')
    args = parser.parse_args(argv)

    def measure() -> None:
        robot = Robot.load(args.robot)
        study = Study(robot, 'default', args.seeds, 10.0, False, args.folder)
        part = slice(0, round(args.seconds / SAMPLE_TIME))
        motions = {seed: study.stream(seed, 'held_out').part(part) for seed in args.seeds}
        print(
            '| interpretation | before [rad] | before [N] | after [rad] | after [N] | share at '
            'T_bias, after |'
        )
        print('|---|---|---|---|---|---|')
        for reading in READINGS:
            before, after = (
                np.mean(
                    [
                        errors(robot, study.networks(seed, reading.preset)[when], reading, motion)
                        for seed, motion in motions.items()
                    ],
                    axis=0,
                )
                for when in ('before', 'after')
            )
            print(
                f'| {reading.text} | {before[0]:.3f} | {before[1]:.0f} | {after[0]:.3f} '
                f'| {after[1]:.0f} | {after[2]:.2f} |',
                flush=True,
            )

    return exit_status(measure)


if __name__ == '__main__':
    raise SystemExit(main())
