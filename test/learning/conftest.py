# SPDX-License-Identifier: Apache-2.0
"""One small arm, one network trained for a second, and bodies that differ from the model."""

from __future__ import annotations

import numpy as np
import pytest

from musculoskeletal_ae.learning.body import CorrectedBody
from musculoskeletal_ae.learning.body_fit import Prior
from musculoskeletal_ae.learning.sample import Sample
from musculoskeletal_ae.learning.store import SampleStore
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.robot.robot import Robot


@pytest.fixture(scope='session')
def arm26() -> Robot:
    return Robot.load('arm26')


@pytest.fixture(scope='session')
def initial(arm26):
    """Return a network of the geometric model, trained for a moment."""
    return initial_mae(arm26, 'default', steps=300).mae


@pytest.fixture(scope='session')
def other_body(arm26) -> CorrectedBody:
    """Return a body drawn from the prior, wrapping and all."""
    body, rng = CorrectedBody(arm26, seed=7), np.random.default_rng(3)
    for m, layout in enumerate(body.layouts):
        spread = Prior().spread(layout)
        body.parameters[m] = Prior().mean(layout) + 0.7 * spread * rng.standard_normal(layout.size)
    return body


class Stage:
    """Gives samples of a body at rest."""

    def __init__(self, body: CorrectedBody, seed: int = 0) -> None:
        self.body, self.rng = body, np.random.default_rng(seed)

    def sample(self) -> Sample:
        robot = self.body.robot
        theta = robot.random_postures(1, self.rng)
        tension = self.rng.uniform(30.0, 200.0, (1, robot.muscle_count))
        sliding = self.rng.choice([-1.0, 1.0], (1, robot.muscle_count))
        (length,) = self.body.lengths(theta, tension, sliding)
        noise = 1e-4 * self.rng.standard_normal(robot.muscle_count)
        return Sample(theta[0], tension[0], length[0] + noise, sliding[0])

    def store(self, count: int) -> SampleStore:
        store = SampleStore()
        for _ in range(count):
            store.add(self.sample())
        return store

    def states(self, count: int):
        """Return θ, T, l without friction."""
        robot = self.body.robot
        theta = robot.random_postures(count, self.rng)
        tension = self.rng.uniform(30.0, 200.0, (count, robot.muscle_count))
        (length,) = self.body.lengths(theta, tension, np.zeros_like(tension))
        return theta, tension, length


@pytest.fixture
def stage(other_body) -> Stage:
    return Stage(other_body)
