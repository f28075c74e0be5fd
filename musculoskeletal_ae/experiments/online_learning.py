# SPDX-License-Identifier: Apache-2.0
"""Online learning.

The initial network knows the geometric model only. One stream of sensor messages of each
individual, commanded by the initial default network, feeds both presets. The held-out motion
follows one fixed list of commands from a random stream that is never used for learning; its error
is the mean over all messages at 100 Hz, moving and resting, of ‖θ_est − θ_true‖ over all joints,
with the true angles of the emulator. Oracle: weighted least squares on one message with the true
routes, elastic constants and noise, friction taken as zero.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import curve_fit

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.least_squares import learned, oracle_errors
from musculoskeletal_ae.experiments.recording import (
    EXPLORATION_STREAM,
    HELD_OUT_STREAM,
    SAMPLE_TIME,
    Recording,
    estimation_error,
    record,
    times,
)
from musculoskeletal_ae.experiments.study import (
    Experiment,
    Individuals,
    Measured,
    Progress,
    Rests,
    Study,
)
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.presets import PRESETS

CURVE_STRIDE = 10  # of held-out messages, after every update
FIRST_ERRORS = 10.0  # [s] whose mean starts the exponential fit
PRINTED_MINUTES = 10.0
PRINTED = (0.324, 0.154)  # [rad] the paper's fit at the start and after ten minutes
COLOURS = {'paper': plots.PAPER, 'default': plots.AFTER}

#: what is seen of θ [rad] (D,) at the n-th message, with the network of the moment; None if nothing
See = Callable[[int, Mae], Array | None]


class Curve(NamedTuple):
    """Learning over one stream.

    Attributes:
        samples: Number of samples before learning and after each update.
        errors: Held-out error then [rad].
        running: Error of each message, by the network of the moment, beside the sensor [rad].
    """

    samples: list[int]
    errors: list[float]
    running: Array


def follow(
    learner: Learner, stream: Recording, held_out: Recording, see: See | None = None
) -> Curve:
    """Feed a recorded stream to a learner, as the node would.

    Args:
        learner: Goes on from what it knows.
        stream: What to learn from.
        held_out: What to judge by.
        see: Where θ comes from; the joint sensors by default.
    """
    mae, start = learner.mae, 0
    samples = [len(learner.samples)]
    errors = [estimation_error(mae, held_out, CURVE_STRIDE)]
    running = np.empty(len(stream.theta))
    for n in range(len(stream.theta)):
        theta = stream.theta_sensor[n] if see is None else see(n, mae)
        learner.step(n * SAMPLE_TIME, theta, stream.tension[n], stream.length[n])
        if learner.mae is not mae or n == len(running) - 1:
            part = slice(start, n + 1)
            estimate = mae.estimate(stream.tension[part], stream.length[part]).theta
            running[part] = np.linalg.norm(estimate - stream.theta_sensor[part], axis=1)
            start, mae = n + 1, learner.mae
            samples.append(len(learner.samples))
            errors.append(estimation_error(mae, held_out, CURVE_STRIDE))
    return Curve(samples, errors, running)


def train_initial(study: Study, preset: str) -> None:
    """Train a network on the geometric model and keep it."""
    trained = initial_mae(study.body(), preset, steps=study.initial_steps)
    checkpoint.save(trained.mae, study.network_file(preset, None))


def measure(study: Study, seed: int, progress: Progress) -> Measured:
    """Record an individual, learn of it with both presets, and keep all."""
    robot = study.body()
    initial = {preset: study.initial(robot, preset) for preset in PRESETS}
    driven_by, stream = initial['default'], EXPLORATION_STREAM + seed
    exploring = record(EmulatedArm(robot, seed), driven_by, stream, 60.0 * study.minutes)
    held_out = record(EmulatedArm(robot, seed), driven_by, HELD_OUT_STREAM, study.held_out_time)
    study.keep_stream(seed, 'exploring', exploring)
    study.keep_stream(seed, 'held_out', held_out)
    progress(0.2)
    limits, numbers = oracle_errors(robot, seed, held_out), {}
    traces: dict[str, Any] = {}
    for preset, share in (('default', 0.5), ('paper', 0.2)):
        learner = Learner(robot, initial[preset], preset, seed, steps=study.update_steps)
        curve = follow(learner, exploring, held_out)
        checkpoint.save(learner.mae, study.network_file(preset, seed))
        if learner.training.body is not None:
            study.keep_rests(seed, _rests(learner))
            body = learned(robot, learner.training.body)
            limits = {'body_rad': body.error(held_out), **limits}
        values = _numbers(curve, learner, initial[preset], held_out)
        for prefix, named in (('', study.preset), ('paper_', 'paper')):
            if preset == named:
                numbers.update({prefix + key: value for key, value in values.items()})
        traces[preset] = {
            'running': _by_second(curve.running),
            'curve_samples': np.array(curve.samples),
            'curve_errors': np.array(curve.errors),
            'fit_start_rad': values['fit_start_rad'],
            'fit_end_rad': values['fit_end_rad'],
        }
        progress(share)
    return Measured({**limits, **numbers}, traces)


def _rests(learner: Learner) -> Rests:
    store = learner.samples
    if not len(store):
        return Rests(*np.empty((3, 0, 0)))
    seen = store.observations()
    return Rests(seen.theta, seen.tension, seen.length)


def _numbers(curve: Curve, learner: Learner, initial: Mae, held_out: Recording) -> dict[str, float]:
    halved = samples_to_halve(curve)
    fit = exponential_fit(times(len(curve.running)), curve.running)
    return {
        'before_rad': estimation_error(initial, held_out),
        'after_rad': estimation_error(learner.mae, held_out),
        'samples': float(curve.samples[-1]),
        'updates': float(learner.updates),
        # A stream that never halved the error counts with all its samples.
        'samples_to_halve': float(curve.samples[-1] if halved is None else halved),
        'halved': float(halved is not None),
        'fit_start_rad': float(fit[0]),
        'fit_end_rad': float(fit[-1]),
    }


def samples_to_halve(curve: Curve) -> int | None:
    """Return how many samples it took to halve the error for good; None if it never did."""
    above = [i for i, error in enumerate(curve.errors) if error > 0.5 * curve.errors[0]]
    return None if above[-1] + 1 >= len(curve.errors) else curve.samples[above[-1] + 1]


def exponential_fit(time: Array, error: Array) -> Array:
    """Return a + b e^{−t/c} at the times [s] of errors, fitted to them as in the paper [rad]."""

    def model(t: Array, a: float, b: float, c: float) -> Array:
        values: Array = a + b * np.exp(-t / c)
        return values

    span = float(time[-1])
    first, last = error[time < FIRST_ERRORS], error[-len(error) // 5 :]
    guess = float(last.mean()), float(first.mean()), span / 5.0
    bounds = [0.0, 0.0, 1.0], [10.0, 10.0, 10.0 * span]
    return model(time, *curve_fit(model, time, error, guess, bounds=bounds)[0])


def _by_second(values: Array) -> Array:
    every = round(1.0 / SAMPLE_TIME)
    whole = len(values) // every * every
    means: Array = values[:whole].reshape(-1, every).mean(axis=1)
    return means


def plot(individuals: Individuals) -> list[plots.Plot]:
    """Draw the running error with its exponential fit, and the held-out error over samples."""
    rows = list(individuals.rows.values())
    figure, axes = plots.new_figure(12.0, 4.6, 1, 2, width_ratios=(3, 2))
    left, right = axes[0]
    for preset, colour in COLOURS.items():
        traces = [row.traces[preset] for row in rows]
        running = np.array([trace['running'] for trace in traces])
        seconds = np.linspace(0.5, running.shape[1] - 0.5, running.shape[1])
        mean: Array = running.mean(axis=0)
        for each in running if len(running) > 1 else ():
            plots.line(left, seconds / 60, each, 10, color=colour, lw=0.5, alpha=0.25)
        label = f'preset {preset}'
        plots.line(left, seconds / 60, mean, 10, color=colour, lw=1.2, label=label)
        start, end = (np.mean([t[f'fit_{at}_rad'] for t in traces]) for at in ('start', 'end'))
        fit = f'exponential fit: {start:.3f} → {end:.3f} rad'
        fitted = exponential_fit(seconds, mean)
        left.plot(seconds / 60, fitted, color=colour, lw=2.5, ls='--', label=fit)
        for trace in traces:
            points = trace['curve_samples'], trace['curve_errors']
            right.plot(*points, color=colour, lw=1.2, alpha=0.7, label=label)
            label = ''
    ends = f'paper, on Musashi, 10 min: {PRINTED[0]} → {PRINTED[1]} rad'
    long_enough = individuals.study.minutes >= PRINTED_MINUTES
    at = [0.0, PRINTED_MINUTES] if long_enough else [np.nan, np.nan]
    left.plot(at, PRINTED, 'o', color=plots.MARK, clip_on=False, label=ends)
    oracle = float(np.mean([numbers['oracle_rad'] for numbers in individuals.numbers]))
    right.axhline(oracle, color=plots.MARK, ls=':', label=f'oracle {oracle:.3f} rad')
    plots.tidy(left, 'time of exploration [min]', '‖θ_est − θ_sensor‖ [rad]', 'while exploring')
    plots.tidy(right, 'samples at rest', 'mean error [rad]', 'held-out motion, each individual')
    for panel in (left, right):
        panel.set_ylim(bottom=0.0)
        panel.legend(fontsize=9)
    seeds = ', '.join(map(str, individuals.rows))
    caption = (
        'Left: error of the estimate during online learning (10 s running means; bold: mean over '
        f'individuals {seeds}, pale: each), with the exponential fit of the paper. Right: error on '
        'the motion never used for learning, after every update.'
    )
    return [plots.Plot('online_learning', figure, caption)]


EXPERIMENT = Experiment(
    description=__doc__,
    paper=(
        'Ten minutes of random motion in three steps (5 s first, 2 s second, 3 s random tension, '
        'T_bias 30 N, T_limit 200 N) while learning; the exponential fit of the error went from '
        '0.324 to 0.154 rad.'
    ),
    weight=12.0,
    measure=measure,
    plot=plot,
)
