# SPDX-License-Identifier: Apache-2.0
"""Joint trajectories: interpolation between points, replacement, and slowing.

As in joint_trajectory_controller, the interpolation depends on the fields of the points:

    positions                                  straight lines: velocity jumps at the points
    positions, velocities                      cubics: velocity is continuous
    positions, velocities, accelerations       quintics: acceleration is continuous

The curve begins at the setpoint that the arm follows when the message arrives. Points whose time
has passed are skipped. Joints that a message does not name keep the position of this setpoint. The
arm holds the position of the last point. An empty message brings the arm to rest.

A trajectory is slowed in two ways. As a whole (`scaled`), all times are multiplied by a factor s,
velocities divided by s and accelerations divided by s². If it starts at rest, its path stays the
same. Where necessary (`eased`), the factor changes along the way, and the path always stays the
same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.messages.message_reading import TrajectoryPoints
from musculoskeletal_ae.report import distinct
from musculoskeletal_ae.robot.robot import Robot

#: refuse a curve that exceeds the joint limits between its points by more than this [rad]
BEYOND = 0.02
STOPPING = 0.3  # bring a cancelled motion to rest in this time [s]
SAMPLES = 200  # evaluate a trajectory at about this many instants to check limits and speeds
WITHIN = 5  # evaluate each piece between two points at no fewer instants than this
#: replace a requested time of 0 by this time [s]; the planner then slows the motion as necessary
AT_ONCE = 0.01
#: Refuse two successive times that are closer than this, relative to the later one: in a shorter
#: piece of the curve, rounding errors of the time would matter.
RESOLUTION = 1e-11
#: Take at least this time to join a motion that is under way [s]; for a trajectory that is late by
#: less than this, take as much time as it is late. Points that are due sooner are skipped, except
#: the last: a point that is due at once would slow the whole trajectory down.
JOINING = 0.1
# Matrices that give the coefficients c of u(τ) = Σ c_k τ^k, τ in [0, 1], from position, velocity
# and acceleration at both ends.
LINEAR = np.array([[1, 0, 0, 0, 0, 0], [-1, 0, 0, 1, 0, 0], *np.zeros((4, 6))])
CUBIC = np.array(
    [[1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0], [-3, -2, 0, 3, -1, 0], [2, 1, 0, -2, 1, 0],
     *np.zeros((2, 6))]
)  # fmt: skip
QUINTIC = np.array(
    [[1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 0.5, 0, 0, 0],
     [-10, -6, -1.5, 10, -4, 0.5], [15, 8, 1.5, -15, 7, -1], [-6, -3, -0.5, 6, -3, 0.5]]
)  # fmt: skip


class Setpoint(NamedTuple):
    """Desired motion at one instant, each array (D,), or at N instants, each array (N, D)."""

    theta: Array  # joint angles [rad]
    velocity: Array  # joint velocities [rad/s]
    acceleration: Array  # joint accelerations [rad/s²]

    @classmethod
    def resting(cls, theta: Array) -> Setpoint:
        """Return the setpoint of an arm that rests at the posture θ [rad], (D,)."""
        return cls(theta, np.zeros_like(theta), np.zeros_like(theta))


@dataclass(frozen=True)
class Slowdown:
    """Slows a trajectory by a factor that changes along the way.

        dt/du = f(u),   u̇ = 1/f,   ü = −f'/f³

    u is the time on the original trajectory, t that on the slowed one. The factor f is linear
    between N instants.
    """

    original: Array  # u of the instants [s], (N,), increasing from 0
    factor: Array  # f at the instants, (N,); positive
    time: Array  # t at the instants [s], (N,)

    @classmethod
    def by(cls, original: Array, factor: Array) -> Slowdown:
        """Return the slowdown by factors f (N,) at the instants u [s], (N,)."""
        spans = 0.5 * (factor[1:] + factor[:-1]) * np.diff(original)
        return cls(original, factor, np.append(0.0, np.cumsum(spans)))

    def slowed(self, original: Array) -> Array:
        """Return the times t [s] of instants u [s]."""
        k, change = self._pieces(self.original, original)
        after = original - self.original[k]
        return self.time[k] + after * (self.factor[k] + 0.5 * change * after)

    def at(self, time: Array) -> tuple[Array, Array, Array]:
        """Return the time u [s] on the original trajectory, u̇ and ü [1/s], at times t [s]."""
        k, change = self._pieces(self.time, time)
        after, factor = time - self.time[k], self.factor[k]
        now = np.sqrt(factor**2 + 2.0 * change * after)
        return self.original[k] + 2.0 * after / (factor + now), 1.0 / now, -change / now**3

    def _pieces(self, knots: Array, at: Array) -> tuple[Ints, Array]:
        """Return the piece in which each instant is, and f' in it [1/s]."""
        k = np.clip(np.searchsorted(knots, at, side='right') - 1, 0, len(knots) - 2)
        factor, original = self.factor, self.original
        return k, (factor[k + 1] - factor[k]) / (original[k + 1] - original[k])


@dataclass(frozen=True)
class Trajectory:
    """A piecewise polynomial curve from `start` through points."""

    start: Setpoint
    points: TrajectoryPoints  # points that were still ahead at the start of the trajectory
    time: Array  # times of the knots [s], (K,); the first time is 0
    coefficients: Array  # coefficients of each piece, (K−1, 6, D)
    end: Array  # posture that is held after the last point [rad], (D,)
    slowed: float = 1.0  # factor by which the slowed trajectory lasts longer
    slowdown: Slowdown | None = None  # how it is slowed where necessary; None if it is not

    @classmethod
    def through(cls, start: Setpoint, points: TrajectoryPoints, passed: float = 0.0) -> Trajectory:
        """Return the trajectory from `start` through the points that are still ahead.

        Of a trajectory that began in the past, points that are due too soon are skipped, too. A
        single point at time 0 is reached as fast as possible.

        Args:
            start: Setpoint at which the trajectory begins.
            points: The points; their times count from the same instant, the time 0 of the points.
            passed: Time elapsed since this time 0 [s]; points before it are skipped.

        Raises:
            MessageError: If no point remains, or two points are too close in time.
        """
        kept = points.time > passed + min(passed, JOINING) + 1e-9
        kept[-1] = points.time[-1] > passed + 1e-9
        # If all points are at time 0, they are requested after AT_ONCE instead. The planner then
        # slows the trajectory as far as necessary.
        if not kept.any() and passed == 0.0:
            points = points._replace(time=points.time + AT_ONCE)
            kept = points.time >= AT_ONCE
        if not kept.any():
            detail = f'the trajectory started {passed:.3g} s ago; send a later header.stamp, or 0'
            raise MessageError('all points have passed', detail)
        velocity, acceleration = (None if part is None else part[kept] for part in points[3:])
        time, position = points.time[kept] - passed, points.position[kept]
        if ((apart := np.diff(time, prepend=0.0)) < RESOLUTION * time).any():
            raise MessageError(
                'points too close in time',
                f'two points are only {apart.min():.3g} s apart; send one of them only',
            )
        left = TrajectoryPoints(points.joints, time, position, velocity, acceleration)
        return cls._joined(start, left)

    @classmethod
    def _joined(cls, start: Setpoint, points: TrajectoryPoints, slowed: float = 1.0) -> Trajectory:
        time = np.concatenate([[0.0], points.time])
        degrees = [points.velocity, points.acceleration]
        every = np.zeros((3, len(time), len(start.theta)))
        every[0] = start.theta
        every[:, 0] = start
        every[0, 1:, points.joints] = points.position.T
        for order, values in enumerate(degrees, 1):
            if values is not None:
                every[order, 1:, points.joints] = values.T
        shape = LINEAR if degrees[0] is None else CUBIC if degrees[1] is None else QUINTIC
        span = np.diff(time)[:, None]
        first, last = every[:, :-1], every[:, 1:]
        scales = np.stack([np.ones_like(span), span, span**2])
        ends = np.concatenate([scales * first, scales * last])
        pieces = np.einsum('cp,pkd->kcd', shape, ends)
        return cls(start, points, time, pieces, every[0, -1], slowed)

    @classmethod
    def to(cls, start: Setpoint, theta: Array, duration: float) -> Trajectory:
        """Return a trajectory of quintics that comes to rest at each of one or more postures.

        A motion that starts at rest is a minimum-jerk motion.

        Args:
            start: Setpoint at which the trajectory begins.
            theta: One posture θ [rad], (D,), or K postures, (K, D).
            duration: Time from each posture to the next [s].
        """
        path = np.atleast_2d(theta)
        (count, joints), still = path.shape, np.zeros(path.shape)
        time = duration * np.arange(1.0, count + 1.0)
        return cls.through(start, TrajectoryPoints(np.arange(joints), time, path, still, still))

    @classmethod
    def stopping(cls, start: Setpoint, robot: Robot) -> Trajectory:
        """Return a trajectory that comes to rest within STOPPING seconds."""
        return cls.to(start, _halt(start, robot), STOPPING)

    def after_rest(self, robot: Robot) -> Trajectory:
        """Return a trajectory that first comes to rest and then passes through the points.

        The points have to name all joints. A slowed curve that starts in motion overshoots more if
        it lasts longer; coming to rest first avoids that.
        """
        points, still = self.points, np.zeros((1, len(self.end)))
        time = np.append(STOPPING, STOPPING + points.time)
        where = np.vstack([_halt(self.start, robot), points.position])
        rates = (None if part is None else np.vstack([still, part]) for part in points[3:])
        return self.through(self.start, TrajectoryPoints(points.joints, time, where, *rates))

    def check(self, robot: Robot) -> None:
        """Check that the curve stays within the joint limits between its points.

        Raises:
            MessageError: If the curve exceeds the limits by more than `BEYOND`.
        """
        _, theta = self.path
        out = np.maximum(robot.lower - theta, theta - robot.upper).max(axis=0)
        if not np.isfinite(out).all():
            raise MessageError(
                'leaves the joint limits',
                'between the points, the curve is not finite; send smaller velocities and '
                'accelerations',
            )
        if (out > BEYOND).any():
            j = int(out.argmax())
            excess, legal = distinct(*robot.units.to_position(np.array([out[j], BEYOND]), j))
            joint, unit = robot.joints[j], robot.units[j].position
            raise MessageError(
                'leaves the joint limits',
                f'between the points, joint {joint} exceeds its limits by {excess} {unit}; legal: '
                f'at most {legal} {unit}; send more points or smaller velocities',
            )

    @property
    def path(self) -> tuple[Array, Array]:
        """The curve at N instants, several in each piece: times [s], (N,), and θ [rad], (N, D)."""
        share = np.linspace(0.0, 1.0, max(WITHIN, SAMPLES // (len(self.time) - 1)), endpoint=False)
        inner = (self.time[:-1, None] + np.diff(self.time)[:, None] * share).ravel()
        time = np.append(inner, self.time[-1])
        theta = share[:, None] ** np.arange(6.0) @ self.coefficients  # (K−1, n, D)
        joints = len(self.end)
        time = time if self.slowdown is None else self.slowdown.slowed(time)
        return time, np.append(theta, self.end).reshape(-1, joints)

    @property
    def duration(self) -> float:
        """Duration of the trajectory [s]."""
        return float(self.time[-1] if self.slowdown is None else self.slowdown.time[-1])

    def sample(self, time: Array | float) -> Setpoint:
        """Return the setpoint at one time or at times (N,) [s].

        Before the start and after the end of the trajectory, the setpoint is at rest.
        """
        time = np.asarray(time)
        within = np.clip(time, 0.0, self.duration)
        if self.slowdown is None:
            theta, velocity, acceleration = self._original(within)
        else:
            original, rate, change = self.slowdown.at(within)
            theta, velocity, acceleration = self._original(original)
            rate, change = rate[..., None], change[..., None]
            acceleration = acceleration * rate**2 + velocity * change
            velocity = velocity * rate
        moving = ((time >= 0.0) & (time < self.duration))[..., None]
        return Setpoint(theta, moving * velocity, moving * acceleration)

    def _original(self, time: Array) -> Setpoint:
        """Return the setpoint of the curve without its slowdown, at times from 0 to its end [s]."""
        piece = np.clip(np.searchsorted(self.time, time, side='right') - 1, 0, len(self.time) - 2)
        span = np.diff(self.time)[piece]
        tau = ((time - self.time[piece]) / span)[..., None]
        c, k = np.moveaxis(self.coefficients[piece], -2, 0), np.arange(6.0)
        powers = tau**k  # (..., 6)
        theta = np.einsum('k...d,...k->...d', c, powers)
        velocity = np.einsum('k...d,...k->...d', c[1:], k[1:] * powers[..., :-1])
        acceleration = np.einsum('k...d,...k->...d', c[2:], k[2:] * k[1:-1] * powers[..., :-2])
        rate = (1.0 / span)[..., None]
        return Setpoint(theta, velocity * rate, acceleration * rate**2)

    def scaled(self, slower: float) -> Trajectory:
        """Return the trajectory slowed as a whole by the factor `slower`.

        A trajectory that has been slowed where necessary can no longer be slowed as a whole.
        """
        assert self.slowdown is None
        return self._joined(self.start, self.points.later(slower), self.slowed * slower)

    def eased(self, slowdown: Slowdown) -> Trajectory:
        """Return the trajectory slowed where necessary, as `slowdown` states."""
        assert self.slowdown is None
        longer = float(slowdown.time[-1] / slowdown.original[-1])
        return replace(self, slowdown=slowdown, slowed=self.slowed * longer)


def _halt(start: Setpoint, robot: Robot) -> Array:
    """Return the posture [rad], (D,), at which a motion comes to rest STOPPING seconds later."""
    return np.clip(start.theta + 0.5 * STOPPING * start.velocity, robot.lower, robot.upper)
