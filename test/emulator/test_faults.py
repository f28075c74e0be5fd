# SPDX-License-Identifier: Apache-2.0
"""Emulated faults: each has exactly the effect that its name states, until it is repaired."""

import numpy as np
import pytest

from emulator.commands import to_mid_range
from musculoskeletal_ae.emulator.faults import KINDS, SENSED, ArmReadings, Faults, read_fault
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.emulator.sensors import Sensors, read_sensors
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.signals.muscle_states import MuscleReadings

MUSCLE = 2


@pytest.fixture
def arm(robot):
    return EmulatedArm(robot, 1)


def numbered(robot, i):
    """Return sensor readings of a robot in which every value of a muscle is `i`."""
    muscles = MuscleReadings(length=np.full(robot.muscle_count, float(i)))
    return ArmReadings(np.zeros(robot.joint_count), muscles)


def delivered(robot, line, count=400, period=0.0078125):
    faults = Faults(robot, np.random.default_rng(0))
    faults.set([line])
    arrived = [faults.deliver(numbered(robot, i), i * period) for i in range(count)]
    return [[int(one.muscles.length[0]) for one in readings] for readings in arrived]


def test_messages_are_dropped_delayed_duplicated_and_reordered(robot):
    assert delivered(robot, 'drop:0') == [[i] for i in range(400)]
    lost = delivered(robot, 'drop:0.25')
    assert 40 < sum(one == [] for one in lost) < 160
    assert all(one in ([], [i]) for i, one in enumerate(lost))
    assert delivered(robot, 'drop:1', 50) == [[]] * 50
    late = delivered(robot, 'delay:0.0390625', 50)
    assert late == [[]] * 5 + [[i] for i in range(45)]
    twice = delivered(robot, 'duplicate')
    assert {len(one) for one in twice} == {1, 2}
    swapped = delivered(robot, 'reorder')
    assert {tuple(np.diff(one)) for one in swapped} == {(), (-1,)}
    order = np.concatenate(swapped)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(order)))


def test_ending_a_delay_discards_the_delayed_messages(robot):
    faults = Faults(robot, np.random.default_rng(0))
    for i, lines in enumerate(['delay:0.25'] * 50 + [''] * 50):
        faults.set([lines] if lines else [])
        last = [
            int(one.muscles.length[0]) for one in faults.deliver(numbered(robot, i), i * 0.0078125)
        ]
        assert last == ([i] if not lines else [i - 32] if i >= 32 else [])
    faults.set(['reorder:1'])
    assert faults.deliver(numbered(robot, 100), 1.0) == []
    faults.set([])
    assert len(faults.deliver(numbered(robot, 101), 1.1)) == 1


def test_a_frozen_sensor_stays_frozen_when_another_fault_is_added(arm, robot):
    frozen, other = robot.muscles[MUSCLE], robot.muscles[MUSCLE + 1]
    lines = [f'freeze:tension:{frozen}']
    arm.faults.set(lines)
    before = arm.sense().muscles.tension[MUSCLE]
    after = hold(arm, robot, [*lines, f'bias:tension:{other}']).muscles.tension
    assert after[MUSCLE] == before and after[MUSCLE + 1] > before + 50.0


def test_a_drift_goes_on_when_another_fault_is_added(robot):
    faults, readings = Faults(robot, np.random.default_rng(0)), numbered(robot, 0)
    drift = 'drift:length:0.01'
    for lines in ([drift], [drift, 'bias:tension']):
        faults.set(lines)
        faults.pass_time(1.0)
    np.testing.assert_allclose(faults.apply(readings).muscles.length, 0.02)
    faults.set([])
    faults.set([drift])  # the drift was removed, so it starts from 0 again
    np.testing.assert_allclose(faults.apply(readings).muscles.length, 0.0)


def sensed(arm, line, count=300):
    """Return the readings of N messages with a fault, (N, M) of each quantity."""
    arm.faults.set([line])
    return MuscleReadings.stack(arm.sense().muscles for _ in range(count))


def test_sensors_are_offset_frozen_dead_or_spiky(arm, robot):
    healthy = sensed(arm, 'drop:0')
    others = np.arange(robot.muscle_count) != MUSCLE
    name = robot.muscles[MUSCLE]
    for line, quantity, size in (
        ('bias', 'length', 0.05),
        ('bias:tension', 'tension', 100.0),
        ('bias:length', 'length', -0.1),
    ):
        text = f'{line}:{name}' + (f':{size}' if size < 0.0 else '')
        off = {
            each: np.mean(getattr(sensed(arm, text), each) - getattr(healthy, each), axis=0)
            for each in SENSED
        }
        assert off[quantity][MUSCLE] == pytest.approx(size, rel=0.05)
        assert max(np.abs(each[others]).max() for each in off.values()) < 0.5
    dead = sensed(arm, f'dead_sensor:tension:{name}', 3).at(-1)
    assert dead.tension[MUSCLE] == 0.0 and dead.tension[others].min() > 5.0
    assert dead.length[MUSCLE] != 0.0
    dead = sensed(arm, 'dead_sensor', 1)
    assert not any(getattr(dead, each).any() for each in SENSED)
    frozen = sensed(arm, f'freeze:{name}', 50)
    assert max(np.ptp(getattr(frozen, each)[:, MUSCLE]) for each in SENSED) == 0.0
    assert np.ptp(frozen.tension, axis=0)[others].min() > 0.0
    spikes = sensed(arm, 'spike:temperature:80', 300).temperature
    assert 1 <= np.sum(spikes > 90.0) < 60
    assert np.all(np.sum(spikes > 90.0, axis=1) <= 1)


def test_a_fault_of_one_joint_sensor_leaves_the_others(arm, robot):
    angles = np.array([arm.sense().theta for _ in range(300)])
    for line, expected in (('dead_sensor', 0.0), ('bias', 0.1 + angles[:, 1].mean())):
        arm.faults.set([f'{line}:{robot.joints[1]}'])
        off = np.mean([arm.sense().theta for _ in range(300)], axis=0)
        assert off == pytest.approx([angles[:, 0].mean(), expected], abs=0.01)


def hold(arm, robot, lines, seconds=1.5, tension=80.0):
    arm.set_faults(lines)
    command = to_mid_range(robot, tension)
    for _ in range(round(seconds / 0.01)):
        arm.command_length(command)
        arm.step(0.01)
    return arm.sense()


def test_a_jammed_motor_stands_until_it_is_repaired(arm, robot):
    before = arm.sense().muscles.length
    after = hold(arm, robot, [f'stuck_motor:{robot.muscles[MUSCLE]}']).muscles.length
    assert after[MUSCLE] == pytest.approx(before[MUSCLE], abs=1e-3)
    assert np.abs(after - before).max() > 0.01
    assert abs(hold(arm, robot, []).muscles.length[MUSCLE] - before[MUSCLE]) > 0.005


def test_a_slack_tendon_is_wound_in(robot):
    healthy, slack = (EmulatedArm(robot, 1) for _ in range(2))
    before = hold(healthy, robot, []).muscles.length
    slack.faults.set([f'slack:{robot.muscles[MUSCLE]}'])
    slack.step(0.01)
    assert slack.tension[MUSCLE] < 5.0
    after = hold(slack, robot, [f'slack:{robot.muscles[MUSCLE]}'], 4.0).muscles.length
    assert after[MUSCLE] - before[MUSCLE] < -0.02


@pytest.mark.parametrize('reality', ['kin', 'foreign'])
def test_ending_slack_causes_no_peak_of_tension(robot, reality):
    arm, name = make_arm(robot, 1, reality), robot.muscles[MUSCLE]
    command = to_mid_range(robot, 80.0)
    for slack in ([f'slack:{name}:0.1'], []):
        arm.set_faults(slack)
        most = 0.0
        for _ in range(2000):
            arm.command_length(command)
            arm.step(0.001)
            most = max(most, arm.tension[MUSCLE])
    assert most < 200.0  # if the slack ended at once, the tension would rise to 2996 N
    arm.set_faults([f'slack:{name}'])
    arm.reset()
    assert arm.tension[MUSCLE] == pytest.approx(robot.tension.bias[MUSCLE])
    arm.step(0.01)
    assert arm.tension[MUSCLE] > 0.5 * robot.tension.bias[MUSCLE]


def test_a_ruptured_tendon_stays_ruptured_until_the_fault_ends(arm, robot):
    arm.set_faults([f'rupture:{robot.muscles[MUSCLE]}', 'drop:0.1'])
    for change in (lambda: None, arm.reset, lambda: arm.set_faults(['rupture', 'drop'])):
        change()
        arm.step(0.01)
        assert arm.tension[MUSCLE] == 0.0
    arm.set_faults(['drop'])
    arm.step(0.01)
    assert arm.tension[MUSCLE] > 0.5 * robot.tension.bias[MUSCLE]


def test_an_offset_of_either_sign_shifts_the_length_of_one_muscle(arm, robot):
    before = arm.sense().muscles.length
    arm.set_faults([f'offset:{robot.muscles[MUSCLE]}:-0.02'])
    expected = -0.02 * (np.arange(robot.muscle_count) == MUSCLE)
    np.testing.assert_allclose(arm.sense().muscles.length - before, expected, atol=2e-3)
    for wrong in ('offset:2', 'offset:-2', 'offset:nan'):
        with pytest.raises(MusculoskeletalError, match='sizes from -1 to 1 m'):
            arm.set_faults([wrong])


@pytest.mark.parametrize(
    ('lines', 'sensors'),
    [
        ([], Sensors()),
        (['joints'], Sensors(joints=True)),
        (['imu:hand', 'marker'], Sensors(marker_rate=10.0, imu_link='hand')),
        (['marker:0.5'], Sensors(marker_rate=0.5)),
    ],
)
def test_lines_describe_the_sensors_of_an_arm(robot, lines, sensors):
    assert read_sensors(lines, robot) == sensors


@pytest.mark.parametrize(
    ('lines', 'legal'),
    [
        (['radar'], "'radar' describes no sensor; legal: joints, marker"),
        (['joints:3'], 'legal: joints, marker'),
        (['marker:0'], 'above 0 to 100 Hz'),
        (['marker:nan'], 'above 0 to 100 Hz'),
        (['marker:fast'], 'above 0 to 100 Hz'),
        (['imu:knee'], "unknown link 'knee'; legal: .*forearm"),
        (['imu:hand', 'imu:forearm'], 'the second sensor of its kind'),
    ],
)
def test_a_line_that_describes_no_sensor_is_refused(robot, lines, legal):
    with pytest.raises(MusculoskeletalError, match=legal):
        read_sensors(lines, robot)


def test_a_slow_winch_keeps_its_speed(robot):
    arm, name = EmulatedArm(robot, 1), robot.muscles[MUSCLE]
    lines = [f'slack:{name}', f'winch_speed:{name}:0.009']
    wound = (
        hold(arm, robot, lines, 0.5).muscles.length - hold(arm, robot, lines, 2.5).muscles.length
    )
    assert wound[MUSCLE] == pytest.approx(0.0225, abs=0.002)


def test_unzeroed_winches_have_length_offsets(arm):
    before = arm.sense().muscles.length
    arm.faults.set(['unzeroed:0.1'])
    off = arm.sense().muscles.length - before
    assert (np.abs(off) > 0.038).all() and (np.abs(off) < 0.102).all() and np.ptp(off) > 0.05


def test_an_overheated_module_is_hot_until_a_reset(arm, robot):
    name = robot.muscles[MUSCLE]
    hot = hold(arm, robot, [f'overheat:{name}:95'], 0.1).muscles.temperature
    assert hot[MUSCLE] > 90.0 and np.delete(hot, MUSCLE).max() < 40.0
    arm.faults.set([])
    arm.step(0.1)
    assert (
        arm.sense().muscles.temperature[MUSCLE] > 90.0
    )  # the motor cools only slowly after the repair
    arm.reset()
    assert arm.sense().muscles.temperature.max() < 40.0


@pytest.mark.parametrize(
    'line',
    ['melt', 'drop:2', 'spike:length:inf', 'stuck_motor:nobody', 'bias:pressure'],
)
def test_an_illegal_fault_is_refused_with_the_legal_ones(line, arm):
    arm.faults.set(['stuck_motor'])
    with pytest.raises(MusculoskeletalError, match='legal'):
        arm.faults.set(['drop', line])
    assert arm.faults.stuck.all()


@pytest.mark.parametrize('name', KINDS)
def test_every_kind_of_fault_can_be_set_by_name_and_repaired(name, arm, robot):
    assert read_fault(name, robot).kind == name
    hold(arm, robot, [name], 0.2)
    hold(arm, robot, [], 0.5)
    assert arm.faults.deliver(arm.sense(), 100.0)
    assert not arm.faults.stuck.any() and not arm.faults.slack.any()
    assert np.isfinite(arm.theta).all()


@pytest.mark.parametrize('reality', ['kin', 'foreign'])
def test_an_arm_mounted_upside_down_falls_upwards_and_its_accelerometer_shows_it(robot, reality):
    fallen, readings = [], []
    for lines in ([], ['mount_y:3.1416'], []):
        arm = make_arm(robot, 1, reality)
        arm.set_faults(['mount_x'])
        arm.set_faults([*lines, 'rupture'])
        arm.step(2.0)
        fallen.append(robot.kinematics.end_effector_pose(arm.theta).translation[2])
        readings.append(arm.accelerometer('torso')[2])
    assert fallen[1] > fallen[0] + 0.2 and fallen[2] == pytest.approx(fallen[0])
    assert readings[0] > 9.0 and readings[1] < -9.0


def test_a_saturated_tension_sensor_reads_no_more_than_its_size(arm, robot):
    name = robot.muscles[MUSCLE]
    arm.set_faults([f'saturate:{name}:20'])
    arm.command_length(to_mid_range(robot, 80.0))
    arm.step(1.0)
    assert arm.tension[MUSCLE] > 30.0
    read = arm.sense().muscles.tension
    assert read[MUSCLE] == 20.0 and np.delete(read, MUSCLE).max() > 30.0
