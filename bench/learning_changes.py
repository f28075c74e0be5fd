# SPDX-License-Identifier: Apache-2.0
"""Learning under other conditions: a camera instead of joint sensors, and a body that changes.

python -m bench learning_changes [--robot …] [--seeds 0,1] [--quick]

- camera: what `joint_source: marker` learns of the same motion as `sensor`; a marker on the hand at
  33 Hz, with a camera's noise, and inverse kinematics started from the estimate.
- slow: what a learner learns that takes slow motion for rest, too, by its parameters (`SLOW`).
- offset: one length sensor shifts by 10 mm after ten minutes of learning.
- replaced: one muscle's elastic unit, wire, cable and sensors become another individual's.

The held-out error [rad] of the changed arm is printed as learning goes on, and what it would be for
a learner that starts over; `told` is a learner whose `relearn_muscles` names the muscle.
"""

import copy
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.emulator.modules import seen_by_camera
from musculoskeletal_ae.experiments.online_learning import See, teach
from musculoskeletal_ae.experiments.recording import (
    EXPLORATION_STREAM,
    HELD_OUT_STREAM,
    Recording,
    estimation_error,
    record,
)
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.settings import Settings
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.inverse_kinematics import inverse_kinematics
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.series_elastic import SeriesElastic

SLOW = Settings(rest_time=0.2, rest_joint_rate=0.5, rest_length_rate=0.05)
EVERY = 3  # messages between two pictures of the camera: 33 Hz
OFFSET = 0.010  # [m]
#: of motion after the change, after which the error is read [minutes]
READ_AT = (1.0, 2.0, 5.0)
HELD_OUT_TIME = 300.0  # [s]
AFTER_STREAM = 500  # of random postures after the change


def camera(robot: Robot, stream: Recording, seed: int) -> See:
    """Return what the estimator makes of a marker on the hand."""
    rng = np.random.default_rng([seed, 0xCA])

    def see(learner: Learner, n: int, true: Array, _read: Array) -> Array | None:
        if n % EVERY:
            return None
        pose = seen_by_camera(robot.kinematics.end_effector_pose(true), rng)
        estimate = learner.mae.estimate(stream.tension[n], stream.length[n]).theta
        return inverse_kinematics(robot, pose, estimate).seen

    return see


def replaced(robot: Robot, individual: Individual, muscle: int, donor: Individual) -> Individual:
    """Return the individual with one muscle's constants taken from a donor; its route stays."""
    changed = copy.copy(individual)

    def swap(own: Array, other: Array) -> Array:
        values: Array = np.array(np.broadcast_to(own, robot.muscle_count))
        values[muscle] = np.broadcast_to(other, robot.muscle_count)[muscle]
        return values

    old, new = individual.elastic, donor.elastic
    changed.elastic = SeriesElastic(
        swap(old.force, new.force),
        swap(old.rate, new.rate),
        swap(old.wire_stretch, new.wire_stretch),
    )
    for name in ('cable_friction', 'length_bias', 'tension_bias', 'tension_gain'):
        setattr(changed, name, swap(getattr(individual, name), getattr(donor, name)))
    return changed


class Streams(NamedTuple):
    """What one arm's sensors said, exploring and in the held-out motion."""

    exploring: Recording
    held_out: Recording


def streams(arm: EmulatedArm, mae: Mae, stream: int, minutes: float, held_out: float) -> Streams:
    """Record an arm in random motion, and in the held-out one."""
    exploring = record(arm, mae, stream, 60.0 * minutes)
    return Streams(exploring, record(arm, mae, HELD_OUT_STREAM, held_out))


def going_on(learner: Learner, after: Streams, read_at: tuple[float, ...]) -> list[float]:
    """Return the held-out error at once, and after so many minutes of learning on."""
    errors, begun = [estimation_error(learner.mae, after.held_out)], 0
    for minutes in read_at:
        end = round(6000.0 * minutes)
        part = after.exploring.part(slice(begun, end))
        teach(learner, zip(*part, strict=True))
        errors.append(estimation_error(learner.mae, after.held_out))
        begun = end
    return errors


def row(title: str, errors: list[float]) -> str:
    """Return one line of the table."""
    return f'  {title:28s}' + ''.join(f'{error:9.4f}' for error in errors)


def report(robot: Robot, mae: Mae, seed: int, muscle: int, quick: bool) -> str:
    """Return the tables of one individual."""
    minutes, held_out = (1.0, 30.0) if quick else (10.0, HELD_OUT_TIME)
    read_at = (1.0,) if quick else READ_AT
    individual = Individual(robot, seed)
    before = streams(
        EmulatedArm(robot, seed, individual), mae, EXPLORATION_STREAM + seed, minutes, held_out
    )

    def taught(learner: Learner, *see: See) -> float:
        teach(learner, zip(*before.exploring, strict=True), *see)
        return estimation_error(learner.mae, before.held_out)

    learner = Learner(robot, mae, seed=seed)
    by_sensor = taught(learner)
    by_camera = taught(Learner(robot, mae, seed=seed), camera(robot, before.exploring, seed))
    slow = Learner(robot, mae, seed=seed, settings=SLOW)
    in_motion = taught(slow)
    initial = estimation_error(mae, before.held_out)
    head = f'individual {seed}, {minutes:g} min: error before {initial:.4f} rad, after: '
    ratio = by_camera / by_sensor
    lines = [f'{head}sensor {by_sensor:.4f}, marker {by_camera:.4f} rad, × {ratio:.2f}']
    counts = f'{len(slow.samples)} samples, {len(learner.samples)} of rests only'
    lines.append(f'  slow motion, too: {in_motion:.4f} rad from {counts}')
    shifted = EmulatedArm(robot, seed, individual)
    shifted.set_length_offset(OFFSET * np.eye(robot.muscle_count)[muscle])
    other = replaced(robot, individual, muscle, Individual(robot, seed + 1000))
    for title, arm in (
        (f'{robot.muscles[muscle]}: offset of {1e3 * OFFSET:g} mm', shifted),
        (f'{robot.muscles[muscle]}: replaced', EmulatedArm(robot, seed, other)),
    ):
        after = streams(arm, mae, AFTER_STREAM + seed, read_at[-1], held_out)
        head = ''.join(f'{f"{at:g} min":>9s}' for at in (0.0, *read_at))
        lines.append(f'  {title:28s}{head}')
        lines.append(row('untold', going_on(copy.deepcopy(learner), after, read_at)))
        told = copy.deepcopy(learner)
        told.relearn([muscle])
        lines.append(row('told by relearn_muscles', going_on(told, after, read_at)))
        anew = Learner(robot, mae, seed=seed)
        lines.append(row('starting over', going_on(anew, after, read_at)))
    return '\n'.join(lines)


def main(argv: list[str]) -> None:
    """Print the tables."""
    parser = Parser('learning_changes', 'Learning by a camera, and of a body that changes.')
    parser.add_robot()
    parser.add_seeds((0,))
    parser.add_argument('--muscle', help='name of the one that changes; the second by default')
    parser.add_argument('--initial', type=Path, help='checkpoint, instead of training one')
    parser.add_quick('a minute instead of ten')
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    robot = Robot.load(args.robot)
    mae = checkpoint.load(args.initial, robot) if args.initial else initial_mae(robot).mae
    (muscle,) = robot.muscle_indices([args.muscle or robot.muscles[1]])
    for seed in args.seeds:
        print(report(robot, mae, seed, muscle, args.quick), flush=True)
