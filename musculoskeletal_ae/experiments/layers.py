# SPDX-License-Identifier: Apache-2.0
"""Number of layers and units.

Paper (§III-A). The encoder has hidden layers of 200 and 30 units. The number of layers hardly
affects the accuracy, but fewer units lower it.

Here. Networks of preset `paper` with other hidden layers are trained on the geometric model, and
then learn from the messages of the default preset’s exploration of one individual. Only the first
individual is measured. A network does not learn if checkpoint validation rejects it, because its
initial training was too inaccurate.

- model: mean error of θ, T and l after initial training, on states of the geometric model that were
  not used for training
- before, after: error of the estimate on the held-out motion, before and after online learning
- trainings: number of random seeds over which the errors are means
"""

from functools import partial
from typing import Any

import numpy as np

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
from musculoskeletal_ae.mae.training import OUTPUTS, completed, pair_errors
from musculoskeletal_ae.mae.units import Mask
from musculoskeletal_ae.presets.paper import PaperPreset
from musculoskeletal_ae.presets.registry import PAPER_PRESET

#: units of the encoder's hidden layers. The decoder has the reverse, the latent layer D + M units.
HIDDEN = {
    'as in the paper: 200, 30': (200, 30),
    'fewer layers: 200': (200,),
    'more layers: 200, 100, 30': (200, 100, 30),
    'fewer units: 100, 30': (100, 30),
    'fewer units: 50, 20': (50, 20),
    'fewer units: 20, 10': (20, 10),
}
TRAININGS = 1  # random seeds
QUICK_STEPS = 600  # number of steps of a shortened initial training


def measure(study: Study, seed: int) -> Measured:
    """Return the results of the first individual; nothing for the others."""
    if seed != study.seeds[0]:
        return Measured({}, {})
    layouts = [name for name in HIDDEN if not study.quick or name in list(HIDDEN)[:2]]
    trainings = range(TRAININGS)
    every = {
        name: [
            study.remember(
                f'layers_{seed}_{"_".join(map(str, HIDDEN[name]))}_{training}',
                partial(_learn, study, seed, HIDDEN[name], training),
            )
            for training in trainings
        ]
        for name in layouts
    }
    layers = dict[str, Any]()
    for name, repeated in every.items():
        after = [row.pop('after_rad') for row in repeated]
        layers[name] = {key: float(np.mean([row[key] for row in repeated])) for key in repeated[0]}
        known = [error for error in after if error is not None]
        values = (float(np.mean(known)), min(known), max(known)) if known else (None,) * 3
        layers[name] |= dict(zip(('after_rad', 'after_min_rad', 'after_max_rad'), values))
    return Measured({'layers': layers, 'trainings': len(trainings)}, {'layers': layers})


def _learn(study: Study, seed: int, hidden: tuple[int, ...], training: int) -> dict[str, Any]:
    robot, preset = study.robot, PaperPreset(hidden)
    steps = QUICK_STEPS if study.quick else preset.initial_steps(robot.groups)
    network = preset.train_initial(robot, training, steps, None)
    initial = completed(robot, network, PAPER_PRESET, training).mae
    test = preset.training_states(robot, TEST_STATES, np.random.default_rng([0, 2]))
    norms = np.reshape([error.norm for error in pair_errors(initial, test)], (len(Mask), -1))
    keys = [f'model_{name}_{unit}'.lower() for name, unit, _ in OUTPUTS]
    numbers = dict(zip(keys, norms.mean(axis=0).tolist(), strict=True))
    held_out = study.stream(seed, 'held_out')
    numbers['before_rad'] = estimation_error(initial, held_out)
    try:
        learner = Learner(robot, initial, PAPER_PRESET, training)
    except GateError:  # checkpoint validation rejects a network that is this inaccurate
        return numbers | {'after_rad': None}
    teach(learner, zip(*study.stream(seed, 'exploring'), strict=True))
    numbers['after_rad'] = estimation_error(learner.mae, held_out)
    return numbers


def layers(_: Study, rows: Rows) -> Plot:
    """Draw the error of each layout before and after online learning."""
    seed, row = first_individual(rows)
    results = row.traces['layers']
    groups = {
        f'{when} learning': (
            colour,
            np.array([[each[f'{when}_rad'] for each in results.values()]], dtype=float),
        )
        for when, colour in plots.WHEN.items()
    }
    figure, (panel,) = plots.new_figure(9.0, 0.62 * len(results) + 1.3)
    title = f'individual {seed}, preset {PAPER_PRESET} with other hidden layers of the encoder'
    plots.bars(panel, list(results), groups, 'mean error [rad], held-out motion', title)
    count = row.numbers['trainings']
    repeated = 'one training each' if count == 1 else f'means over {count} trainings'
    return figure, (
        'Error of the estimate on the held-out motion with other hidden layers of the encoder, '
        f'{repeated}.'
    )


EXPERIMENT = Experiment(__doc__, measure, (layers,), 8.0)
