# SPDX-License-Identifier: Apache-2.0
"""Bodies that differ from the model, their samples, and a network that has learned one."""

import copy

import numpy as np
import pytest

from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.body_model.observations import Observations, Sample
from musculoskeletal_ae.body_model.priors import PRIOR
from musculoskeletal_ae.body_model.remainder import Remainder
from musculoskeletal_ae.learning.body_updater import BodyUpdater
from musculoskeletal_ae.learning.detector_calibration import Healthy
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.learning.scheduler import Job
from musculoskeletal_ae.robot.model_errors import attachment_spread
from musculoskeletal_ae.robot.robot import Robot


@pytest.fixture(scope='session')
def arm26() -> Robot:
    return Robot.load('arm26')


@pytest.fixture(scope='session')
def initial(trained):
    """Return a briefly trained network of the geometric model."""
    return trained['default']


class Wrapping(Remainder):
    """Smooth length errors of each muscle that depend on the joints that it crosses.

    They stand for tendons that wrap round bones.
    """

    def __init__(self, robot, scale: float, seed: int) -> None:
        super().__init__(robot.muscle_count)
        rng, waves = np.random.default_rng([seed, 0xF0]), 60
        shape = robot.muscle_count, waves, robot.joint_count
        crossed = robot.routes.crossed[:, None] / (0.35 * (robot.upper - robot.lower))
        values = {
            'frequency': rng.standard_normal(shape) * crossed,
            'phase': rng.uniform(0.0, 2.0 * np.pi, shape[:2]),
            'size': scale * 0.002 * np.sqrt(2.0 / waves) * rng.standard_normal(shape[:2]),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def at(self, theta, tension):  # noqa: ARG002 (lengths do not depend on tensions here)
        angles = np.einsum('mkd,nd->nmk', self.frequency, theta) + self.phase
        return ((np.cos(angles) - np.cos(self.phase)) * self.size).sum(axis=2)


def drawn_body(robot, wrapping: int, seed: int, scale: float) -> CalibratedBody:
    """Return a body drawn from the prior, with wrapping but without creep."""
    body, rng = CalibratedBody(robot), np.random.default_rng(seed)
    body.remainder = Wrapping(robot, scale, wrapping)
    spreads = attachment_spread(robot).tolist()
    for m, layout in enumerate(body.layouts):
        draw = np.insert(rng.standard_normal(layout.size - 1), layout.creep, 0.0)
        body.parameters[m] = PRIOR.mean(layout) + scale * PRIOR.spread(layout, spreads[m]) * draw
    return body


@pytest.fixture(scope='session')
def other_body(arm26) -> CalibratedBody:
    return drawn_body(arm26, 7, 3, 0.7)


class Stage:
    """Generates samples of a body at rest."""

    def __init__(self, body: CalibratedBody, seed: int = 0) -> None:
        self.body, self.rng = body, np.random.default_rng(seed)

    def observations(self, count: int) -> Observations:
        robot = self.body.robot
        theta = robot.random_postures(count, self.rng)
        tension = self.rng.uniform(30.0, 200.0, (count, robot.muscle_count))
        direction = self.rng.choice([-1.0, 1.0], tension.shape)
        (length,) = self.body.lengths(theta, tension, direction)
        length = length + 1e-4 * self.rng.standard_normal(length.shape)
        return Observations(theta, tension, length, direction, np.ones(length.shape, dtype=bool))

    def sample(self) -> Sample:
        drawn = self.observations(1)
        return Sample(drawn.theta[0], drawn.tension[0], drawn.length[0], drawn.direction[0])

    def store(self, count: int) -> SampleStore:
        store = SampleStore()
        for _ in range(count):
            store.add(self.sample())
        return store

    def states(self, count: int):
        """Return θ (N, D), T (N, M) and l (N, M) of random rests, without friction."""
        robot = self.body.robot
        theta = robot.random_postures(count, self.rng)
        tension = self.rng.uniform(30.0, 200.0, (count, robot.muscle_count))
        (length,) = self.body.lengths(theta, tension, np.zeros_like(tension))
        return theta, tension, length

    def messages(self, count: int):
        """Return `count` messages as rows (T, l, s), with friction direction s = 0."""
        _, tension, length = self.states(count)
        return np.concatenate([tension, length, np.zeros_like(length)], axis=1).astype(np.float32)


@pytest.fixture
def stage(other_body) -> Stage:
    return Stage(other_body)


def job(store, messages=None, time=0.0, steps=60, hold=True, rests=100, **parts):
    empty = np.empty((0, 18), dtype=np.float32)
    healthy = Healthy(empty if messages is None else messages, time, rests, **parts)
    return Job(store.observations(), healthy, hold, steps)


@pytest.fixture(scope='session')
def learned_once(arm26, initial, other_body):
    stage = Stage(other_body)
    updater = BodyUpdater(arm26, initial)
    store = stage.store(20)
    for _ in range(3):
        update = updater.update(job(store))
    return update.mae, updater, store, stage


@pytest.fixture
def learned(learned_once):
    """Return a network that has learned from 20 samples.

    Its updater, the store of the samples, and the stage that generated them are returned as well.
    """
    return copy.deepcopy(learned_once)
