# SPDX-License-Identifier: Apache-2.0
"""Control.

The same as in the paper, in closed loop with the estimator and the controller that the nodes run,
on targets that the true body can hold within [T_bias, T_limit]; read 8 s after the command.
`geometric` is the model’s, the others run on the learned network, `proposed_paper` is the printed
method on the network of preset paper. QP bound: the least ‖T‖ with which the true body holds
θ_eval. "Bound reached": the same at the posture where the arm came to rest, as an arm that sags
needs less. What all starts of a target have in common is the model’s error, their scatter is
hysteresis.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.exploration import TRIES, holdable_postures
from musculoskeletal_ae.control.methods import proposed
from musculoskeletal_ae.control.safety import LENGTH, Muscles
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.exceptions import InfeasibleError, MusculoskeletalError
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, frictionless
from musculoskeletal_ae.experiments.study import Experiment, Individuals, Measured, Progress, Study
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension


class Method(NamedTuple):
    """A method under test: the controller's, on the network of a preset; its colour in plots."""

    method: str
    preset: str
    colour: str


METHODS = {
    'geometric': Method('geometric', 'default', '#999999'),
    'first': Method('first', 'default', '#E69F00'),
    'second': Method('second', 'default', '#009E73'),
    'proposed': Method('proposed', 'default', '#0072B2'),
    'proposed_paper': Method('proposed', 'paper', '#CC79A7'),
}
# `second` is done after 5 s + 2 s; all methods are read at the same time.
DURATION = 8.0  # [s]


def approach(arm: EmulatedArm, mae: Mae, settings: Settings, start: Array, theta: Array) -> None:
    """Let an arm go from rest at `start` to θ [rad] (D,), closed as on the real one.

        sense → estimate → control → command

    Raises:
        MusculoskeletalError: If the controller stopped on the way.
    """
    arm.reset(start)
    core = Controller(arm.robot, settings)
    core.use(mae)
    core.target({name: (angle, 0.0) for name, angle in zip(arm.robot.joints, theta.tolist())})
    now = 0.0
    for _ in range(round(DURATION / SAMPLE_TIME)):
        read = arm.sense()
        core.muscles(Muscles(read.length, read.tension, read.temperature), now)
        core.estimated(mae.estimate(read.tension, read.length).theta, now)
        command = core.step(now)
        if command is not None:
            follow = arm.command_length if command.kind == LENGTH else arm.command_tension
            follow(command.value)
        arm.step(SAMPLE_TIME)
        now += SAMPLE_TIME
    if core.safety.cause:
        raise MusculoskeletalError(f'control stopped: {core.safety.cause}')


class Approaches(NamedTuple):
    """Where P targets, each from S starts, left an arm.

    Attributes:
        target: θ_eval [rad], shape (P, D).
        bound: Least ‖T‖ with which the true body holds each [N], shape (P,).
        offset: θ − θ_eval at the end, by method [rad], each of shape (P, S, D).
        tension: ‖T‖ there [N], each of shape (P, S).
        bound_there: Least ‖T‖ that holds the posture reached [N]; nan where none does, as in one
            that leans on a joint's stop or rests by friction; each of shape (P, S).
    """

    target: Array
    bound: Array
    offset: dict[str, Array]
    tension: dict[str, Array]
    bound_there: dict[str, Array]


def protocol(
    arm: EmulatedArm,
    networks: Mapping[str, Mae],
    seed: int,
    count: int,
    progress: Progress | None = None,
) -> Approaches:
    """Approach random targets from random starts by every method.

    Args:
        arm: The arm.
        networks: By preset.
        seed: Draws targets and starts.
        count: How many targets, and how many starts for each.
        progress: Told the share of the work done since it was told last.
    """
    robot, rng = arm.robot, np.random.default_rng([seed, 0xC0])
    postures = robot.random_postures(TRIES, rng)
    held = holdable_postures(robot, postures, count, arm.individual.muscle_jacobian)
    offset = {name: np.empty((count, count, robot.joint_count)) for name in METHODS}
    tension, there = ({name: np.empty((count, count)) for name in METHODS} for _ in range(2))
    for p, (theta, _) in enumerate(held):
        for s, start in enumerate(robot.random_postures(count, rng)):
            for name, (method, preset, _) in METHODS.items():
                settings = Settings(method=method, preset=preset)
                approach(arm, networks[preset], settings, start, theta)
                offset[name][p, s] = arm.theta - theta
                tension[name][p, s] = np.linalg.norm(arm.tension)
                there[name][p, s] = _bound(arm)
            if progress:
                progress(1.0 / count**2)
    bound = np.array([np.linalg.norm(least) for _, least in held])
    return Approaches(np.array([theta for theta, _ in held]), bound, offset, tension, there)


def _bound(arm: EmulatedArm) -> float:
    jacobian = arm.individual.muscle_jacobian(arm.theta[None])[0]
    try:
        return float(np.linalg.norm(holding_tension(arm.robot, arm.theta, jacobian=jacobian)))
    except InfeasibleError:
        return float('nan')


def measure(study: Study, seed: int, progress: Progress) -> Measured:
    """Return the numbers and traces of one individual."""
    robot = study.body()
    networks = {'default': study.learned(robot, seed), 'paper': study.learned(robot, seed, 'paper')}
    ended = protocol(EmulatedArm(robot, seed), networks, seed, study.approaches, progress)
    errors = {name: np.linalg.norm(offset, axis=-1) for name, offset in ended.offset.items()}
    numbers: dict[str, Any] = {'qp_bound_n': float(ended.bound.mean())}
    for name, tension in ended.tension.items():
        offset, there = ended.offset[name], ended.bound_there[name]
        common, held = offset.mean(axis=1, keepdims=True), np.isfinite(there)
        numbers[name] = {
            'error_rad': float(errors[name].mean()),
            # Around each θ_eval's own mean: the scatter that hysteresis leaves, as in the paper.
            'error_var': float(errors[name].var(axis=1).mean()),
            # What every start has in common is the model's, what differs is hysteresis.
            'common_rad': float(np.linalg.norm(common, axis=-1).mean()),
            'scatter_rad': float(np.linalg.norm(offset - common, axis=-1).mean()),
            'tension_n': float(tension.mean()),
            'tension_var': float(tension.var(axis=1).mean()),
            'tension_to_bound': float((tension / ended.bound[:, None]).mean()),
            'bound_reached_n': float(there[held].mean()) if held.any() else 0.0,
            'reached_holdable_share': float(held.mean()),
        }
    numbers['proposed_causes'] = _causes(robot, networks['default'], seed, ended)
    return Measured(numbers, {'errors': errors, 'tensions': ended.tension, 'bound': ended.bound})


def _causes(robot: Robot, mae: Mae, seed: int, ended: Approaches) -> dict[str, float]:
    """Return what `proposed` plans, and what comes of it on the same body without friction.

    The plan's ‖T‖ beside the bound is the learned body's error; what the frictionless arm has
    beyond it comes from the tensions' being commanded as lengths, and the rest is friction.
    """
    arm = frictionless(robot, seed)
    planned, errors, tensions = [], [], []
    for theta in ended.target:
        torque = robot.kinematics.holding_torque(theta)
        none = np.full(robot.muscle_count, robot.tension.bias)
        plan = proposed(robot, mae, theta, torque, none, robot.tension.limit)
        planned.append(np.linalg.norm(plan.tension))
        approach(arm, mae, Settings(method='proposed'), 0.5 * (robot.lower + robot.upper), theta)
        errors.append(np.linalg.norm(arm.theta - theta))
        tensions.append(np.linalg.norm(arm.tension))
    return {
        'planned_to_bound': float((np.array(planned) / ended.bound).mean()),
        'frictionless_to_bound': float((np.array(tensions) / ended.bound).mean()),
        'frictionless_rad': float(np.mean(errors)),
    }


def plot(individuals: Individuals) -> list[plots.Plot]:
    """Draw the bars of the first individual, and those of all together."""
    seed, first = individuals.first
    traces = [row.traces for row in individuals.rows.values()]
    targets = [f'θ_eval {p + 1}' for p in range(len(first.traces['bound']))]
    one = _bars(first.traces, targets, f'individual {seed}')
    # Each individual has its own θ_eval: in the second plot a group of bars is an individual.
    together: dict[str, Any] = {
        key: {name: np.array([trace[key][name].ravel() for trace in traces]) for name in METHODS}
        for key in ('errors', 'tensions')
    }
    together['bound'] = np.array([trace['bound'].mean() for trace in traces])
    every = _bars(together, [f'individual {seed}' for seed in individuals.rows], 'all individuals')
    caption = (
        'Distance from the target and muscle tension at rest for {}; whiskers: standard deviation '
        'over {}. Dashed: the least ‖T‖ with which the true body can hold the target. `first` and '
        '`second` rest elsewhere and so may need less.'
    )
    both = 'every individual (all its θ_eval together)', 'starts and targets'
    return [
        plots.Plot('control', one, caption.format('every target posture', 'starts')),
        plots.Plot('control_all', every, caption.format(*both)),
    ]


def _bars(trace: Mapping[str, Any], labels: list[str], title: str) -> Any:
    """Draw groups of bars, by method (groups, approaches), with the bound of each group."""
    figure, axes = plots.new_figure(11.0, 6.4, 2, 1, sharex=True)
    place, width, bound = np.arange(len(labels)), 0.8 / len(METHODS), trace['bound']
    whiskers = {'lw': 1, 'capsize': 2}
    for m, (name, method) in enumerate(METHODS.items()):
        at = place + (m - 0.5 * (len(METHODS) - 1)) * width
        for panel, key, form in (
            (axes[0, 0], 'errors', '{}: {:.3f} rad'),
            (axes[1, 0], 'tensions', '{}: {:.0f} N'),
        ):
            mean, spread = trace[key][name].mean(axis=1), trace[key][name].std(axis=1)
            style = {'color': method.colour, 'label': form.format(name, mean.mean())}
            panel.bar(at, mean, 0.92 * width, yerr=spread, error_kw=whiskers, **style)
    panel = axes[1, 0]
    label = f'QP bound at θ_eval: {bound.mean():.0f} N'
    left, right = place - 0.45, place + 0.45
    panel.hlines(bound, left, right, color=plots.TRUE, lw=1.5, ls='--', label=label)
    plots.tidy(axes[0, 0], '', '‖θ_eval − θ‖ [rad]', title)
    plots.tidy(panel, '', '‖T‖ [N]')
    panel.set_xticks(place, labels)
    for each in axes[:, 0]:
        each.legend(fontsize=9, loc='center left', bbox_to_anchor=(1.0, 0.5))
    return figure


EXPERIMENT = Experiment(
    description=__doc__,
    paper=(
        'Five random θ_eval, each approached from five random postures, by the geometric model, '
        'by `first`, `second` and `proposed` after learning: all learned ones far better than '
        'geometric; `proposed` as exact as `second` with less tension than either.'
    ),
    weight=10.0,
    measure=measure,
    plot=plot,
)
