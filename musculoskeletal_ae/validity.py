# SPDX-License-Identifier: Apache-2.0
"""Which messages are used: the rules of validity (doc/interface.md), without ROS.

Messages are told by their fields, so that the rules hold for a live message and for one of a bag
alike. What breaks a rule raises `MessageError` with a short reason; who reads counts it and lives
on. A JointState is matched by name in any order, a Float64MultiArray by length and, where given,
layout.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.control.trajectory import Points
from musculoskeletal_ae.exceptions import MessageError

# Far more than any arm has; what is longer is refused before it is looked at.
MOST_ENTRIES = 10_000
# What a hand can take [N], [N·m]: a third of what the emulated arms do, any axis and posture.
MOST_WRENCH = np.array([1000.0] * 3 + [30.0] * 3)
MOST_TWIST = np.array([5.0] * 3 + [20.0] * 3)  # [m/s], [rad/s] asked of the hand
LEAST_GRAVITY, MOST_GRAVITY = 3.0, 30.0  # [m/s²] that an accelerometer reads on an arm
LAST_VELOCITY = 1e-6  # [rad/s] at which a trajectory ends
MOST_EFFORT = 1000.0  # [N·m] asked of one joint
MOST_IGNORED = 1e6  # of what does not count; a power of more overflows
UNIT_TOLERANCE = 0.01  # of a quaternion's length
QUANTITIES = ('length', 'tension', 'temperature')


def read_array(
    message: Any,
    rows: int,
    columns: int,
    ignored: Sequence[int] | Ints = (),
    unknown: float = 0.0,
) -> Array:
    """Return the data of a Float64MultiArray as (rows, columns); rows = 1 gives (columns,).

    Three rows are the `QUANTITIES`, of which a temperature may be NaN, where it is not measured.
    Of ignored columns nothing counts: what is not finite there, or as good as infinite, is returned
    as `unknown`, a temperature as NaN.
    """
    count = len(message.data)
    if count > MOST_ENTRIES:
        raise MessageError('oversized', f'{count} values, at most {MOST_ENTRIES}')
    if count == 0:
        raise MessageError('empty', f'no values, expected {rows * columns}')
    if count != rows * columns:
        raise MessageError('wrong length', f'{count} values, not {rows * columns}')
    given = [(dim.label, dim.size, dim.stride) for dim in message.layout.dim]
    legal = [('quantity', rows, rows * columns), ('muscle', columns, columns)][rows == 1 :]
    # Without labels or strides the sizes alone say the layout; what is given must match.
    fits = len(given) == len(legal) and all(
        label in ('', name) and size == count and stride in (0, step)
        for (label, size, stride), (name, count, step) in zip(given, legal)
    )
    if given and not fits:
        raise MessageError('wrong layout', f'{given}; expected {legal}')
    if message.layout.data_offset != 0:
        raise MessageError('wrong layout', f'data_offset {message.layout.data_offset}, not 0')
    values = np.array(message.data, dtype=float)
    finite = np.isfinite(values)
    shape = (rows, columns) if rows > 1 else columns
    if not len(ignored) and np.count_nonzero(finite) == count:
        return values.reshape(shape)
    sound = np.abs(values) < MOST_IGNORED
    left_out = ~sound & np.tile(np.isin(np.arange(columns), ignored), rows)
    values[left_out], finite[left_out] = unknown, True
    if rows == len(QUANTITIES):  # a module without a thermometer says NaN: not known
        values[2 * columns :][left_out[2 * columns :]] = np.nan
        finite[2 * columns :] |= np.isnan(values[2 * columns :])
    if not finite.all():
        raise MessageError('not finite', f'value {np.flatnonzero(~finite)[0]}')
    return values.reshape(shape)


def read_joints(
    message: Any, joints: Sequence[str], foreign_allowed: bool, some: bool = False
) -> dict[str, tuple[float, float]]:
    """Return name → (position, effort) of the listed joints in a JointState; no effort is 0.

    Where foreign joints are allowed (`joint_states`), those the robot does not list are ignored,
    and all that it lists are asked for, unless `some` are enough; else (targets) they are refused,
    and a subset will do.
    """
    names, efforts, speeds = list(message.name), message.effort, message.velocity
    counts = len(names), len(message.position), len(efforts), len(speeds)
    if max(counts) > MOST_ENTRIES:
        raise MessageError('oversized', f'{max(counts)} entries, at most {MOST_ENTRIES}')
    if not names:
        raise MessageError('empty', 'no joints')
    if counts[1] != counts[0] or not set(counts[2:]) <= {0, counts[0]}:
        raise MessageError(
            'wrong length', '{} names, {} positions, {} efforts, {} velocities'.format(*counts)
        )
    listed = set(joints)
    unknown = [name for name in names if name not in listed]
    if unknown and not foreign_allowed:
        raise MessageError('unknown joint', f'{unknown[0]!r}; legal: {", ".join(joints)}')
    values: dict[str, tuple[float, float]] = {}
    for i, name in enumerate(names):
        if name not in listed:
            continue
        if name in values:
            raise MessageError('duplicate joint', repr(name))
        # Drivers say NaN for a velocity or effort they do not measure; only a target's counts.
        effort = efforts[i] if len(efforts) and not foreign_allowed else 0.0
        if abs(effort) > MOST_EFFORT:
            raise MessageError('oversized', f'effort {effort:g}, at most {MOST_EFFORT:g}')
        values[name] = (message.position[i], effort)
    if foreign_allowed and len(values) < (1 if some else len(joints)):
        missing = [name for name in joints if name not in values]
        raise MessageError('missing joint', ', '.join(missing))
    if not np.isfinite(list(values.values())).all() or not (
        foreign_allowed or np.isfinite(np.asarray(speeds, dtype=float)).all()
    ):
        raise MessageError('not finite', 'a position, effort or velocity')
    return values


def read_posture(message: Any, joints: Sequence[str], some: bool = False) -> Array:
    """Return θ [rad] (D,) of a JointState that has all listed joints, others ignored.

    Where `some` are enough, the others are NaN.
    """
    count, others = len(joints), {len(message.velocity), len(message.effort)}
    # As nearly all messages are; the other way says what is wrong, and takes its time.
    if [*message.name] == [*joints] and len(message.position) == count and others <= {0, count}:
        theta = np.array(message.position, dtype=float)
        if np.count_nonzero(np.isfinite(theta)) == count:
            return theta
    values = read_joints(message, joints, foreign_allowed=True, some=some)
    return np.array([values[name][0] if name in values else np.nan for name in joints])


def read_names(message: Any) -> list[str]:
    """Return the names in a String, with commas between; they may have spaces within."""
    return [name for part in message.data.split(',') if (name := part.strip())]


def read_imu(message: Any, links: Sequence[str], prefix: str = '') -> tuple[str, Array]:
    """Return the link and the acceleration [m/s²] (3,) of an Imu, whose frame is that link."""
    link, read = message.header.frame_id.removeprefix(prefix), message.linear_acceleration
    if link not in links:
        told = f'{message.header.frame_id!r}; legal: {", ".join(links)}'
        raise MessageError('wrong frame', told)
    acceleration = np.array([read.x, read.y, read.z])
    if not np.isfinite(acceleration).all():
        raise MessageError('not finite', 'an acceleration')
    norm = float(np.linalg.norm(acceleration))
    if not LEAST_GRAVITY <= norm <= MOST_GRAVITY:
        raise MessageError('no gravity', f'{norm:.3g} m/s², an arm at rest has 9.81')
    return link, acceleration


def read_wrench(message: Any, root_link: str) -> Array:
    """Return force [N] and torque [N·m] (6,) of a WrenchStamped; no frame means the root link."""
    if message.header.frame_id not in ('', root_link):
        raise MessageError('wrong frame', f'{message.header.frame_id!r}, not {root_link!r}')
    wrench = message.wrench
    return _six(wrench.force, wrench.torque, MOST_WRENCH, 'a force or torque')


def _six(first: Any, second: Any, most: Array, what: str) -> Array:
    """Return two vectors as one (6,), all finite and no larger than `most` (6,)."""
    values = np.array([first.x, first.y, first.z, second.x, second.y, second.z])
    if not np.isfinite(values).all():
        raise MessageError('not finite', what)
    if (np.abs(values) > most).any():
        raise MessageError('oversized', f'{values}, at most {most}')
    return values


def read_trajectory(message: Any, joints: Sequence[str]) -> Points | None:
    """Return the points of a JointTrajectory, or None if it has none: come to rest.

    Velocities and accelerations are given at all points or at none.
    """
    names, points = list(message.joint_names), list(message.points)
    if len(names) * max(len(points), 1) > MOST_ENTRIES:
        told = f'{len(points)} points of {len(names)} joints, at most {MOST_ENTRIES} values'
        raise MessageError('oversized', told)
    if not points:
        return None
    if not names:
        raise MessageError('empty', 'points, but no joint_names')
    if unknown := [name for name in names if name not in joints]:
        raise MessageError('unknown joint', f'{unknown[0]!r}; legal: {", ".join(joints)}')
    if len(set(names)) < len(names):
        raise MessageError('duplicate joint', repr(max(names, key=names.count)))
    columns: dict[str, Array | None] = {}
    for what in ('positions', 'velocities', 'accelerations', 'effort'):
        rows = [getattr(point, what) for point in points]
        lengths = {len(row) for row in rows}
        legal = {len(names)} if what == 'positions' else {0, len(names)}
        if len(lengths) > 1 or not lengths <= legal:
            told = f'{what} of {sorted(lengths)} values at the points, for {len(names)} joints'
            raise MessageError('wrong length', told)
        columns[what] = None if 0 in lengths else np.array([list(row) for row in rows], dtype=float)
    position, velocity, acceleration, effort = columns.values()
    assert position is not None
    if effort is not None:
        raise MessageError('effort', 'a trajectory has positions, velocities, accelerations only')
    if velocity is None and acceleration is not None:
        raise MessageError('wrong length', 'accelerations without velocities')
    spans = [point.time_from_start for point in points]
    time = np.array([span.sec + 1e-9 * span.nanosec for span in spans])
    if not (np.diff(time, prepend=-1e-9) > 0.0).all() or time[0] < 0.0:
        raise MessageError('times do not increase', str(time[:20].tolist()))
    parts = [part for part in (position, velocity, acceleration) if part is not None]
    if not all(np.isfinite(part).all() for part in parts):
        raise MessageError('not finite', 'a position, velocity or acceleration')
    if velocity is not None and np.abs(velocity[-1]).max() > LAST_VELOCITY:
        raise MessageError('moves at its end', f'last velocities {velocity[-1].tolist()}')
    places = np.array([list(joints).index(name) for name in names])
    return Points(places, time, position, velocity, acceleration)


def read_twist(message: Any, frame: str) -> Array:
    """Return the linear [m/s] and angular velocity [rad/s] (6,) of a TwistStamped in `frame`."""
    if message.header.frame_id != frame:
        raise MessageError('wrong frame', f'{message.header.frame_id!r}, expected {frame!r}')
    twist = message.twist
    return _six(twist.linear, twist.angular, MOST_TWIST, 'a linear or angular velocity')


def without_orientation(message: Any) -> bool:
    """Whether a PoseStamped asks for a position only: its quaternion is all zeros."""
    turn = message.pose.orientation
    return not any((turn.x, turn.y, turn.z, turn.w))


def read_pose(message: Any, frame: str, position_only: bool = False) -> pin.SE3:
    """Return the pose of a PoseStamped that is given in `frame`, or its position alone."""
    if message.header.frame_id != frame:
        raise MessageError('wrong frame', f'{message.header.frame_id!r}, expected {frame!r}')
    position, turn = message.pose.position, message.pose.orientation
    values = np.array([turn.x, turn.y, turn.z, turn.w, position.x, position.y, position.z])
    if position_only:
        values[:4] = 0.0, 0.0, 0.0, 1.0
    if not np.isfinite(values).all():
        raise MessageError('not finite', 'a position or orientation')
    norm = np.linalg.norm(values[:4])
    if abs(norm - 1.0) > UNIT_TOLERANCE:
        raise MessageError('not a unit quaternion', str(values[:4]))
    values[:4] /= norm
    return pin.XYZQUATToSE3(np.concatenate([values[4:], values[:4]]))
