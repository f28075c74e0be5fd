# SPDX-License-Identifier: Apache-2.0
"""Joint springs: their torque is part of every torque balance."""

from dataclasses import replace

import bodies
import numpy as np
import pytest
from exact_mae import ExactMae
from robots import read_muscles, with_modules, write_muscles, write_robot

from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.body_model.fit import fit_body
from musculoskeletal_ae.body_model.observations import Observations
from musculoskeletal_ae.body_model.posture_model import Bent, PostureModel, Unknowns
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.design.checks import check_robot
from musculoskeletal_ae.design.robot_report import summary
from musculoskeletal_ae.emulator.foreign.arm import ForeignArm
from musculoskeletal_ae.emulator.foreign.effects import NONE
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.emulator.kin.individual import NOMINAL, Individual
from musculoskeletal_ae.estimation.contact import ContactEstimator
from musculoskeletal_ae.exceptions import CheckpointError, InfeasibleError, RobotDescriptionError
from musculoskeletal_ae.exporting.exported_mjcf import export
from musculoskeletal_ae.importing.convert import import_robot
from musculoskeletal_ae.learning.body_updater import BodyUpdater
from musculoskeletal_ae.learning.detector_calibration import Healthy
from musculoskeletal_ae.learning.scheduler import Job
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.motion.activities import msc_compensation
from musculoskeletal_ae.motion.methods import StiffnessModel
from musculoskeletal_ae.robot.joint_elasticity import JointElasticity
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension
from musculoskeletal_ae.simulation.load import LoadTree
from musculoskeletal_ae.simulation.simulation import Simulation

#: entries of joint_elasticity: the spring of `bend` opposes the muscle that bends; the springs of
#: `lift` and `swing` are softer and coupled
SPRINGS = [
    {'joint': 'bend', 'stiffness': 9.0, 'rest_angle': 0.3, 'damping': 0.4},
    {'joint': 'lift', 'stiffness': 3.0, 'rest_angle': 0.1, 'coupled': {'swing': -1.5}},
    {'joint': 'swing', 'stiffness': 2.0},
]


def one_sided(document):
    """Remove from a muscles.yaml the muscles that straighten the joint `bend`."""
    muscles = document['muscles']
    muscles[:] = [m for m in muscles if not m['name'].startswith('straightener')]


@pytest.fixture(scope='module')
def springy(tmp_path_factory):
    directory = tmp_path_factory.mktemp('springy')
    return Robot.load(write_robot(directory, joint_elasticity=SPRINGS))


def commanded(robot, theta, tension):
    """Return l_target [m] (M,) at which the muscles rest at θ with these tensions."""
    return robot.muscle_lengths(theta, tension) + msc_compensation(robot, tension)


def energy(theta):
    """Return the energy stored in the springs, ½ (θ − θ_0)ᵀ K (θ − θ_0), written out by hand."""
    bend, lift, swing = theta - np.array([0.3, 0.1, 0.0])
    return 0.5 * (9.0 * bend**2 + 3.0 * lift**2 + 2.0 * swing**2) - 1.5 * lift * swing


def test_the_torque_of_springs_is_the_slope_of_their_energy(springy):
    kin, step = springy.kinematics, 1e-6 * np.eye(3)
    theta = springy.random_postures(10, np.random.default_rng(0))
    for row in theta:
        slope = [(energy(row + s) - energy(row - s)) / 2e-6 for s in step]
        springs = kin.holding_torque(row) - kin.weight_torque(row)
        np.testing.assert_allclose(springs, slope, atol=1e-6)
        gradient = [
            (kin.holding_torque(row + s) - kin.holding_torque(row - s)) / 2e-6 for s in step
        ]
        np.testing.assert_allclose(kin.holding_gradient(row), gradient, atol=1e-5)
        still, turning = np.zeros(3), np.array([2.0, 0.0, 0.0])
        held = kin.inverse_dynamics(row, still, still)
        np.testing.assert_allclose(held, kin.holding_torque(row), atol=1e-9)
        bare = kin.with_elasticity(JointElasticity.none(3))
        drag = kin.inverse_dynamics(row, turning, still) - bare.inverse_dynamics(
            row, turning, still
        )
        np.testing.assert_allclose(drag - springs, [0.8, 0.0, 0.0], atol=1e-9)
    load, slope = LoadTree.of(kin).load(theta)
    np.testing.assert_allclose(load, kin.holding_torque(theta), atol=1e-9)
    np.testing.assert_allclose(slope[0], kin.holding_gradient(theta[0]), atol=1e-9)


@pytest.mark.parametrize('reality', ['kin', 'foreign'])
def test_an_emulated_arm_rests_where_muscles_hold_weight_and_springs(springy, reality):
    if reality == 'kin':
        arm = EmulatedArm(springy, 0, Individual(springy, 0, NOMINAL))
    else:
        arm = ForeignArm(springy, 0, NONE)
    middle = 0.5 * (springy.lower + springy.upper)
    tension = holding_tension(springy, middle, 80.0)
    command = commanded(springy, middle, tension)
    for _ in range(400):
        arm.command_length(command)
        arm.step(0.02)
    assert np.abs(arm.velocity).max() < 1e-4
    exerted = -springy.routes.muscle_jacobian(arm.theta).T @ arm.tension
    np.testing.assert_allclose(exerted, springy.kinematics.holding_torque(arm.theta), atol=5e-3)


def test_emulated_individuals_differ_in_their_springs(springy):
    one, two = (Individual(springy, seed).joint_elasticity for seed in (1, 2))
    assert np.abs(one.stiffness - two.stiffness).max() > 0.1
    assert np.abs(one.rest - two.rest).max() > 0.01
    assert np.linalg.eigvalsh(one.stiffness)[0] > 0.0


def test_a_simulated_arm_rests_where_muscles_hold_weight_and_springs(springy):
    mae, middle = ExactMae(springy), 0.5 * (springy.lower + springy.upper)
    tension = holding_tension(springy, middle, 80.0)
    arms = Simulation(springy, mae)
    arms.command = commanded(springy, middle, tension)[None]
    np.testing.assert_allclose(arms.settle().theta[0], middle, atol=0.02)
    stiffer = springy.kinematics.elasticity.deviating(np.full(3, 1.5), np.full(3, 0.2))
    mae.elasticity = stiffer
    arms.use(mae)
    state = arms.settle()
    assert np.abs(state.theta[0] - middle).max() > 0.01
    exerted = -mae.muscle_jacobian(*(part[0] for part in state[:2])).T @ state.tension[0]
    expected = springy.with_elasticity(stiffer).kinematics.holding_torque(state.theta[0])
    np.testing.assert_allclose(exerted, expected, atol=0.02)


def test_a_spring_takes_the_place_of_an_antagonist(tmp_path):
    """Five muscles hold three joints, fewer than two for each, if a spring opposes them."""
    document = read_muscles(write_robot(tmp_path))
    one_sided(document)
    without = check_robot(Robot.load(write_muscles(tmp_path, document)))
    assert 'one_way_joint' in {fault.kind for fault in without.faults}
    document['joint_elasticity'] = [{'joint': 'bend', 'stiffness': 9.0, 'rest_angle': 0.6}]
    sprung = check_robot(Robot.load(write_muscles(tmp_path, document)))
    assert not sprung.faults, [fault.text for fault in sprung.faults]
    assert sprung.held.mean() > 0.95
    document['joint_elasticity'][0]['stiffness'] = 0.5
    weak = check_robot(Robot.load(write_muscles(tmp_path, document)))
    assert 'not_held' in {fault.kind for fault in weak.faults}


def test_the_report_names_the_springs(springy):
    assert summary(springy, check_robot(springy, 20), 0).count('spring of') == 3
    assert 'bend: spring of 9 N·m/rad, at rest at 0.3 rad' in springy.description.notes


def test_springs_stiffen_the_joints(springy):
    bare = springy.with_elasticity(JointElasticity.none(3))
    theta, tension = 0.5 * (springy.lower + springy.upper), np.full(8, 80.0)
    stiff, soft = (
        StiffnessModel.read(robot, ExactMae(robot), theta, tension).joint_stiffness(tension)
        for robot in (springy, bare)
    )
    np.testing.assert_allclose(stiff - soft, springy.kinematics.elasticity.stiffness, atol=1e-9)
    at = check_robot(springy, 20).stiffness - check_robot(bare, 20).stiffness
    assert np.nanmedian(at) > 0.5


def test_springs_are_not_felt_as_a_contact(springy):
    theta = springy.random_postures(1, np.random.default_rng(3))[0]
    tension = holding_tension(springy, theta, 60.0)
    contact = ContactEstimator(springy)
    contact.use(ExactMae(springy))
    for _ in range(200):
        felt = contact.step(theta, tension, 0.02)
    assert np.abs(felt.torque).max() < 0.1


@pytest.mark.parametrize(
    ('entry', 'problem'),
    [
        ({'joint': 'knee'}, "unknown joint 'knee'; legal: bend, lift, swing"),
        ({'joint': 'bend', 'stiffness': -1.0}, 'stiffness'),
        ({'joint': 'bend', 'stiffness': float('nan')}, 'stiffness'),
        ({'joint': 'bend', 'damping': -0.1}, 'damping'),
        ({'joint': 'bend', 'rest_angel': 0.1}, 'rest_angel'),
        ({'joint': 'bend', 'stiffness': 1.0, 'coupled': {'bend': 1.0}}, 'is the joint itself'),
        ({'joint': 'bend', 'stiffness': 1.0, 'coupled': {'toe': 1.0}}, "unknown joint 'toe'"),
        ({'joint': 'bend', 'stiffness': 1.0, 'coupled': {'lift': 0.5}}, 'at most 0, the geometric'),
    ],
)
def test_impossible_springs_are_refused(tmp_path, entry, problem):
    with pytest.raises(RobotDescriptionError) as error:
        Robot.load(write_robot(tmp_path, joint_elasticity=[entry]))
    assert problem in str(error.value)
    assert 'muscles.yaml' in str(error.value)
    assert 'joint_elasticity' in str(error.value)


def test_a_joint_has_one_entry_and_a_pair_one_term(tmp_path):
    bend = {'joint': 'bend', 'stiffness': 1.0, 'coupled': {'lift': 0.1}}
    lift = {'joint': 'lift', 'stiffness': 1.0, 'coupled': {'bend': 0.1}}
    with pytest.raises(RobotDescriptionError, match="'bend' is listed twice"):
        Robot.load(write_robot(tmp_path, joint_elasticity=[bend, bend]))
    with pytest.raises(RobotDescriptionError, match='are coupled twice; remove one entry'):
        Robot.load(write_robot(tmp_path, joint_elasticity=[bend, lift]))


def test_springs_survive_export_and_import(tmp_path):
    document = bodies.MJCF.replace('<joint name="elbow" ', SPRUNG, 1)
    (tmp_path / 'own.xml').write_text(document, encoding='utf-8')
    robot = import_robot(tmp_path / 'own.xml', tmp_path / 'robot').robot
    k, elasticity = robot.joints.index('elbow'), robot.kinematics.elasticity
    assert elasticity.stiffness[k, k] == pytest.approx(2.0)
    assert elasticity.damping[k] == pytest.approx(0.5)
    assert elasticity.rest[k] == pytest.approx(0.4)
    other = (k + 1) % robot.joint_count
    stiffness = elasticity.stiffness.copy()
    stiffness[other, other] = 1.5
    stiffness[k, other] = stiffness[other, k] = 0.8
    preload = stiffness @ np.linspace(-0.3, 0.2, robot.joint_count)
    learned = JointElasticity(stiffness, preload, elasticity.damping)
    mae = replace(initial_mae(robot, steps=1), elasticity=learned)
    export(robot, mae, tmp_path / 'model')
    again = import_robot(tmp_path / 'model' / 'model.xml', tmp_path / 'again').robot
    np.testing.assert_allclose(again.kinematics.elasticity.stiffness, stiffness, atol=1e-4)
    np.testing.assert_allclose(again.kinematics.elasticity.preload, preload, atol=1e-4)


SPRUNG = '<joint name="elbow" stiffness="2" springref="0.4" damping="0.5" '


def test_springs_are_learned_from_rest_samples(springy):
    """The true springs have other stiffnesses and rest angles than stated; 60 samples correct them.

    The fit assumes that a torque balance has a standard deviation of 0.3 times the torques of the
    muscles, so weak springs beside strong muscles keep their stated values.
    """
    true = springy.kinematics.elasticity.deviating(
        np.array([0.5, 0.6, 1.8]), np.array([0.2, -0.2, 0.15])
    )
    observed = rests(springy.with_elasticity(true), 60)
    body = CalibratedBody(springy)
    fit_body(body, observed)
    theta = springy.random_postures(200, np.random.default_rng(9))
    off, before = (
        np.abs(each.holding_torque(theta) - true.holding_torque(theta)).mean(axis=0)
        for each in (body.elasticity, springy.kinematics.elasticity)
    )
    assert off[0] < 0.15 * before[0]
    assert off.sum() < 0.35 * before.sum()


def test_without_tensions_springs_stay_as_stated(springy):
    modules = {'actuation': 'position', 'tension_source': 'none'}
    robot = Robot(with_modules(springy.description, **modules))
    true = springy.kinematics.elasticity.deviating(np.full(3, 0.5), np.full(3, 0.2))
    body = CalibratedBody(robot)
    fit_body(body, rests(springy.with_elasticity(true), 20))
    stated = springy.kinematics.elasticity
    np.testing.assert_allclose(body.elasticity.stiffness, stated.stiffness, rtol=1e-6)
    np.testing.assert_allclose(body.elasticity.preload, stated.preload, rtol=1e-6)


def test_an_update_publishes_learned_springs_and_control_uses_them(springy):
    true = springy.kinematics.elasticity.deviating(np.full(3, 0.5), np.full(3, 0.2))
    observed = rests(springy.with_elasticity(true), 40)
    updater = BodyUpdater(springy, initial_mae(springy, steps=1))
    nothing = Healthy(np.empty((0, 24), dtype=np.float32), 0.0, 0)
    mae = updater.update(Job(observed, nothing, True, 4)).mae
    core, theta = Controller(springy, Settings()), observed.theta[0]
    before = core.robot.kinematics.holding_torque(theta)
    core.use(mae)
    off, nominal = (
        np.abs(torque - springy.with_elasticity(true).kinematics.holding_torque(theta))[0]
        for torque in (core.robot.kinematics.holding_torque(theta), before)
    )
    assert off < 0.3 * nominal
    # The controller uses a copy of the robot with the learned springs. The original must not
    # change.
    assert springy.kinematics.elasticity is springy.description.joint_elasticity


def rests(robot, count):
    """Return rest samples of a body in which muscles hold weight and springs."""
    rng, rows = np.random.default_rng(2), []
    while len(rows) < count:
        theta = robot.random_postures(1, rng)[0]
        try:
            rows.append((theta, holding_tension(robot, theta, rng.uniform(30.0, 150.0, 8))))
        except InfeasibleError:  # the muscles cannot hold this posture, so draw another one
            continue
    theta, tension = map(np.array, zip(*rows, strict=True))
    length = robot.muscle_lengths(theta, tension) + 1e-4 * rng.standard_normal(tension.shape)
    return Observations(
        theta, tension, length, np.zeros_like(tension), np.ones(tension.shape, bool)
    )


def test_the_slopes_of_the_torque_by_the_springs_are_difference_quotients(springy):
    body = CalibratedBody(springy)
    observed, joints = rests(springy, 4), np.arange(3)
    model = PostureModel(body, observed, joints, np.arange(8), Bent.unknown(4, 3))
    springs = np.array([[0.2, -0.3, 0.1], [0.4, 0.1, -0.2]])
    at = Unknowns(observed.theta, np.zeros(3), body.parameters, springs)
    rows = model.residuals(at)
    for k, (i, j) in enumerate(np.ndindex(2, 3)):
        moved = springs.copy()
        moved[i, j] += 1e-6
        slope = -(model.residuals(at._replace(springs=moved)).torque - rows.torque) / 1e-6
        np.testing.assert_allclose(rows.torque_by_springs[:, :, k], slope, atol=1e-5)


def test_learned_springs_are_part_of_a_checkpoint(trained):
    mae = trained['default']
    stiffness = np.diag([1.0, 2.0])
    elasticity = JointElasticity(stiffness, np.array([0.3, -0.1]), np.full(2, 0.1))
    again = checkpoint.from_bytes(checkpoint.to_bytes(replace(mae, elasticity=elasticity)))
    np.testing.assert_array_equal(again.elasticity.stiffness, stiffness)
    np.testing.assert_array_equal(again.elasticity.preload, elasticity.preload)
    assert checkpoint.from_bytes(checkpoint.to_bytes(mae)).elasticity is None
    bad = JointElasticity(-stiffness, elasticity.preload, elasticity.damping)
    with pytest.raises(CheckpointError, match='springs only store energy'):
        checkpoint.from_bytes(checkpoint.to_bytes(replace(mae, elasticity=bad)))
