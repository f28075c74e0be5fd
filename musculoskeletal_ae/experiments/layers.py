# SPDX-License-Identifier: Apache-2.0
"""Number of layers and units.

Paper (§III-A). The encoder has hidden layers of 200 and 30 units. The number of layers hardly
affects the accuracy, but fewer units lower it.

Here. Networks of preset `paper` with other hidden layers are trained on the geometric model, and
then learn from the messages of the default preset’s exploration of one individual. Only the first
individual is measured. If initial training leaves a network too inaccurate, checkpoint validation
rejects it, and the network does not learn.

- model: mean error of θ, T and l after initial training, on states of the geometric model that were
  not used for training
- before, after: error of the estimate on the held-out motion, before and after online learning
- trainings: number of random seeds over which the errors are means
"""

from functools import partial
from typing import Any

import numpy as np

from musculoskeletal_ae.estimation.network_validation.validator import CheckpointValidator
from musculoskeletal_ae.exceptions import GateError
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.online_learning import TEST_STATES, teach
from musculoskeletal_ae.experiments.recording import estimation_error
from musculoskeletal_ae.experiments.study import (
    Experiment,
    Measured,
    Plot,
    Rows,
    Study,
    first_individual,
)
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae.initial_training import completed
from musculoskeletal_ae.mae.training import OUTPUTS, pair_errors
from musculoskeletal_ae.mae.units import Mask
from musculoskeletal_ae.presets.paper import PaperPreset
from musculoskeletal_ae.presets.preset import PAPER_PRESET

#: compare encoders with hidden layers of these numbers of units. The decoder has the same layers in
#: reverse order, and the latent layer has D + M units.
HIDDEN = {
    'as in the paper: 200, 30': (200, 30),
    'fewer layers: 200': (200,),
    'more layers: 200, 100, 30': (200, 100, 30),
    'fewer units: 100, 30': (100, 30),
    'fewer units: 50, 20': (50, 20),
    'fewer units: 20, 10': (20, 10),
}
TRAININGS = 3  # train each layout this many times, with different random seeds
QUICK_STEPS = 100  # in a shortened run, end the initial training after this many steps
ERRORS = 'before_rad', 'after_rad'  # report the range of these numbers over the trainings


def measure(study: Study, seed: int) -> Measured:
    """Measure networks whose hidden layers differ from the default, on the first emulated arm.

    The result of every other arm is empty.
    """
    if seed != study.seeds[0]:
        return Measured({}, {})
    layouts = list(HIDDEN)[: study.number(len(HIDDEN))]
    trainings = study.number(TRAININGS)
    trained = {
        name: [_trained(study, seed, HIDDEN[name], training) for training in range(trainings)]
        for name in layouts
    }
    layers = {name: _summary(rows) for name, rows in trained.items()}
    return Measured({'layers': layers, 'trainings': trainings}, {'layers': trained})


def _summary(rows: list[dict[str, Any]]) -> dict[str, float | None]:
    """Return the mean of each number over the trainings, and the range of the errors.

    Each row holds the numbers of one training. Means, minima and maxima are None if every training
    lacks the number. `learned` counts the trainings in which checkpoint validation accepted the
    initial network; only these networks learned online.
    """
    learned = [row for row in rows if row['after_rad'] is not None]
    summary: dict[str, float | None] = {'learned': len(learned)}
    for key in rows[0]:
        known = [row[key] for row in rows if row[key] is not None]
        summary[key] = float(np.mean(known)) if known else None
        if key in ERRORS:
            summary[key.replace('_rad', '_min_rad')] = min(known, default=None)
            summary[key.replace('_rad', '_max_rad')] = max(known, default=None)
    return summary


def _trained(study: Study, seed: int, hidden: tuple[int, ...], training: int) -> dict[str, Any]:
    """Return the numbers of one training, from its file if an interrupted run has saved them.

    `seed` selects the individual, `hidden` has the sizes of the hidden layers, and `training` is
    the seed of the initial training.
    """
    part = f'layers_{seed}_{"_".join(map(str, hidden))}_{training}'
    numbers: dict[str, Any] = study.remember(part, partial(_learn, study, seed, hidden, training))
    return numbers


def _learn(study: Study, seed: int, hidden: tuple[int, ...], training: int) -> dict[str, Any]:
    robot, preset = study.robot, PaperPreset(hidden)
    steps = QUICK_STEPS if study.quick else preset.initial_steps(robot)
    network = preset.train_initial(robot, training, steps, None)
    initial = completed(robot, network, PAPER_PRESET, training, steps)
    test = preset.training_states(robot, TEST_STATES, np.random.default_rng([0, 2]))
    norms = np.reshape([error.norm for error in pair_errors(initial, test)], (len(Mask), -1))
    keys = [f'model_{name}_{unit}'.lower() for name, unit, _ in OUTPUTS]
    numbers = dict(zip(keys, norms.mean(axis=0).tolist(), strict=True))
    held_out = study.stream(seed, 'held_out')
    numbers['before_rad'] = estimation_error(initial, held_out)
    try:
        CheckpointValidator(robot).check(initial)
    except GateError:  # the estimator would reject the initial network as too inaccurate
        return numbers | {'after_rad': None}
    learner = Learner(robot, initial, PAPER_PRESET, training)
    teach(learner, zip(*study.stream(seed, 'exploring'), strict=True))
    numbers['after_rad'] = estimation_error(learner.mae, held_out)
    return numbers


def layers(_: Study, rows: Rows) -> Plot:
    """Draw the errors of each choice of hidden layers, before and after online learning."""
    seed, row = first_individual(rows)
    trained = row.traces['layers']
    groups = {
        f'{when} learning': (
            colour,
            np.array([[row[f'{when}_rad'] for row in rows] for rows in trained.values()], float).T,
        )
        for when, colour in plots.WHEN.items()
    }
    figure, (panel,) = plots.new_figure(9.0, 0.62 * len(trained) + 1.3)
    title = f'individual {seed}, preset {PAPER_PRESET} with other hidden layers of the encoder'
    plots.bars(panel, list(trained), groups, 'mean error [rad], held-out motion', title)
    count = row.numbers['trainings']
    return figure, (
        'Error of the estimate on the held-out motion with other hidden layers of the encoder, '
        f'mean of {count} trainings, and a dot for each. In brackets: the number of trainings '
        'whose network passed checkpoint validation, and with which learning started.'
    )


EXPERIMENT = Experiment(__doc__, measure, (layers,), 24.0)
