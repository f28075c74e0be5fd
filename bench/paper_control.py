# SPDX-License-Identifier: Apache-2.0
"""Readings of the paper's `proposed`, beside `geometric`, `first` and `second`, after learning.

python -m bench paper_control [--robot …] [--reality kin] [--seeds 0,1,2,3,4] [--quick]

The paper found `proposed` as exact as `second` with less tension than `first` and `second`. Its
print leaves open in what unit τ is weighted (w₃ = 0.01), whether l sent is decoded after the
descent or the network's own at (θ_target, T_calc) through ①, where the descent starts, the step of
G, and whether T_current is read once or again and again. Each reading is tried on the network of
preset `paper` that an individual learned while it explored with it. Targets can be held by the
true body; the arm goes to a start with `first`, on to the target, and is read at rest.
"""

from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.exploration import DURATIONS, TRIES, holdable_postures
from musculoskeletal_ae.control.methods import (
    SEARCH,
    TORQUE_WEIGHT,
    first_command,
    geometric_command,
    msc_compensation,
    paper_terms,
)
from musculoskeletal_ae.control.posture import RAMP_SHARE, Ramp
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.experiments.online_learning import beginner, explore, teach
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME
from musculoskeletal_ae.experiments.study import Study
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.descent import Term, descend
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.mae.units import TENSION_SCALE, Mask
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.robot import Robot

TARGETS, STARTS = 5, 2
AGAIN, EVERY = 10, 0.5  # times that T_current is read again, and how long each is followed [s]
RATE = 0.1  # [m/s] of a command, at most
WIDE_STEP = 0.1  # [rad] of G, ten times ours
#: units of τ by how many of them a newton metre is
UNITS = {
    'N·m': 1.0,
    '20 N·m (scaled T and l)': 0.05,
    '0.1 N·m (T in N, scaled l)': 10.0,
    'N·cm': 100.0,
    'N·mm': 1000.0,
}
PRINTED, SCALED_LENGTH = 'N·m', '0.1 N·m (T in N, scaled l)'


class Reading(NamedTuple):
    """One reading of the print."""

    unit: float = 1.0  # units of τ in a newton metre
    own_length: bool = False  # l sent by ① at (θ_target, T_calc) instead of decoded
    from_bias: bool = False  # the descent starts at T_bias instead of T_current
    after_first: bool = False  # `first` is run before
    again: bool = False  # T_current is read again and again
    step: float = 0.01  # [rad] of G's difference

    def command(self, robot: Robot, mae: Mae, theta: Array, tension: Array) -> Array:
        """Return l_target [m] (M,) for θ_target [rad] (D,) and T_current [N] (M,)."""
        torque = robot.kinematics.holding_torque(theta)
        least, posture, _ = paper_terms(robot, mae, theta, torque, tension)
        jacobian = mae.muscle_jacobian_difference(theta, tension, self.step)
        exerted = jacobian.T @ least.matrix / TENSION_SCALE
        balance = Term(self.unit * TORQUE_WEIGHT, exerted, -torque)
        start = robot.tension.bias if self.from_bias else tension
        z = mae.encode(Mask.THETA_TENSION, theta, start)
        state = mae.decode(descend(mae, z, (least, posture, balance), SEARCH))
        length = mae.lengths(theta, state.tension) if self.own_length else state.length
        return length + msc_compensation(robot, state.tension)


READINGS = {
    **{f'τ in {name}': Reading(unit) for name, unit in UNITS.items()},
    **{
        f'τ in {name}; {what}': Reading(UNITS[name], **{field: value})
        for field, what, value in (
            ('own_length', 'l by ① at θ_target', True),
            ('from_bias', 'descent from T_bias', True),
            ('after_first', 'after `first`', True),
            ('step', f'G by {WIDE_STEP:g} rad', WIDE_STEP),
            ('again', f'T_current read {AGAIN} times again', True),
        )
        for name in (PRINTED, SCALED_LENGTH)
    },
    'w₃ twenty times as large': Reading(20.0),
    'w₃ twenty times as large; T_current read again': Reading(20.0, again=True),
}

#: l_target [m] for T_current [N]
Command = Callable[[Array], Array]


def follow(arm: Arm, last: Array, goal: Array, duration: float) -> Array:
    """Ramp to a command [m] (M,), as the controller does, and rest; return the command."""
    ramp, command = Ramp(last, goal, RAMP_SHARE * duration, RATE), last
    for _ in range(round(max(duration, ramp.duration) / SAMPLE_TIME)):
        command = goal if ramp.done else ramp.step(SAMPLE_TIME)
        arm.command_length(command)
        arm.step(SAMPLE_TIME)
    return command


def stages(robot: Robot, mae: Mae, name: str, theta: Array) -> list[tuple[Command, float]]:
    """Return the commands of a method or reading one after another, and for how long each [s]."""
    bias = robot.tension.bias
    reading, (long, short, _) = READINGS.get(name, Reading()), DURATIONS

    def first(_: Array) -> Array:
        return first_command(robot, mae, theta, bias)

    def proposed(tension: Array) -> Array:
        return reading.command(robot, mae, theta, tension)

    if name == 'geometric':
        return [(lambda _: geometric_command(robot, theta), long)]
    if name == 'first':
        return [(first, long)]
    if name == 'second':
        return [(first, long), (lambda tension: first_command(robot, mae, theta, tension), short)]
    before = [(first, long)] if reading.after_first else []
    return [*before, (proposed, long), *[(proposed, EVERY)] * (AGAIN if reading.again else 0)]


METHODS = ('geometric', 'first', 'second', *READINGS)


@contextmanager
def studied(args: Namespace, preset: str) -> Iterator[Study]:
    """Make a study of the individuals that a bench is asked for, with the initial network."""
    robot = Robot.load(args.robot)
    with TemporaryDirectory() as folder:
        study = Study(
            robot, preset, args.seeds, args.minutes, args.quick, Path(folder), args.reality
        )
        checkpoint.save(initial_mae(robot, preset).mae, study.network_file(preset, None))
        yield study


def learned(study: Study, seed: int) -> Mae:
    """Return what the study's preset learns of an individual that explores with it."""
    learner, loop = beginner(study, study.arm(seed), seed, study.preset)
    teach(learner, explore(loop, learner, 60.0 * study.minutes))
    return learner.mae


def individual(study: Study, seed: int) -> dict[str, tuple[float, float]]:
    """Return mean error [rad] and ‖T‖ [N] of every method and reading; 'bound' has ‖T‖ alone."""
    robot, mae, arm = study.robot, learned(study, seed), study.arm(seed)
    rng, bias = np.random.default_rng([seed, 0xC0]), robot.tension.bias
    postures = robot.random_postures(TRIES, rng)
    count, starts = (1, 1) if study.quick else (TARGETS, STARTS)
    held = holdable_postures(robot, postures, count, arm.individual.muscle_jacobian)
    ends: dict[str, list[tuple[float, float]]] = {name: [] for name in METHODS}
    command = arm.sense().length
    for theta, _ in held:
        for start in robot.random_postures(starts, rng):
            for name in METHODS:
                command = follow(arm, command, first_command(robot, mae, start, bias), DURATIONS[0])
                for stage, duration in stages(robot, mae, name, theta):
                    command = follow(arm, command, stage(arm.sense().tension), duration)
                end = np.linalg.norm(arm.theta - theta), np.linalg.norm(arm.tension)
                ends[name].append((float(end[0]), float(end[1])))
    means = {name: tuple(np.mean(rows, axis=0).tolist()) for name, rows in ends.items()}
    bound = float(np.mean([np.linalg.norm(least) for _, least in held]))
    return {**means, 'bound': (0.0, bound)}


def table(rows: list[dict[str, tuple[float, float]]]) -> str:
    """Return the table of the individuals' means, as doc/experiments.md has it."""
    mean = {name: np.mean([row[name] for row in rows], axis=0) for name in rows[0]}
    second, lowest = mean['second'][0], min(mean['first'][1], mean['second'][1])
    lines = ['| reading | error [rad] | ‖T‖ [N] | as printed |', '|---|---|---|---|']
    for name in METHODS:
        error, tension = mean[name]
        told = ''
        if name in READINGS:
            exact = ['as exact'] * bool(error <= 1.1 * second)
            told = ', '.join([*exact, *['less tension'] * bool(tension < lowest)])
        lines.append(f'| {name} | {error:.3f} | {tension:.0f} | {told} |')
    return '\n'.join([*lines, f'| least ‖T‖ that holds θ_eval | | {mean["bound"][1]:.0f} | |'])


def main(argv: list[str]) -> None:
    """Print the table."""
    parser = Parser('paper_control', 'Readings of the paper’s `proposed`.')
    parser.add_robot()
    parser.add_seeds((0, 1, 2, 3, 4))
    parser.add_reality()
    parser.add_minutes('duration of the exploration', 10.0)
    parser.add_quick('one target and start')
    args = parser.parse_args(argv)

    rows = []
    with studied(args, 'paper') as study:
        for seed in args.seeds:
            rows.append(individual(study, seed))
            print(f'individual {seed}\n{table(rows[-1:])}\n', flush=True)
    print(f'individuals {", ".join(map(str, args.seeds))}\n{table(rows)}')
