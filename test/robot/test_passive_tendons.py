# SPDX-License-Identifier: Apache-2.0
"""Tendons without a muscle turn joints back: their torque is part of every torque balance."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from robots import write_robot

from musculoskeletal_ae.design.checks import check_robot
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.emulator.kin.individual import NOMINAL, Individual
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.exceptions import MusculoskeletalError, RobotDescriptionError
from musculoskeletal_ae.importing.convert import import_robot
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.motion.activities import msc_compensation
from musculoskeletal_ae.robot.joint_elasticity import JointElasticity
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension
from musculoskeletal_ae.simulation.load import LoadTree

#: a finger with one flexor, a return tendon that only pulls, one that also pushes and spans both
#: joints, and a fixed tendon that is slack in a part of the range
FINGER = """
<mujoco model="finger">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <site name="f0" pos="0.012 0 0.03"/><site name="e0" pos="-0.012 0 0.03"/>
    <site name="long0" pos="-0.016 0 0.03"/>
    <body name="proximal">
      <joint name="mcp" axis="0 -1 0" range="0 1.2" damping="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.05" size="0.005" mass="0.03"/>
      <geom name="pulley" type="cylinder" fromto="0 -0.01 0 0 0.01 0" size="0.008" mass="0"/>
      <site name="side" pos="0.02 0 0"/>
      <site name="f1" pos="0.012 0 -0.03"/><site name="e1" pos="-0.012 0 -0.03"/>
      <body name="distal" pos="0 0 -0.05">
        <joint name="pip" axis="0 -1 0" range="0 1.0" damping="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.03" size="0.005" mass="0.02"/>
        <geom name="pulley2" type="cylinder" fromto="0 -0.01 0 0 0.01 0" size="0.008" mass="0"/>
        <site name="side2" pos="0.02 0 0"/>
        <site name="f2" pos="0.012 0 -0.02"/><site name="long2" pos="-0.012 0 -0.02"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <spatial name="flexor">
      <site site="f0"/><geom geom="pulley" sidesite="side"/><site site="f1"/>
      <geom geom="pulley2" sidesite="side2"/><site site="f2"/>
    </spatial>
    <spatial name="short"><site site="f0"/><geom geom="pulley" sidesite="side"/><site site="f1"/>
    </spatial>
    <spatial name="return" stiffness="1500" damping="20" springlength="0 0.055">
      <site site="e0"/><site site="e1"/>
    </spatial>
    <spatial name="strip" stiffness="400" springlength="0.1">
      <site site="long0"/><site site="e1"/><site site="long2"/>
    </spatial>
    <fixed name="stop" stiffness="0.4" springlength="-2 0.8"><joint joint="pip" coef="1"/></fixed>
  </tendon>
  <actuator>
    <motor name="flexor" tendon="flexor" ctrlrange="-60 0"/>
    <motor name="short" tendon="short" ctrlrange="-60 0"/>
  </actuator>
</mujoco>
"""
BAND = {
    'name': 'band', 'stiffness': 500.0, 'slack': [0.0, 0.01], 'joints': ['bend'],
    'centre': [0.4], 'length': [[0.03, 0], [0.01, 1], [-0.002, 2]],
}  # fmt: skip


@pytest.fixture(scope='module')
def imported(tmp_path_factory):
    folder = tmp_path_factory.mktemp('finger')
    (folder / 'finger.xml').write_text(FINGER)
    return import_robot(folder / 'finger.xml', folder / 'robot')


@pytest.fixture(scope='module')
def finger(imported):
    description = imported.robot.description
    light = replace(description.tension, bias=np.full(2, 0.1))
    return Robot(replace(description, tension=light))


def passive_torque(robot, theta):
    """Return the torques of springs and tendons that MuJoCo computes for `model.xml`, (N, D)."""
    model = mujoco.MjModel.from_xml_path(str(robot.description.directory / 'model.xml'))
    data, rows = mujoco.MjData(model), []
    for at in theta:
        data.qpos[:] = at
        mujoco.mj_forward(model, data)
        rows.append(data.qfrc_passive.copy())
    return np.array(rows)


def test_their_torque_is_that_of_mujoco(finger):
    theta = finger.random_postures(100, np.random.default_rng(1))
    kin = finger.kinematics
    ours = kin.weight_torque(theta) - kin.holding_torque(theta)
    theirs = passive_torque(finger, theta)
    assert np.all(np.abs(theirs).max(axis=0) > 0.05)
    np.testing.assert_allclose(ours, theirs, atol=0.01 * np.abs(theirs).max())


def test_the_import_names_each_of_them_and_keeps_their_damping(imported):
    notes = ' '.join(imported.robot.description.notes)
    for name in ('return', 'strip', 'stop'):
        assert f'passive tendon {name} ' in notes
    assert not [note for note in imported.source.notes if 'no actuator pulls it' in note]
    damping = imported.robot.kinematics.elasticity.damping
    assert damping[0] > 0.01 + 20.0 * 0.003**2
    assert damping[1] == pytest.approx(0.01)


def test_all_solvers_use_the_same_torque_and_stiffness(finger):
    theta, step = finger.random_postures(20, np.random.default_rng(2)), 1e-6
    kin = finger.kinematics
    load, slope = LoadTree.of(kin).load(theta)
    np.testing.assert_allclose(load, kin.holding_torque(theta), atol=1e-12)
    np.testing.assert_allclose(slope[3], kin.holding_gradient(theta[3]), atol=1e-9)
    turned = [theta[3] + sign * step * np.eye(2) for sign in (1.0, -1.0)]
    numerical = (kin.holding_torque(turned[0]) - kin.holding_torque(turned[1])) / (2.0 * step)
    np.testing.assert_allclose(kin.holding_gradient(theta[3]), numerical, atol=1e-6)
    springs = kin.elasticity.stiffness_at(theta)
    assert np.abs(springs - springs[0]).max() > 0.01


def test_a_finger_with_muscles_on_one_side_and_return_tendons_needs_none_on_the_other(finger):
    bare = Robot(replace(finger.description, joint_elasticity=JointElasticity.none(2)))
    assert not check_robot(finger).faults
    # Without the tendons, only the weight turns the joints back.
    assert 'suspended' in {warning.kind for warning in check_robot(bare).warnings}


def test_an_emulated_arm_rests_where_muscles_hold_weight_and_return_tendons(finger):
    arm = EmulatedArm(finger, 0, Individual(finger, 0, NOMINAL))
    middle = 0.5 * (finger.lower + finger.upper)
    tension = holding_tension(finger, middle, 10.0)
    command = finger.muscle_lengths(middle, tension) + msc_compensation(finger, tension)
    for _ in range(1500):
        arm.command_length(command)
        arm.step(0.02)
    assert np.abs(arm.velocity).max() < 1e-3
    assert np.all((arm.theta > finger.lower) & (arm.theta < finger.upper))
    exerted = -finger.routes.muscle_jacobian(arm.theta).T @ arm.tension
    np.testing.assert_allclose(exerted, finger.kinematics.holding_torque(arm.theta), atol=5e-3)


def test_a_network_that_is_saved_keeps_the_torque_of_the_description(finger):
    mae = initial_mae(finger, steps=1)
    mae = replace(mae, elasticity=finger.kinematics.elasticity)
    again = checkpoint.from_bytes(checkpoint.to_bytes(mae))
    theta = finger.random_postures(3, np.random.default_rng(3))
    learned = finger.with_elasticity(again.elasticity)
    expected = finger.kinematics.holding_torque(theta)
    np.testing.assert_allclose(learned.kinematics.holding_torque(theta), expected, atol=1e-5)


def test_a_joint_outside_of_a_limb_is_held_at_zero(finger):
    both = finger.kinematics.elasticity
    alone, angle = both.of_joints(np.array([1])), np.array([0.4])
    expected = both.holding_torque(np.array([0.0, 0.4]))[1]
    assert alone.holding_torque(angle)[0] == pytest.approx(expected)


@pytest.mark.parametrize(
    ('change', 'problem'),
    [
        ({'joints': ['knee']}, "unknown joint 'knee'"),
        ({'slack': [0.2, 0.1]}, 'expected the smaller length first'),
        ({'centre': [0.1, 0.2]}, 'expected 1 numbers, got 2'),
        ({'length': [[0.1, 0.5]]}, 'a coefficient and 1 whole powers'),
        ({'stiffness': -1.0}, 'stiffness'),
    ],
)
def test_a_bad_entry_is_refused(change, problem, tmp_path):
    with pytest.raises(RobotDescriptionError, match=problem):
        Robot.load(write_robot(tmp_path, passive_tendons=[{**BAND, **change}]))


def test_an_entry_can_be_written_by_hand(tmp_path):
    robot = Robot.load(write_robot(tmp_path, passive_tendons=[BAND]))
    kin, bend, moved = robot.kinematics, robot.joints.index('bend'), 0.2
    theta = np.zeros(robot.joint_count)
    theta[bend] = 0.4 + moved
    length = 0.03 + 0.01 * moved - 0.002 * moved**2
    held = (kin.holding_torque(theta) - kin.weight_torque(theta))[bend]
    assert held == pytest.approx(500.0 * (length - 0.01) * (0.01 - 0.004 * moved))
    with pytest.raises(MusculoskeletalError, match="passive tendon 'band' has no route"):
        make_arm(robot, 0, 'foreign')
    assert holding_tension(robot, 0.5 * (robot.lower + robot.upper), 80.0).min() > 0.0
