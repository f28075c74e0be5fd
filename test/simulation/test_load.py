# SPDX-License-Identifier: Apache-2.0
"""Gravity and pushes of many arms at once equal pinocchio's results for each."""

import numpy as np
import pinocchio as pin
import pytest

from musculoskeletal_ae.robot.kinematics import Kinematics
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.load import LoadTree


def sliding_tree():
    """Return a branching tree with a prismatic joint, and its joints in another order."""
    model = pin.Model()
    rng = np.random.default_rng(1)

    def add(parent, joint, name, body):
        place = pin.SE3.Random()
        index = model.addJoint(parent, joint, place, name)
        model.lowerPositionLimit[-1], model.upperPositionLimit[-1] = -1.0, 1.0
        inertia = pin.Inertia(1.0 + rng.uniform(), rng.normal(size=3) * 0.1, np.eye(3) * 0.01)
        model.appendBodyToJoint(index, inertia, pin.SE3.Identity())
        model.addBodyFrame(body, index, pin.SE3.Random(), 0)
        return index

    pin.seed(0)
    first = add(0, pin.JointModelRZ(), 'a', 'link_a')
    second = add(first, pin.JointModelPY(), 'b', 'link_b')
    add(first, pin.JointModelRX(), 'c', 'link_c')
    add(second, pin.JointModelRY(), 'd', 'hand')
    return Kinematics(model, ('c', 'a', 'd', 'b'), 'hand')


@pytest.fixture(scope='module', params=['musashi_left_arm', 'arm26', 'sliding'])
def kinematics(request):
    return sliding_tree() if request.param == 'sliding' else Robot.load(request.param).kinematics


def test_the_load_is_the_gravity_of_pinocchio_less_the_wrench(kinematics):
    rng = np.random.default_rng(0)
    theta = rng.uniform(kinematics.lower, kinematics.upper, (20, len(kinematics.lower)))
    wrench = rng.normal(0.0, 20.0, (20, 6))
    load, _ = LoadTree.of(kinematics).load(theta, wrench)
    for i in range(20):
        jacobian = kinematics.end_effector_jacobian(theta[i])
        expected = kinematics.holding_torque(theta[i]) - jacobian.T @ wrench[i]
        np.testing.assert_allclose(load[i], expected, atol=1e-9)
    alone, _ = LoadTree.of(kinematics).load(theta)
    np.testing.assert_allclose(alone, kinematics.holding_torque(theta), atol=1e-9)


def test_the_slope_of_the_load_is_its_derivative(kinematics):
    rng = np.random.default_rng(0)
    theta = rng.uniform(kinematics.lower, kinematics.upper, (20, len(kinematics.lower)))
    wrench = np.hstack([rng.normal(0.0, 20.0, (20, 3)), np.zeros((20, 3))])
    load = LoadTree.of(kinematics).load
    _, slope = load(theta, wrench)
    for k, offset in enumerate(1e-6 * np.eye(theta.shape[1])):
        change = load(theta + offset, wrench)[0] - load(theta - offset, wrench)[0]
        np.testing.assert_allclose(slope[:, :, k], change / 2e-6, atol=1e-5)
