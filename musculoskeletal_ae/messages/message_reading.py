# SPDX-License-Identifier: Apache-2.0
"""Validate messages and read their values, one function for each kind of message.

`signals/muscle_states.py` does so for muscle states.

doc/reference/topics_and_services.md lists the rules. The functions access only the fields of a
message, which may be live or from a bag. An invalid message raises a `MessageError` with a short
reason; the caller counts it and continues.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.report import distinct
from musculoskeletal_ae.robot.joint_units import JointUnits

#: reject a message with more entries than this in an array, or a trajectory with more joints ×
#: points; no arm needs nearly as many
MOST_ENTRIES = 10_000
#: reject a wrench whose force [N] or torque [N·m] exceeds this along any axis
MOST_WRENCH = np.array([1000.0] * 3 + [30.0] * 3)
#: reject a twist whose linear [m/s] or angular [rad/s] velocity exceeds this along any axis
MOST_TWIST = np.array([5.0] * 3 + [20.0] * 3)
#: reject accelerometer readings outside this range [m/s²]; a sensor at rest measures 9.81
LEAST_GRAVITY, MOST_GRAVITY = 3.0, 30.0
#: reject a trajectory that ends with a higher velocity than this [rad/s], because the arm holds its
#: last point
LAST_VELOCITY = 1e-6
MOST_EFFORT = 1000.0  # reject a request for more torque or force at one joint than this [N·m or N]
UNIT_TOLERANCE = 0.01  # reject a quaternion whose norm differs from 1 by more than this


def read_array(message: Any, rows: int, columns: int, owner: str = 'muscle') -> Array:
    """Return the data of a Float64MultiArray as (rows, columns), or (columns,) for one row.

    The data must be finite. The layout may be empty; otherwise it must match, and the label of the
    columns is `owner`.
    """
    values = read_rows(message, rows, columns, owner)
    finite = np.isfinite(values)
    if not finite.all():
        place = np.flatnonzero(~finite)[0]
        detail = f'element {place} of the data is {values.flat[place]}; expected a finite number'
        raise MessageError('not finite', detail)
    return values[0] if rows == 1 else values


def read_rows(message: Any, rows: int, columns: int, owner: str = 'muscle') -> Array:
    """Return the data of a Float64MultiArray as (rows, columns), with size and layout checked.

    `owner` is the legal label of the columns.
    """
    count = len(message.data)
    if count > MOST_ENTRIES:
        raise MessageError('oversized', f'{count} values; legal: at most {MOST_ENTRIES}')
    if count == 0:
        raise MessageError('empty', f'the data have no values; expected {rows * columns}')
    if count != rows * columns:
        raise MessageError('wrong length', f'{count} values; expected {rows * columns}')
    stated = [(dim.label, dim.size, dim.stride) for dim in message.layout.dim]
    legal = [('quantity', rows, rows * columns), (owner, columns, columns)][rows == 1 :]
    fits = len(stated) == len(legal) and all(
        label in ('', name) and size == length and stride in (0, step)
        for (label, size, stride), (name, length, step) in zip(stated, legal)
    )
    if stated and not fits:
        raise MessageError('wrong layout', f'{stated}; expected {legal}')
    if message.layout.data_offset != 0:
        raise MessageError(
            'wrong layout', f'data_offset is {message.layout.data_offset}; expected 0'
        )
    return np.array(message.data, dtype=float).reshape(rows, columns)


def read_posture(message: Any, units: JointUnits, some: bool = False) -> Array:
    """Return θ [rad], (D,), from a measured JointState.

    Joints are matched by name, and joints of the message that are not in `units` are ignored.
    Every joint in `units` must have a finite position. With `some`, one finite position is enough,
    and θ of all other joints is NaN. Velocities and efforts are not checked, because drivers
    publish NaN for quantities that they do not measure.
    """
    names, joints = joint_names(message), units.names
    index = {name: i for i, name in enumerate(names)}
    known = [name for name in joints if name in index]
    if len(index) < len(names):
        for name in known:
            if names.count(name) > 1:
                raise MessageError('duplicate joint', f'{name!r} is listed more than once')
    if len(known) < (1 if some else len(joints)):
        missing = ', '.join(name for name in joints if name not in index)
        raise MessageError('missing joint', missing)
    position = [message.position[index[name]] if name in index else np.nan for name in joints]
    theta = np.array(position, dtype=float)
    finite = np.isfinite(theta)
    if np.count_nonzero(finite) < (1 if some else len(known)):
        raise MessageError('not finite', _positions_of(joints_not_finite(message, joints)))
    theta[~finite] = np.nan
    return units.to_theta(theta)


def joints_not_finite(message: Any, joints: Sequence[str]) -> list[str]:
    """Return the names in `joints` whose position in a JointState is NaN or infinite."""
    return [
        name
        for name, position in zip(message.name, message.position)
        if name in joints and not math.isfinite(position)
    ]


def _positions_of(names: Sequence[str]) -> str:
    return f'position of {", ".join(names)}'


def read_target(message: Any, units: JointUnits) -> dict[str, tuple[float, float]]:
    """Return θ [rad] and torque [N·m], by joint name, of a JointState that is a command.

    The rules are those of `target_values`.
    """
    of = dict(zip(units.names, units, strict=True))
    return {
        name: (position / of[name].radian, effort * of[name].radian)
        for name, (position, effort) in target_values(message, units.names).items()
    }


def target_values(message: Any, joints: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Return position and effort, by joint name, of a JointState that is a command.

    The values are in the units of the message, which need not contain all joints. Without efforts
    in the message, efforts are 0.
    """
    names = joint_names(message)
    listed = set(joints)
    if unknown := [name for name in names if name not in listed]:
        raise MessageError('unknown joint', f'{unknown[0]!r}; legal: {", ".join(joints)}')
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise MessageError('duplicate joint', f'{name!r} is listed more than once')
    efforts = np.array(message.effort if len(message.effort) else [0.0] * len(names), dtype=float)
    for what, values in (
        ('position', message.position), ('effort', efforts), ('velocity', message.velocity)
    ):  # fmt: skip
        wrong = [name for name, value in zip(names, values) if not math.isfinite(value)]
        if wrong:
            stated = f'{what} of {", ".join(wrong)}'
            raise MessageError('not finite', f'{stated}; expected finite numbers')
    for name, effort in zip(names, efforts.tolist()):
        if abs(effort) > MOST_EFFORT:
            value, most = distinct(effort, math.copysign(MOST_EFFORT, effort))
            legal = f'at most ±{most.lstrip("-")} N·m or N'
            raise MessageError('oversized', f'effort of {name} is {value}; legal: {legal}')
    return dict(zip(names, zip(message.position, efforts.tolist())))


def joint_names(message: Any) -> list[str]:
    """Return the joint names of a JointState after checking the lengths of its arrays.

    Arrays of velocities and efforts may be empty.
    """
    names = list(message.name)
    counts = len(names), len(message.position), len(message.effort), len(message.velocity)
    if max(counts) > MOST_ENTRIES:
        raise MessageError('oversized', f'{max(counts)} entries; legal: at most {MOST_ENTRIES}')
    if not names:
        raise MessageError('empty', 'no joints')
    if counts[1] != counts[0] or not set(counts[2:]) <= {0, counts[0]}:
        stated = '{} names, {} positions, {} efforts, {} velocities'.format(*counts)
        legal = 'a position for each name, and as many efforts and velocities, or none'
        raise MessageError('wrong length', f'{stated}; expected {legal}')
    return names


def read_imu(message: Any, links: Sequence[str], prefix: str = '') -> tuple[str, Array]:
    """Return the link that carries an IMU, and the acceleration [m/s²], (3,), of an Imu message.

    The frame of the message is the name of the link, which may follow `prefix`.
    """
    link, vector = message.header.frame_id.removeprefix(prefix), message.linear_acceleration
    if link not in links:
        problem = f'{message.header.frame_id!r}; legal: {", ".join(links)}'
        raise MessageError('wrong frame', problem)
    acceleration = np.array([vector.x, vector.y, vector.z])
    if not np.isfinite(acceleration).all():
        raise _not_finite('an acceleration', acceleration)
    norm = float(np.linalg.norm(acceleration))
    if not LEAST_GRAVITY <= norm <= MOST_GRAVITY:
        legal = f'{LEAST_GRAVITY:g} to {MOST_GRAVITY:g} (an IMU at rest measures 9.81)'
        raise MessageError('implausible gravity', f'{norm:.3g} m/s²; legal: {legal}')
    return link, acceleration


def read_wrench(message: Any, root_link: str) -> Array:
    """Return force [N] and torque [N·m], together (6,), of a WrenchStamped.

    The frame of the message must be `root_link` or empty; an empty frame counts as `root_link`.
    """
    if message.header.frame_id not in ('', root_link):
        raise MessageError('wrong frame', f'{message.header.frame_id!r}; expected {root_link!r}')
    wrench = message.wrench
    return _six(wrench.force, wrench.torque, MOST_WRENCH, 'a force or torque')


def _six(first: Any, second: Any, most: Array, what: str) -> Array:
    """Return two vectors as one array (6,), whose elements must be finite and within ±`most`.

    `what` names the vectors in messages of errors.
    """
    values = np.array([first.x, first.y, first.z, second.x, second.y, second.z])
    if not np.isfinite(values).all():
        raise _not_finite(what, values)
    if (np.abs(values) > most).any():
        detail = f'{what} is too large: {values}; legal: magnitudes of at most {most}'
        raise MessageError('oversized', detail)
    return values


def _not_finite(what: str, values: Array) -> MessageError:
    """Return the error for an array with NaN or infinite values; it states the first of these.

    `what` names the array in the message.
    """
    return MessageError(
        'not finite', f'{what} is {values[~np.isfinite(values)][0]}; expected finite numbers'
    )


class TrajectoryPoints(NamedTuple):
    """K points of some joints in a JointTrajectory."""

    joints: Ints  # indices of the named joints in θ, (J,)
    time: Array  # times of the points, relative to the start [s], (K,)
    position: Array  # positions of the named joints at each point [rad], (K, J)
    #: velocities at each point [rad/s], (K, J); None if the message states none
    velocity: Array | None
    #: accelerations at each point [rad/s²], (K, J); None if the message states none
    acceleration: Array | None

    def later(self, slower: float) -> TrajectoryPoints:
        """Return the points slowed by the factor `slower`."""
        velocity, acceleration = self.velocity, self.acceleration
        return self._replace(
            time=self.time * slower,
            velocity=None if velocity is None else velocity / slower,
            acceleration=None if acceleration is None else acceleration / slower**2,
        )


def read_trajectory(message: Any, units: JointUnits) -> TrajectoryPoints | None:
    """Return the points of a JointTrajectory; None if it is empty, which commands the arm to stop.

    Velocities and accelerations must be present at all points or at none.
    """
    names, points, joints = list(message.joint_names), list(message.points), units.names
    if len(names) * max(len(points), 1) > MOST_ENTRIES:
        problem = (
            f'{len(points)} points of {len(names)} joints; legal: at most {MOST_ENTRIES} values'
        )
        raise MessageError('oversized', problem)
    if not points:
        return None
    _check_names(names, joints)
    position, velocity, acceleration, effort = (
        _column(points, what, len(names))
        for what in ('positions', 'velocities', 'accelerations', 'effort')
    )
    assert position is not None
    if effort is not None:
        raise MessageError(
            'effort', 'the points have efforts; legal: positions, velocities, accelerations'
        )
    if velocity is None and acceleration is not None:
        detail = 'the points have accelerations, but no velocities; send both'
        raise MessageError('wrong length', detail)
    spans = [point.time_from_start for point in points]
    time = np.array([span.sec + 1e-9 * span.nanosec for span in spans])
    if not (np.diff(time, prepend=-1e-9) > 0.0).all() or time[0] < 0.0:
        stated = f'{time[:20].tolist()}; expected increasing times of at least 0'
        raise MessageError('times negative or not increasing', stated)
    columns = {'position': position, 'velocity': velocity, 'acceleration': acceleration}
    for what, column in columns.items():
        if column is not None and not np.isfinite(column).all():
            point, joint = np.argwhere(~np.isfinite(column))[0]
            place = f'{what} of {names[joint]} at point {point + 1}'
            raise MessageError('not finite', f'{place}; expected a finite number')
    if velocity is not None and np.abs(velocity[-1]).max() > LAST_VELOCITY:
        raise MessageError(
            'moves at its end', f'the last velocities are {velocity[-1].tolist()}; expected 0'
        )
    places = np.array([joints.index(name) for name in names])
    values = (
        None if each is None else units.to_theta(each, places) for each in (velocity, acceleration)
    )
    return TrajectoryPoints(places, time, units.to_theta(position, places), *values)


def _check_names(names: Sequence[str], joints: Sequence[str]) -> None:
    """Check that a trajectory names joints of the robot, each once."""
    if not names:
        raise MessageError('empty', 'the trajectory has points, but no joint_names')
    if unknown := [name for name in names if name not in joints]:
        raise MessageError('unknown joint', f'{unknown[0]!r}; legal: {", ".join(joints)}')
    if len(set(names)) < len(names):
        name = max(names, key=names.count)
        raise MessageError('duplicate joint', f'{name!r} is listed more than once')


def _column(points: Sequence[Any], what: str, joint_count: int) -> Array | None:
    """Return the field `what` of all K points as an array (K, joint_count).

    The result is None if the points do not state this quantity.
    """
    rows = [getattr(point, what) for point in points]
    lengths = {len(row) for row in rows}
    legal = {joint_count} if what == 'positions' else {0, joint_count}
    if len(lengths) > 1 or not lengths <= legal:
        found, expected = (' or '.join(map(str, sorted(sizes))) for sizes in (lengths, legal))
        problem = f'the points have {found} {what}; expected {expected} at every point'
        raise MessageError('wrong length', problem)
    return None if 0 in lengths else np.array([list(row) for row in rows], dtype=float)


def read_twist(message: Any, frame: str) -> Array:
    """Return linear [m/s] and angular velocity [rad/s], together (6,), of a TwistStamped.

    The frame of the message must be `frame`.
    """
    if message.header.frame_id != frame:
        raise MessageError('wrong frame', f'{message.header.frame_id!r}; expected {frame!r}')
    twist = message.twist
    return _six(twist.linear, twist.angular, MOST_TWIST, 'a linear or angular velocity')


def without_orientation(message: Any) -> bool:
    """Return whether a PoseStamped commands only a position.

    Its quaternion is then (0, 0, 0, 0).
    """
    turn = message.pose.orientation
    return not any((turn.x, turn.y, turn.z, turn.w))


def read_pose(message: Any, frame: str, position_only: bool = False) -> pin.SE3:
    """Return the pose of a PoseStamped, whose frame must be `frame`.

    With `position_only`, the rotation in the message is ignored, and the result has none.
    """
    if message.header.frame_id != frame:
        raise MessageError('wrong frame', f'{message.header.frame_id!r}; expected {frame!r}')
    position, turn = message.pose.position, message.pose.orientation
    values = np.array([turn.x, turn.y, turn.z, turn.w, position.x, position.y, position.z])
    if position_only:
        values[:4] = 0.0, 0.0, 0.0, 1.0
    if not np.isfinite(values).all():
        raise _not_finite('a position or orientation', values)
    norm = np.linalg.norm(values[:4])
    if abs(norm - 1.0) > UNIT_TOLERANCE:
        detail = f'{values[:4]} has the norm {norm:.4g}; legal: 1 ± {UNIT_TOLERANCE:g}'
        raise MessageError('not a unit quaternion', detail)
    values[:4] /= norm
    return pin.XYZQUATToSE3(np.concatenate([values[4:], values[:4]]))
