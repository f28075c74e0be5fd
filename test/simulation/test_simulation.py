# SPDX-License-Identifier: Apache-2.0
"""The simulator on bodies with exact lengths, which exclude network errors, and on networks."""

from dataclasses import replace

import numpy as np
import pytest
from nominal_rest import (
    NOTICEABLE,
    nominal_rest,
    random_commands,
    responses,
    rest_errors,
)

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.friction import REVERSAL
from musculoskeletal_ae.simulation import simulation
from musculoskeletal_ae.simulation.equilibrium import JOINT_SPEED
from musculoskeletal_ae.simulation.simulation import Simulation, on_all_cores


class GeometricBody:
    """A body with the lengths of the geometric model and the interface of a network."""

    def __init__(self, robot, friction=0.0):
        self.robot, self.friction = robot, np.full(robot.muscle_count, friction)
        self.elasticity = None

    def lengths(self, theta, tension):
        return self.robot.muscle_lengths(theta, tension)

    def lengths_with_pullback(self, theta, tension):
        jacobian = self.robot.routes.muscle_jacobian(theta)
        return self.lengths(theta, tension), lambda g: np.einsum('nm,nmd->nd', g, jacobian)


@pytest.fixture(scope='module')
def robot():
    return Robot.load('musashi_left_arm')


@pytest.fixture(scope='module')
def arm26():
    return Robot.load('arm26')


@pytest.fixture(scope='module')
def mae(trained):
    return trained['default']


@pytest.fixture(scope='module')
def body(robot):
    return GeometricBody(robot)


@pytest.fixture(scope='module')
def commands(robot):
    return random_commands(robot, 6, seed=4)


def settled(robot, body, commands):
    arms = Simulation(robot, body, arms=len(commands))
    arms.command = commands
    arms.settle()
    return arms


def rest_of_body(robot, state, command, i, wrench=None, fixed=None):
    rest = nominal_rest(
        robot,
        command,
        state.theta[i],
        state.tension[i],
        np.zeros(6) if wrench is None else wrench,
        np.full(robot.joint_count, np.nan) if fixed is None else fixed,
    )
    assert rest.residual < 1e-6
    return rest


def test_the_arm_rests_at_the_equilibrium_of_the_geometric_model(robot, body, commands):
    arms = settled(robot, body, commands)
    for i, command in enumerate(commands):
        if arms.limits(i):
            continue  # at a joint limit the results differ: `rest_of_body` has springs as stops
        rest = rest_of_body(robot, arms.state, command, i)
        np.testing.assert_allclose(arms.state.theta[i], rest.theta, atol=1e-4)
        np.testing.assert_allclose(arms.state.tension[i], rest.tension, atol=0.1)


def test_at_rest_tension_is_what_stiffness_control_makes_of_the_command(robot, body, commands):
    state = settled(robot, body, commands).state
    wound = robot.stiffness * (state.length - commands)
    np.testing.assert_allclose(
        state.tension, robot.tension.bias + np.maximum(0.0, wound), atol=0.01
    )
    np.testing.assert_allclose(
        state.length, robot.muscle_lengths(state.theta, state.tension), atol=1e-6
    )


def test_a_held_command_keeps_the_arm_still_for_three_seconds(robot, body, commands):
    arms = settled(robot, body, commands)
    rest = arms.state
    for _ in range(300):
        state = arms.step(0.01)
    assert np.abs(state.theta - rest.theta).max() < 1e-4
    assert np.abs(state.tension - rest.tension).max() < 0.05


def test_a_push_moves_the_arm_as_it_moves_the_geometric_model(robot, body, commands):
    arms = settled(robot, body, commands)
    wrench = np.array([5.0, 10.0, -15.0, 0.5, 0.0, -0.5])
    arms.wrench = np.tile(wrench, (len(commands), 1))
    arms.settle()
    for i, command in enumerate(commands):
        if not arms.limits(i):
            rest = rest_of_body(robot, arms.state, command, i, wrench)
            np.testing.assert_allclose(arms.state.theta[i], rest.theta, atol=1e-4)
    arms.wrench = np.zeros_like(arms.wrench)
    np.testing.assert_allclose(
        arms.settle().theta, settled(robot, body, commands).state.theta, atol=1e-3
    )


def test_forced_joints_take_their_angles_and_the_others_follow(robot, body, commands):
    arms = settled(robot, body, commands)
    forced = np.full(robot.joint_count, np.nan)
    forced[[1, 3]] = -0.3, -1.0
    arms.fixed = np.tile(forced, (len(commands), 1))
    state = arms.settle()
    np.testing.assert_allclose(state.theta[:, [1, 3]], np.tile([-0.3, -1.0], (len(commands), 1)))
    for i, command in enumerate(commands):
        if not arms.limits(i):
            rest = rest_of_body(robot, state, command, i, fixed=forced)
            np.testing.assert_allclose(state.theta[i], rest.theta, atol=1e-4)


def test_the_pushes_and_forced_joint_of_the_paper_move_the_arm_as_the_geometric_model(robot, body):
    for answer in responses(robot, body, 'default'):
        moved = np.abs(answer.body) > NOTICEABLE
        assert moved.any()
        np.testing.assert_allclose(answer.simulated[moved], answer.body[moved], rtol=0.1)
        assert np.linalg.norm(answer.simulated_tension - answer.body_tension) < 10.0


def test_without_a_command_every_muscle_is_at_the_bias(robot, body):
    state = Simulation(robot, body).settle()
    np.testing.assert_array_equal(state.tension, robot.tension.bias[None])


def test_a_command_out_of_reach_ends_at_the_limits_and_is_reported(robot, body):
    arms = Simulation(robot, body)
    assert not any(name in robot.muscles for name in arms.limits())
    shortest = robot.muscle_lengths(robot.random_postures(500, np.random.default_rng(0)),
                                    np.zeros((500, robot.muscle_count))).min(axis=0)  # fmt: skip
    arms.command = (shortest - 0.1)[None]
    state = arms.settle()
    assert state.tension.max() == robot.tension.max[0]
    assert np.all((state.theta >= robot.lower) & (state.theta <= robot.upper))
    assert set(arms.limits()) & set(robot.muscles)
    arms.command = np.full((1, robot.muscle_count), -1e9)
    assert np.isfinite(arms.settle().theta).all()
    before = arms.state
    assert arms.step(0.0) is before
    arms.isolate([0])
    assert robot.muscles[0] not in arms.limits()
    arms.isolate([])
    # The extreme command must leave nothing behind: with long target lengths, all tensions fall to
    # T_bias within 0.5 s.
    arms.command = np.full((1, robot.muscle_count), 1e9)
    assert arms.step(0.5).tension.max() < robot.tension.bias[0] + 1.0


def test_a_joint_forced_beyond_its_limits_stops_there_and_is_reported(robot, body):
    arms = Simulation(robot, body)
    arms.fixed[0, 0] = 9.0
    assert arms.settle().theta[0, 0] == robot.upper[0]
    assert robot.joints[0] in arms.limits()


def test_the_limits_of_each_arm_are_its_own(robot, body):
    arms = Simulation(robot, body, arms=2)
    arms.fixed[1, 0] = 9.0
    assert robot.joints[0] not in arms.limits(0)
    assert robot.joints[0] in arms.limits(1)


def test_speeds_stay_limited_when_the_command_jumps(robot, body, commands):
    arms = settled(robot, body, commands)
    arms.command = commands[::-1]
    before = arms.state
    for _ in range(100):
        state = arms.step(0.01)
        assert np.abs(state.theta - before.theta).max() <= JOINT_SPEED * 0.01 + 1e-12
        # T may change by K_stiff times the largest travel in 10 ms at 0.25 m/s.
        assert np.abs(state.tension - before.tension).max() < 25.0
        before = state


def test_a_long_step_agrees_with_many_short_ones(robot, body, commands):
    one, many = settled(robot, body, commands), settled(robot, body, commands)
    one.command = many.command = commands[::-1]
    one.step(0.05)
    for _ in range(5):
        many.step(0.01)
    np.testing.assert_allclose(one.state.theta, many.state.theta, rtol=0, atol=1e-12)


def test_one_arm_and_a_batch_agree(robot, body, commands, monkeypatch):
    # Small pieces make the batch use all cores; the last piece is smaller than the others.
    monkeypatch.setattr(simulation, 'CHUNK', 5)
    rng = np.random.default_rng(0)
    wrench = rng.normal(0.0, 8.0, (len(commands), 6))
    fixed = np.where(rng.uniform(size=(len(commands), 5)) < 0.2, -0.2, np.nan)
    batch = Simulation(robot, body, arms=len(commands))
    batch.command, batch.wrench, batch.fixed = commands, wrench, fixed
    batch.step(0.5)
    for i in range(len(commands)):
        single = Simulation(robot, body)
        single.command, single.wrench, single.fixed = commands[[i]], wrench[[i]], fixed[[i]]
        state = single.step(0.5)
        for ours, theirs in zip(state, batch.state, strict=True):
            np.testing.assert_allclose(ours[0], theirs[i], rtol=1e-6, atol=1e-6)


def test_results_of_parallel_pieces_keep_their_order_and_errors_are_raised():
    assert on_all_cores(lambda i: i * i, range(50)) == [i * i for i in range(50)]
    with pytest.raises(ZeroDivisionError):
        on_all_cores(lambda i: 1 // i, [1, 0])


@pytest.mark.parametrize('friction', [0.1, 0.4])
def test_friction_holds_the_arm_after_winding_in(robot, commands, friction):
    arms = settled(robot, GeometricBody(robot, friction), commands)
    before = arms.state
    end = np.exp(-friction * before.slid) * before.tension
    jacobian = robot.routes.muscle_jacobian(before.theta)
    pull = np.einsum('nm,nmd->nd', end, jacobian)
    left = robot.kinematics.holding_torque(before.theta) + pull
    free = (before.theta > robot.lower) & (before.theta < robot.upper)
    np.testing.assert_allclose(left[free], 0.0, atol=1e-3)
    # With friction, winding in and paying out by the same length does not restore the state.
    for way in (0.01, 0.0):
        arms.command = commands - way
        arms.settle()
    assert np.abs(arms.state.theta - before.theta).max() > 0.01


# -- on networks ----------------------------------------------------------------------------------


def test_with_a_network_the_arm_rests_at_the_equilibrium_of_the_nominal_body(arm26, mae):
    commands = random_commands(arm26, 5, seed=2)
    theta, _, drift, tension_drift = rest_errors(arm26, mae, 'default', commands)
    # Networks of five training seeds had at most 0.004 rad (error), 1e-6 rad and 1e-4 N (drift).
    assert np.median(theta.max(axis=1)) < 0.02
    assert drift.max() < 1e-4
    assert tension_drift.max() < 0.05


def test_with_a_network_one_arm_and_a_batch_agree(arm26, mae):
    commands = random_commands(arm26, 300, seed=3)
    batch = Simulation(arm26, mae, arms=300)
    batch.command = commands
    batch.wrench[:, 2] = -10.0
    batch.step(0.3)
    for i in (0, 17, 299):
        single = Simulation(arm26, mae)
        single.command, single.wrench = commands[[i]], batch.wrench[[i]]
        for name, ours in single.step(0.3)._asdict().items():
            theirs = getattr(batch.state, name)[i]
            # Single precision rounds lengths to 1 µm. `slid` divides them by REVERSAL, so its error
            # is larger than that of the other values.
            atol = 1e-6 / REVERSAL if name == 'slid' else 1e-5
            np.testing.assert_allclose(ours[0], theirs, rtol=1e-5, atol=atol)


def test_a_new_number_of_arms_clears_wrenches_and_forced_joints(arm26, mae):
    simulation = Simulation(arm26, mae, arms=2)
    simulation.wrench[:, 2], simulation.fixed[:, 0] = -10.0, -0.3
    for arms in (4, 1):
        simulation.start_from(np.zeros((arms, arm26.joint_count)))
        free = Simulation(arm26, mae, arms=arms).step(0.02)
        np.testing.assert_allclose(simulation.step(0.02).theta, free.theta, atol=1e-9)


def test_zero_arms_are_refused(arm26, mae):
    with pytest.raises(MusculoskeletalError, match='at least 1, got 0'):
        Simulation(arm26, mae, arms=0)


@pytest.mark.parametrize('preset', ['default', 'paper'])
def test_a_nonsense_network_keeps_the_arm_within_its_limits(arm26, mae, preset):
    rng = np.random.default_rng(5)
    wild = tuple((1e3 * rng.normal(size=w.shape), 1e3 * b) for w, b in mae.decoder)
    arms = Simulation(arm26, replace(mae, decoder=wild), preset, arms=3)
    arms.command = random_commands(arm26, 3, seed=0)
    arms.wrench[:] = 1e6
    state = arms.step(0.5)
    assert np.all((state.theta >= arm26.lower) & (state.theta <= arm26.upper))
    assert np.all((state.tension >= arm26.tension.bias) & (state.tension <= arm26.tension.max))
    arms.use(mae)
    arms.wrench[:] = 0.0
    assert np.isfinite(arms.settle().length).all()


def test_a_network_that_cannot_be_simulated_leaves_the_one_in_use(arm26, mae):
    simulation = Simulation(arm26, mae)
    simulation.command = mae.lengths(np.zeros((1, 2)), np.full((1, 6), 50.0)) - 0.01
    beyond = replace(mae, decoder=tuple((1e30 * w, b) for w, b in mae.decoder))
    expected = Simulation(arm26, mae)
    expected.command = simulation.command
    with np.errstate(all='ignore'), pytest.raises(FloatingPointError, match='not finite'):
        simulation.use(beyond)
    assert simulation.mae is mae
    np.testing.assert_array_equal(simulation.step(0.01).theta, expected.step(0.01).theta)
