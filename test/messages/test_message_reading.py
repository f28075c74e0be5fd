# SPDX-License-Identifier: Apache-2.0
"""Rules for the validity and the order of messages. The tests need no graph."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from hypothesis import given
from hypothesis import strategies as st
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float64MultiArray, MultiArrayDimension, MultiArrayLayout
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.messages.message_reading import (
    joints_not_finite,
    read_array,
    read_imu,
    read_pose,
    read_posture,
    read_target,
    read_trajectory,
    read_twist,
    read_wrench,
    without_orientation,
)
from musculoskeletal_ae.robot.joint_units import JointUnits
from musculoskeletal_ae.robot.tension_source import TENSION_SENSOR
from musculoskeletal_ae.ros.message_building import array_message, posture_message
from musculoskeletal_ae.signals.muscle_states import read_muscle_states

# Stands in for a robot with two muscles.
TWO = SimpleNamespace(muscle_count=2, muscles=('triceps', 'biceps'), tension_source=TENSION_SENSOR)
UNITS = JointUnits(('a', 'b'), [False, False])


def muscle_array(data, sizes=None, strides=None, offset=0):
    strides = strides or [0] * len(sizes or [])
    dims = [
        MultiArrayDimension(size=size, stride=stride)
        for size, stride in zip(sizes or [], strides, strict=True)
    ]
    return Float64MultiArray(layout=MultiArrayLayout(dim=dims, data_offset=offset), data=data)


@given(st.integers(1, 3), st.integers(1, 8))
def test_what_is_written_is_read(rows, columns):
    values = np.arange(rows * columns, dtype=float)
    shaped = values.reshape(rows, columns) if rows > 1 else values
    labels = ('quantity', 'muscle') if rows > 1 else ('muscle',)
    np.testing.assert_array_equal(read_array(array_message(shaped, *labels), rows, columns), shaped)


def test_an_array_without_layout_is_accepted_by_its_length():
    assert read_array(muscle_array([1.0, 2.0]), 1, 2).tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ('message', 'reason'),
    [
        (muscle_array([]), 'empty'),
        (muscle_array([1.0] * 7), 'wrong length'),
        (muscle_array([0.0] * 1_000_000), 'oversized'),
        (muscle_array([1.0, 2.0, 3.0, math.nan, 5.0, 6.0]), 'not finite'),
        (muscle_array([1.0, 2.0, 3.0, 4.0, 5.0, math.inf]), 'not finite'),
        (muscle_array([0.0] * 6, [2, 3]), 'wrong layout'),
        (muscle_array([0.0] * 6, [3, 2], [6, 3]), 'wrong layout'),
        (muscle_array([0.0] * 6, offset=1), 'wrong layout'),
        (array_message(np.zeros((3, 2)), 'muscle', 'quantity'), 'wrong layout'),
    ],
)
def test_a_wrong_array_is_rejected_by_reason(message, reason):
    for read in (lambda: read_array(message, 3, 2), lambda: read_muscle_states(message, TWO)):
        with pytest.raises(MessageError) as error:
            read()
        assert error.value.reason == reason


def test_labels_of_a_layout_may_be_empty():
    assert read_array(array_message(np.zeros((3, 3)), '', ''), 3, 3).shape == (3, 3)


def test_a_temperature_that_is_not_measured_is_nan_and_nothing_else_is():
    values = [1.0, 2.0, 3.0, 4.0, math.nan, 25.0]
    np.testing.assert_array_equal(
        read_muscle_states(muscle_array(values), TWO).rows[:3].ravel(), values
    )
    with pytest.raises(MessageError, match='tension of biceps is nan'):
        read_muscle_states(muscle_array([1.0, 2.0, 3.0, math.nan, 25.0, 25.0]), TWO)


def test_values_of_isolated_muscles_are_ignored():
    legal = [[math.nan, 2.0], [3.0, 4.0], [math.nan, 25.0]]
    broken = muscle_array([math.nan, 2.0, 3.0, 4.0, math.inf, 25.0])
    np.testing.assert_array_equal(read_muscle_states(broken, TWO, [0]).rows[:3], legal)
    absurd = muscle_array([1e80, 2.0, 3.0, 4.0, -1e300, 25.0])
    np.testing.assert_array_equal(read_muscle_states(absurd, TWO, [0]).rows[:3], legal)
    np.testing.assert_array_equal(read_muscle_states(absurd, TWO).rows[:3].ravel(), absurd.data)
    with pytest.raises(MessageError, match='not finite'):
        read_muscle_states(broken, TWO, [1])


def test_measured_joints_are_matched_by_name_and_foreign_ones_ignored():
    message = JointState(name=['b', 'x', 'a'], position=[2.0, math.nan, 1.0])
    # The sensors measure neither velocity nor effort.
    message.velocity, message.effort = [math.nan] * 3, [math.nan] * 3
    assert read_posture(message, UNITS).tolist() == [1.0, 2.0]


def test_a_measurement_of_some_joints_leaves_the_others_open():
    message = JointState(name=['x', 'b'], position=[1.0, 2.0])
    np.testing.assert_array_equal(read_posture(message, UNITS, some=True), [np.nan, 2.0])
    with pytest.raises(MessageError, match='a, b'):
        read_posture(JointState(name=['x'], position=[1.0]), UNITS, some=True)


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf])
def test_a_sensor_without_a_number_costs_its_joint_only_and_is_named(value):
    message = JointState(name=['x', 'b', 'a'], position=[value, 2.0, value])
    np.testing.assert_array_equal(read_posture(message, UNITS, some=True), [np.nan, 2.0])
    assert joints_not_finite(message, UNITS.names) == ['a']
    message = JointState(name=['b', 'a'], position=[value, value])
    with pytest.raises(MessageError, match='not finite: position of b, a'):
        read_posture(message, UNITS, some=True)


@pytest.mark.parametrize('field', ['position', 'velocity', 'effort'])
def test_a_target_without_a_number_is_refused_and_names_the_joint(field):
    values = {'position': [0.1, 0.2], field: [0.1, math.nan]}
    with pytest.raises(MessageError, match=f'{field} of b'):
        read_target(JointState(name=['a', 'b'], **values), UNITS)


@pytest.mark.parametrize('field', ['positions', 'velocities', 'accelerations'])
def test_a_trajectory_without_a_number_is_refused_and_names_joint_and_point(field):
    rows = {'velocities': [(0.0, 0.0)] * 2, 'accelerations': [(0.0, 0.0)] * 2}
    rows[field] = [(0.0, 0.0), (math.nan, 0.0)]
    with pytest.raises(MessageError, match='of b at point 2'):
        read_trajectory(trajectory(**rows), UNITS)


@pytest.mark.parametrize(
    ('message', 'reason'),
    [
        (JointState(), 'empty'),
        (JointState(name=['a'], position=[1.0]), 'missing joint'),
        (JointState(name=['a', 'b', 'a'], position=[1.0, 2.0, 3.0]), 'duplicate joint'),
        (JointState(name=['a', 'b'], position=[1.0]), 'wrong length'),
        (JointState(name=['a', 'b'], position=[1.0, 2.0], effort=[1.0]), 'wrong length'),
        (JointState(name=['a', 'b'], position=[1.0, math.inf]), 'not finite'),
        (JointState(name=['a', 'b'], velocity=[1.0, 1.0]), 'wrong length'),
        (JointState(name=['x'] * 20_000, position=[0.0] * 20_000), 'oversized'),
        (JointState(name=['a', 'b'], position=[0.0] * 2, velocity=[0.0] * 20_000), 'oversized'),
    ],
)
def test_a_wrong_measurement_is_rejected_by_reason(message, reason):
    with pytest.raises(MessageError) as error:
        read_posture(message, UNITS)
    assert error.value.reason == reason


def test_a_target_may_name_a_subset_and_effort():
    message = JointState(name=['b'], position=[2.0], effort=[3.0])
    assert read_target(message, UNITS) == {'b': (2.0, 3.0)}
    assert read_target(JointState(name=['b'], position=[2.0]), UNITS) == {'b': (2.0, 0.0)}


@pytest.mark.parametrize(
    ('message', 'reason'),
    [
        (JointState(), 'empty'),
        (JointState(name=['x'], position=[1.0]), 'unknown joint'),
        (JointState(name=['a', 'a'], position=[1.0, 1.0]), 'duplicate joint'),
        (JointState(name=['a'], position=[math.nan]), 'not finite'),
        (JointState(name=['a'], position=[1.0], effort=[math.nan]), 'not finite'),
        (JointState(name=['a'], position=[1.0], velocity=[math.nan]), 'not finite'),
        (JointState(name=['a'], position=[1.0], effort=[-2000.0]), 'oversized'),
    ],
)
def test_a_wrong_target_is_rejected_by_reason(message, reason):
    with pytest.raises(MessageError) as error:
        read_target(message, UNITS)
    assert error.value.reason == reason


@pytest.mark.parametrize(('part', 'value'), [('force', -2000.0), ('torque', 1000.0)])
def test_a_wrench_that_no_arm_outlives_is_refused(part, value):
    message = WrenchStamped()
    getattr(message.wrench, part).x = value
    with pytest.raises(MessageError, match='oversized'):
        read_wrench(message, 'torso')


def test_messages_are_known_by_their_fields_whatever_library_made_them():
    from bags.arm_bag import ARRAY
    from bags.arm_bag import JOINTS as JOINT_STATE
    from bags.arm_bag import array as bag_array
    from bags.arm_bag import joints as bag_joints

    from musculoskeletal_ae.bags.message_types import decode

    values = np.arange(6.0).reshape(3, 2)
    recorded = decode(bag_array(values), ARRAY)
    np.testing.assert_array_equal(read_muscle_states(recorded, TWO).rows[:3], values)
    recorded = decode(bag_joints(['b', 'a'], [2.0, 1.0]), JOINT_STATE)
    assert read_posture(recorded, UNITS).tolist() == [1.0, 2.0]


def trajectory(names=('b', 'a'), times=(1.0, 2.5), rows=((1.0, 2.0), (3.0, 4.0)), **others):
    points = [JointTrajectoryPoint(positions=row) for row in rows]
    for point, time in zip(points, times):
        point.time_from_start.sec = int(time // 1)
        point.time_from_start.nanosec = round(1e9 * (time % 1))
    for field, values in others.items():
        for point, row in zip(points, values):
            setattr(point, field, row)
    return JointTrajectory(joint_names=names, points=points)


def test_a_trajectory_is_matched_by_name_and_an_empty_one_is_none():
    still = ((0.5, 0.0), (0.0, 0.0))
    points = read_trajectory(trajectory(velocities=still, accelerations=still), UNITS)
    assert points.joints.tolist() == [1, 0]
    assert points.time.tolist() == [1.0, 2.5]
    assert points.position.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert points.velocity.tolist() == [[0.5, 0.0], [0.0, 0.0]]
    assert read_trajectory(trajectory(['a'], rows=[[1.0]]), UNITS).velocity is None
    assert read_trajectory(JointTrajectory(), UNITS) is None


@pytest.mark.parametrize(
    ('message', 'reason'),
    [
        (trajectory(('a', 'c')), 'unknown joint'),
        (trajectory(('a', 'a')), 'duplicate joint'),
        (trajectory((), rows=((), ())), 'empty'),
        (trajectory(rows=((1.0, 2.0), (3.0,))), 'wrong length'),
        (trajectory(velocities=((0.0, 0.0), ())), 'wrong length'),
        (trajectory(accelerations=((0.0, 0.0), (0.0, 0.0))), 'wrong length'),
        (trajectory(effort=((0.0, 0.0), (0.0, 0.0))), 'effort'),
        (trajectory(times=(1.0, 1.0)), 'times negative or not increasing'),
        (trajectory(times=(-1.0, 1.0)), 'times negative or not increasing'),
        (trajectory(rows=((1.0, math.nan), (3.0, 4.0))), 'not finite'),
        (trajectory(velocities=((math.inf, 0.0), (0.0, 0.0))), 'not finite'),
        (trajectory(velocities=((0.0, 0.0), (0.0, 0.1))), 'moves at its end'),
        (trajectory(times=range(6000), rows=((0.0, 0.0),) * 6000), 'oversized'),
    ],
)
def test_what_is_no_trajectory_is_refused(message, reason):
    with pytest.raises(MessageError, match=reason):
        read_trajectory(message, UNITS)


def test_a_pose_may_contain_a_position_only_and_needs_the_right_frame():
    message = PoseStamped()
    message.header.frame_id, message.pose.orientation.w = 'base', 0.0
    assert without_orientation(message)
    message.pose.position.x = 0.3
    assert read_pose(message, 'base', position_only=True).translation.tolist() == [0.3, 0.0, 0.0]
    with pytest.raises(MessageError, match='quaternion'):
        read_pose(message, 'base')
    with pytest.raises(MessageError, match='wrong frame'):
        read_pose(message, 'hand', position_only=True)
    turn = message.pose.orientation
    turn.z = turn.w = 1.005 * math.sqrt(0.5)  # a norm of 1.005 is accepted, and normalised
    np.testing.assert_allclose(
        read_pose(message, 'base').rotation @ [1, 0, 0], [0, 1, 0], atol=1e-9
    )


def test_a_twist_is_in_the_root_link_finite_and_not_absurd():
    message = TwistStamped()
    message.twist.linear.y = 0.2
    with pytest.raises(MessageError, match='wrong frame'):
        read_twist(message, 'base')
    message.header.frame_id = 'base'
    assert read_twist(message, 'base').tolist() == [0.0, 0.2, 0.0, 0.0, 0.0, 0.0]
    for value, reason in ((math.nan, 'not finite'), (1e3, 'oversized')):
        message.twist.angular.z = value
        with pytest.raises(MessageError, match=reason):
            read_twist(message, 'base')


@pytest.mark.parametrize(
    ('acceleration', 'reason'),
    [(math.nan, 'not finite'), (0.1, 'implausible gravity'), (40.0, 'implausible gravity')],
)
def test_an_acceleration_that_is_no_gravity_is_refused_with_the_reason(acceleration, reason):
    message = Imu()
    message.header.frame_id = 'hand'
    message.linear_acceleration.z = acceleration
    with pytest.raises(MessageError) as refused:
        read_imu(message, ['hand'])
    assert refused.value.reason == reason


def test_60_mm_of_a_prismatic_joint_are_one_radian_inside_and_metres_in_messages():
    units = JointUnits(('a', 'b'), [False, True])
    message = posture_message(units, np.array([0.5, 0.5]), Time())
    assert list(message.position) == [0.5, pytest.approx(0.03)]
    np.testing.assert_allclose(read_posture(message, units), [0.5, 0.5])
    command = JointState(name=['b'], position=[0.03], effort=[10.0])
    assert read_target(command, units)['b'] == (pytest.approx(0.5), pytest.approx(0.6))
    still = [[0.0, 0.0], [0.0, 0.0]]
    rows = [[0.1, 0.003], [0.2, 0.006]]
    speeds = [[0.1, 0.003], [0.0, 0.0]]
    message = trajectory(['a', 'b'], rows=rows, velocities=speeds, accelerations=still)
    points = read_trajectory(message, units)
    np.testing.assert_allclose(points.position, [[0.1, 0.05], [0.2, 0.1]])
    np.testing.assert_allclose(points.velocity, [[0.1, 0.05], [0.0, 0.0]])
    reversed_names = trajectory(['b', 'a'], rows=[[0.003, 0.1]])
    np.testing.assert_allclose(read_trajectory(reversed_names, units).position, [[0.05, 0.1]])
