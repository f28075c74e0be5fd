# SPDX-License-Identifier: Apache-2.0
"""Each remedy that check_robot prints is applied to the robot directory that has the problem.

A row of the table has a key of robot_problems.yaml, a part of the remedy, a function that writes a
robot directory with this problem, and edits of the directory. Each edit follows the remedy
literally, and afterwards check_robot has neither this problem nor a fault.
"""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from remedies import in_file
from robots import (
    DRUM_ENDS,
    behind_a_drum,
    copy_robot,
    read_muscles,
    write_muscles,
    write_platform,
    write_robot,
)

from musculoskeletal_ae.design.checks import PROBLEMS, check_robot
from musculoskeletal_ae.problems import Problem
from musculoskeletal_ae.robot.robot import Robot

from .test_check_robot import IDLE, drop_straighteners, in_millimetres

POSTURES = 40
#: problems that have no row here
EXCEPTIONS = {
    'small_joints': 'the remedy changes the expectations of the reader, not the robot',
    'suspended': 'the remedy changes the expectations of the reader, not the robot',
    'not_held': 'test_check_robot.py tries what `remedies` computes',
    'not_stiff': 'test_check_robot.py tries what `remedies` computes',
}


class Row(NamedTuple):
    """A problem, and the edits that its remedy allows."""

    write: Callable[[Path], object]  # writes a robot directory with the problem
    remedy: str  # a part of the remedy
    edits: list[Callable[[Path, Problem], object]]


def edited(edit):
    """Return an edit of a robot directory that changes the content of muscles.yaml."""

    def change(directory, _=None):
        document = read_muscles(directory)
        edit(document)
        write_muscles(directory, document)

    return change


def route_of(document, muscle):
    (route,) = (entry['route'] for entry in document['muscles'] if entry['name'] == muscle)
    return route


def mirrored(muscle, axis=0):
    """Return an edit that moves a muscle to the other side of the axes across direction `axis`."""

    def edit(document):
        for point in route_of(document, muscle):
            point['xyz'][axis] *= -1.0

    return edited(edit)


def routed(muscle, route):
    """Return an edit that gives a muscle another route; the muscle may be new."""

    def edit(document):
        others = [each for each in document['muscles'] if each['name'] != muscle]
        points = [each if isinstance(each, dict) else {'link': each[0], 'xyz': list(each[1])}
                  for each in route]  # fmt: skip
        document['muscles'] = [*others, {'name': muscle, 'route': points}]

    return edited(edit)


def removed(muscle):
    def edit(document):
        document['muscles'] = [each for each in document['muscles'] if each['name'] != muscle]

    return edited(edit)


def other(*edits, **top):
    """Return a function that writes the arm of `robots`, and then edits it."""

    def write(directory):
        write_robot(directory, **top)
        for edit in edits:
            edit(directory)

    return write


def arm26(*edits):
    """Return a function that copies arm26, and then edits the copy."""

    def write(directory):
        copy_robot('arm26', directory)
        for edit in edits:
            edit(directory)

    return write


def platform(height=0.05, limit=150.0):
    """Return a function that writes a platform on four tendons, in place of an earlier one.

    `height` is that of the attachments [m], and `limit` the tension limit [N].
    """

    def write(directory, _=None):
        shutil.rmtree(directory, ignore_errors=True)
        write_platform(directory, height)
        document = read_muscles(directory)
        document['tension']['limit'] = limit
        write_muscles(directory, document)

    return write


def in_metres(document):
    for muscle in document['muscles']:
        for point in muscle['route']:
            point['xyz'] = [1e-3 * v for v in point['xyz']]


def scaled_route(muscle, factor):
    def edit(document):
        for point in route_of(document, muscle):
            point['xyz'] = [factor * v for v in point['xyz']]

    return edited(edit)


def at_least_past(directory, problem):
    """Route the muscle at the stated distance past the axis of the joint `bend`."""
    distance = 1e-3 * float(re.search(r'at least ([\d.]+) mm past', problem.remedy)[1])
    route = [('upper', (distance, 0.0, -0.25)), ('lower', (distance, 0.0, -0.1))]
    routed('idler', route)(directory)


CROSSER = [('pillar', (0.02, 0.0, 0.06)), ('upper', (0.0, 0.0, -0.1))]
FURTHER = [('pillar', (0.06, 0.0, 0.02)), ('upper', (0.04, 0.0, -0.1))]
#: around the axis of `swing` and of `lift`, which cross the origin of `upper`
GUIDE = {
    'wrap': 'cylinder', 'link': 'pillar', 'axis': [0.0, 1.0, 0.0], 'xyz': [0.0, 0.0, 0.0],
    'radius': 0.02, 'side': [0.03, 0.0, 0.0],
}  # fmt: skip
OBJECT = {'wrap': 'cylinder', 'link': 'forearm', 'axis': [0, 1, 0], 'xyz': [0.0, 0.0, 0.0]}


def with_object(**values):
    """Return an edit of arm26 that adds an object to the route of a muscle."""

    def edit(document):
        route = route_of(document, 'triceps_lateral')
        place = next(n for n, item in enumerate(route) if item['link'] == 'forearm')
        route.insert(place, OBJECT | {'radius': 0.03} | values)

    return edited(edit)


def changed_object(**values):
    """Return an edit that changes values of the object, or removes it if there are none."""

    def edit(document):
        route = route_of(document, 'triceps_lateral')
        place = next(n for n, item in enumerate(route) if 'wrap' in item)
        route[place : place + 1] = [route[place] | values] if values else []

    return edited(edit)


def drum(**values):
    """Return an edit of the wrap of `behind_a_drum`."""
    return edited(lambda document: route_of(document, 'straightener')[1].update(values))


def end_of_drum(end):
    def edit(document):
        route_of(document, 'straightener')[-1]['xyz'] = list(end)

    return edited(edit)


def limit_as_stated(directory, problem):
    """Give the joint of a remedy the limits that the remedy states."""
    joint, *limits = re.match(r'limit (\w+) to the range (.*) to (.*) rad', problem.remedy).groups()
    file = directory / 'robot.urdf'
    start, end = file.read_text().split(f'<joint name="{joint}"')
    for name, limit in zip(('lower', 'upper'), limits, strict=True):
        end = re.sub(f'{name}=".*?"', f'{name}="{limit}"', end, count=1)
    file.write_text(f'{start}<joint name="{joint}"{end}')


def without_mass(directory):
    """Remove the masses of the links that the joint `bend` carries."""
    file = directory / 'robot.urdf'
    text = file.read_text()
    for link in 'tool', 'lower':
        text = re.sub(rf'(<link name="{link}">)\s*<inertial>.*?</inertial>\s*', r'\1', text,
                      flags=re.DOTALL)  # fmt: skip
    file.write_text(text)


INERTIAL = """<inertial><origin xyz="0 0 -0.1"/><mass value="0.6"/>
  <inertia ixx="0.003" ixy="0" ixz="0" iyy="0.003" iyz="0" izz="0.001"/></inertial>"""
SPRING = {'joint': 'bend', 'stiffness': 4.0, 'rest_angle': 0.5}
WITH_FINGER = {'joints': ['swing', 'lift', 'bend', 'finger'], 'finger': True}
FINGER_MUSCLES = {'flexor': 0.035, 'extensor': -0.035}


def route_past_the_finger(directory, _):
    for name, y in FINGER_MUSCLES.items():
        routed(name, [('tool', (0.0, y, -0.05)), ('fingertip', (0.03, y, 0.0))])(directory)


ROWS = {
    'wrong_sign': Row(
        arm26(mirrored('brachialis')), 'move its route to the other side of the joint axis',
        [mirrored('brachialis')],
    ),
    'wrong_sign, declared': Row(
        arm26(in_file('moment_arms.csv', 'brachialis,elbow,-', 'brachialis,elbow,+')),
        'or correct moment_arms.csv',
        [in_file('moment_arms.csv', 'brachialis,elbow,+', 'brachialis,elbow,-')],
    ),
    'one_way_joint': Row(
        other(edited(drop_straighteners)),
        'route a muscle to the other side of the joint axis, or state the spring',
        [
            routed(
                'bender',
                [
                    ('upper', (-0.035, 0.01, -0.15)),
                    ('upper', (-0.042, 0.01, -0.27)),
                    ('lower', (-0.038, 0.01, 0.01)),
                ],
            ),
            edited(lambda document: document.update(joint_elasticity=[SPRING])),
        ],
    ),
    'one_way_joint, idle': Row(
        other(**WITH_FINGER),
        'route muscles past its axis, or hold the joint fixed at 0: remove it from `joints`',
        [
            route_past_the_finger,
            edited(lambda document: document['joints'].remove('finger')),
        ],
    ),
    'useless_muscle': Row(
        other(edited(lambda document: document['muscles'].append(
            {'name': 'idler', 'route': IDLE}))),
        'past the axis of a joint, or remove it',
        [at_least_past, removed('idler')],
    ),
    'flipping_muscle': Row(
        other(routed('crosser', CROSSER)),
        'route it further from the axis of that joint, or keep it on one side of the axis',
        [
            routed('crosser', FURTHER),
            routed('crosser', [CROSSER[0], GUIDE, CROSSER[1]]),
        ],
    ),
    'other_units, points': Row(
        other(edited(in_millimetres)), 'give all points in metres, not millimetres',
        [edited(in_metres)],
    ),
    'other_units, arm': Row(
        other(scaled_route('bender', 1e3)), 'give all points in metres, not millimetres',
        [scaled_route('bender', 1e-3)],
    ),
    'other_units, limits': Row(
        other(in_file('robot.urdf', 'lower="-1.6" upper="-0.2"', 'lower="-92" upper="-11.5"')),
        'give them in radians, not degrees',
        [in_file('robot.urdf', 'lower="-92" upper="-11.5"', 'lower="-1.6057" upper="-0.2007"')],
    ),
    'other_units, limits, prismatic': Row(
        other(in_file('robot.urdf', 'lower="0.0" upper="0.05"', 'lower="0" upper="50"'),
              slider=True),
        'give them in metres, not millimetres',
        [in_file('robot.urdf', 'lower="0" upper="50"', 'lower="0" upper="0.05"')],
    ),
    'jumping_muscle': Row(
        lambda directory: behind_a_drum(directory, DRUM_ENDS['jumps']),
        'move the side of that wrap, or a neighbouring point, until the tendon stays on one side',
        [drum(side=[-0.2, 0.0, -0.33]), end_of_drum(DRUM_ENDS['stays'])],
    ),
    'jumping_muscle, limit': Row(
        lambda directory: behind_a_drum(directory, DRUM_ENDS['jumps']),
        'limit bend to the range ', [limit_as_stated],
    ),
    'jumping_muscle, left out': Row(
        lambda directory: behind_a_drum(directory, DRUM_ENDS['jumps']),
        'leave the muscle out (import_robot --without straightener)', [removed('straightener')],
    ),
    'idle_object': Row(
        arm26(with_object(radius=30.0)), 'check that centre and radius are in metres',
        [changed_object(radius=0.03), changed_object()],
    ),
    'idle_object, centre': Row(
        arm26(with_object(xyz=[0.0, 0.0, 300.0])), 'check that centre and radius are in metres',
        [changed_object(xyz=[0.0, 0.0, 0.0])],
    ),
    'idle_object, point inside': Row(
        arm26(with_object(radius=0.045)), 'no route point lies inside',
        [changed_object(radius=0.03)],
    ),
    'unstable': Row(
        platform(height=-0.4), 'attach the muscles above the centre of mass of what they carry',
        [platform()],
    ),
    'no_equilibrium': Row(
        platform(limit=25.0), 'raise tension.limit',
        [platform()],
    ),
    'no_inertia': Row(
        other(without_mass), 'add an <inertial> to the links that it carries in robot.urdf',
        [in_file('robot.urdf', '<link name="lower">', f'<link name="lower">{INERTIAL}')],
    ),
}  # fmt: skip


def problems(directory):
    check = check_robot(Robot.load(directory), POSTURES)
    return check, [*check.faults, *check.warnings]


@pytest.mark.parametrize('name', ROWS)
def test_a_problem_is_gone_after_its_remedy(name, tmp_path):
    row, kind = ROWS[name], name.partition(',')[0]
    for number, edit in enumerate(row.edits):
        directory = tmp_path / str(number)
        row.write(directory)
        found = [each for each in problems(directory)[1] if each.kind == kind]
        assert found and row.remedy in found[0].remedy
        edit(directory, found[0])
        check, left = problems(directory)
        assert kind not in {each.kind for each in left}, left
        assert not check.faults, (number, check.faults)


def test_every_problem_has_a_row_or_a_reason():
    tried = {key for key in PROBLEMS if any((name + ', ').startswith(key + ', ') for name in ROWS)}
    assert tried.isdisjoint(EXCEPTIONS)
    assert tried | EXCEPTIONS.keys() == PROBLEMS.keys()
