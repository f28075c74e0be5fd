# SPDX-License-Identifier: Apache-2.0
"""What learning changes in the body.

Paper (§IV-A). l against S-p from −120° to 30° at T = 0, and against T from 0 to 500 N at θ = 0:
changes up to 40 mm, largest in #2, #3 and #7; tension curves from linear to strongly curved, put
down to wear of #2’s elastic unit and to much friction in #6.

Here. l(θ) at T = 0 over −120…30° of the shoulder, and l(T) over 0…T_max at θ = 0, through ① of the
network before and after learning, beside the true body. All other joints are at θ = 0; where that
lies outside a joint’s limits (the elbow’s, by 5°) it is kept all the same. "Shape" is the error of
a curve beside the true one after their mean difference is taken off. "Worn" is the first individual
with a worn elastic unit at #2 and friction in #6, explored and learned anew.
"""

from typing import Any

import numpy as np

from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.online_learning import beginner, explore, teach
from musculoskeletal_ae.experiments.roles import shoulder
from musculoskeletal_ae.experiments.study import Experiment, Measured, Plot, Rows, Study, first
from musculoskeletal_ae.robot.robot import Robot

SWEEP = np.radians(np.linspace(-120.0, 30.0, 151))  # [rad]
POINTS = 101  # of tension
COLUMNS = 5  # of plots
WORN, RUBBING = 0.5, 0.4  # of the stiffening rate; capstan exponent of the cable (others: 0.1)
LABELS = {'before': 'before learning', 'after': 'after learning', 'true': 'true body'}


def measure(study: Study, seed: int) -> Measured:
    """Return the numbers and traces of one individual."""
    robot, true = study.robot, study.arm(seed).individual
    joint, seen = shoulder(robot), study.rests(seed).tension
    tension = np.linspace(0.0, robot.tension.max.max(), POINTS)
    swept = np.zeros((len(SWEEP), robot.joint_count))
    swept[:, joint] = SWEEP
    stretched = np.repeat(tension[:, None], robot.muscle_count, axis=1)
    # Where something was trained: within the joint's limits, and the tensions of the samples.
    inside = (robot.lower[joint] <= SWEEP) & (robot.upper[joint] >= SWEEP)
    low, high = (seen.min(), seen.max()) if seen.size else (0.0, robot.tension.limit.max())
    held, still = (tension >= low) & (tension <= high), np.zeros((POINTS, robot.joint_count))
    sweeps = {
        'angle': (np.degrees(SWEEP), inside, swept, np.zeros((len(SWEEP), robot.muscle_count))),
        'tension': (tension, held, still, stretched),
    }
    traces: dict[str, Any] = {}
    numbers: dict[str, Any] = {'joint': robot.joints[joint]}
    for name, (x, trained, *points) in sweeps.items():
        curves = {when: mae.lengths(*points) for when, mae in study.networks(seed).items()}
        curves['true'] = true.muscle_lengths(*points)
        traces[name] = x, trained, curves
        change = 1e3 * np.abs(curves['after'] - curves['before'])[trained].max(axis=0)
        numbers[f'{name}_change_mm'] = dict(zip(robot.muscles, change.tolist(), strict=True))
        for when in plots.WHEN:
            # Beside the zero that each curve has its own: only their shapes are compared.
            off = (curves[when] - curves['true'])[trained]
            shape = 1e3 * (off - off.mean(axis=0)).std(axis=0)
            numbers[f'{name}_{when}_shape_mm'] = float(shape.mean())
    if seed == study.seeds[0]:
        learner, loop = beginner(study, arm := worn_arm(robot, seed), seed, study.preset)
        teach(learner, explore(loop, learner, 60.0 * study.minutes))
        changed = {
            'before': traces['tension'][2]['before'],
            'after': learner.mae.lengths(still, stretched),
            'true': arm.individual.muscle_lengths(still, stretched),
        }
        traces['worn'] = tension, held, changed
    return Measured(numbers, traces)


def worn_arm(robot: Robot, seed: int) -> EmulatedArm:
    """Return an individual whose second elastic unit is worn, and whose sixth muscle rubs."""
    individual = Individual(robot, seed)
    worn, rubbing = np.minimum((1, 5), robot.muscle_count - 1)
    individual.elastic.rate[worn] *= WORN
    individual.cable_friction[rubbing] = RUBBING
    return EmulatedArm(robot, seed, individual)


def length_against_angle(study: Study, rows: Rows) -> Plot:
    """Draw l over the shoulder's angle, one panel for each muscle."""
    joint = first(rows)[1].numbers['joint']
    title = 'muscle length at T = 0, all other joints at 0'
    return _panels(study, rows, 'angle', f'θ of {joint} [deg]', title), (
        f'Muscle length against {joint} at no tension. Dotted: outside the joint’s limits, '
        'where nothing was trained.'
    )


def length_against_tension(study: Study, rows: Rows) -> Plot:
    """Draw l over tension, one panel for each muscle."""
    return _panels(study, rows, 'tension', 'T [N]', 'muscle length at θ = 0'), (
        'Muscle length against tension at θ = 0. Dotted: tensions that no sample of the '
        'exploration held.'
    )


def worn_muscles(study: Study, rows: Rows) -> Plot:
    """Draw l over tension of the individual with worn muscles."""
    title = 'muscle length at θ = 0, #2 worn, #6 with friction'
    return _panels(study, rows, 'worn', 'T [N]', title), (
        'Muscle length against tension at θ = 0 of an individual whose muscle 2 has a worn elastic '
        f'unit ({WORN:g} × its stiffening rate) and whose muscle 6 loses {RUBBING:.0%} of its '
        'tension to friction, before and after learning. The true curves are without friction.'
    )


def _panels(study: Study, rows: Rows, name: str, xlabel: str, title: str) -> Any:
    (seed, row), robot = first(rows), study.robot
    x, trained, curves = row.traces[name]
    count = min(COLUMNS, robot.muscle_count)
    height = -(-robot.muscle_count // count)
    size = 2.6 * count + 0.6, 2.4 * height + 0.9
    figure, panels = plots.new_figure(*size, height, count, sharex=True)
    for panel in panels[robot.muscle_count :]:
        panel.set_axis_off()
    for m, (muscle, panel) in enumerate(zip(robot.muscles, panels)):  # some stay empty
        for when, label in LABELS.items():
            y, width = 1e3 * curves[when][:, m], 1.0 if when == 'true' else 1.8
            style = {'color': plots.WHEN.get(when, plots.TRUE), 'lw': width}
            panel.plot(x, y, ls=':', **style)
            panel.plot(x, np.where(trained, y, np.nan), label=label if m == 0 else None, **style)
        lowest = m + count >= robot.muscle_count
        ylabel = 'l [mm]' if m % count == 0 else ''
        plots.tidy(panel, xlabel if lowest else '', ylabel, f'{m + 1} {muscle}')
        panel.title.set_fontsize(9)
        panel.tick_params(labelbottom=lowest)
    figure.legend(loc='outside lower center', ncols=3, fontsize=9)
    figure.suptitle(f'individual {seed}: {title}')
    return figure


PLOTS = (length_against_angle, length_against_tension, worn_muscles)
EXPERIMENT = Experiment(__doc__, measure, PLOTS, 2.0)
