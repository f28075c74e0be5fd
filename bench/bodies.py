# SPDX-License-Identifier: Apache-2.0
"""Errors of the learned estimate on emulated bodies, beside those of regressions.

    python -m bench bodies kin_0 foreign_1 kin_0+coupled:25:0 --cache DIR

A case is INDIVIDUAL[+OPTION][:COUNT[:DRAW]]. COUNT is the number of training samples, by default as
many as the learner keeps, and DRAW the seed with which they are drawn.

    kin_SEED, foreign_SEED  rest samples of an emulated arm that explored for 5 minutes, tested on
                            another minute. With `+coupled`, a smooth function of all joints with a
                            standard deviation of 6 mm is added to each length. With `+blind`, the
                            learner has no joint sensors

The line of a case has the mean error ‖θ_est − θ‖ [rad] after the updates, the share of test errors
in the 95 % ellipsoid, the error of the lengths of network and body [mm], the size of the remainder
[mm] and its constants, the processor time of an update [s], and the errors of the regressions. With
--body, only the body is fitted, and θ is estimated by least squares on it, with the covariance that
the fit expects. This takes a quarter of the time. notes/real_bodies.md contains the figures;
`bench recordings` measures recorded robots.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from bench.learned_arm import Never, initial
from bench.regression import BASELINES
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.body_model.body_fit import BodyFit
from musculoskeletal_ae.body_model.covariance import ellipsoids
from musculoskeletal_ae.body_model.observations import Observations
from musculoskeletal_ae.body_model.remainder import UNITS, GroupRemainder, Remainder
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments.online_learning import teach
from musculoskeletal_ae.experiments.recording import EXPLORATION_STREAM, HELD_OUT_STREAM, record
from musculoskeletal_ae.gauss_newton import minimise_each
from musculoskeletal_ae.learning.body_updater import BodyUpdater
from musculoskeletal_ae.learning.convergence import STEPS, until_converged
from musculoskeletal_ae.learning.detector_calibration import Healthy
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.samples import CAPACITY
from musculoskeletal_ae.learning.scheduler import Job, Update
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import Parser, whole
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.friction import directions

ROBOT = 'musashi_left_arm'  # use this robot in the emulated cases
#: let an emulated arm explore for EXPLORED, and test on a held-out motion of HELD_OUT [s]
EXPLORED, HELD_OUT = 300.0, 60.0
THINNED = 10  # use only every tenth message of the held-out motion for the test
#: let `+coupled` add a coupling of the joints with this standard deviation to each length [m]
COUPLING = 0.006
MOST_FITTED = 150  # fit at most this many test rows by least squares, because each fit is slow
#: constants of least squares: step of finite differences [rad], typical step as a share of the
#: joint ranges, and number of iterations after which it ends
DIFFERENCE, USUAL_STEP, ROUNDS = 1e-4, 0.1, 15


class Case(NamedTuple):
    """A robot with samples to learn from and to test with."""

    robot: Robot
    initial: Mae
    training: Observations
    test: Observations
    healthy: Healthy


def _observed(theta: Array, tension: Array, length: Array) -> Observations:
    known = np.ones(length.shape, dtype=bool)
    return Observations(theta, tension, length, np.zeros_like(length), known)


def _nothing(robot: Robot) -> Healthy:
    return Healthy(np.empty((0, 3 * robot.muscle_count), dtype=np.float32), 0.0, 0)


def emulated(name: str, count: int, draw: int, cache: Path) -> Case:
    """Return the case of an emulated arm; its samples are cached in `cache`.

    `name` is that of the case. `draw` is the random seed with which `count` of the training samples
    are drawn.
    """
    individual, *options = name.split('+')
    reality, _, seed = individual.partition('_')
    robot = Robot.load(ROBOT)
    driver, file = initial(robot, cache), cache / f'samples_{individual}.npz'
    if not file.exists():
        arrays: dict[str, Any] = dict(_explored(robot, driver, reality, int(seed)))
        np.savez(file, **arrays)
    with np.load(file) as stored:
        training, test, learned, judging = (
            Observations(*(stored[f'{part}_{n}'] for n in range(8)))
            for part in ('training', 'test', 'learned', 'judging')
        )
    healthy = _nothing(robot)._replace(learned=learned, judging=judging)
    if count < len(training):
        order = np.random.default_rng([draw, count]).permutation(len(training))
        training, healthy = training[np.sort(order[:count])], _nothing(robot)
    if 'coupled' in options:
        training, test, learned, judging = (
            replace(part, length=part.length + coupling(robot, part.theta))
            for part in (training, test, learned, judging)
        )
        if healthy.learned is not None:
            healthy = healthy._replace(learned=learned, judging=judging)
    if 'blind' in options:
        training = replace(training, theta=np.full_like(training.theta, np.nan))
        healthy = _nothing(robot)
    return Case(robot, driver, training, test, healthy)


def _explored(robot: Robot, driver: Mae, reality: str, seed: int) -> Iterator[tuple[str, Array]]:
    """Let an individual explore, and yield the name and values of each field of its samples."""
    stream = EXPLORATION_STREAM + seed
    exploring = record(make_arm(robot, seed, reality), driver, stream, EXPLORED)
    held = record(make_arm(robot, seed, reality), driver, HELD_OUT_STREAM, HELD_OUT)
    learner = Learner(robot, driver, seed=seed, trainer=Never)
    teach(learner, zip(*exploring, strict=True))
    healthy = learner.collector.healthy.healthy()
    thin = slice(None, None, THINNED)
    test = replace(
        _observed(held.theta[thin], held.tension[thin], held.length[thin]),
        direction=directions(held.length)[thin],
    )
    parts = learner.samples.observations(), test, healthy.learned, healthy.judging
    for name, part in zip(('training', 'test', 'learned', 'judging'), parts, strict=True):
        assert part is not None  # the joints of these individuals have sensors
        for n, values in enumerate(vars(part).values()):
            yield f'{name}_{n}', values


def coupling(robot: Robot, theta: Array) -> Array:
    """Return changes of all lengths [m] (N, M) that depend smoothly on θ [rad] (N, D)."""
    rng, waves = np.random.default_rng(123), 40
    frequency = rng.normal(0.0, 1.0, (waves, robot.joint_count))
    frequency /= 0.6 * (robot.upper - robot.lower)
    phase = rng.uniform(0.0, 2.0 * np.pi, waves)
    size = rng.normal(0.0, 1.0, (waves, robot.muscle_count)) * COUPLING / np.sqrt(0.5 * waves)
    changes: Array = (np.cos(theta @ frequency.T + phase) - np.cos(phase)) @ size
    return changes


def package(case: Case, updates: int | None, seed: int) -> str:
    """Learn a case, and return its errors as text.

    Args:
        case: The case.
        updates: Number of updates; None to make updates until they have converged.
        seed: Random seed of the training.
    """
    updater, times = BodyUpdater(case.robot, case.initial, seed), list[float]()

    def make_update() -> Update:
        begin = time.process_time()
        made = updater.update(Job(case.training, case.healthy, True, STEPS))
        times.append(time.process_time() - begin)
        return made

    if updates is None:
        *_, (update, _) = until_converged(make_update, lambda: updater.body)
    else:
        *_, update = (make_update() for _ in range(updates))
    mae, test, body = update.mae, case.test, updater.body
    end = test.end_tension(mae.transmission)
    error = mae.estimate(end, test.length).theta - test.theta
    (of_body,) = body.lengths(test.theta, test.tension, test.direction)
    of_network = mae.lengths(test.theta, end)
    by_network, by_body = (
        1e3 * np.sqrt(np.square(length - test.length).mean()) for length in (of_network, of_body)
    )
    assert mae.covariance is not None  # preset `default` has one
    inside = (ellipsoids(mae.covariance, error) <= 1.0).mean()
    constants = ' '.join(map(constants_text, body.remainder.groups))
    return (
        f'{np.linalg.norm(error, axis=1).mean():.4f} rad, {inside:.2f} inside, '
        f'lengths {by_network:.2f} and {by_body:.2f} mm, '
        f'remainder {1e3 * update.remainder.max():.2f} mm ({constants}), '
        f'offsets up to {np.abs(body.zero).max():.4f} rad, {len(times)} updates, '
        f'{np.mean(times[1:] or times):.2f} s per update'
    )


def constants_text(group: GroupRemainder) -> str:
    """Return the constants of a remainder as a text for people."""
    amplitude, by_theta, ratio, by_tension, tail, noise = UNITS * np.exp(group.logarithms)
    scales = f'b {by_theta:.2f}, e {ratio:.1f}, c {by_tension:.1f}, ν {tail:.1f}'
    return f'a {1e3 * amplitude:.1f} mm, {scales}, σ {1e3 * noise:.2f} mm'


def remainder_covariance(remainder: Remainder, theta: Array, tension: Array) -> Array:
    """Return the posterior covariance of the remainder [m²] for a known body, (N, M, M)."""
    result = np.zeros((len(theta), remainder.muscle_count, remainder.muscle_count))
    for group in remainder.groups:
        root = group.spread(theta, tension)[..., None] * group.correlation
        result[:, group.muscles[:, None], group.muscles] = root @ root.swapaxes(1, 2)
    return result


def body_alone(case: Case, fits: int = 2) -> str:
    """Fit the body without a network, and return the error of least squares on it as text."""
    body_fit = BodyFit(case.robot, None)
    for _ in range(fits):
        fit = body_fit.fit(case.training, case.training.theta)
    body, robot = body_fit.body, case.robot
    rows = slice(None, None, max(1, len(case.test) // MOST_FITTED))
    test = case.test[rows]
    start = case.initial.estimate(test.end_tension(case.initial.transmission), test.length).theta

    def length(theta: Array) -> Array:
        return body.lengths(theta, test.tension, test.direction)[0]

    def residuals(theta: Array) -> tuple[Array, Array]:
        covariance = remainder_covariance(body.remainder, theta, test.tension) + np.diag(
            fit.noise**2
        )
        white = np.linalg.inv(np.linalg.cholesky(covariance))
        steps = DIFFERENCE * np.eye(robot.joint_count)
        slope = [
            (length(theta + step) - length(theta - step)) / (2.0 * DIFFERENCE) for step in steps
        ]
        return (white @ (length(theta) - test.length)[..., None])[..., 0], white @ np.stack(
            slope, axis=-1
        )

    usual = (USUAL_STEP * (robot.upper - robot.lower)) ** -2.0
    theta = minimise_each(residuals, start, usual, ROUNDS, bounds=(robot.lower, robot.upper))
    error = np.linalg.norm(theta - test.theta, axis=1).mean()
    constants = ' '.join(map(constants_text, body.remainder.groups))
    return f'mean error {error:.4f} rad by least squares on the body (remainder: {constants})'


def regressions(case: Case) -> str:
    """Fit the regressions; return their mean errors of θ in the test [rad] as text."""

    def inputs(observed: Observations) -> Array:
        return np.hstack([observed.length, observed.tension])

    texts = []
    for name, fit in BASELINES.items():
        model = fit(inputs(case.training), case.training.theta)
        error = np.linalg.norm(model(inputs(case.test)) - case.test.theta, axis=1).mean()
        texts.append(f'{name} {error:.4f}')
    return ', '.join(texts)


def read_case(text: str, cache: Path) -> Case:
    """Read INDIVIDUAL[+OPTION][:COUNT[:DRAW]], and return the case that it names.

    Raises:
        MusculoskeletalError: If there is no such case.
    """
    name, *numbers = text.split(':')
    known = re.fullmatch(r'(kin|foreign)_\d+(\+(coupled|blind))*', name)
    if not known or len(numbers) > 2 or not all(number.isdecimal() for number in numbers):
        legal = 'kin_SEED or foreign_SEED, then +coupled or +blind, then :COUNT and :DRAW'
        raise MusculoskeletalError(f'case {text!r}: expected {legal}')
    count, draw = ([int(number) for number in numbers] + [CAPACITY, 0][len(numbers) :])[:2]
    return emulated(name, count, draw, cache)


def main(argv: list[str]) -> None:
    """Learn each case that the command line names, and print a line with its errors."""
    parser = Parser('bodies', (__doc__ or '').partition('\n')[0])
    parser.add_argument('cases', nargs='+', metavar='CASE', help='INDIVIDUAL[:COUNT[:DRAW]]')
    help_cache = 'directory that keeps initial networks, and samples of emulated arms'
    parser.add_argument('--cache', type=Path, required=True, help=help_cache)
    text = 'number of updates; by default, as many as the network needs to converge'
    parser.add_argument('--updates', type=whole(1, 100), help=text)
    parser.add_argument('--seed', type=whole(0, 10**6), default=0, help='seed of the training')
    parser.add_argument(
        '--body',
        action='store_true',
        help='fit only the body model, and estimate θ by least squares',
    )
    parser.add_argument('--baselines', action='store_true', help='also fit the regressions')
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    args.cache.mkdir(parents=True, exist_ok=True)
    for text in args.cases:
        case = read_case(text, args.cache)
        line = body_alone(case) if args.body else package(case, args.updates, args.seed)
        also = f'; {regressions(case)}' if args.baselines else ''
        print(f'{text} ({len(case.training)} samples): {line}{also}', flush=True)
