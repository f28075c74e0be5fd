# SPDX-License-Identifier: Apache-2.0
"""Winding temperatures are estimated from those of the housings, and limit the tensions."""

import numpy as np
import pytest
from numba import njit
from readings import reading

from musculoskeletal_ae.emulator import modules
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.heat import AIR, HELD, LEARNED, MOMENT, RATIO, Heat, flow, soon

ROBOT = Robot.load('arm26')
COUNT, TENSION = ROBOT.muscle_count, ROBOT.tension
HIGHEST = 85.0
POSTURE = 0.5 * (ROBOT.lower + ROBOT.upper)


@njit(cache=True)
def warm(wound, muscle, command, steps):
    for _ in range(steps):
        for m in range(len(muscle.tension)):
            modules.heat(wound, muscle, command, m)


class Motors:
    """The motors of an emulated arm, and the thermal model that estimates their temperatures."""

    def __init__(self, seed=0, hold=10, most=TENSION.limit, period=2.0):
        """Create the motors.

        Args:
            seed: Random seed of the motors' constants and of the tensions.
            hold: Time for which a random tension is held [s].
            most: Highest random tensions [N], (M,).
            period: Time between two readings [s].
        """
        self.rng, self.hold, self.most = np.random.default_rng(seed), hold, most
        self.period = period
        self.arm = EmulatedArm(ROBOT)
        factors = np.exp(self.rng.normal(0.0, modules.HEAT_SPREAD, (5, COUNT)))
        mean = (
            modules.LOSS / TENSION.limit[0] ** 2, modules.WINDING_CAPACITY,
            modules.HOUSING_CAPACITY, modules.WINDING_RESISTANCE, modules.HOUSING_RESISTANCE,
        )  # fmt: skip
        own = dict(zip(modules.Modules._fields[-5:], np.array(mean)[:, None] * factors))
        self.wound = self.arm._module_constants._replace(**own)
        self.heat = Heat(ROBOT)
        self.errors, self.pulled, self.read = [], TENSION.bias, None

    def run(self, seconds, tension=None):
        """Advance the time [s] with the tensions `tension` [N], or with random ones."""
        arm = self.arm
        count = round(seconds / self.period)
        for n in range(count):
            if tension is None and n % round(self.hold / self.period) == 0:
                self.pulled = self.rng.uniform(TENSION.bias, self.most)
            elif tension is not None:
                self.pulled = tension() if callable(tension) else tension
            arm._muscle.tension[:] = self.pulled
            warm(self.wound, arm._muscle, arm._command, round(self.period / modules.STEP))
            self.read = arm._muscle.housing + self.rng.normal(0.0, 0.1, COUNT)
            self.hand_on()
            self.errors.append(self.heat.core - arm.winding)
        return np.abs(self.errors[-count:])

    def hand_on(self):
        """Advance the thermal model by one period with the present readings."""
        self.heat.step(self.pulled, self.read, self.period)


class ObservedMotors(Motors):
    """Motors whose readings are passed to an estimator, which contains the thermal model."""

    def __init__(self, mae, **options):
        super().__init__(period=1.0, **options)
        self.core, self.now = Estimator(ROBOT), 0.0
        self.core.use(mae)
        self.heat = self.core.health.heat
        #: whether readings go to the thermal model alone, without the estimator, which is slower;
        #: this suffices while the model learns the constants of the modules
        self.is_learning = True

    def hand_on(self):
        if self.is_learning:
            super().hand_on()
            return
        length = ROBOT.muscle_lengths(POSTURE, self.pulled)
        self.now += self.period
        self.core.take(reading([length, self.pulled, self.read]), self.now, self.now)

    def learn(self):
        """Let the thermal model learn the constants of all modules."""
        self.run(1.2 * LEARNED - 30.0)
        self.is_learning = False
        self.run(30.0)

    def run_until_changed(self):
        """Continue until the thermal model has found a changed module, for 600 s at most."""
        for _ in range(20):
            if not self.heat.changed:
                self.run(30.0)


def test_a_step_of_any_length_solves_the_thermal_model():
    state = Heat(ROBOT)._state
    state[0], state[1] = 10.0, 50.0
    kappa, tau, slow = np.exp(state[2:5])
    share = tau / (slow * RATIO)
    winding, housing = 60.0, 50.0
    for _ in range(3000):
        through = (winding - housing) / tau
        winding = winding + 1e-2 * (kappa * 150.0**2 / share - through)
        housing = housing + 1e-2 * (share * through - (housing - state[5]) / slow)
    for _ in range(6):
        state = flow(state, np.full(COUNT, 150.0**2), 5.0)
    np.testing.assert_allclose(state[1], housing, atol=0.2)
    np.testing.assert_allclose(state[0] + state[1], winding, atol=0.3)


@pytest.mark.parametrize(
    'seed', [0, *(pytest.param(seed, marks=pytest.mark.thorough) for seed in (1, 2))]
)
def test_the_winding_temperature_is_estimated_after_twenty_minutes(seed):
    motors = Motors(seed)
    first = motors.run(300)
    motors.run(900)
    last = motors.run(300)
    assert last.mean() < 4.0
    assert last.mean() < first.mean()
    through = motors.arm.winding - motors.arm._muscle.housing
    # The error must be much smaller than if the housing's temperature were taken for the winding's.
    assert last.mean() < 0.5 * through.mean()
    assert motors.heat.changed == {}


def test_a_muscle_held_at_its_limit_reaches_the_highest_temperature_and_no_more():
    motors = Motors()
    motors.run(1200)
    held = motors.run(1800, lambda: motors.heat.limits(HIGHEST)[0])
    limit = motors.heat.limits(HIGHEST)[0]
    assert (limit < TENSION.limit).any()
    hot = limit < TENSION.max
    assert (motors.heat.core <= HIGHEST + 0.5).all()
    assert (motors.heat.core > HIGHEST - 10.0)[hot].all()
    assert (motors.arm.winding < HIGHEST + held[-1] + 0.5).all()
    # While the muscles rest at T_bias, their motors cool, and their limits rise again.
    motors.run(300, TENSION.bias)
    assert (motors.heat.limits(HIGHEST)[0] > limit)[hot].all()


def test_the_predicted_rest_is_as_long_as_the_motors_need():
    motors = Motors()
    motors.run(1500.0)
    motors.run(300.0, TENSION.limit)
    highest = float(motors.heat.core.max()) - 8.0
    predicted = motors.heat.rest_needed(highest, TENSION.bias)
    hottest = int(motors.heat.core.argmax())
    assert 0.0 < predicted[hottest] < 600.0
    motors.run(predicted[hottest] + 60.0, TENSION.bias)
    assert motors.arm.winding[hottest] < highest + 3.0
    assert motors.heat.rest_needed(highest + 60.0, TENSION.bias)[hottest] == 0.0


@pytest.mark.parametrize(
    ('seconds', 'text'),
    [
        (0.0, 'now'),
        (30.0, 'in about 1 min'),
        (90.0, 'in about 2 min'),
        (np.inf, 'in more than 60 min'),
    ],
)
def test_a_rest_is_stated_in_minutes_and_never_as_shorter_than_it_is(seconds, text):
    assert soon(seconds) == text


def test_cool_muscles_are_not_limited_and_short_pulls_may_be_stronger_than_long_ones():
    motors = Motors()
    motors.run(10, TENSION.bias)
    long, moment = motors.heat.limits(HIGHEST)
    assert (long >= TENSION.limit).all()
    np.testing.assert_array_equal(moment, TENSION.max)
    assert HELD > MOMENT
    hot, at_once = motors.heat.limits(45.0)
    assert (hot < at_once).all()
    np.testing.assert_array_equal(motors.heat.limits(20.0)[0], TENSION.bias)


@pytest.mark.parametrize('constant', ['loss', 'housing_resistance'])
def test_a_module_whose_heat_changes_is_an_anomaly_of_that_muscle_only(trained, constant):
    motors = ObservedMotors(trained['default'], seed=1)
    motors.learn()
    assert motors.heat.changed == {}
    assert motors.core.cause == ''
    getattr(motors.wound, constant)[2] *= 2.2
    motors.run_until_changed()
    assert set(motors.heat.changed) == {2}
    assert motors.core.cause.startswith(f'{ROBOT.muscles[2]}: its module ')
    # Accepting another module does not clear the report of module 2.
    motors.core.health.heat.accept(3)
    assert set(motors.heat.changed) == {2}
    motors.core.reset()  # after a reset, the present state of all modules counts as healthy
    motors.run(60)
    assert motors.core.cause == ''


def test_an_anomaly_of_a_cool_muscle_is_reported_without_a_stop(trained):
    motors = ObservedMotors(trained['default'], seed=1, most=0.6 * TENSION.limit)
    motors.learn()
    motors.wound.loss[2] *= 2.2
    motors.run_until_changed()
    assert motors.core.cause == ''
    reported, how = motors.core.report(motors.now), f'{ROBOT.muscles[2]}: its module '
    assert reported.level == 'warn'
    assert f': the module of {ROBOT.muscles[2]} ' in reported.message
    assert reported.values['suspect muscle'] == ROBOT.muscles[2]
    motors.run(120, TENSION.limit)
    assert motors.core.cause.startswith(how)


def test_hours_of_healthy_work_are_no_anomaly():
    motors = Motors(5, hold=60, period=4.0)
    motors.run(3600)
    motors.run(1800, TENSION.bias)
    motors.run(3600)
    assert motors.heat.changed == {}


@pytest.mark.parametrize('most', [pytest.param(1.0, marks=pytest.mark.thorough), 1.3])
def test_a_gap_of_a_minute_in_the_messages_is_no_anomaly(most):
    motors = Motors(3, most=most * TENSION.limit)
    motors.run(1500)
    arm = motors.arm
    arm._muscle.tension[:] = motors.pulled = TENSION.bias
    warm(motors.wound, arm._muscle, arm._command, round(60.0 / modules.STEP))
    motors.heat.step(motors.pulled, arm._muscle.housing, 60.0)
    for _ in range(10):
        motors.run(60)
        assert motors.heat.changed == {}


def test_an_unknown_temperature_limits_no_tension_until_it_is_known():
    heat, pull = Heat(ROBOT), TENSION.limit
    known = np.full(COUNT, 84.9)
    unknown = np.where(np.arange(COUNT) == 1, -np.inf, known)
    for read in (known, unknown, known, np.full(COUNT, np.nan)):
        heat.step(pull, read, 0.01)
        np.testing.assert_array_equal(np.isfinite(heat.core), np.isfinite(read))
        free = heat.limits(HIGHEST)[0] == TENSION.max
        np.testing.assert_array_equal(free, ~np.isfinite(read))


def test_an_intermittent_thermometer_does_not_disturb_the_other_muscles():
    sound, flaky = Motors(seed=3), Motors(seed=3)
    read = np.full((2, COUNT), AIR + 5.0)
    for n in range(1200):
        for heat, lost in ((sound.heat, False), (flaky.heat, n % 2 == 0)):
            here = np.where((np.arange(COUNT) == 1) & lost, np.nan, read[0] + 0.02 * n)
            heat.step(1.2 * TENSION.limit, here, 0.25)
    others = np.arange(COUNT) != 1
    np.testing.assert_allclose(flaky.heat.core[others], sound.heat.core[others], atol=0.1)
    for known, observed in zip(sound.heat.limits(HIGHEST), flaky.heat.limits(HIGHEST), strict=True):
        np.testing.assert_allclose(observed[others], known[others], atol=0.5)
    # The winding temperature of the muscle with the intermittent thermometer is still estimated.
    flaky.heat.step(TENSION.limit, read[0] + 24.0, 0.25)
    assert flaky.heat.core[1] > AIR + 40.0


def test_a_changed_module_is_accepted_by_a_reset_of_the_estimator(trained):
    motors = ObservedMotors(trained['default'], seed=1, most=0.6 * TENSION.limit)
    motors.learn()
    motors.wound.loss[2] *= 2.2
    motors.run_until_changed()
    present = [each.identifier for each in motors.core.conditions(motors.now)]
    assert 'module_changed' in present or 'thermal_drift' in present
    motors.core.reset()
    motors.run(60.0)
    assert motors.core.report(motors.now).level == 'ok'
