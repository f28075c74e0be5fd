# SPDX-License-Identifier: Apache-2.0
"""Objects of the page are where the kinematics place them, and muscles are distinguishable."""

import os
import shutil

import numpy as np
import pytest

trimesh = pytest.importorskip('trimesh', reason='./bringup.sh --view installs what the page needs')

from robots import read_muscles, write_muscles, write_robot  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

from musculoskeletal_ae.robot.robot import Robot  # noqa: E402
from musculoskeletal_ae.view.body import (  # noqa: E402
    DASHES,
    DrawnState,
    link_solids,
    muscle_tubes,
    pieces,
)


@pytest.fixture(scope='module')
def robot():
    return Robot.load('musashi_left_arm')


@pytest.fixture
def theta(robot):
    return robot.lower + 0.3 * (robot.upper - robot.lower)


def test_tubes_lie_on_the_routes_and_grow_thicker_with_tension(robot, theta):
    pull = np.linspace(0.0, 1.0, robot.muscle_count)
    tension = robot.tension.bias + pull * (robot.tension.limit - robot.tension.bias)
    tubes = muscle_tubes(robot, theta, tension, np.zeros(robot.muscle_count, dtype=int))
    points = robot.routes.points(theta[None])[0]
    along = Rotation.from_quat(tubes['batched_wxyzs'], scalar_first=True).apply([0.0, 0.0, 1.0])
    line = points[robot.routes.second] - points[robot.routes.first]
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    np.testing.assert_allclose(along, np.repeat(line, DASHES, axis=0), atol=1e-9)
    middle = 0.5 * (points[robot.routes.first] + points[robot.routes.second])
    np.testing.assert_allclose(
        tubes['batched_positions'][DASHES // 2 :: DASHES], middle, atol=1e-12
    )
    owner = robot.routes.muscle.repeat(DASHES)
    radius = [tubes['batched_scales'][owner == m, 0] for m in (0, len(tension) - 1)]
    assert radius[1][0] > 2.0 * radius[0][0]


def test_a_muscle_of_unknown_tension_is_drawn_like_one_at_the_bias(robot, theta):
    tension = np.full((2, robot.muscle_count), robot.tension.bias)
    tension[0, 2], kinds = np.nan, np.zeros(robot.muscle_count, dtype=int)
    unknown, known = (muscle_tubes(robot, theta, each, kinds) for each in tension)
    for name in known:
        np.testing.assert_array_equal(unknown[name], known[name])


def test_a_wrapping_tendon_is_drawn_with_its_length_by_a_constant_number_of_tubes(tmp_path):
    directory = write_robot(tmp_path)
    document = read_muscles(directory)
    route = next(m['route'] for m in document['muscles'] if m['name'] == 'straightener')
    route[1:2] = [{'wrap': 'sphere', 'link': 'upper', 'xyz': [0.0, 0.0, -0.3], 'radius': 0.03}]
    robot = Robot.load(write_muscles(directory, document))
    owner, sound = pieces(robot).repeat(DASHES), np.zeros(robot.muscle_count, dtype=int)
    postures = robot.random_postures(20, np.random.default_rng(3))
    detours = robot.routes.detours(postures).max(axis=1)
    assert detours.min() < 1e-9 and detours.max() > 1e-3
    for posture in postures:
        tubes = muscle_tubes(robot, posture, np.full(robot.muscle_count, 50.0), sound)
        assert len(tubes['batched_positions']) == len(owner)
        drawn = np.bincount(owner, tubes['batched_scales'][:, 2]) / 1.02
        np.testing.assert_allclose(drawn, robot.routes.absolute_lengths(posture), atol=2e-4)
        assert np.isfinite(tubes['batched_wxyzs']).all()


def test_ruptured_isolated_and_suspect_muscles_look_different(robot, theta):
    tension = np.full(robot.muscle_count, 100.0)
    kinds = np.arange(robot.muscle_count) % 4
    tubes = muscle_tubes(robot, theta, tension, kinds)
    kind = kinds[robot.routes.muscle].repeat(DASHES)
    length = np.linalg.norm(
        np.diff(robot.routes.points(theta[None])[0], axis=0)[robot.routes.first], axis=1
    ).repeat(DASHES)
    filled = tubes['batched_scales'][:, 2] * DASHES / length
    assert (filled[kind >= DrawnState.ISOLATED] < 0.7).all() and (
        filled[kind < DrawnState.ISOLATED] > 1.0
    ).all()
    looks = {tuple(colour) for colour in tubes['batched_colors']}
    assert len(looks) == 4
    # The colours must differ in luminance, for people who do not distinguish all hues.
    light = sorted(np.dot(look, [0.2126, 0.7152, 0.0722]) for look in looks)
    assert np.diff(light).min() > 15.0


def test_links_are_drawn_by_the_meshes_of_the_urdf_or_else_by_capsules(tmp_path):
    folder = tmp_path / 'arm'
    shutil.copytree(Robot.load('arm26').description.directory, folder)
    solids, notes = link_solids(Robot.load(folder))
    assert len(solids) == 2 and not notes  # capsules of the upper arm and the forearm
    elbow = Robot.load('arm26').kinematics.tree.placement_translation[2, 2]
    low, high = solids[0][1].bounds[:, 2]
    assert low < elbow < low + 0.03 and high - 0.03 < 0.0 < high
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    (folder / 'box.stl').write_bytes(box.export(file_type='stl'))
    os.mkfifo(folder / 'fifo.stl')
    urdf = (folder / 'robot.urdf').read_text()
    visual = (
        '<visual><origin xyz="0 0 -0.1" rpy="0 0 0"/><geometry>'
        '<mesh filename="{}" scale="0.1 0.1 0.2"/></geometry></visual>'
    )
    added = ''.join(visual.format(name) for name in ('box.stl', 'fifo.stl', 'none.stl', 'arm.dae'))
    name = '<link name="upper_arm">'
    urdf = urdf.replace('<robot ', '<robot xmlns="http://www.ros.org" ')
    plugin = '<gazebo><plugin name="p"><link>upper_arm</link></plugin></gazebo></robot>'
    urdf = urdf.replace(name, name + added).replace('</robot>', plugin)
    (folder / 'robot.urdf').write_text(urdf)
    robot = Robot.load(folder)
    ((joint, mesh), (other, _)), notes = link_solids(robot)
    # The upper arm is drawn by its one readable mesh, the forearm by a capsule.
    assert [robot.kinematics.model.names[j] for j in (joint, other)] == ['shoulder', 'elbow']
    np.testing.assert_allclose(mesh.bounds, [[-0.05, -0.05, -0.2], [0.05, 0.05, 0.0]])
    assert [any(word in note for note in notes) for word in ('no regular', 'No such', '.stl, .obj')]
    assert len(notes) == 3
