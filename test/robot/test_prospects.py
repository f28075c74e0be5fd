# SPDX-License-Identifier: Apache-2.0
"""What makes training pointless is known within seconds, and before anything else."""

import re
import time
from itertools import combinations

import bodies
import numpy as np
from robots import read_muscles, write_muscles, write_robot

from musculoskeletal_ae.design import prospects as module
from musculoskeletal_ae.design.contacts import movable_joints
from musculoskeletal_ae.design.prospects import prospects
from musculoskeletal_ae.importing.convert import import_robot
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tools import import_robot as tool
from musculoskeletal_ae.tools.network_cache import network_file


def test_a_sound_arm_has_no_warning(tmp_path):
    found = prospects(Robot.load(write_robot(tmp_path)))
    assert found.share > 0.95
    assert not [line for line in found.lines() if line.startswith('warning')]


def test_an_arm_that_nothing_can_hold_and_an_idle_joint_are_said_first(tmp_path, capsys):
    (tmp_path / 'heavy.xml').write_text(bodies.HEAVY)
    assert tool.main([str(tmp_path / 'heavy.xml'), '--out', str(tmp_path / 'out')]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith('warning: no muscle moves loose')
    assert lines[1].startswith('warning: 0 of 150 random postures can be held: training is pointl')


def test_fewer_muscles_than_joints_are_said(tmp_path):
    document = read_muscles(write_robot(tmp_path))
    crossed = Robot.load(tmp_path).routes.crossed
    pair = next(pair for pair in combinations(range(8), 2) if crossed[list(pair)].any(axis=0).all())
    document['muscles'] = [document['muscles'][m] for m in pair]
    lines = prospects(Robot.load(write_muscles(tmp_path, document))).lines()
    assert any('lengths of 2 muscles cannot tell the angles of' in line for line in lines)


def test_few_holdable_postures_are_said_with_the_joint_that_lacks_torque(tmp_path):
    document = read_muscles(write_robot(tmp_path))
    document['tension'] = {'bias': 30.0, 'limit': 34.0, 'max': 500.0}
    found = prospects(Robot.load(write_muscles(tmp_path, document)))
    assert found.share < 0.5
    (line, *_) = found.lines()
    assert line.startswith(f'warning: {found.held} of 150')
    assert f'{found.lacking[0][0]} (' in line


def test_contacts_that_keep_a_joint_from_its_range_are_said_with_the_bodies(tmp_path):
    # The obstacle of this finger is beside a part of the range; a second one is opposite.
    wall = '<geom type="box" size=".01 .05 .1" pos="-.035 0 -.1"/><site name="a"'
    free, walled = (tmp_path / name for name in ('free', 'walled'))
    for folder, text in (
        (free, bodies.TOUCHING.replace('type="box"', 'type="box" contype="0" conaffinity="0"')),
        (walled, bodies.TOUCHING.replace('<site name="a"', wall)),
    ):
        folder.mkdir()
        (folder / 'own.xml').write_text(text)
    robots = [import_robot(folder / 'own.xml', folder / 'own').robot for folder in (free, walled)]
    assert not any('contacts' in line for line in prospects(robots[0]).lines())
    assert movable_joints(robots[0]).all()
    (line,) = [line for line in prospects(robots[1]).lines() if 'contacts' in line]
    start = r'warning: contacts: joint bend \(range -1.05 to 1.05 rad\) can move without contact'
    assert re.match(start, line)
    assert 'world and finger' in line and 'counts as not movable' in line
    assert dict(zip(robots[1].joints, movable_joints(robots[1]))) == {'spread': True, 'bend': False}
    (tmp_path / 'walled' / 'own' / 'model.xml').write_text('<mujoco/>')
    assert any('contacts were not examined' in line for line in prospects(robots[1]).lines())
    (tmp_path / 'walled' / 'own' / 'model.xml').unlink()
    assert not any('contacts' in line for line in prospects(robots[1]).lines())


def test_a_large_arm_is_examined_only_for_some_seconds(tmp_path, monkeypatch):
    robot, now = Robot.load(write_robot(tmp_path)), iter(np.arange(0.0, 1e5, 10.0))
    monkeypatch.setattr(time, 'monotonic', lambda: float(next(now)))
    assert prospects(robot).postures == module.LEAST_POSTURES


def test_a_quick_network_has_its_own_place_in_the_cache(tmp_path):
    directory = write_robot(tmp_path / 'arm')
    full, quick = (network_file(directory, 'default', each).name for each in (False, True))
    assert quick.startswith('arm-default-quick-')
    assert full.startswith('arm-default-')
    assert full != quick
