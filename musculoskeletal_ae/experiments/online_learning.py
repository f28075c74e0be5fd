# SPDX-License-Identifier: Apache-2.0
"""How well and how fast the body is learned online: the protocol of DESIGN.md.

python -m musculoskeletal_ae.experiments.online_learning --help

One recorded stream of ten minutes of exploration feeds both presets; the held-out motion of five
minutes follows one fixed list of commands computed from the initial default network. Errors are
means over all samples at 100 Hz of ‖θ_est − θ_true‖₂.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.experiments.least_squares import mean_error, oracle
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, Recording, motion, record
from musculoskeletal_ae.learning.online import STEPS, OnlineLearner
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.robot.robot import Robot

#: seeds of the random streams: exploring, and the motion never used for learning
EXPLORATION_STREAM, HELD_OUT_STREAM = 100, 9000
HELD_OUT_TIME = 300.0  # [s]
#: every so many held-out messages are estimated by least squares, which is slow
ORACLE_STRIDE = 10


class Streams(NamedTuple):
    """What one individual's sensors said, exploring and in the held-out motion."""

    exploring: Recording
    held_out: Recording


#: what is seen of θ [rad] (D,) at the n-th message, with the network of the moment; None if nothing
See = Callable[[int, Mae], Array | None]


class Curve(NamedTuple):
    """Learning over one stream.

    Attributes:
        learner: At the end.
        samples: Number of samples after each update.
        errors: Held-out error after each update [rad].
        running: Error of each message, by the network of the moment, beside the sensor [rad].
    """

    learner: OnlineLearner
    samples: list[int]
    errors: list[float]
    running: Array


def streams(robot: Robot, initial: Mae, seed: int, minutes: float) -> Streams:
    """Record one individual."""
    exploring = record(
        EmulatedArm(robot, seed), motion(robot, initial, EXPLORATION_STREAM + seed, 60.0 * minutes)
    )
    held_out = record(
        EmulatedArm(robot, seed), motion(robot, initial, HELD_OUT_STREAM, HELD_OUT_TIME)
    )
    return Streams(exploring, held_out)


def held_out_error(mae: Mae, recording: Recording, stride: int = 1) -> float:
    """Return the mean of ‖θ_est − θ_true‖₂ [rad]."""
    part = slice(None, None, stride)
    estimate = mae.estimate(recording.tension[part], recording.length[part]).theta
    return mean_error(estimate, recording.theta[part])


def oracle_error(robot: Robot, seed: int, recording: Recording) -> float:
    """Return the error of least squares on the true body [rad]."""
    part = slice(None, None, ORACLE_STRIDE)
    estimate = oracle(robot, Individual(robot, seed)).estimate(
        recording.tension[part], recording.length[part]
    )
    return mean_error(estimate, recording.theta[part])


def learn(
    robot: Robot, mae: Mae, preset: str, recorded: Streams, seed: int = 0, steps: int = STEPS
) -> Curve:
    """Feed a recorded stream to a new learner, as the node would."""
    return follow(OnlineLearner(robot, mae, preset, seed, steps), recorded)


def follow(learner: OnlineLearner, recorded: Streams, see: See | None = None) -> Curve:
    """Feed a recorded stream to a learner.

    Args:
        learner: Goes on from what it knows.
        recorded: What to learn from, and what to judge by.
        see: Where θ comes from; the joint sensors by default.
    """
    mae = learner.mae
    samples = [len(learner.collector.store)]
    errors = [held_out_error(mae, recorded.held_out, 10)]
    stream = recorded.exploring
    running = np.empty(len(stream.theta))
    start = 0
    for n in range(len(stream.theta)):
        theta = stream.theta_sensor[n] if see is None else see(n, learner.mae)
        update = learner.step(stream.tension[n], stream.length[n], SAMPLE_TIME, theta)
        if update is not None or n == len(running) - 1:
            part = slice(start, n + 1)
            before = learner.mae if update is None else mae
            estimate = before.estimate(stream.tension[part], stream.length[part]).theta
            running[part] = np.linalg.norm(estimate - stream.theta_sensor[part], axis=1)
            start, mae = n + 1, learner.mae
            samples.append(len(learner.collector.store))
            errors.append(held_out_error(mae, recorded.held_out, 10))
    return Curve(learner, samples, errors, running)


def samples_to_halve(curve: Curve) -> float:
    """Return how many samples it took to halve the error for good; infinite if it never did."""
    half = 0.5 * curve.errors[0]
    above = [i for i, error in enumerate(curve.errors) if error > half]
    if above[-1] + 1 >= len(curve.errors):
        return math.inf
    return float(curve.samples[above[-1] + 1])


def exponential_fit(time: Array, error: Array) -> tuple[float, float]:
    """Return start and end of a + b e^{−t/c}, fitted as in the paper [rad]."""
    from scipy.optimize import curve_fit

    def model(t: Array, a: float, b: float, c: float) -> Array:
        values: Array = a + b * np.exp(-t / c)
        return values

    span = float(time[-1])
    guess = (float(error[-len(error) // 5 :].mean()), float(error[:1000].mean()), span / 5.0)
    found, _ = curve_fit(
        model, time, error, guess, bounds=([0.0, 0.0, 1.0], [10.0, 10.0, 10.0 * span])
    )
    ends = model(np.array([0.0, span]), *found)
    return float(ends[0]), float(ends[1])


def individual(
    robot: Robot, initial: dict[str, Mae], seed: int, minutes: float, steps: int = STEPS
) -> dict[str, float]:
    """Return what one individual says, by the names of INTERFACE.md."""
    recorded = streams(robot, initial['default'], seed, minutes)
    result: dict[str, float] = {'seed': seed}
    for preset, prefix in (('default', ''), ('paper', 'paper_')):
        begun = time.perf_counter()
        curve = learn(robot, initial[preset], preset, recorded, seed, steps)
        elapsed = time.perf_counter() - begun
        result[f'{prefix}before_rad'] = held_out_error(initial[preset], recorded.held_out)
        result[f'{prefix}after_rad'] = held_out_error(curve.learner.mae, recorded.held_out)
        result[f'{prefix}samples_to_halve'] = samples_to_halve(curve)
        if preset == 'default':
            times = SAMPLE_TIME * np.arange(len(curve.running), dtype=float)
            result['fit_start_rad'], result['fit_end_rad'] = exponential_fit(times, curve.running)
            result['samples'] = curve.samples[-1]
            result['updates'] = curve.learner.updates
            result['seconds'] = elapsed
    result['oracle_rad'] = oracle_error(robot, seed, recorded.held_out)
    return result


def main(argv: list[str] | None = None) -> None:
    """Print one line per individual and the means."""
    parser = argparse.ArgumentParser(description=__doc__, prog='online_learning')
    parser.add_argument('--robot', default='musashi_left_arm')
    parser.add_argument('--seeds', default='0,1,2,3,4')
    parser.add_argument('--minutes', type=float, default=10.0)
    parser.add_argument('--steps', type=int, default=STEPS, help='of training per update')
    parser.add_argument('--initial', type=Path, help='default checkpoint, instead of training one')
    parser.add_argument('--initial-paper', type=Path, help='the same of preset paper')
    parser.add_argument('--out', type=Path, help='result.json')
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    robot = Robot.load(args.robot)
    given = {'default': args.initial, 'paper': args.initial_paper}
    initial = {
        preset: checkpoint.load(file, robot) if file else initial_mae(robot, preset).mae
        for preset, file in given.items()
    }
    rows = []
    for seed in map(int, args.seeds.split(',')):
        rows.append(individual(robot, initial, seed, args.minutes, args.steps))
        print('  '.join(f'{key} {value:.4g}' for key, value in rows[-1].items()), flush=True)
    mean = {key: float(np.mean([row[key] for row in rows])) for key in rows[0] if key != 'seed'}
    print('mean  ' + '  '.join(f'{key} {value:.4g}' for key, value in mean.items()))
    if args.out:
        args.out.write_text(json.dumps({**mean, 'seeds': rows}, indent=2), encoding='utf-8')


if __name__ == '__main__':
    main()
