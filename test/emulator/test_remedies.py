# SPDX-License-Identifier: Apache-2.0
"""Each advice about faults, sensors and the model of an emulated arm is followed."""

import re

import bodies
import pytest
from remedies import check_remedy, listed, members
from robots import read_muscles, with_modules, write_muscles, write_robot

from musculoskeletal_ae.emulator.faults import KINDS, read_fault
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.emulator.sensors import read_sensors
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.importing.convert import import_robot
from musculoskeletal_ae.robot.robot import Robot


def ends(fault):
    """Return the two legal ends of the size of a fault, as lines."""
    return [lambda match: f'{fault}:{match[1]}', lambda match: f'{fault}:{match[2]}']


SIZE = r'legal: sizes from (\S+) to (\S+) '
FAULTS = {
    'kind': ('melt', 'kinds: (.*)$', members(lambda kind: kind)),
    'joint': ('bias:theta:knee', "unknown joint 'knee'; legal: (.*)$",
              members(lambda joint: f'bias:theta:{joint}')),
    'muscle': ('rupture:psoas', "unknown muscle 'psoas'; legal: (.*)$",
               members(lambda muscle: f'rupture:{muscle}')),
    'size of a fault without one': ('rupture:0.5', "unknown muscle '0.5'; legal: (.*)$",
                                    members(lambda muscle: f'rupture:{muscle}')),
    'exchange': ('exchange:elbow', r'legal: exchange:JOINT:JOINT; joints: (.*)$',
                 [lambda match: ':'.join(['exchange', *listed(match)])]),
    'muscle of all readings': ('drop:biceps_long:0.5', r'legal: (drop)\[:SIZE\], without the name',
                               [lambda match: match[1], lambda match: f'{match[1]}:0.5']),
    'muscle of the base': ('mount_x:biceps_long', r'legal: (mount_x)\[:SIZE\], without the name',
                           [lambda match: match[1]]),
    **{f'size of {name}': (f'{name}:1e9', SIZE, ends(name))
       for name, kind in KINDS.items() if kind.size},
    **{f'size of {name} of {quantity}': (f'{name}:{quantity}:1e9', SIZE, ends(f'{name}:{quantity}'))
       for name, kind in KINDS.items() if kind.size and kind.of_quantity
       for quantity in ('length', 'tension', 'temperature', 'theta')},
}  # fmt: skip
LINKS = "unknown link 'knee'; legal: (.*)$"
FORMS = r'joints, marker\[:RATE\] \(above 0 to (\d+) Hz\) and imu:LINK, each once'
SENSORS = {
    'kind': (['radar'], FORMS, [['joints'], ['marker'], ['imu:hand']]),
    'rate': (['marker:1000'], FORMS, [lambda match: [f'marker:{match[1]}'], ['marker:1e-3']]),
    'link': (['imu:knee'], LINKS, members(lambda link: [f'imu:{link}'])),
    'second': (['marker', 'marker:5'], f'is the second sensor of its kind; legal: {FORMS}',
               [['marker:5'], ['joints', 'marker', 'imu:hand']]),
}  # fmt: skip


@pytest.mark.parametrize('name', FAULTS)
def test_a_fault_is_accepted_after_its_advice(name, robot):
    check_remedy(lambda line: read_fault(line, robot), *FAULTS[name])


@pytest.mark.parametrize('name', SENSORS)
def test_sensors_are_accepted_after_their_advice(name, robot):
    check_remedy(lambda lines: read_sensors(lines, robot), *SENSORS[name])


def of_another_robot(folder):
    """Return a robot that was imported, and the model of another one."""
    robots = []
    for name, text in ('a', bodies.MJCF), ('b', bodies.MJCF.replace('"swing"', '"swung"')):
        file = folder / f'{name}.xml'
        file.write_text(text, encoding='utf-8')
        robots.append(import_robot(file, folder / name).robot)
    models = [str(robot.description.directory / 'model.xml') for robot in robots]
    return robots[0], models[1], 'use the model.xml that import_robot writes', [models[0]]


def unknown_reality(_):
    legal = r'legal: (kin, foreign) or the model.xml that import_robot writes'
    return Robot.load('arm26'), 'real', legal, members(lambda reality: reality)


def coupling_of_high_degree(folder):
    directory = write_robot(folder / 'a', finger=True)
    document = read_muscles(directory)
    terms = [0.0, 0.5, 0.1, 0.1, 0.1, 0.1]
    document['couplings'] = [{'joint': 'finger', 'master': 'bend', 'polynomial': terms}]
    robot = Robot.load(write_muscles(directory, document))
    return (
        robot,
        'foreign',
        'legal in MuJoCo: at most 4; use reality `(kin)`',
        [lambda match: match[1]],
    )


@pytest.mark.parametrize('situation', [of_another_robot, unknown_reality, coupling_of_high_degree])
def test_an_emulated_arm_can_be_made_after_the_advice(situation, tmp_path):
    robot, *row = situation(tmp_path)
    check_remedy(lambda reality: make_arm(robot, 0, reality), *row)


def test_modules_that_follow_lengths_take_the_command_that_the_refusal_names(robot):
    arm = make_arm(Robot(with_modules(robot.description, 'position')))
    with pytest.raises(MusculoskeletalError) as refused:
        arm.command_tension(robot.tension.bias)
    named = re.search('publish muscle_(length)_command', str(refused.value))[1]
    getattr(arm, f'command_{named}')(arm.sense().muscles.length)
