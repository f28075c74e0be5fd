# SPDX-License-Identifier: Apache-2.0
"""Motor currents instead of tension sensors: description, messages, emulator and control."""

from types import SimpleNamespace

import numpy as np
import pytest
from exact_mae import ExactMae
from readings import reading
from robots import read_muscles, with_modules, write_muscles, write_robot
from sensor_loop import WithJointSensors

from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.settings import METHODS, Settings
from musculoskeletal_ae.driver.listening import Listening
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.exceptions import MusculoskeletalError, RobotDescriptionError
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.friction import Transmission
from musculoskeletal_ae.signals.muscle_states import read_muscle_states
from musculoskeletal_ae.signals.muscle_stream import MuscleStream, RejectionError

DRIVE = {'torque_constant': 0.05, 'gear': 20.0, 'spool_radius': 0.01}
PER_AMPERE = 100.0  # tension per motor current of DRIVE [N per A]
BY_CURRENT = {'actuation': 'position', 'tension_source': 'current'}
ROBOT = Robot(with_modules(Robot.load('arm26').description, **BY_CURRENT))
COUNT = ROBOT.muscle_count
PERIOD = 0.01  # time between two messages [s]


def array(states):
    layout = SimpleNamespace(dim=[], data_offset=0)
    return SimpleNamespace(data=np.ravel(states).tolist(), layout=layout)


def test_torque_constant_gear_and_radius_convert_a_current_to_a_tension(tmp_path):
    robot = Robot.load(write_robot(tmp_path, drive=DRIVE, **BY_CURRENT))
    source, count = robot.tension_source, robot.muscle_count
    np.testing.assert_allclose(source.newton_per_ampere, PER_AMPERE)
    document = read_muscles(tmp_path)
    document['muscles'][1]['drive'] = DRIVE | {'gear': 40.0}
    robot = Robot.load(write_muscles(tmp_path, document))
    scale = PER_AMPERE * np.where(np.arange(count) == 1, 2.0, 1.0)
    np.testing.assert_allclose(robot.tension_source.newton_per_ampere, scale)
    rows = np.stack([np.zeros(count), np.full(count, 0.5), np.full(count, 30.0)])
    tension = read_muscle_states(array(rows), robot).tension
    np.testing.assert_allclose(tension, 0.5 * scale)
    np.testing.assert_allclose(robot.tension_source.to_message(tension), 0.5)
    assert any('100–200 N per A' in line for line in robot.description.notes)


@pytest.mark.parametrize(
    ('keys', 'fragments'),
    [
        ({'tension_source': 'current', 'drive': DRIVE}, ['needs actuation: position']),
        (BY_CURRENT, ['needs drive', 'torque_constant', 'gear', 'spool_radius']),
        ({'actuation': 'position', 'drive': DRIVE}, ['tension_source: current', 'remove drive']),
        (BY_CURRENT | {'drive': DRIVE | {'gear': 0.0}}, ['drive.gear']),
        (BY_CURRENT | {'drive': {'gear': 1.0}}, ['torque_constant']),
    ],
)
def test_incomplete_or_superfluous_drives_are_refused(tmp_path, keys, fragments):
    with pytest.raises(RobotDescriptionError) as error:
        Robot.load(write_robot(tmp_path, **keys))
    for fragment in fragments:
        assert fragment in str(error.value)


def test_scale_offset_and_drive_friction_are_removed_by_the_direction_of_motion():
    gain, offset, friction = drive = np.array([[0.2], [4.0], [12.0]]) * np.ones(COUNT)
    transmission = Transmission(np.full(COUNT, 0.1), drive)
    stream, pull = MuscleStream(ROBOT), 60.0
    stream.use_transmission(transmission)
    for way in (1.0, -1.0):  # wind in, then pay out
        read = np.exp(-gain) * (pull + offset + way * friction)
        for n in range(100):
            states = np.stack([np.zeros(COUNT), read, np.full(COUNT, 30.0)])
            states[0] -= way * 1e-4 * n
            sample = stream.take(reading(states), (n + 100.0 * (way < 0.0)) * PERIOD)
        np.testing.assert_allclose(sample.tension_read, read)
        np.testing.assert_allclose(sample.motor_tension, pull, rtol=1e-2)
        np.testing.assert_allclose(sample.newest.tension, pull, rtol=1e-2)
        np.testing.assert_allclose(sample.bone_tension, pull * np.exp(-0.1 * way), rtol=1e-2)
    np.testing.assert_allclose(transmission.reading(np.full(COUNT, pull), -np.ones(COUNT)), read)


def test_a_drive_that_pays_out_against_its_friction_does_not_make_a_tendon_push():
    stream = MuscleStream(ROBOT)
    states = np.stack([np.zeros(COUNT), np.full(COUNT, -15.0), np.full(COUNT, 30.0)])
    # −15 N is legal for a motor current: the drive brakes while it pays out.
    sample = stream.take(reading(states), 0.0)
    assert (sample.motor_tension == 0.0).all() and (sample.bone_tension == 0.0).all()
    assert (sample.tension_read == -15.0).all()
    with pytest.raises(RejectionError, match='tension beyond the maximum'):
        stream.take(reading(states * np.array([[1.0], [200.0], [1.0]])), PERIOD)


@pytest.mark.parametrize('reality', ['kin', 'foreign'])
def test_an_emulated_drive_reads_more_current_while_it_winds_in(reality):
    arm, read = make_arm(ROBOT, 0, reality), {}
    start = arm.sense().muscles.length
    for way in (1.0, -1.0):
        for n in range(100):
            arm.command_length(start - way * 1e-4 * n)
            arm.step(PERIOD)
            read[way] = arm.sense().muscles.tension - arm.tension
        start = arm.sense().muscles.length
    # Winding in adds the drive friction and paying out subtracts it. The difference is therefore
    # twice the friction, which is 0.1 T_limit on average; the current also has an error of scale.
    share = (read[1.0] - read[-1.0]) / ROBOT.tension.limit
    assert 0.1 < np.median(share) < 0.35


@pytest.mark.parametrize('method', METHODS)
def test_methods_that_regulate_tension_are_refused_for_motor_currents(method):
    settings = Settings(method=method)
    if not METHODS[method].commands_tension:
        Controller(ROBOT, settings)
        return
    with pytest.raises(MusculoskeletalError, match=r'friction of a resting drive .* legal: geom'):
        Controller(ROBOT, settings)


def test_the_driver_check_accepts_currents_and_names_wrong_units():
    arm, verdicts = make_arm(ROBOT, 0), {}
    for unit, factor in (('A', 1.0), ('mA', 1000.0)):
        listening = Listening(ROBOT, 100.0)
        for n in range(100):
            arm.step(PERIOD)
            read = arm.sense()
            current = factor * ROBOT.tension_source.to_message(read.muscles.tension)
            listening.muscles(
                array([read.muscles.length, current, read.muscles.temperature]), n * PERIOD
            )
        verdicts[unit] = listening.verdict(1.0)
    assert not verdicts['A'].faults
    assert 'current' in str(verdicts['mA']) and 'publish A' in str(verdicts['mA'])


def test_the_arm_reaches_a_target_and_no_tendon_is_overloaded_before_anything_is_learned():
    arm, theta, highest = make_arm(ROBOT, 0), np.array([-0.3, -1.0]), 0.0
    loop = WithJointSensors(arm, ExactMae(ROBOT))
    loop.wait(0.1)
    loop.target(theta)
    for _ in range(400):
        loop.step()
        highest = max(highest, float((arm.tension / ROBOT.tension.limit).max()))
    assert loop.core.supervisor.is_running
    assert np.abs(arm.theta - theta).max() < 0.15
    assert highest < 1.1
