# SPDX-License-Identifier: Apache-2.0
"""Control.

Paper (§IV-C). The arm approaches each of five random targets θ_eval from five random postures. It
uses the geometric model, and after learning the control methods `first`, `second` and `proposed`.
All learned methods are far better than `geometric`. `proposed` is as accurate as `second`, with
less tension than `first` and `second`.

Here. The protocol is the same, in closed loop with the estimator and the controller of the nodes.
Targets are postures that the true body can hold within [T_bias, T_limit]. `proposed` on the learned
network moves the arm to each start. `geometric` uses the geometric model, and the other methods use
the learned network. Methods whose name ends in `_paper` use the network of preset `paper`. Results
are read 8 s after the command, even if the controller has stopped by then. These stops are counted.

- model error and hysteresis: the mean offset over all starts of a target is the error of the model;
  the scatter about this mean is hysteresis
- QP bound: the least ‖T‖ with which the true body holds θ_eval
- bound reached: the least ‖T‖ with which the true body holds the posture in which the arm came to
  rest. An arm that sags below θ_eval may need less tension there than at θ_eval.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.exceptions import InfeasibleError
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.recording import ClosedLoop
from musculoskeletal_ae.experiments.study import (
    Experiment,
    Measured,
    Plot,
    Rows,
    Study,
    first_individual,
)
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion.explored_postures import TRIES, holdable_postures
from musculoskeletal_ae.motion.tension_plan import plan_at_rest
from musculoskeletal_ae.presets.preset import PAPER_PRESET
from musculoskeletal_ae.robot.tension import holding_tension

#: colours of the methods; a suffix names the preset whose network a method uses
METHODS = {
    'geometric': '#999999',
    'first': '#E69F00',
    'second': '#009E73',
    'proposed': '#0072B2',
    f'first_{PAPER_PRESET}': '#F5D999',
    f'second_{PAPER_PRESET}': '#99D8C7',
    f'proposed_{PAPER_PRESET}': '#CC79A7',
}
APPROACHES = 5  # approach this many targets θ_eval, each of them from this many starts


class Durations(NamedTuple):
    """Durations of the parts of an approach [s]."""

    start: float  # duration of the motion to the posture from which the approach starts
    end: float  # time from the command until the results are read; `second` must have ended by then
    first: float  # value of the setting `first_duration`
    second: float  # value of the setting `second_duration`


DURATIONS = Durations(5.0, 8.0, 5.0, 2.0)


class Approaches(NamedTuple):
    """Results of approaching P targets from S starts each, with every control method."""

    target: Array  # target postures θ_eval [rad], (P, D)
    bound: Array  # least ‖T‖ with which the true body holds each target [N], (P,)
    offset: dict[str, Array]  # θ − θ_eval at the end of each approach [rad], (P, S, D)
    tension: dict[str, Array]  # ‖T‖ at the end of each approach [N], (P, S)
    #: least ‖T‖ that holds the final posture [N], (P, S); NaN if no tensions do, for example if
    #: the arm rests against a joint stop or by friction
    bound_there: dict[str, Array]
    stops: dict[str, int]  # number of approaches that ended with a stop of the controller


def protocol(
    arm: Arm,
    networks: Mapping[str, Mae],
    seed: int,
    count: int,
    durations: Durations = DURATIONS,
) -> Approaches:
    """Approach `count` random targets from `count` random starts each, with every control method.

    Args:
        arm: The emulated arm, which is moved.
        networks: The networks by the names of their presets.
        seed: Random seed of targets and starts.
        count: Number of targets, and of starts for each of them.
        durations: Durations of the parts of an approach.
    """
    robot, rng = arm.robot, np.random.default_rng([seed, 0xC0])
    postures = robot.random_postures(TRIES, rng)
    held = holdable_postures(robot, postures, count, arm.individual.muscle_jacobian)
    offset = {name: np.empty((count, count, robot.joint_count)) for name in METHODS}
    tension, there = ({name: np.empty((count, count)) for name in METHODS} for _ in range(2))
    stops = dict.fromkeys(METHODS, 0)
    for p, (theta, _) in enumerate(held):
        for s, start in enumerate(robot.random_postures(count, rng)):
            for name in METHODS:
                method, _, preset = name.partition('_')
                preset = preset or 'default'
                loop = ClosedLoop(arm, networks['default'])
                loop.approach(start, durations.start)
                if not loop.core.supervisor.is_running:  # stopped on the way: start from here
                    loop = ClosedLoop(arm, networks['default'])
                loop.use(networks[preset])
                settings = Settings(
                    method=method, preset=preset,
                    first_duration=durations.first, second_duration=durations.second,
                )  # fmt: skip
                loop.core.configure(settings)
                loop.approach(theta, durations.end)
                stops[name] += not loop.core.supervisor.is_running
                offset[name][p, s] = arm.theta - theta
                tension[name][p, s] = np.linalg.norm(arm.tension)
                there[name][p, s] = _bound(arm)
    bound = np.array([np.linalg.norm(least) for _, least in held])
    targets = np.array([theta for theta, _ in held])
    return Approaches(targets, bound, offset, tension, there, stops)


def _bound(arm: Arm) -> float:
    jacobian = arm.individual.muscle_jacobian(arm.theta[None])[0]
    try:
        return float(np.linalg.norm(holding_tension(arm.robot, arm.theta, jacobian=jacobian)))
    except InfeasibleError:
        return float('nan')


def measure(study: Study, seed: int) -> Measured:
    """Measure the errors and tensions of every control method on one individual."""
    networks = {'default': study.network(seed), PAPER_PRESET: study.network(seed, PAPER_PRESET)}
    # A shortened run has too little time to reach the start, so an approach begins before that.
    count, durations = study.number(APPROACHES), Durations(*map(study.seconds, DURATIONS))
    ended = protocol(study.arm(seed), networks, seed, count, durations)
    errors = {name: np.linalg.norm(offset, axis=-1) for name, offset in ended.offset.items()}
    numbers: dict[str, Any] = {
        'qp_bound_n': float(ended.bound.mean()),
        'targets': len(ended.target),
    }
    for name, tension in ended.tension.items():
        offset, there = ended.offset[name], ended.bound_there[name]
        common, held = offset.mean(axis=1, keepdims=True), np.isfinite(there)
        numbers[name] = {
            'error_rad': float(errors[name].mean()),
            # Variance over the starts at each θ_eval: the scatter by hysteresis (paper, §IV-C).
            'error_var': float(errors[name].var(axis=1).mean()),
            # The mean offset of all starts is the model's error; the scatter is hysteresis.
            'common_rad': float(np.linalg.norm(common, axis=-1).mean()),
            'scatter_rad': float(np.linalg.norm(offset - common, axis=-1).mean()),
            'tension_n': float(tension.mean()),
            'tension_var': float(tension.var(axis=1).mean()),
            'tension_to_bound': float((tension / ended.bound[:, None]).mean()),
            'bound_reached_n': float(there[held].mean()) if held.any() else 0.0,
            'reached_holdable_share': float(held.mean()),
            'stops': ended.stops[name],
        }
    frictionless = study.arm(seed, friction=False)
    numbers['proposed_causes'] = _causes(frictionless, networks['default'], ended, durations)
    return Measured(numbers, {'errors': errors, 'tensions': ended.tension, 'bound': ended.bound})


def _causes(
    frictionless: Arm, mae: Mae, ended: Approaches, durations: Durations
) -> dict[str, float]:
    """Return measures that show why `proposed` needs more than the least tension.

    `proposed` moves the same body, but without tendon friction, to each target. Friction is why the
    arm itself needs still more tension.

    Returns:
        Three means. planned_to_bound: ratio of the planned ‖T‖ to the least ‖T‖ with which the true
        body holds the target, which shows the error of the learned body. frictionless_to_bound: the
        same ratio for ‖T‖ after the motion, which also shows the effect of commanding tensions as
        lengths. frictionless_rad: distance [rad] of the frictionless arm from the target.
    """
    robot, rows = frictionless.robot, []
    for theta in ended.target:
        ClosedLoop(frictionless, mae).approach(theta, durations.end)
        planned = plan_at_rest(robot, mae, theta).bone_tension
        parts = planned, frictionless.tension, frictionless.theta - theta
        rows.append([np.linalg.norm(part) for part in parts])
    planned, tension, error = np.transpose(rows)
    return {
        'planned_to_bound': float((planned / ended.bound).mean()),
        'frictionless_to_bound': float((tension / ended.bound).mean()),
        'frictionless_rad': float(error.mean()),
    }


CAPTION = (
    'Distance from the target and muscle tension at rest for {}; whiskers: standard deviation over '
    '{}. Dashed: the least ‖T‖ with which the true body can hold the target. `first` and `second` '
    'come to rest elsewhere and may need less tension there.'
)


def control(_: Study, rows: Rows) -> Plot:
    """Draw errors and tensions of the first individual, with a group of bars for each θ_eval."""
    seed, row = first_individual(rows)
    labels = [f'θ_eval {p + 1}' for p in range(len(row.traces['bound']))]
    figure = _bars(row.traces, labels, f'individual {seed}')
    return figure, CAPTION.format('every target posture', 'starts')


def control_all(_: Study, rows: Rows) -> Plot:
    """Draw errors and tensions of all individuals, with a group of bars for each individual."""
    traces = [row.traces for row in rows.values()]
    together: dict[str, Any] = {
        key: {name: np.array([trace[key][name].ravel() for trace in traces]) for name in METHODS}
        for key in ('errors', 'tensions')
    }
    together['bound'] = np.array([trace['bound'].mean() for trace in traces])
    figure = _bars(together, [f'individual {seed}' for seed in rows], 'all individuals')
    every = 'every individual (all its θ_eval together)'
    return figure, CAPTION.format(every, 'starts and targets')


def _bars(trace: Mapping[str, Any], labels: list[str], title: str) -> Any:
    """Draw errors and tensions as groups of bars, with one bar for each control method.

    A dashed line shows the QP bound of each group. `labels` are the names of the groups. In
    `trace`, 'errors' [rad] and 'tensions' [N] are arrays (groups, approaches) by method, and
    'bound' [N] is an array (groups,). `title` is that of the figure.
    """
    figure, (upper, lower) = plots.new_figure(11.0, 6.4, 2, sharex=True)
    place, width, bound = np.arange(len(labels)), 0.8 / len(METHODS), trace['bound']
    whiskers = {'lw': 1, 'capsize': 2}
    for m, (name, colour) in enumerate(METHODS.items()):
        at = place + (m - 0.5 * (len(METHODS) - 1)) * width
        shown = (upper, 'errors', '{}: {:.3f} rad'), (lower, 'tensions', '{}: {:.0f} N')
        for panel, key, form in shown:
            mean, spread = trace[key][name].mean(axis=1), trace[key][name].std(axis=1)
            style = {'color': colour, 'label': form.format(name, mean.mean())}
            panel.bar(at, mean, 0.92 * width, yerr=spread, error_kw=whiskers, **style)
    label = f'QP bound at θ_eval: {bound.mean():.0f} N'
    left, right = place - 0.45, place + 0.45
    lower.hlines(bound, left, right, color=plots.TRUE, lw=1.5, ls='--', label=label)
    lower.set_xticks(place, labels)
    plots.tidy(upper, '', '‖θ_eval − θ‖ [rad]', title, legend='right')
    plots.tidy(lower, '', '‖T‖ [N]', legend='right')
    return figure


EXPERIMENT = Experiment(__doc__, measure, (control, control_all), 22.0)
