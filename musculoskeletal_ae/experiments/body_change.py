# SPDX-License-Identifier: Apache-2.0
"""What learning changes in the body.

Paper (§IV-A). The figure shows the muscle length l against the shoulder pitch S-p from −120° to 30°
at T = 0, and against the tension T from 0 to 500 N at θ = 0. Learning changes the lengths by up to
about 40 mm, most of all those of muscles #2, #3 and #7. After learning, the tension curves of some
muscles are nearly linear, and others are strongly nonlinear. The paper explains this by a change of
#2’s elastic unit, and by high friction in #6, whose nonlinearity vanishes.

Here. The figures show l(θ) at T = 0 over −120…30° of the shoulder, and l(T) over 0…T_max at θ = 0.
They compare the lengths that the networks of both presets predict, before and after learning, with
those of the true body. All other joints are at θ = 0, even where this lies outside a joint’s limits
(by 5° at the elbow). The shoulder's lower limit is −70°, so the networks extrapolate from there to
−120°.

- change: largest difference between a muscle's curves before and after learning
- relative change: the same for l − l(0), because the curves of the paper pass through the origin
- true change: difference between the true body and its model, which a perfect learner would find
- model error: error of the initial network on the geometric model from which it was trained
- excursion: range of a muscle's length within the joint's limits
- nonlinearity: largest distance of l(T) from the straight line between its ends, relative to its
  range
- shape: error of a curve after subtracting its mean difference from the true curve
- worn: another arm that explores and learns. It is the first individual, but with a worn series
  elastic element in #2 and high tendon friction in #6.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.emulator.kin.individual import Individual
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.online_learning import explore, new_learner_and_loop, teach
from musculoskeletal_ae.experiments.roles import shoulder
from musculoskeletal_ae.experiments.study import (
    Experiment,
    Measured,
    Plot,
    Rows,
    Study,
    first_individual,
)
from musculoskeletal_ae.robot.robot import Robot

#: compare muscle lengths at these angles of the shoulder [rad], as in the paper's figure
SWEEP = np.radians(np.linspace(-120.0, 30.0, 151))
POINTS = 101  # compute a curve of length over tension at this many points
COLUMNS = 5  # put this many panels in a row of a plot
WORN = 0.5  # multiply the stiffening rate of the worn series elastic element by this
WORN_FRICTION = 0.4  # give the tendon with high friction this capstan exponent (others: 0.1)
SMALL = 1e-9  # divide by at least this, to avoid a division by zero [m]


def measure(study: Study, seed: int) -> Measured:
    """Measure how learning changes the length curves of one individual."""
    robot, true = study.robot, study.arm(seed).individual
    joint, sampled = shoulder(robot), study.rests(seed).tension
    tension = np.linspace(0.0, robot.tension.max.max(), POINTS)
    swept = np.zeros((len(SWEEP), robot.joint_count))
    swept[:, joint] = SWEEP
    stretched = np.repeat(tension[:, None], robot.muscle_count, axis=1)
    # The trained ranges: the joint's limits, and the tensions of the samples.
    inside = (robot.lower[joint] <= SWEEP) & (robot.upper[joint] >= SWEEP)
    low, high = 0.0, robot.tension.limit.max()
    if sampled.size:
        low, high = sampled.min(), sampled.max()
    within, at_zero = (tension >= low) & (tension <= high), np.zeros((POINTS, robot.joint_count))
    no_tension = np.zeros((len(SWEEP), robot.muscle_count))
    sweeps = {
        'angle': (np.degrees(SWEEP), inside, swept, no_tension),
        'tension': (tension, within, at_zero, stretched),
    }
    traces: dict[str, Any] = {name: {} for name in sweeps}
    numbers: dict[str, Any] = {'joint': robot.joints[joint]}
    for preset in study.presets:
        networks, values = study.networks(seed, preset), dict[str, Any]()
        for name, (x, trained, *points) in sweeps.items():
            curves = {when: mae.lengths(*points) for when, mae in networks.items()}
            curves['true'] = true.muscle_lengths(*points)
            traces[name][preset] = x, trained, curves
            origin = int(np.abs(x).argmin())
            values |= _changes(robot, name, origin, trained, curves)
            off = curves['before'] - robot.muscle_lengths(*points)
            values[f'{name}_model_error_mm'] = _by_muscle(robot, (off - off[origin])[trained])
        numbers |= study.with_prefix(preset, values)
    model = robot.muscle_lengths(swept, no_tension)
    deviation = true.muscle_lengths(swept, no_tension) - model
    deviation -= deviation[np.abs(SWEEP).argmin()]
    # The change that a perfect learner would make, and the excursion of each muscle.
    numbers['angle_true_change_mm'] = _by_muscle(robot, deviation[inside])
    numbers['angle_true_change_all_mm'] = _by_muscle(robot, deviation)
    excursion = 1e3 * np.ptp(model[inside], axis=0)
    numbers['angle_excursion_mm'] = dict(zip(robot.muscles, excursion.tolist(), strict=True))
    if seed == study.seeds[0]:
        arm = worn_arm(robot, seed)
        learner, loop = new_learner_and_loop(study, arm, seed, study.preset)
        teach(learner, explore(loop, learner, 60.0 * study.minutes))
        worn = {
            'before': traces['tension'][study.preset][2]['before'],
            'after': learner.mae.lengths(at_zero, stretched),
            'true': arm.individual.muscle_lengths(at_zero, stretched),
        }
        for when, curve in worn.items():
            bend = nonlinearity(curve).tolist()
            numbers[f'worn_nonlinearity_{when}'] = dict(zip(robot.muscles, bend, strict=True))
        traces['worn'] = {study.preset: (tension, within, worn)}
    return Measured(numbers, traces)


def _changes(
    robot: Robot, name: str, origin: int, trained: Bools, curves: Mapping[str, Array]
) -> dict[str, Any]:
    """Return measures of how learning changes the length curves of one sweep.

    The change of a muscle is the largest difference [mm] between its curves before and after
    learning. Keys with "relative" hold the change of l − l(origin), because the curves in the paper
    pass through the origin. Changes whose keys contain "all" cover the whole sweep, as in the
    paper's figure. All other changes cover the points in `trained` only.

    Args:
        robot: The robot whose muscles are compared.
        name: The swept quantity, 'angle' or 'tension', with which the keys begin.
        origin: Index of the point at which this quantity is 0.
        trained: Mask (points,) of the points within the range of the training.
        curves: Lengths [m] (points, M) 'before' and 'after' learning, and of the 'true' body.
    """
    change = curves['after'] - curves['before']
    relative = change - change[origin]
    numbers: dict[str, Any] = {
        f'{name}_change_mm': _by_muscle(robot, change[trained]),
        f'{name}_change_all_mm': _by_muscle(robot, change),
        f'{name}_relative_change_mm': _by_muscle(robot, relative[trained]),
        f'{name}_relative_change_all_mm': _by_muscle(robot, relative),
    }
    for when in plots.WHEN:
        # Each curve has its own offset, so compare only the shapes.
        off = (curves[when] - curves['true'])[trained]
        shape = 1e3 * (off - off.mean(axis=0)).std(axis=0)
        numbers[f'{name}_{when}_shape_mm'] = float(shape.mean())
        numbers[f'{name}_{when}_origin_mm'] = float(1e3 * np.abs(curves[when][origin]).max())
    if name == 'tension':
        for when, curve in curves.items():
            bend = nonlinearity(curve)
            numbers[f'nonlinearity_{when}'] = dict(zip(robot.muscles, bend.tolist(), strict=True))
    return numbers


def _by_muscle(robot: Robot, change: Array) -> dict[str, float]:
    """Return the largest absolute value [mm] of `change` [m] (points, M), by name of the muscle."""
    largest = 1e3 * np.abs(change).max(axis=0)
    return dict(zip(robot.muscles, largest.tolist(), strict=True))


def nonlinearity(curve: Array) -> Array:
    """Return how much the length curve of each muscle deviates from a straight line, (M,).

    `curve` [m] has the shape (points, M). The deviation is the largest distance of a curve from the
    straight line between its ends, relative to the range of the curve.
    """
    share = np.linspace(0.0, 1.0, len(curve))[:, None]
    chord = curve[0] + share * (curve[-1] - curve[0])
    bend: Array = np.abs(curve - chord).max(axis=0) / np.maximum(np.ptp(curve, axis=0), SMALL)
    return bend


def worn_arm(robot: Robot, seed: int) -> EmulatedArm:
    """Return an arm with a worn series elastic element in muscle 2, and high friction in muscle 6.

    Apart from this, the arm is the individual of `seed`.
    """
    individual = Individual(robot, seed)
    worn, with_friction = np.minimum((1, 5), robot.muscle_count - 1)
    individual.elastic.rate[worn] *= WORN
    individual.tendon_friction[with_friction] = WORN_FRICTION
    return EmulatedArm(robot, seed, individual)


def length_against_angle(study: Study, rows: Rows) -> Plot:
    """Draw the muscle length over the shoulder's angle, one panel for each muscle."""
    joint = first_individual(rows)[1].numbers['joint']
    title = 'muscle length at T = 0, all other joints at 0'
    return _panels(study, rows, 'angle', f'θ of {joint} [deg]', title), (
        f'Muscle length against {joint} at zero tension. Dotted: outside the joint’s limits, '
        'where the network was not trained.'
    )


def length_against_tension(study: Study, rows: Rows) -> Plot:
    """Draw the muscle length over the tension, one panel for each muscle."""
    return _panels(study, rows, 'tension', 'T [N]', 'muscle length at θ = 0'), (
        'Muscle length against tension at θ = 0. Dotted: tensions outside the range of the '
        'exploration’s samples.'
    )


def worn_muscles(study: Study, rows: Rows) -> Plot | None:
    """Draw the muscle length over the tension for the worn arm.

    Return None if the worn arm was not measured.
    """
    title = 'muscle length at θ = 0, #2 worn, #6 with high friction'
    figure = _panels(study, rows, 'worn', 'T [N]', title)
    if figure is None:
        return None
    return figure, (
        'Muscle length against tension at θ = 0, before and after learning, for an individual '
        'with a worn series elastic element in muscle 2 '
        f'({WORN:g} × its stiffening rate) and high tendon friction in muscle 6 (capstan exponent '
        f'{WORN_FRICTION:g}). The true curves are without friction.'
    )


def _panels(study: Study, rows: Rows, name: str, xlabel: str, title: str) -> Any:
    (seed, row), robot = first_individual(rows), study.robot
    if name not in row.traces:
        return None
    by_preset = row.traces[name]
    count = min(COLUMNS, robot.muscle_count)
    height = -(-robot.muscle_count // count)
    size = 2.6 * count + 0.6, 2.4 * height + 1.1
    figure, panels = plots.new_figure(*size, height, count, sharex=True)
    for panel in panels[robot.muscle_count :]:
        panel.set_axis_off()
    for m, (muscle, panel) in enumerate(zip(robot.muscles, panels)):
        lines = [
            (f'{preset}, {when} learning', preset, when, x, trained, curves[when])
            for preset, (x, trained, curves) in by_preset.items()
            for when in plots.WHEN
        ]
        x, trained, curves = by_preset[study.preset]
        for label, preset, when, *_, curve in [
            *lines,
            ('true body', study.preset, 'true', x, trained, curves['true']),
        ]:
            style = _line_style(study, preset, when)
            y = 1e3 * curve[:, m]
            panel.plot(x, y, **(style | {'ls': ':', 'lw': 0.8}))
            panel.plot(x, np.where(trained, y, np.nan), label='' if m else label, **style)
        lowest = m + count >= robot.muscle_count
        ylabel = 'l [mm]' if m % count == 0 else ''
        plots.tidy(panel, xlabel if lowest else '', ylabel, f'#{m + 1} {muscle}')
        panel.title.set_fontsize(9)
        panel.tick_params(labelbottom=lowest)
    figure.legend(loc='outside lower center', ncols=5, fontsize=9)
    figure.suptitle(f'individual {seed}: {title}')
    return figure


def _line_style(study: Study, preset: str, when: str) -> dict[str, Any]:
    """Return the style of a curve: its colour depends on `when`, its dashes on the preset."""
    if when == 'true':
        return {'color': plots.TRUE, 'lw': 1.0, 'ls': '-'}
    dashes = '-' if preset == study.preset else '--'
    return {'color': plots.WHEN[when], 'lw': 1.6, 'ls': dashes}


PLOTS = (length_against_angle, length_against_tension, worn_muscles)
EXPERIMENT = Experiment(__doc__, measure, PLOTS, 2.0)
