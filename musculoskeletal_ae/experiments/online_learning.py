# SPDX-License-Identifier: Apache-2.0
"""Online learning.

Paper (§IV-A). The arm learns during ten minutes of random motion in three steps (5 s `first`, 2 s
`second`, 3 s random tension, T_bias 30 N, T_limit 200 N). The exponential fit of the error falls
from 0.324 to 0.154 rad.

Here. The initial network knows only the geometric model. With each preset, the arm explores on its
own, as with the nodes: in closed loop through estimator and controller, with the network that is
being trained. Preset `paper` moves to random postures. The default preset puts a quarter of the
joint targets at joint limits, where the joint stops reveal the offsets of the joint sensors. "Same
stream" is preset `paper` trained on the messages of the default preset’s exploration. All networks
are evaluated on the held-out motion. It follows a fixed list of commands to random postures, whose
random seed is never used for learning. The error is ‖θ_est − θ_true‖, the 2-norm over all joints,
averaged over all messages at 100 Hz, in motion and at rest. θ_true are the joint angles of the
emulated arm. The oracle is weighted least squares on one message with the true routes, elastic
constants and noise; it assumes zero friction.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from scipy.optimize import curve_fit

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.least_squares import on_calibrated_body, oracle_errors
from musculoskeletal_ae.experiments.recording import (
    EXPLORATION_STREAM,
    HELD_OUT_STREAM,
    SAMPLE_TIME,
    ClosedLoop,
    Recording,
    columns,
    estimation_error,
    make_error_function,
    record,
    times,
)
from musculoskeletal_ae.experiments.study import (
    Experiment,
    Measured,
    Plot,
    Rows,
    Study,
)
from musculoskeletal_ae.learning.collector import SENSOR
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.scheduler import STEPS
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import Network, to_mae
from musculoskeletal_ae.mae.training import OUTPUTS, pair_errors
from musculoskeletal_ae.mae.units import Mask, State, scale_vector
from musculoskeletal_ae.presets.preset import DEFAULT, PAPER_PRESET
from musculoskeletal_ae.presets.registry import PRESETS, preset_named
from musculoskeletal_ae.signals.friction import FrictionDirection

#: after each update, evaluate only every tenth message of the held-out motion, to save time
CURVE_STRIDE = 10
#: take the initial guess of b in the exponential fit from the mean error over this first part of a
#: run [s]
FIRST_ERRORS = 10.0
PUBLISHED_MINUTES = 10.0
PUBLISHED = (0.324, 0.154)  # errors that the paper fits at the start, and after ten minutes [rad]
#: numbers of steps of a shortened initial training, by preset; after fewer steps, checkpoint
#: validation rejects the network of preset `paper`
QUICK_STEPS = {PAPER_PRESET: 600, DEFAULT: 300}
NOTE_EVERY = 25  # record the training errors after every 25th mini-batch
#: test a network of the initial training on this many states of the geometric model
TEST_STATES = 1000
COLOURS = {PAPER_PRESET: plots.AS_PRINTED, 'default': plots.AFTER}

#: function that returns the θ [rad] (D,) that the learner receives, or None. Its arguments are the
#: learner, the index of the message, the true θ, and the joint-sensor readings.
JointView = Callable[[Learner, int, Array, Array], Array | None]


class Curve(NamedTuple):
    """The course of learning over one stream of N messages."""

    samples: list[int]  # number of samples, before learning and after each update
    errors: list[float]  # held-out error, before learning and after each update [rad]
    running: Array  # ‖θ_est − θ_sensor‖ of each message, with the network of that time [rad], (N,)


def teach(
    learner: Learner,
    stream: Iterable[tuple[Array, ...]],
    view: JointView = lambda _learner, _n, _true, read: read,
) -> None:
    """Teach a learner the messages of a recording one by one, as the learner node does.

    For each message, `view` returns the joint angles [rad] that the learner receives, or None. By
    default, these are the joint-sensor readings.
    """
    for n, (true, read, length, tension, _) in enumerate(stream):
        learner.step(n * SAMPLE_TIME, view(learner, n, true, read), tension, length)


def teach_and_evaluate(
    learner: Learner, stream: Iterable[tuple[Array, ...]], held_out: Recording
) -> tuple[Curve, Recording]:
    """Teach a learner messages, and evaluate it on the held-out motion after each update.

    Returns:
        The course of learning, and a recording of the messages.
    """
    samples, rows, running = list[int](), list[tuple[Array, ...]](), list[float]()
    errors, mae, direction = list[float](), None, FrictionDirection()
    error = make_error_function(held_out, CURVE_STRIDE)
    for n, row in enumerate(stream):
        if learner.mae is not mae:
            mae = learner.mae
            samples.append(len(learner.samples))
            errors.append(error(mae))
        _, sensor, length, tension, _ = row
        end = direction.end_tension(mae.transmission, tension, length)
        running.append(float(np.linalg.norm(mae.estimate(end, length).theta - sensor)))
        learner.step(n * SAMPLE_TIME, sensor, tension, length)
        rows.append(row)
    samples.append(len(learner.samples))
    errors.append(error(learner.mae))
    return Curve(samples, errors, np.array(running)), Recording(*columns(rows))


def explore(loop: ClosedLoop, learner: Learner, duration: float) -> Iterator[tuple[Array, ...]]:
    """Explore for `duration` [s] with the learner's latest network; yield each message."""
    accepted = loop.mae
    for _ in range(round(duration / SAMPLE_TIME)):
        if learner.mae is not accepted:
            loop.use(learner.mae)
            learner.note_accepted(loop.mae)
            # `note_accepted` may have replaced the learner's network by a copy with the residual
            # torque that the estimator added.
            accepted = learner.mae
        yield loop.explore()


def train_initial(study: Study, preset: str) -> None:
    """Train a preset's network on the geometric model; save it and its errors during training."""
    robot, rows = study.robot, list[list[float]]()
    test = preset_named(preset).training_states(robot, TEST_STATES, np.random.default_rng([0, 2]))

    def note(step: int, _: float, network: Network, batch: Array) -> None:
        if step % NOTE_EVERY:
            return
        mae = to_mae(network, robot.joints, robot.muscles, preset, '')
        joints, muscles = robot.joint_count, robot.muscle_count
        samples = batch.reshape(-1, batch.shape[-1]) / scale_vector(joints, muscles)
        train = State(*np.split(samples, [joints, -muscles], axis=1))
        norms = ([each.norm for each in pair_errors(mae, states)] for states in (train, test))
        rows.append([step, *np.reshape([*norms], (2, len(Mask), -1)).mean(axis=1).ravel()])

    steps = QUICK_STEPS[preset] if study.quick else None
    mae = initial_mae(robot, preset, progress=note, steps=steps)
    checkpoint.save(mae, study.network_file(preset, None))
    np.save(study.folder / f'{preset}_initial.npy', rows)


def new_learner(study: Study, seed: int, preset: str, source: str = SENSOR) -> Learner:
    """Return a learner that starts with the initial network of a preset.

    `seed` determines its random numbers, and `source` names where its joint angles come from, such
    as the joint sensors.
    """
    initial, steps = study.network(None, preset), STEPS // 5 if study.quick else STEPS
    return Learner(study.robot, initial, preset, seed, steps=steps, joint_source=source)


def new_learner_and_loop(
    study: Study, arm: Arm, seed: int, preset: str
) -> tuple[Learner, ClosedLoop]:
    """Return a learner with the initial network of a preset, and a closed loop that explores.

    `seed` is that of the individual `arm`; it also selects the exploration.
    """
    learner = new_learner(study, seed, preset)
    settings = Settings(preset=preset)
    return learner, ClosedLoop(arm, learner.mae, settings, EXPLORATION_STREAM + seed)


def measure(study: Study, seed: int) -> Measured:
    """Let an individual explore and learn with both presets; save streams and networks."""
    driven_by = study.network(None, 'default')
    held_out = record(study.arm(seed), driven_by, HELD_OUT_STREAM, study.held_out_time)
    study.save(seed, held_out=held_out)
    numbers, traces = oracle_errors(study.arm(seed), seed, held_out), {}
    for preset in PRESETS:
        initial = study.network(None, preset)
        learner, loop = new_learner_and_loop(study, study.arm(seed), seed, preset)
        exploration = explore(loop, learner, 60.0 * study.minutes)
        curve, stream = teach_and_evaluate(learner, exploration, held_out)
        checkpoint.save(learner.mae, study.network_file(preset, seed))
        if learner.trainer.body is not None:
            study.save(seed, exploring=stream, rests=_rests(learner))
            body = on_calibrated_body(study.robot, learner.trainer.body)
            numbers = {'body_rad': body.error(held_out), **numbers}
        values = _numbers(curve, learner, initial, held_out) | {'stops': float(loop.stops)}
        numbers |= study.with_prefix(preset, values)
        traces[preset] = curve, values
    learner = new_learner(study, seed, PAPER_PRESET)
    teach(learner, zip(*study.stream(seed, 'exploring'), strict=True))
    numbers[f'{PAPER_PRESET}_same_stream_after_rad'] = estimation_error(learner.mae, held_out)
    return Measured(numbers, traces)


def _rests(learner: Learner) -> State:
    if not len(learner.samples):
        return State(*np.empty((3, 0, 0)))
    stored = learner.samples.observations()
    return State(stored.theta, stored.tension, stored.length)


def _numbers(curve: Curve, learner: Learner, initial: Mae, held_out: Recording) -> dict[str, float]:
    halved = samples_to_halve(curve)
    fit = exponential_fit(times(len(curve.running)), curve.running)
    return {
        'before_rad': estimation_error(initial, held_out),
        'after_rad': estimation_error(learner.mae, held_out),
        'samples': float(curve.samples[-1]),
        'updates': float(learner.updates),
        # If the error was never halved, count all samples.
        'samples_to_halve': float(curve.samples[-1] if halved is None else halved),
        'halved': float(halved is not None),
        'fit_start_rad': float(fit[0]),
        'fit_end_rad': float(fit[-1]),
    }


def samples_to_halve(curve: Curve) -> int | None:
    """Return after how many samples the error stays below half its initial value.

    Return None if even the last error is larger.
    """
    above = [i for i, error in enumerate(curve.errors) if error > 0.5 * curve.errors[0]]
    return None if above[-1] + 1 >= len(curve.errors) else curve.samples[above[-1] + 1]


def exponential_fit(time: Array, error: Array) -> Array:
    """Fit a + b e^{−t/c} to errors [rad] at times [s] (paper, §IV-A); return the fitted values."""

    def model(t: Array, a: float, b: float, c: float) -> Array:
        values: Array = a + b * np.exp(-t / c)
        return values

    span = float(time[-1])
    first, last = error[time < FIRST_ERRORS], error[-len(error) // 5 :]
    guess = float(last.mean()), float(first.mean()), max(1.0, span / 5.0)
    bounds = [0.0, 0.0, 1.0], [10.0, 10.0, 10.0 * span]
    return model(time, *curve_fit(model, time, error, guess, bounds=bounds)[0])


def initial_training(study: Study, _: Rows) -> Plot:
    """Draw the errors of the networks of both presets during their initial training."""
    figure, panels = plots.new_figure(12.0, 6.2, 2, 3, sharex='row')
    for p, (preset, colour) in enumerate(COLOURS.items()):
        step, *errors = np.load(study.folder / f'{preset}_initial.npy').T
        for n, (name, unit, *_factor) in enumerate(OUTPUTS):
            panel = panels[3 * p + n]
            for label, values, width in (('train', errors[n], 0.7), ('test', errors[3 + n], 1.8)):
                plots.line(panel, step, values, color=colour, lw=width, label=label)
            panel.set_yscale('log')
            title = f'preset {preset}: {name}'
            plots.tidy(panel, 'mini-batches' if p else '', f'mean norm [{unit}]', title)
        panels[3 * p].legend(fontsize=9)
    return figure, (
        'Errors ‖θ − θ_calc‖, ‖T − T_calc‖ and ‖l − l_calc‖ during initial training, means over '
        'the three masks. Thin: the mini-batch. Bold: states of the geometric model that are not '
        'used for training.'
    )


def online_learning(study: Study, rows: Rows) -> Plot:
    """Draw how the errors of all individuals fall while they learn.

    The left panel shows the errors over the time of exploration, with an exponential fit. The right
    panel shows the error on the held-out motion over the number of rest samples.
    """
    figure, (left, right) = plots.new_figure(12.0, 5.2, 1, 2, width_ratios=(3, 2))
    every = round(1.0 / SAMPLE_TIME)
    for preset, colour in COLOURS.items():
        curves, values = zip(*(row.traces[preset] for row in rows.values()), strict=True)
        whole = len(curves[0].running) // every * every
        running = np.array([c.running[:whole].reshape(-1, every).mean(axis=1) for c in curves])
        seconds = np.arange(0.5, running.shape[1])
        mean: Array = running.mean(axis=0)
        for each in running if len(running) > 1 else ():
            plots.line(left, seconds / 60, each, 10, color=colour, lw=0.5, alpha=0.25)
        label = f'preset {preset}'
        plots.line(left, seconds / 60, mean, 10, color=colour, lw=1.2, label=label)
        start, end = (
            np.mean([each[f'fit_{at}_rad'] for each in values]) for at in ('start', 'end')
        )
        fit = f'exponential fit: {start:.3f} → {end:.3f} rad'
        fitted = exponential_fit(seconds, mean)
        left.plot(seconds / 60, fitted, color=colour, lw=2.5, ls='--', label=fit)
        for curve in curves:
            right.plot(curve.samples, curve.errors, color=colour, lw=1.2, alpha=0.7, label=label)
            label = ''
    if study.minutes >= PUBLISHED_MINUTES:
        label = f'paper, on Musashi, 10 min: {PUBLISHED[0]} → {PUBLISHED[1]} rad'
        at = 0.0, PUBLISHED_MINUTES
        left.plot(at, PUBLISHED, 'o', color=plots.MARK, clip_on=False, label=label)
    oracle = float(np.mean([row.numbers['oracle_rad'] for row in rows.values()]))
    right.axhline(oracle, color=plots.MARK, ls=':', label=f'oracle {oracle:.3f} rad')
    xlabel, ylabel = 'exploration time [min]', '‖θ_est − θ_sensor‖ [rad]'
    plots.tidy(left, xlabel, ylabel, 'while exploring', legend='below')
    title = 'held-out motion, each individual'
    plots.tidy(right, 'rest samples', 'mean error [rad]', title, legend='below')
    for panel in (left, right):
        panel.set_ylim(bottom=0.0)
    return figure, (
        'Left: estimation error during online learning (10 s running means; bold: mean over '
        f'individuals {", ".join(map(str, rows))}, pale: each individual). Dashed: an '
        'exponential fit to the mean, as in the paper (§IV-A). Right: error on the held-out motion '
        'after every update.'
    )


EXPERIMENT = Experiment(__doc__, measure, (online_learning, initial_training), 16.0)
