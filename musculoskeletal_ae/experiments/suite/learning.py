# SPDX-License-Identifier: Apache-2.0
"""What comes before every experiment: initial networks, one sensor stream, what is learnt of it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.experiments import online_learning as protocol
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, motion, record
from musculoskeletal_ae.experiments.suite.limits import body_error, oracle_errors
from musculoskeletal_ae.experiments.suite.study import Measured, Progress, Study
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.presets import PRESETS
from musculoskeletal_ae.robot.robot import Robot

EXPLORING, HELD_OUT = 'exploring', 'held_out'


def train_initial(study: Study, preset: str) -> None:
    """Train a network on the geometric model and keep it."""
    trained = initial_mae(study.body(), preset, steps=study.initial_steps)
    checkpoint.save(trained.mae, study.network_file(preset, None))


def learn_individual(study: Study, seed: int, progress: Progress) -> Measured:
    """Record an individual, learn of it with both presets, keep all; `online_learning`'s numbers.

    Both presets learn from the same stream, which the initial default network's commands make.
    """
    robot = study.body()
    initial = {preset: study.initial(robot, preset) for preset in PRESETS}
    streams = _streams(study, robot, initial['default'], seed)
    progress(0.2)
    numbers: dict[str, Any] = {}
    traces: dict[str, Any] = {}
    for preset, share in (('default', 0.5), ('paper', 0.2)):
        curve = protocol.learn(robot, initial[preset], preset, streams, seed, study.update_steps)
        learner = curve.learner
        checkpoint.save(learner.mae, study.network_file(preset, seed))
        found = _numbers(initial[preset], curve, streams)
        if preset == 'default':
            _keep_samples(study, seed, curve)
            numbers['body_rad'] = body_error(robot, learner, streams.held_out)
        numbers[preset] = found
        traces[preset] = {
            'running': _by_second(curve.running),
            'curve_samples': np.array(curve.samples),
            'curve_errors': np.array(curve.errors),
            'fit_start_rad': found['fit_start_rad'],
            'fit_end_rad': found['fit_end_rad'],
        }
        progress(share)
    numbers.update(oracle_errors(robot, seed, streams.held_out))
    return Measured(_named(numbers, study.preset), traces)


def _streams(study: Study, robot: Robot, mae: Mae, seed: int) -> protocol.Streams:
    """Record as `protocol.streams` does, for as long as the study wants, and keep it."""
    plans = (
        (EXPLORING, protocol.EXPLORATION_STREAM + seed, 60.0 * study.minutes),
        (HELD_OUT, protocol.HELD_OUT_STREAM, study.held_out_time),
    )
    recordings = []
    for name, stream, duration in plans:
        recording = record(EmulatedArm(robot, seed), motion(robot, mae, stream, duration))
        study.save_stream(seed, name, recording)
        recordings.append(recording)
    return protocol.Streams(*recordings)


def _keep_samples(study: Study, seed: int, curve: protocol.Curve) -> None:
    store = curve.learner.collector.store
    if len(store):
        seen = store.observations()
        samples = {'theta': seen.theta, 'tension': seen.tension, 'length': seen.length}
    else:
        samples = {name: np.empty((0, 0)) for name in ('theta', 'tension', 'length')}
    np.savez(study.folder / f'samples_{seed}.npz', **samples)  # type: ignore[arg-type]


def rest_samples(study: Study, seed: int) -> tuple[Array, Array, Array]:
    """Return (θ, T, l) of the samples at rest that the learner stored."""
    with np.load(study.folder / f'samples_{seed}.npz') as arrays:
        return arrays['theta'], arrays['tension'], arrays['length']


def _numbers(initial: Mae, curve: protocol.Curve, streams: protocol.Streams) -> dict[str, float]:
    halved = protocol.samples_to_halve(curve)
    times = np.asarray(SAMPLE_TIME * np.arange(len(curve.running)), dtype=np.float64)
    start, end = protocol.exponential_fit(times, curve.running)
    return {
        'before_rad': protocol.held_out_error(initial, streams.held_out),
        'after_rad': protocol.held_out_error(curve.learner.mae, streams.held_out),
        'samples': float(curve.samples[-1]),
        'updates': float(curve.learner.updates),
        # JSON has no infinity: a stream that never halved the error counts with all its samples.
        'samples_to_halve': halved if math.isfinite(halved) else float(curve.samples[-1]),
        'halved': float(math.isfinite(halved)),
        'fit_start_rad': start,
        'fit_end_rad': end,
    }


def _named(found: dict[str, Any], preset: str) -> dict[str, Any]:
    """Return the numbers by the names of INTERFACE.md: of the chosen preset, and of `paper`."""
    chosen, paper = found[preset], found['paper']
    rest = {key: value for key, value in found.items() if key not in PRESETS}
    return {**rest, **chosen, **{f'paper_{key}': value for key, value in paper.items()}}


def _by_second(values: Array) -> Array:
    every = round(1.0 / SAMPLE_TIME)
    whole = len(values) // every * every
    means: Array = values[:whole].reshape(-1, every).mean(axis=1)
    return means
