# SPDX-License-Identifier: Apache-2.0
"""Windings' temperatures are learned from the housings', and limit what muscles may pull."""

from __future__ import annotations

import numpy as np
import pytest

from musculoskeletal_ae.control.heat import HELD, LEARNED, MOMENT, RATIO, Heat, flow
from musculoskeletal_ae.emulator import modules
from musculoskeletal_ae.robot.robot import Robot

ROBOT = Robot.load('arm26')
COUNT, TENSION = ROBOT.muscle_count, ROBOT.tension
HIGHEST = 85.0


class Motors:
    """Two-resistor motors, each with constants of its own, that pull as they are told."""

    def __init__(self, seed=0, hold=10):
        self.rng, self.hold = np.random.default_rng(seed), hold
        factors = np.exp(self.rng.normal(0.0, modules.HEAT_SPREAD, (5, COUNT)))
        mean = (
            modules.LOSS / TENSION.limit[0] ** 2, modules.WINDING_CAPACITY,
            modules.HOUSING_CAPACITY, modules.WINDING_RESISTANCE, modules.HOUSING_RESISTANCE,
        )  # fmt: skip
        self.constants = np.array(mean)[:, None] * factors
        self.winding, self.housing = np.full((2, COUNT), modules.AMBIENT)
        self.heat = Heat(ROBOT)
        self.errors = []

    def run(self, seconds, tension=None):
        """Let time pass with given tensions [N], or random ones."""
        loss, inner, outer, thin, thick = self.constants
        for n in range(round(seconds)):
            if tension is None and n % self.hold == 0:
                pulled = self.rng.uniform(TENSION.bias, TENSION.limit)
            elif tension is not None:
                pulled = tension() if callable(tension) else tension
            for _ in range(4):
                through = (self.winding - self.housing) / thin
                self.winding = self.winding + 0.25 * (loss * pulled**2 - through) / inner
                lost = (self.housing - modules.AMBIENT) / thick
                self.housing = self.housing + 0.25 * (through - lost) / outer
            read = self.housing + self.rng.normal(0.0, 0.1, COUNT)
            self.heat.step(pulled, read, 1.0)
            self.errors.append(self.heat.core - self.winding)
        return np.abs(self.errors[-round(seconds) :])


def test_a_step_is_that_of_the_two_resistors_whatever_its_length():
    state = Heat(ROBOT)._state
    state[0], state[1] = 10.0, 50.0
    kappa, tau, slow = np.exp(state[2:5])
    share = tau / (slow * RATIO)
    winding, housing = 60.0, 50.0
    for _ in range(30_000):
        through = (winding - housing) / tau
        winding = winding + 1e-3 * (kappa * 150.0**2 / share - through)
        housing = housing + 1e-3 * (share * through - (housing - state[5]) / slow)
    for _ in range(6):
        state = flow(state, np.full(COUNT, 150.0**2), 5.0)
    np.testing.assert_allclose(state[1], housing, atol=0.2)
    np.testing.assert_allclose(state[0] + state[1], winding, atol=0.3)


@pytest.mark.parametrize('seed', range(3))
def test_after_twenty_minutes_the_winding_is_known(seed):
    motors = Motors(seed)
    first = motors.run(300)
    motors.run(900)
    last = motors.run(300)
    assert last.mean() < 4.0
    assert last.mean() < first.mean()
    assert last.mean() < 0.5 * (motors.winding - motors.housing).mean()  # what the housing is off
    assert motors.heat.changed == {}


def test_what_is_held_at_the_limit_reaches_the_highest_temperature_and_no_more():
    motors = Motors()
    motors.run(1200)
    held = motors.run(1800, lambda: motors.heat.limits(HIGHEST)[0])
    limit = motors.heat.limits(HIGHEST)[0]
    assert (limit < TENSION.limit).any()
    hot = limit < TENSION.max
    assert (motors.heat.core <= HIGHEST + 0.5).all()
    assert (motors.heat.core > HIGHEST - 10.0)[hot].all()
    assert (motors.winding < HIGHEST + held[-1] + 0.5).all()
    # Another pulls for it meanwhile, and it may pull again.
    motors.run(300, TENSION.bias)
    assert (motors.heat.limits(HIGHEST)[0] > limit)[hot].all()


def test_cool_muscles_are_not_limited_and_a_moment_allows_more_than_long():
    motors = Motors()
    motors.run(10, TENSION.bias)
    long, moment = motors.heat.limits(HIGHEST)
    assert (long >= TENSION.limit).all()
    np.testing.assert_array_equal(moment, TENSION.max)
    assert HELD > MOMENT
    hot, at_once = motors.heat.limits(45.0)
    assert (hot < at_once).all()
    np.testing.assert_array_equal(motors.heat.limits(20.0)[0], TENSION.bias)


@pytest.mark.parametrize('constant', [0, 4])  # its loss, its housing's resistance
def test_a_module_that_changes_is_named_and_no_other(constant):
    motors = Motors(1)
    motors.run(1.2 * LEARNED)
    assert motors.heat.changed == {}
    motors.constants[constant, 2] *= 2.2
    motors.run(600)
    assert set(motors.heat.changed) == {2}


def test_hours_of_health_change_no_constant():
    motors = Motors(5, hold=60)
    motors.run(3600)
    motors.run(1800, TENSION.bias)
    motors.run(3600)
    assert motors.heat.changed == {}


def test_an_unknown_temperature_limits_nothing_and_comes_back():
    heat, pull = Heat(ROBOT), TENSION.limit
    known = np.full(COUNT, 84.9)
    unknown = np.where(np.arange(COUNT) == 1, -np.inf, known)
    for read in (known, unknown, known, np.full(COUNT, np.nan)):
        heat.step(pull, read, 0.01)
        np.testing.assert_array_equal(np.isfinite(heat.core), np.isfinite(read))
        free = heat.limits(HIGHEST)[0] == TENSION.max
        np.testing.assert_array_equal(free, ~np.isfinite(read))
