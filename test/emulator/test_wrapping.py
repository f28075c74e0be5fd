# SPDX-License-Identifier: Apache-2.0
"""Routes of emulated individuals.

The muscle Jacobian is the derivative of the lengths, and each individual has other routes.
"""

import numpy as np
import pytest
from differences import slopes
from robots import read_muscles, write_muscles, write_robot

from musculoskeletal_ae.design import route_jumps
from musculoskeletal_ae.emulator.foreign.arm import ForeignArm
from musculoskeletal_ae.emulator.kin.individual import NOMINAL, Individual, Spread
from musculoskeletal_ae.robot.robot import Robot


@pytest.mark.parametrize('name', ['arm26', 'musashi_left_arm'])
def test_true_jacobian_is_the_derivative_of_true_lengths(name):
    robot = Robot.load(name)
    body = Individual(robot, 3, Spread(wrap=0.9))
    theta = robot.random_postures(20, np.random.default_rng(0))
    off = np.abs(slopes(body.absolute_lengths, theta) - body.muscle_jacobian(theta))
    # Length has no derivative in postures where a tendon just touches a bone. Allow this in one of
    # the twenty postures.
    assert (np.sum(off.max(axis=1) > 1e-6, axis=0) <= 1).all()


def test_the_nominal_body_is_the_geometric_model():
    robot = Robot.load('musashi_left_arm')
    body = Individual(robot, 0, NOMINAL)
    rng = np.random.default_rng(1)
    theta = robot.random_postures(50, rng)
    tension = rng.uniform(0.0, 500.0, (50, robot.muscle_count))
    expected = robot.muscle_lengths(theta, tension)
    np.testing.assert_allclose(body.muscle_lengths(theta, tension), expected, atol=1e-12)
    np.testing.assert_allclose(
        body.muscle_jacobian(theta), robot.routes.muscle_jacobian(theta), atol=1e-9
    )


def test_a_seed_determines_the_individual():
    robot = Robot.load('arm26')
    theta = robot.random_postures(5, np.random.default_rng(0))
    one, same, other = (Individual(robot, s).absolute_lengths(theta) for s in (4, 4, 5))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 1e-3
    assert np.abs(one - robot.routes.absolute_lengths(theta)).max() > 1e-3


def test_individuals_keep_drums_drums_and_rings_rings(tmp_path, monkeypatch):
    monkeypatch.setattr(route_jumps, 'LINES', 5)  # saves time; lengths that jump do not matter here
    document = read_muscles(write_robot(tmp_path))
    for m, share in ((6, 1.02), (7, 0.98)):
        side = {'side': [-0.03 * share, 0.0, -0.3]}
        drum = {'wrap': 'cylinder', 'link': 'upper', 'xyz': [0, 0, -0.3], 'axis': [0, 1, 0]}
        document['muscles'][m]['route'][1:2] = [{**drum, 'radius': 0.03, **side}]
    robot = Robot.load(write_muscles(tmp_path, document))
    for seed in range(3):
        true, model = Individual(robot, seed).routes.objects, ForeignArm(robot, seed)._model
        away = [np.linalg.norm(true.side[s]) / true.radius[s] for s in robot.routes.wrapping]
        for name in robot.muscles[6:]:
            geom, site = model.geom(f'{name}, 1'), model.site(f'{name}, 1 side')
            away.append(np.linalg.norm(site.pos - geom.pos) / geom.size[0])
        np.testing.assert_allclose(away, [1.02, 0.98] * 2)
