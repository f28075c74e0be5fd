# SPDX-License-Identifier: Apache-2.0
"""External forces are exact with an exact network, and without a force there is no contact."""

from dataclasses import replace

import numpy as np
import pytest
from exact_mae import ExactMae
from readings import reading

from musculoskeletal_ae.estimation.contact import ContactEstimator
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.estimation.healthy_torque import HealthyTorque
from musculoskeletal_ae.mae.residuals import LEAST_MOTION, LEAST_PEAKS, TouchStatistics, rare_peak
from musculoskeletal_ae.robot.joint_elasticity import JointElasticity
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import TensionProgramme
from musculoskeletal_ae.signals.friction import FrictionDirection, Transmission

ARM = Robot.load('musashi_left_arm')
THETA = np.array([0.1, -0.4, 0.2, -1.0, 0.1])
DT = 0.01
SPREAD = np.full(5, 0.2)
PEAKS = 4.0 + np.tile([-0.8, -0.3, 0.0, 0.5, 1.4], 6)  # the threshold is then 9.1


def observer(spread=SPREAD, time=LEAST_MOTION, robot=ARM):
    mae = ExactMae(robot)
    mae.touch = TouchStatistics(mae.friction, spread, time, peaks=PEAKS)
    result = ContactEstimator(robot)
    result.use(mae)
    return result


def pulling(theta, force=(0.0, 0.0, 0.0), robot=ARM):
    """Return T [N] and l [m] of the arm at rest at θ, with a force on its hand [N]."""
    kin = robot.kinematics
    torque = kin.holding_torque(theta) - kin.end_effector_jacobian(theta)[:3].T @ np.array(force)
    jacobian = ExactMae(robot).muscle_jacobian(theta, np.full(robot.muscle_count, 60.0))
    tension = TensionProgramme(jacobian, torque, 10.0, 400.0).nearest(60.0)
    return tension, robot.muscle_lengths(theta, tension)


def states(tension, length):
    return np.array([length, tension, np.full(len(length), 25.0)])


def felt(core, theta, tension):
    for _ in range(100):
        contact = core.step(theta, tension, DT)
    return contact


@pytest.mark.parametrize('axis', range(3))
@pytest.mark.parametrize('size', [-20.0, 20.0])
def test_a_force_on_the_hand_is_estimated_in_every_direction(axis, size):
    force = size * np.eye(3)[axis]
    core = observer()
    contact = felt(core, THETA, pulling(THETA, force)[0])
    np.testing.assert_allclose(contact.force(), force, atol=1.0)
    assert contact.is_contact


def test_a_free_arm_has_no_external_force_and_no_contact():
    contact = felt(observer(), THETA, pulling(THETA)[0])
    np.testing.assert_allclose(contact.torque, 0.0, atol=0.02)
    np.testing.assert_allclose(contact.force(), 0.0, atol=0.2)
    assert not contact.is_contact


def test_a_planar_arm_estimates_no_force_across_its_plane(robot):
    theta = 0.5 * (robot.lower + robot.upper)
    core = observer(spread=np.full(2, 0.2), robot=robot)
    contact = felt(core, theta, pulling(theta, (5.0, 0.0, -5.0), robot)[0])
    np.testing.assert_allclose(contact.force(), [5.0, 0.0, -5.0], atol=0.5)


def test_known_tendon_friction_is_not_taken_for_a_force():
    tension, length = pulling(THETA)
    # Every tendon is wound in, so the direction of sliding s is 1.
    wound = length + np.linspace(0.01, 0.0, 50)[:, None]
    errors = []
    for friction in (0.0, 0.1):
        core, sliding = observer(), FrictionDirection()
        for row in (*wound, *[length] * 100):
            end = sliding.end_tension(
                Transmission(np.full(10, friction)), tension * np.exp(0.1), row
            )
            contact = core.step(THETA, end, DT)
        errors.append(np.abs(contact.torque).max())
    assert errors[1] < 0.05 < 0.2 < errors[0]


def test_inertia_is_not_taken_for_a_force():
    """The muscles of a swinging arm exert exactly the torque of inverse dynamics."""
    core, largest, free, rate = observer(), 0.0, 0.0, 3.0
    for n in range(300):
        t = n * DT
        swing = np.array([0.0, 0.2, 0.0, 0.3, 0.0])
        theta = THETA + swing * np.sin(rate * t)
        velocity, turn = swing * rate * np.cos(rate * t), -swing * rate**2 * np.sin(rate * t)
        torque = ARM.kinematics.inverse_dynamics(theta, velocity, turn)
        jacobian = ExactMae(ARM).muscle_jacobian(theta, np.full(10, 60.0))
        tension = TensionProgramme(jacobian, torque, 5.0, 400.0).nearest(60.0)
        contact = core.step(theta, tension, DT)
        if n > 50:
            largest = max(largest, np.abs(contact.torque).max())
            free = max(free, np.abs(torque - ARM.kinematics.holding_torque(theta)).max())
    assert largest < 0.5 * free


def test_the_torque_of_a_joint_at_its_stop_is_unknown():
    tension, _ = pulling(THETA)
    for joint in range(5):
        for stop in (ARM.upper, ARM.lower):
            theta = THETA.copy()
            theta[joint] = stop[joint]
            torque = felt(observer(), theta, tension).torque
            assert torque[joint] == 0.0 and np.count_nonzero(torque) == 4


def test_without_statistics_there_is_a_force_but_no_contact():
    core = observer(time=0.0)
    contact = felt(core, THETA, pulling(THETA, (20.0, 0.0, 0.0))[0])
    assert np.linalg.norm(contact.force()) > 10.0
    assert np.isnan(contact.distance)
    assert not contact.is_contact


@pytest.mark.filterwarnings('ignore:invalid value')
def test_a_message_that_is_not_finite_leaves_no_trace():
    core, (tension, _) = observer(), pulling(THETA, (20.0, 0.0, 0.0))
    contact = core.step(np.full(5, np.nan), tension, DT)
    np.testing.assert_array_equal(contact.force(), 0.0)
    assert not contact.is_contact
    np.testing.assert_allclose(felt(core, THETA, tension).force(), [20.0, 0.0, 0.0], atol=1.0)


def test_motion_during_a_gap_in_the_messages_is_no_contact(robot, mae):
    statistics = TouchStatistics(mae.friction, np.full(2, 0.25), LEAST_MOTION, peaks=PEAKS)
    mae = replace(mae, touch=statistics)
    core, middle, time = Estimator(robot), 0.5 * (robot.lower + robot.upper), 0.0
    core.use(mae)
    for n in range(200):
        time += DT + 0.9 * (n == 100)
        theta = middle + 0.8 * np.sin(1.2 * time)
        acceleration = np.full(2, -1.152 * np.sin(1.2 * time))
        velocity = np.full(2, 0.96 * np.cos(1.2 * time))
        torque = robot.kinematics.inverse_dynamics(theta, velocity, acceleration)
        jacobian = mae.muscle_jacobian(theta, np.full(robot.muscle_count, 60.0))
        tension = TensionProgramme(jacobian, torque, 10.0, 400.0).nearest(60.0)
        contact = core.take(
            reading(states(tension, mae.lengths(theta, tension))), time, time
        ).contact
        assert n < 60 or contact.distance < rare_peak(PEAKS)


@pytest.mark.parametrize('dt', [0.0, 0.002, 0.1])
def test_the_observer_is_stable_at_any_rate(dt):
    core, (tension, _) = observer(), pulling(THETA, (0.0, 20.0, 0.0))
    for _ in range(200):
        contact = core.step(THETA, tension, dt)
    np.testing.assert_allclose(contact.force(), [0.0, 20.0, 0.0], atol=1.0)


def test_healthy_torque_is_measured_in_motion_and_a_touch_hardly_counts(mae):
    unknown = replace(mae, touch=TouchStatistics(np.zeros(10), np.zeros(5), 0.0))
    core, rng = HealthyTorque(ARM), np.random.default_rng(0)

    def move(seconds, push=0.0):
        for _ in range(round(seconds / DT)):
            core.step(rng.normal(push, 2.0, 5), np.full(5, 0.3), np.zeros(5), DT)

    assert core.put_into(mae) is mae  # it has no statistics
    core.step(np.full(5, 9.0), np.zeros(5), np.zeros(5), DT)
    assert core.put_into(unknown).touch.time == 0.0  # only motion counts, and the arm was at rest
    move(LEAST_MOTION + 2.0)
    healthy = core.put_into(unknown).touch
    assert healthy.calibrated
    np.testing.assert_allclose(healthy.spread, 2.0, rtol=0.1)
    move(1.0, push=50.0)
    assert (core.put_into(unknown).touch.spread < 1.5 * healthy.spread).all()


def unmeasured(mae):
    return replace(mae, touch=TouchStatistics(np.zeros(6), np.ones(2), 0.0))


def swing(core, mae, seconds, true=(0.9, 0.3), push=0.0, is_free=True):
    """Move joints with the damping `true`, and return the network with what was measured.

    Every 10 s, the estimate uses the damping measured so far. `push` is a torque along the motion
    [N·m]; if `is_free` is false, the joint is at a stop.
    """
    true, rng, used = np.array(true), np.random.default_rng(0), np.zeros(2)
    for n in range(round(seconds / DT)):
        if n % 1000 == 0 and (damped := core.put_into(mae)).elasticity is not None:
            used = damped.elasticity.damping
        velocity = rng.normal(0.0, 0.2, 2)
        torque = rng.normal(0.0, 0.1, 2) - (true - used) * velocity + push * np.sign(velocity)
        core.step(torque * is_free, velocity, used, DT)
    return core.put_into(mae)


def test_each_arm_has_the_threshold_that_its_healthy_motion_requires(mae):
    """Two kinds of arms differ in how much their largest external torques exceed the usual ones."""
    measured = TouchStatistics(np.zeros(10), SPREAD, LEAST_MOTION)
    known = replace(mae, touch=measured)
    for tail in (1.0, 3.0):
        core, rng = HealthyTorque(ARM), np.random.default_rng(0)
        core.put_into(known)

        def move(seconds, draw, core=core):
            for _ in range(round(seconds / 0.1)):
                core.step(SPREAD, np.full(5, 0.3), np.zeros(5), 0.1, draw())
            return rare_peak(core.put_into(known).touch.peaks)

        def healthy(rng=rng, tail=tail):
            return 1.5 + rng.exponential(0.3 * tail)

        assert move(9.0 * LEAST_PEAKS, healthy) == np.inf
        usual = move(600.0, healthy)
        largest = max(healthy() for _ in range(36_000))  # an hour with ten messages a second
        assert largest < usual < 2.0 * largest
        restarted = HealthyTorque(ARM)
        restarted.put_into(core.put_into(known))
        assert restarted.threshold == core.threshold == usual


def test_pushes_raise_the_threshold_only_if_they_never_end(mae):
    """In the experiment `motion`, pushes at rest made later collisions invisible."""
    known = replace(mae, touch=TouchStatistics(np.zeros(10), SPREAD, LEAST_MOTION))
    core, rng = HealthyTorque(ARM), np.random.default_rng(0)
    core.put_into(known)

    def move(seconds, push=0.0):
        for n in range(round(seconds / 0.1)):
            evidence = max(1.5 + rng.exponential(0.3), push * (n % 50 == 0))
            core.step(SPREAD, np.full(5, 0.3), np.zeros(5), 0.1, evidence)
        return core.threshold

    first = move(61.0)
    usual = move(600.0)
    assert usual < first < np.inf
    assert move(240.0, push=40.0) < 1.2 * usual
    move(20.0)
    assert move(240.0, push=40.0) < 1.2 * usual
    assert move(400.0, push=40.0) > 40.0  # the body has changed
    assert move(400.0) < 1.3 * usual


def test_damping_is_measured_and_kept_in_the_network(robot, mae):
    core = HealthyTorque(robot)
    damped = swing(core, unmeasured(mae), 240.0)
    np.testing.assert_allclose(damped.elasticity.damping, (0.9, 0.3), atol=0.05)
    assert (damped.touch.spread < 0.15).all()
    contact = ContactEstimator(robot)
    contact.use(damped)
    np.testing.assert_array_equal(contact.damping, damped.elasticity.damping)


@pytest.mark.thorough
def test_damping_is_found_even_if_it_exceeds_the_noise_by_far(robot, mae):
    core = HealthyTorque(robot)
    swing(core, unmeasured(mae), 100.0, true=(0.0, 0.0))
    damped = swing(core, unmeasured(mae), 600.0, true=(1.5, 1.0))
    np.testing.assert_allclose(damped.elasticity.damping, (1.5, 1.0), atol=0.2)


def test_damping_lasts_over_a_restart_and_a_push_hardly_changes_it(robot, mae):
    damped = swing(HealthyTorque(robot), unmeasured(mae), 240.0)
    restarted = HealthyTorque(robot)
    restarted.put_into(damped)
    after = swing(restarted, unmeasured(mae), 1.0)
    np.testing.assert_allclose(after.elasticity.damping, (0.9, 0.3), atol=0.1)
    for push in (4.0, -4.0):
        after = swing(restarted, unmeasured(mae), 10.0, push=push)
        np.testing.assert_allclose(after.elasticity.damping, (0.9, 0.3), atol=0.1)


def test_a_joint_at_its_stop_takes_the_residual_torque_of_the_others(robot, mae):
    core = HealthyTorque(robot)
    core.put_into(unmeasured(mae))
    at_stop = swing(core, unmeasured(mae), LEAST_MOTION + 2.0, is_free=np.array([True, False]))
    assert at_stop.touch.calibrated
    assert at_stop.touch.spread[1] == at_stop.touch.spread[0]
    np.testing.assert_array_equal(at_stop.elasticity.damping[1], 0.0)


def test_two_messages_of_the_same_time_leave_a_joint_at_its_stop_unmeasured(robot, mae):
    core = HealthyTorque(robot)
    core.put_into(unmeasured(mae))
    at_stop, velocity = np.array([0.2, 0.0]), np.array([0.3, 0.0])
    for dt in (DT, 0.0, DT):
        core.step(at_stop, velocity, np.zeros(2), dt)
    swing(core, unmeasured(mae), LEAST_MOTION + 2.0)
    touch = core.put_into(unmeasured(mae)).touch
    assert touch.calibrated
    assert np.isfinite(touch.spread).all()


def test_nothing_is_measured_until_the_friction_of_the_tendons_is_known(robot, mae):
    core = HealthyTorque(robot)
    swing(core, replace(mae, touch=None), 100.0, true=(5.0, 5.0))
    damped = swing(core, unmeasured(mae), 100.0)
    np.testing.assert_allclose(damped.elasticity.damping, (0.9, 0.3), atol=0.05)


def test_springs_that_are_stated_later_add_to_a_measured_damping(robot, mae):
    damped = swing(HealthyTorque(robot), unmeasured(mae), 100.0)
    stiffness = np.diag([0.0, 4.0])
    stated = JointElasticity(stiffness, np.array([0.0, -1.2]), np.zeros(2))
    sprung = Robot(replace(robot.description, joint_elasticity=stated))
    used = sprung.with_elasticity(damped.elasticity).kinematics.elasticity
    np.testing.assert_array_equal(used.stiffness, stiffness)
    np.testing.assert_array_equal(used.damping, damped.elasticity.damping)


def test_a_network_is_used_with_the_residual_torque_measured_so_far(robot, mae):
    before = TouchStatistics(np.zeros(6), np.full(2, 0.3), LEAST_MOTION)
    core, middle = Estimator(robot), 0.5 * (robot.lower + robot.upper)
    core.use(replace(mae, touch=before))
    for n in range(300):
        theta = middle + 0.5 * np.sin(2.0 * n * DT)
        tension, length = pulling(theta, robot=robot)
        core.take(reading(states(tension, length)), n * DT, n * DT)
    unmeasured = TouchStatistics(np.zeros(6), np.ones(2))
    touch = core.use(replace(mae, touch=unmeasured)).touch
    assert touch.time > LEAST_MOTION
    assert (touch.spread != before.spread).all()


def test_the_estimator_reports_contacts(robot, mae):
    statistics = TouchStatistics(np.zeros(6), np.full(2, 0.1), LEAST_MOTION, peaks=PEAKS)
    core, theta = Estimator(robot), 0.5 * (robot.lower + robot.upper)
    core.use(replace(mae, touch=statistics))
    tension, length = pulling(theta, (10.0, 0.0, 10.0), robot)
    for n in range(100):
        estimate = core.take(reading(states(tension, length)), n * DT, n * DT)
    assert estimate.contact.is_contact
    values = core.report(1.0).values
    assert values['contacts'] == '1' and values['contact'].endswith('N at the hand')
    core.calibrate_lengths(tuple(theta.tolist()))
    core.take(reading(states(tension, length)), 1.0, 1.0)
    # During a length calibration the lengths are unknown, so no contact can be estimated.
    assert 'contact' not in core.report(1.0).values
    core = Estimator(robot)
    core.use(mae)
    core.take(reading(states(tension, length)), 1.0, 1.0)
    assert core.report(1.0).values['contact'] == 'not calibrated'
