# SPDX-License-Identifier: Apache-2.0
"""Target lengths of all control methods, on the geometric model and on a network.

On the geometric model, the optimum is known.
"""

import numpy as np
import pytest
from exact_mae import ExactMae
from nominal_body import posture_table

from bench.timings import eager_proposed, eager_proposed_paper
from musculoskeletal_ae.control.settings import Settings, Setup
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.emulator.kin.individual import NOMINAL, Individual
from musculoskeletal_ae.exceptions import InfeasibleError
from musculoskeletal_ae.mae.network import from_mae
from musculoskeletal_ae.mae.units import Mask
from musculoskeletal_ae.motion.activities import msc_compensation
from musculoskeletal_ae.motion.explored_postures import holdable_postures
from musculoskeletal_ae.motion.feedback import Shift
from musculoskeletal_ae.motion.methods import first_command
from musculoskeletal_ae.motion.tension_plan import TensionPlan, plan_at_rest
from musculoskeletal_ae.motion.trajectory import Setpoint, Trajectory
from musculoskeletal_ae.paper import control as paper
from musculoskeletal_ae.paper.latent_descent import Loss, descend
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import TensionProgramme


@pytest.fixture(scope='module', params=['musashi_left_arm', 'arm26'])
def robot(request):
    return Robot.load(request.param)


def holdable(robot, seed):
    """Return a random posture, the torque that holds it, and the least tensions for this torque."""
    postures = robot.random_postures(100, np.random.default_rng(seed))
    ((theta, least),) = holdable_postures(robot, postures, 1)
    return theta, robot.kinematics.holding_torque(theta), least


@pytest.mark.parametrize('seed', range(3))
def test_with_an_exact_body_image_the_arm_settles_at_the_target_with_the_least_tension(robot, seed):
    theta, _, least = holdable(robot, seed)
    mae = ExactMae(robot)
    plan = plan_at_rest(robot, mae, theta)
    arm = EmulatedArm(robot, 0, Individual(robot, 0, NOMINAL))
    arm.reset(theta + 0.1)
    for _ in range(150):
        arm.command_length(plan.length(mae, theta))
        arm.step(0.02)
    assert np.linalg.norm(arm.theta - theta) < 0.01
    # A tendon stretches in proportion to its length. The stretch reduces the torque of a muscle by
    # up to 0.5 %, so holding the posture takes more than the least tension of rigid tendons.
    assert np.linalg.norm(plan.bone_tension) == pytest.approx(np.linalg.norm(least), rel=0.02)
    assert not plan.missing_torque.any()


def test_no_other_tension_that_holds_the_posture_is_smaller(robot):
    theta, torque, _ = holdable(robot, 7)
    mae, limit = ExactMae(robot), robot.tension.limit
    tension = plan_at_rest(robot, mae, theta).bone_tension
    jacobian = mae.muscle_jacobian(theta, tension)
    np.testing.assert_allclose(jacobian.T @ tension, -torque, atol=0.02)
    for desired in np.random.default_rng(0).uniform(30.0, limit, (10, robot.muscle_count)):
        other = TensionProgramme(jacobian, torque, robot.tension.bias, limit).nearest(desired)
        assert np.linalg.norm(tension) <= np.linalg.norm(other) + 0.1


def planned(robot, theta, effort, limit):
    """Return a plan of `proposed` at a posture [rad], (D,), with an additional torque [N·m]."""
    plan, none = TensionPlan(Setup(robot, Settings())), np.zeros(robot.joint_count)
    plan.effort = none + effort
    rest = Trajectory.to(Setpoint.resting(theta), theta, 1.0)
    plan.step(rest, 0.0, Shift(none, none), 0.0, ExactMae(robot), limit, 0.01)
    return plan


def test_torque_beyond_the_muscles_is_reported_and_tensions_stay_within_their_limits(robot):
    theta, _, _ = holdable(robot, 1)
    limit = np.linspace(60.0, 120.0, robot.muscle_count)
    plan = planned(robot, theta, 500.0, limit)
    assert (plan.bone_tension >= 30.0 - 1e-6).all()
    assert (plan.bone_tension <= limit + 1e-6).all()
    assert np.linalg.norm(plan.missing_torque) > 100.0


def test_a_torque_that_is_not_finite_is_refused(robot):
    theta, _, _ = holdable(robot, 1)
    with pytest.raises(InfeasibleError, match='not finite'):
        planned(robot, theta, np.nan, robot.tension.limit)


def test_the_length_command_makes_the_module_pull_with_the_planned_tension(robot):
    theta, _, least = holdable(robot, 2)
    mae = ExactMae(robot)
    short = mae.lengths(theta, least) - first_command(robot, mae, theta, least)
    np.testing.assert_allclose(30.0 + robot.stiffness * short, least)
    assert msc_compensation(robot, np.full(robot.muscle_count, 30.0)).max() == 0.0


def test_preset_paper_lowers_the_printed_loss(trained):
    robot, mae = Robot.load('arm26'), trained['paper']
    theta, torque, _ = holdable(robot, 2)
    tension = np.full(6, 100.0)
    terms = paper.control_loss(robot, mae, theta, torque, tension)
    start = mae.encode(Mask.THETA_TENSION, theta, tension)
    end = descend(mae, start, terms, *paper.SEARCH)
    assert Loss(terms)(mae.decode_scaled(end)) < 0.5 * Loss(terms)(mae.decode_scaled(start))
    solution = paper.proposed(robot, mae, theta, torque, tension)
    np.testing.assert_allclose(solution.tension, mae.decode(end).tension)
    reduced = robot.without((2, 4))
    *_, balance = paper.control_loss(reduced, mae, theta, torque, tension)
    pulls = balance.matrix[:, robot.joint_count :][:, : robot.muscle_count]
    np.testing.assert_array_equal(np.abs(pulls).max(axis=0) > 0.0, reduced.used)


@pytest.mark.parametrize('seed', range(3))
def test_the_methods_agree_with_an_implementation_by_autograd(trained, seed):
    robot = Robot.load('arm26')
    theta, torque, _ = holdable(robot, seed)
    tension, (mae, printed) = np.full(6, 40.0), (trained['default'], trained['paper'])
    ours = plan_at_rest(robot, mae, theta).length(mae, theta)
    plain = eager_proposed(robot, from_mae(mae), theta, torque)
    # Single precision causes differences of some micrometres, a wrong term some millimetres.
    np.testing.assert_allclose(ours, plain, atol=1e-5)
    ours = paper.proposed(robot, printed, theta, torque, tension).length
    plain = eager_proposed_paper(robot, from_mae(printed), theta, torque, tension)
    np.testing.assert_allclose(ours, plain, atol=1e-5)


def test_with_a_network_proposed_settles_nearer_than_first_and_near_the_least_tension(trained):
    robot = Robot.load('arm26')
    table = posture_table(robot, trained['default'], trained['paper'], 2)
    error, tension, bound = {name: rows.mean(axis=0) for name, rows in table.items()}['proposed']
    assert error < 0.03
    assert error < 0.2 * table['first'].mean(axis=0)[0]
    assert tension == pytest.approx(bound, rel=0.02)
    # The bound commands the lengths of the true body at the least tension, so it has hardly any
    # error.
    assert table['bound: QP on the true body'][:, 0].max() < 0.01
