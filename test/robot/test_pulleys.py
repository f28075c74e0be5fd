# SPDX-License-Identifier: Apache-2.0
"""Pulleys that swivel about the line along which the tendon enters them."""

import numpy as np
import pytest
from robots import read_muscles, write_muscles, write_platform

from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.description import written
from musculoskeletal_ae.robot.robot import Robot

RADIUS = 0.03


@pytest.fixture(scope='module')
def robot(tmp_path_factory):
    return Robot.load(write_platform(tmp_path_factory.mktemp('a') / 'platform', pulley=RADIUS))


def test_the_tendon_is_the_shortest_one_in_the_plane_of_the_pulley(robot):
    theta = robot.random_postures(5, np.random.default_rng(0))
    lengths, points = robot.routes.absolute_lengths(theta), robot.routes.points(theta)
    turns = np.linspace(0.0, np.pi, 20_001)[:, None]
    for posture in range(5):
        for muscle in range(4):
            start, end = points[posture, 2 * muscle], points[posture, 2 * muscle + 1]
            entry = start * [1.25, 1.0, 1.0]
            forward = np.array([np.sign(entry[0]), 0.0, 0.0])
            out = (end - entry) * [0.0, 1.0, 1.0]
            out /= np.linalg.norm(out)
            leaves = entry + RADIUS * (np.sin(turns) * forward + (1.0 - np.cos(turns)) * out)
            straight = end - leaves
            along = np.cos(turns) * forward + np.sin(turns) * out
            far = np.linalg.norm(straight, axis=1)
            at = int(((straight * along).sum(axis=1) / far).argmax())
            expected = 0.2 + RADIUS * turns[at, 0] + far[at]
            assert lengths[posture, muscle] == pytest.approx(expected, abs=1e-6)


def test_the_jacobian_is_the_derivative_of_the_lengths(robot):
    theta = robot.random_postures(3, np.random.default_rng(1))
    step = 1e-6 * np.eye(6)
    ahead, back = (
        robot.routes.absolute_lengths(theta[:, None] + sign * step) for sign in (1.0, -1.0)
    )
    expected = np.moveaxis((ahead - back) / 2e-6, 1, 2)
    np.testing.assert_allclose(robot.routes.muscle_jacobian(theta), expected, atol=1e-6)


def test_the_drawn_tendon_runs_along_the_pulley(robot):
    theta = robot.random_postures(1, np.random.default_rng(2))[0]
    line, length = robot.routes.drawn(theta)[0], robot.routes.absolute_lengths(theta)[0]
    assert np.linalg.norm(np.diff(line, axis=0), axis=1).sum() == pytest.approx(length, abs=1e-3)


def test_the_emulator_with_the_same_mechanics_has_pulleys_and_mujoco_has_none(robot):
    arm = make_arm(robot, 0, 'kin')
    assert np.isfinite(arm.sense().muscles.length).all()
    with pytest.raises(MusculoskeletalError, match='MuJoCo has no swivelling pulleys'):
        make_arm(robot, 0, 'foreign')


def test_a_pulley_is_written_as_it_was_read(robot):
    entry = written(robot.description.routes[0][1])
    assert entry == {
        'wrap': 'pulley',
        'link': 'frame',
        'xyz': [1.0, 1.0, 1.2],
        'radius': RADIUS,
        'axis': [1.0, 0.0, 0.0],
    }


def test_a_pulley_has_no_side(tmp_path):
    directory = write_platform(tmp_path / 'platform', pulley=RADIUS)
    document = read_muscles(directory)
    document['muscles'][0]['route'][1]['side'] = [0.0, 0.0, 1.0]
    with pytest.raises(MusculoskeletalError, match="unknown key 'side'; legal for a pulley"):
        Robot.load(write_muscles(directory, document))
