# SPDX-License-Identifier: Apache-2.0
"""`check_robot --suggest`: via points that make an arm sound."""

import os
import re

import numpy as np
import pytest
from robots import copy_robot, read_muscles, write_muscles

from musculoskeletal_ae.design import suggestion
from musculoskeletal_ae.design.checks import check_robot
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tools.check_robot import main

WRAP = {'wrap': 'sphere', 'link': 'upper_arm', 'xyz': [0.0, 0.0, -0.2], 'radius': 0.005}


def poor_arm(directory, spread=0.03):
    """Write arm26 to `directory`, with via points as inaccurate as if they were placed by eye.

    Each coordinate of a point is wrong by at most `spread` [m]. The arm also gets the entries that
    a suggestion must keep.
    """
    document = read_muscles(copy_robot('arm26', directory))
    rng = np.random.default_rng(3)
    for muscle in document['muscles']:
        for point in muscle['route']:
            point['xyz'] = (point['xyz'] + rng.uniform(-spread, spread, 3)).tolist()
    # Entries that the suggestion must keep: a wrapped object, a point that occurs twice, the
    # limit of a single muscle, and a stiffness other than the default.
    document['muscles'][4]['route'].insert(2, WRAP)
    document['muscles'][5]['route'].insert(1, dict(document['muscles'][5]['route'][0]))
    document['muscles'][0]['tension'] = {'limit': 190.0}
    return write_muscles(directory, {**document, 'stiffness': 9000.0})


def points(directory):
    return np.array(
        [
            point.xyz
            for route in Robot.load(directory).description.routes
            for point in route
            if not hasattr(point, 'radius')
        ]
    )


def without_points(directory):
    document = read_muscles(directory)
    for muscle in document['muscles']:
        muscle['route'] = [item for item in muscle['route'] if 'wrap' in item]
    return document


@pytest.fixture(autouse=True)
def briefly(monkeypatch):
    monkeypatch.setattr(suggestion, 'TRIES', 3)


def suggest(arm, out, *more):
    return main(
        [str(arm), '--suggest', '--out', str(out), '--postures', '20', '--quiet', *map(str, more)]
    )


def test_a_poor_arm_becomes_sound_by_via_points_moved_within_reach(tmp_path, capsys):
    arm, reach = poor_arm(tmp_path / 'arm'), 0.02
    out, mesh = arm / 'better', arm / 'meshes' / 'hand.stl'
    mesh.parent.mkdir()
    mesh.write_bytes(b'solid')
    before = check_robot(Robot.load(arm), 200, seed=9)
    # Premise of this test: the arm has faults.
    assert {'wrong_sign', 'not_held'} <= {fault.kind for fault in before.faults}
    assert suggest(arm, out, '--reach', reach) == 0
    printed = capsys.readouterr().out
    assert 'better: sound' in printed
    assert 'changes the sign of its main action' not in printed.split(str(out))[1]
    # The search did not use the postures of this check, which has another seed.
    assert check_robot(Robot.load(out), 200, seed=9).faults == ()
    distance = np.linalg.norm(points(out) - points(arm), axis=1)
    assert 0.0 < distance.max() < reach
    assert np.median(distance) < 1e-8  # most points stay where they were
    assert without_points(out) == without_points(arm)
    for name in ('robot.urdf', 'moment_arms.csv', 'meshes/hand.stl'):
        assert (out / name).read_bytes() == (arm / name).read_bytes()
    assert (out / 'suggestion.png').read_bytes().startswith(b'\x89PNG')
    assert not (out / 'better').exists()


def test_the_best_arm_is_written_and_reported_if_none_within_reach_is_sound(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(suggestion, 'TRIES', 1)
    arm, out = poor_arm(tmp_path / 'arm'), tmp_path / 'better'
    assert suggest(arm, out, '--reach', 0.002) == 1
    printed = capsys.readouterr().out
    assert 'by at most 2 mm does not make the robot sound; the best candidate' in printed
    assert 'better: not sound' in printed
    lacks = [suggestion.lacking(check_robot(Robot.load(d), 40, seed=1)) for d in (arm, out)]
    assert 0.0 < lacks[1] < lacks[0]


def test_files_that_cannot_be_copied_do_not_prevent_a_suggestion(tmp_path):
    robot = Robot.load(copy_robot('arm26', tmp_path / 'arm'))
    (tmp_path / 'arm' / 'log').symlink_to('/nowhere')
    os.mkfifo(tmp_path / 'arm' / 'pipe')
    change = np.full((len(points(tmp_path / 'arm')), 3), 0.001)
    suggestion.write(robot, change, tmp_path / 'out')
    moved = points(tmp_path / 'out') - points(tmp_path / 'arm')
    np.testing.assert_allclose(moved, change, atol=1e-6)
    kept = {file.name for file in (tmp_path / 'out').iterdir()}
    assert {'robot.urdf', 'muscles.yaml', 'suggestion.png'} <= kept and not kept & {'log', 'pipe'}


def test_a_sound_arm_is_not_changed(tmp_path):
    assert suggest('arm26', tmp_path / 'better') == 0
    assert not (tmp_path / 'better').exists()


def test_no_via_point_is_moved_if_none_causes_the_faults(tmp_path, capsys):
    arm = copy_robot('arm26', tmp_path / 'arm')
    urdf = arm / 'robot.urdf'
    urdf.write_text(re.sub('<inertial>.*?</inertial>', '', urdf.read_text(), flags=re.S))
    assert suggest(arm, tmp_path / 'better') == 1
    assert 'moving via points cannot remedy these faults' in capsys.readouterr().out
    assert not (tmp_path / 'better').exists()


@pytest.mark.parametrize('name', ['arm26', 'musashi_left_arm'])
def test_a_shipped_arm_lacks_nothing(name):
    assert suggestion.lacking(check_robot(Robot.load(name))) == 0.0


@pytest.mark.parametrize('options', [['--suggest'], ['--out', 'new'], ['--suggest', '--out', '.']])
def test_suggest_needs_a_new_directory(options, capsys):
    with pytest.raises(SystemExit) as ended:
        main(['arm26', *options])
    assert ended.value.code == 2
    assert 'a new directory' in capsys.readouterr().err
