# SPDX-License-Identifier: Apache-2.0
"""The emulated arm: its statics obey mechanics, and its modules their specification."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from robots import write_robot

from emulator.commands import to_mid_range
from musculoskeletal_ae.emulator import modules
from musculoskeletal_ae.emulator.faults import SPEED_LIMIT
from musculoskeletal_ae.emulator.foreign.arm import ForeignArm
from musculoskeletal_ae.emulator.foreign.effects import NONE
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm, tension_from_elongation
from musculoskeletal_ae.emulator.kin.individual import NOMINAL, Individual
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.exceptions import DivergedError
from musculoskeletal_ae.messages.message_reading import MOST_WRENCH
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.series_elastic import SeriesElastic


@pytest.fixture(scope='module', params=['kin', 'foreign'])
def nominal(request, robot):
    """Return a function that creates nominal arms of either emulator model."""
    if request.param == 'foreign':
        return lambda: ForeignArm(robot, 0, NONE)
    return lambda: EmulatedArm(robot, 0, Individual(robot, 0, NOMINAL))


@pytest.fixture(params=['kin', 'foreign'])
def reality(request):
    return request.param


def drive(arm, length, seconds):
    for _ in range(round(seconds / 0.02)):
        arm.command_length(length)
        arm.step(0.02)


@given(st.floats(0.0, 2000.0), st.floats(20, 300), st.floats(10, 60), st.floats(0, 3e-5))
def test_tension_from_elongation_inverts_the_elongation(tension, force, rate, stretch):
    elastic = SeriesElastic(np.array([force]), np.array([rate]), np.array([stretch]))
    elongation = elastic.elongation(np.array([1.0]), np.array([tension]))[0]
    if rate * elongation < 6.0:  # beyond this, the compiled inverse limits the tension
        solved = tension_from_elongation(elongation, force, rate, stretch)
        assert solved == pytest.approx(tension, rel=1e-6, abs=1e-6)


def test_at_rest_the_muscles_hold_the_weight_by_muscle_stiffness_control(robot, nominal):
    arm = nominal()
    command = to_mid_range(robot, 80.0)
    drive(arm, command, 8.0)
    assert np.abs(arm.velocity).max() < 1e-6
    jacobian = robot.routes.muscle_jacobian(arm.theta)
    np.testing.assert_allclose(
        -jacobian.T @ arm.tension, robot.kinematics.holding_torque(arm.theta), atol=1e-3
    )
    length = arm.individual.muscle_lengths(arm.theta[None], arm.tension[None])[0]
    pull = robot.tension.bias + np.maximum(0.0, robot.stiffness * (length - command))
    np.testing.assert_allclose(arm.tension, pull, rtol=1e-3)


def test_a_force_on_the_hand_and_a_payload_are_carried_by_the_muscles(robot, nominal):
    arm = nominal()
    command = to_mid_range(robot, 80.0)
    force = np.array([5.0, 0.0, -8.0, 0.0, 0.0, 0.0])
    arm.set_wrench(force)
    arm.set_payload(1.0)
    drive(arm, command, 12.0)
    carried = -robot.routes.muscle_jacobian(arm.theta).T @ arm.tension
    kin = robot.kinematics
    weight = np.array([0.0, 0.0, -9.81, 0.0, 0.0, 0.0])
    push = kin.end_effector_jacobian(arm.theta).T @ (force + weight)
    np.testing.assert_allclose(carried, kin.holding_torque(arm.theta) - push, atol=1e-3)


def ends_of_detours(arm, command, seconds):
    ends = []
    for detour in (0.02, -0.02):
        drive(arm, command + detour, 1.5)
        drive(arm, command, seconds)
        ends.append(arm.theta)
    return np.linalg.norm(ends[0] - ends[1])


def test_friction_leaves_hysteresis(robot, reality):
    assert ends_of_detours(make_arm(robot, 1, reality), to_mid_range(robot, 80.0), 3.0) > 1e-3


def test_without_friction_there_is_no_hysteresis(robot, nominal):
    assert ends_of_detours(nominal(), to_mid_range(robot, 80.0), 6.0) < 1e-4


def test_friction_can_be_doubled(robot):
    arm = EmulatedArm(robot, 0)
    own = arm.tendon_friction
    arm.friction[:] *= 2.0
    np.testing.assert_allclose(arm.tendon_friction, 2.0 * own)


def test_without_commands_the_modules_go_safe_and_pay_out_to_the_bias(robot, nominal):
    arm = nominal()
    command = to_mid_range(robot, 80.0)
    drive(arm, command, 2.0)
    assert not arm.safe
    assert arm.tension.max() > robot.tension.bias[0] + 10.0
    arm.step(arm.command_timeout + 5.0)
    assert arm.safe
    np.testing.assert_allclose(arm.tension, robot.tension.bias, rtol=0.01)


def test_tension_commands_are_followed_up_to_the_highest_tension(robot, nominal):
    arm = nominal()
    wished = np.array([40.0, 60.0, 50.0, 55.0, 1e6, 45.0])
    for _ in range(200):
        arm.command_tension(wished)
        arm.step(0.02)
    np.testing.assert_allclose(arm.tension, np.minimum(wished, robot.tension.max), rtol=0.02)


def test_a_ruptured_muscle_has_no_tension_and_winds_in_at_the_speed_limit(robot, reality):
    arm = make_arm(robot, 2, reality)
    command = to_mid_range(robot, 80.0)
    drive(arm, command, 2.0)
    arm.set_faults([f'rupture:{robot.muscles[1]}'])
    before = arm._muscle.length[1]
    drive(arm, command, 0.1)
    assert arm.sense().muscles.tension[1] == 0.0
    assert before - arm._muscle.length[1] == pytest.approx(0.1 * SPEED_LIMIT, abs=1e-3)
    drive(arm, command, 3.0)
    limit = arm.sense().muscles.length[1]
    drive(arm, command, 0.5)
    assert arm.sense().muscles.length[1] == pytest.approx(limit, abs=1e-3)
    arm.set_faults([])
    drive(arm, command, 3.0)
    assert arm.sense().muscles.tension[1] > 0.5 * robot.tension.bias[1]


def test_a_weak_muscle_takes_up_slack(tmp_path, reality):
    weak = {'bias': 0.5, 'limit': 50.0, 'max': 75.0}
    robot = Robot.load(write_robot(tmp_path / 'arm', tension=weak))
    arm = make_arm(robot, 2, reality)
    command = to_mid_range(robot, 5.0)
    drive(arm, command, 2.0)
    before = arm.sense().muscles.length[1]
    arm._muscle.length[1] += 0.02
    drive(arm, command, 1.5)
    assert arm.sense().muscles.tension[1] > 0.0
    assert arm.sense().muscles.length[1] - before < 0.01


def test_a_length_offset_shifts_the_controlled_posture(robot, nominal):
    arm = nominal()
    command = to_mid_range(robot, 80.0)
    drive(arm, command, 3.0)
    before = arm.theta
    arm.set_length_offset(np.array([0.01, 0, 0, 0, 0, 0]))
    drive(arm, command, 3.0)
    assert np.abs(arm.theta - before).max() > 0.01


def test_temperatures_settle_at_the_steady_state_of_the_thermal_model(robot):
    arm = EmulatedArm(robot, 0, Individual(robot, 0, NOMINAL))
    muscle, module = arm._muscle, arm._module_constants
    assert np.ptp(module.loss) > 0.1 * module.loss.mean()  # the modules differ
    # The housing would take many minutes to settle. It is faster to set its temperature repeatedly
    # to the steady state at the present tension.
    for _ in range(12):
        muscle.housing[:] = modules.AMBIENT + module.housing_resistance * (
            module.loss * muscle.tension**2
        )
        for _ in range(20):
            arm.command_tension(np.full(robot.muscle_count, 100.0))
            arm.step(0.4)
    heat = module.loss * 100.0**2
    housing = modules.AMBIENT + heat * module.housing_resistance
    np.testing.assert_allclose(muscle.housing, housing, rtol=0.03)
    np.testing.assert_allclose(arm.winding, housing + heat * module.winding_resistance, rtol=0.03)


def test_the_same_seed_gives_the_same_motion(robot, reality):
    command = to_mid_range(robot, 80.0)
    lives = []
    for _ in range(2):
        arm = make_arm(robot, 7, reality)
        drive(arm, command, 1.0)
        lives.append(np.concatenate([arm.sense().theta, *arm.sense().muscles.rows]))
    np.testing.assert_array_equal(lives[0], lives[1])


def test_reset_brings_the_arm_back_to_rest(robot, reality):
    arm = make_arm(robot, 3, reality)
    start = arm.theta
    drive(arm, to_mid_range(robot, 80.0), 2.0)
    arm.reset()
    np.testing.assert_array_equal(arm.theta, start)
    assert arm.sense().muscles.tension.min() > 0.5 * robot.tension.bias[0]


def test_the_marker_is_seen_where_the_hand_is(robot, reality):
    arm = make_arm(robot, 0, reality)
    observed = np.array([arm.marker_pose().translation for _ in range(200)])
    true = robot.kinematics.end_effector_pose(arm.theta).translation
    np.testing.assert_allclose(observed.mean(axis=0), true, atol=1e-3)
    assert 5e-4 < observed.std(axis=0).max() < 1e-2


@pytest.mark.parametrize(
    'name', [pytest.param('arm26', marks=pytest.mark.thorough), 'musashi_left_arm']
)
def test_no_legal_wrench_breaks_the_emulator_and_a_reset_mends_it(name, reality):
    robot, rng = Robot.load(name), np.random.default_rng(0)
    arm = make_arm(robot, 1, reality)
    for payload in (0.0, 20.0):
        arm.set_payload(payload)
        for theta in robot.random_postures(3, rng):
            arm.reset(theta)
            arm.set_wrench(MOST_WRENCH * rng.choice([-1.0, 1.0], 6))
            arm.step(1.0)
            assert not arm.divergence
    arm.set_wrench(np.full(6, 1e7))
    arm.step(1.0)
    assert arm.divergence
    legal = r'the emulated arm has diverged: joint \w+ moves at \S+ rad/s; legal: at most 1000\. .+'
    with pytest.raises(DivergedError, match=f'{legal}(reduce|exclude)'):
        arm.check()
    arm.reset()
    arm.step(1.0)
    assert not arm.divergence
    assert np.abs(arm.velocity).max() < 10.0


def test_the_sensor_of_a_prismatic_joint_errs_by_millimetres(tmp_path, reality):
    robot = Robot.load(write_robot(tmp_path, slider=True))
    arms = [make_arm(robot, seed, reality) for seed in range(3)]
    off = np.array([[arm.sense().theta - arm.theta for _ in range(30)] for arm in arms])
    off = robot.units.to_position(off)[..., -1]
    assert np.abs(off).max() < 0.01
    assert 1e-5 < off.std(axis=1).max() < 2e-4


def test_a_prismatic_joint_stops_at_its_limits(tmp_path, reality):
    """200 N push the joint a few mm beyond its limit, because the stop is not infinitely stiff."""
    urdf = write_robot(tmp_path, slider=True) / 'robot.urdf'
    urdf.write_text(urdf.read_text().replace('"0.25"', '"0.005"'))  # a light tool [kg]
    robot = Robot.load(tmp_path)
    arm, pull = make_arm(robot, 0, reality), robot.tension.bias.copy()
    for name in ('slider_in', 'slider_out'):
        pull[robot.muscles.index(name)] = robot.tension.limit[0]
        for _ in range(10):
            arm.command_tension(pull)
            arm.step(0.1)
            beyond = np.maximum(arm.theta - robot.upper, robot.lower - arm.theta)
            assert robot.units.to_position(beyond)[-1] < 0.01
        pull[:] = robot.tension.bias
