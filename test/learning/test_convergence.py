# SPDX-License-Identifier: Apache-2.0
"""The number of updates of a recording: as many as the network needs to represent the body."""

import pytest

from learning.conftest import Stage, drawn_body, job
from musculoskeletal_ae.learning import recordings
from musculoskeletal_ae.learning.convergence import (
    LEAST_UPDATES,
    MOST_UPDATES,
    is_reached,
    model_error,
)
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.recordings import learn_table
from musculoskeletal_ae.tables.table import Table


def updates(errors):
    """Return the number of updates until the errors, of which the last one repeats, converge."""
    model_errors = list[float]()
    while not is_reached(model_errors):
        model_errors.append(errors[min(len(model_errors), len(errors) - 1)])
    return len(model_errors)


def test_updates_go_on_while_the_error_falls():
    assert updates([0.1 * 0.99**n for n in range(20)]) > 20


def test_updates_end_at_a_maximum_although_the_error_falls():
    assert updates([0.9**n for n in range(100)]) == MOST_UPDATES


@pytest.mark.parametrize('errors', [[0.01], [0.01, 0.02], [float('nan')]])
def test_without_a_falling_error_the_least_number_of_updates_is_made(errors):
    assert updates(errors) == LEAST_UPDATES


def test_the_error_of_a_network_that_has_learned_the_body_is_smaller(learned, initial):
    _, updater, store, _ = learned
    update = updater.update(job(store))
    before = model_error(update._replace(mae=initial), updater.body)
    assert model_error(update, updater.body) < 0.5 * before


def test_a_table_of_rests_is_learned_until_the_network_has_converged(arm26, initial, monkeypatch):
    monkeypatch.setattr(recordings, 'STEPS', 20)  # fewer steps in each update
    theta, tension, length = Stage(drawn_body(arm26, 7, 3, 0.7)).states(20)
    learner = Learner(arm26, initial)
    assert learn_table(learner, Table.of(arm26, theta, length, tension)) == ''
    assert LEAST_UPDATES <= learner.updates <= MOST_UPDATES


def test_a_table_with_too_few_postures_causes_no_update(arm26, initial):
    theta, tension, length = Stage(drawn_body(arm26, 7, 3, 0.7)).states(1)
    learner = Learner(arm26, initial)
    assert 'learns from at least 2' in learn_table(learner, Table.of(arm26, theta, length, tension))
    assert learner.updates == 0
