# SPDX-License-Identifier: Apache-2.0
"""Joint trajectories: what is between their points, what replaces what, and slowing one down.

Points are joined as joint_trajectory_controller does, by what they give:

    positions                                  straight lines: velocity jumps at the points
    positions, velocities                      cubics: velocity is continuous
    positions, velocities, accelerations       quintics: acceleration is continuous

from the state that is desired at the start. Points whose time has passed are left out, the joints
that a message does not name keep the position that they have at the start, and after the last point
its position is held. An empty message brings the arm to rest.

A trajectory is slowed as a whole: all its points come s times later, with velocities that are s and
accelerations that are s² times smaller. From rest that is the same path through the joint space.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.robot.robot import Robot

BEYOND = 0.02  # [rad], or times RACK, by which the curve between points may leave the limits
STOPPING = 0.3  # [s] in which a cancelled motion comes to rest
SAMPLES, WITHIN = 200, 5  # of a trajectory that are looked at, and of each piece at least
AT_ONCE = 0.01  # [s]
RESOLUTION = 1e-11  # share of a time that there is to the next, or doubles cannot tell any between
#: of u(τ) = Σ c_k τ^k with τ in [0, 1]: c from position, velocity, acceleration at both ends
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
    """What is desired at one moment, or at N of them: each (D,) or (N, D)."""

    theta: Array  # [rad]
    velocity: Array  # [rad/s]
    acceleration: Array  # [rad/s²]

    @classmethod
    def resting(cls, theta: Array) -> Setpoint:
        """Return a posture θ (D,) at rest."""
        return cls(theta, np.zeros_like(theta), np.zeros_like(theta))


class Points(NamedTuple):
    """K points of some joints, as a message gives them; see `validity.read_trajectory`."""

    joints: Ints  # places in θ, (J,)
    time: Array  # from the start [s], (K,)
    position: Array  # (K, J)
    velocity: Array | None
    acceleration: Array | None

    def later(self, slower: float) -> Points:
        """Return the same, passed so many times later and slower."""
        velocity, acceleration = self.velocity, self.acceleration
        return self._replace(
            time=self.time * slower,
            velocity=None if velocity is None else velocity / slower,
            acceleration=None if acceleration is None else acceleration / slower**2,
        )


@dataclass(frozen=True)
class Trajectory:
    """Curves through points, from `start` on."""

    start: Setpoint
    points: Points  # that are left
    time: Array  # of the points, the first at 0 [s], (K,)
    coefficients: Array  # of each piece, (K−1, 6, D)
    end: Array  # what is held after the last point [rad], (D,)
    slowed: float = 1.0  # how many times longer it takes

    @classmethod
    def through(cls, start: Setpoint, points: Points, passed: float = 0.0) -> Trajectory:
        """Lead through points, `passed` [s] after the time that they count from.

        One at time 0 is gone to at once. A MessageError says that no point is left, or that two are
        as good as at the same time.
        """
        kept = points.time > passed + 1e-9
        if not kept.any() and passed == 0.0:  # at once: as fast as it is slowed to
            points = points._replace(time=points.time + AT_ONCE)
            kept = points.time >= AT_ONCE
        if not kept.any():
            raise MessageError('all points have passed', f'{passed:.3g} s ago it began')
        velocity, acceleration = (None if part is None else part[kept] for part in points[3:])
        time, position = points.time[kept] - passed, points.position[kept]
        if ((apart := np.diff(time, prepend=0.0)) < RESOLUTION * time).any():
            raise MessageError('points too close in time', f'{apart.min():.3g} s apart')
        left = Points(points.joints, time, position, velocity, acceleration)
        return cls._joined(start, left)

    @classmethod
    def _joined(cls, start: Setpoint, points: Points, slowed: float = 1.0) -> Trajectory:
        time = np.concatenate([[0.0], points.time])
        degrees = [points.velocity, points.acceleration]
        every = np.zeros((3, len(time), len(start.theta)))
        every[0] = start.theta
        every[:, 0] = start
        every[0, 1:, points.joints] = points.position.T
        for order, given in enumerate(degrees, 1):
            if given is not None:
                every[order, 1:, points.joints] = given.T
        shape = LINEAR if degrees[0] is None else CUBIC if degrees[1] is None else QUINTIC
        span = np.diff(time)[:, None]
        first, last = every[:, :-1], every[:, 1:]
        scales = np.stack([np.ones_like(span), span, span**2])
        ends = np.concatenate([scales * first, scales * last])
        pieces = np.einsum('cp,pkd->kcd', shape, ends)
        return cls(start, points, time, pieces, every[0, -1], slowed)

    @classmethod
    def to(cls, start: Setpoint, theta: Array, duration: float) -> Trajectory:
        """Lead to rest at θ [rad] (D,) by a quintic, from rest the motion of least jerk.

        Or to rest at each of some postures (K, D), each within the duration [s].
        """
        path = np.atleast_2d(theta)
        (count, joints), still = path.shape, np.zeros(path.shape)
        time = duration * np.arange(1.0, count + 1.0)
        return cls.through(start, Points(np.arange(joints), time, path, still, still))

    @classmethod
    def stopping(cls, start: Setpoint, robot: Robot) -> Trajectory:
        """Come to rest within a moment, where that leads."""
        return cls.to(start, _halt(start, robot), STOPPING)

    def after_rest(self, robot: Robot) -> Trajectory:
        """Return one through points of all joints that comes to rest before it passes them.

        A start in motion carries a curve the farther, the longer it lasts.
        """
        points, still = self.points, np.zeros((1, len(self.end)))
        time = np.append(STOPPING, STOPPING + points.time)
        where = np.vstack([_halt(self.start, robot), points.position])
        rates = (None if part is None else np.vstack([still, part]) for part in points[3:])
        return self.through(self.start, Points(points.joints, time, where, *rates))

    def check(self, robot: Robot) -> None:
        """Refuse, by a MessageError, a curve that leaves the joint limits between its points."""
        _, theta = self.path
        out = np.maximum(robot.lower - theta, theta - robot.upper).max(axis=0)
        if not np.isfinite(out).all():
            raise MessageError('leaves the joint limits', 'its curve is too steep for a number')
        beyond = out / robot.kinematics.radian
        if (beyond > BEYOND).any():
            j = int(beyond.argmax())
            told = f'{robot.joints[j]} by {out[j]:.3g} {robot.units[j].theta}'
            raise MessageError('leaves the joint limits', told)

    @property
    def path(self) -> tuple[Array, Array]:
        """Moments [s] (N,) that show each piece, and so many of all, and θ [rad] (N, D) then."""
        share = np.linspace(0.0, 1.0, max(WITHIN, SAMPLES // (len(self.time) - 1)), endpoint=False)
        inner = self.time[:-1, None] + np.diff(self.time)[:, None] * share
        theta = share[:, None] ** np.arange(6.0) @ self.coefficients  # (K−1, n, D)
        joints = len(self.end)
        return np.append(inner, self.time[-1]), np.append(theta, self.end).reshape(-1, joints)

    @property
    def duration(self) -> float:
        """How long it takes [s]."""
        return float(self.time[-1])

    def sample(self, time: Array | float) -> Setpoint:
        """Return what is desired at times [s] (N,), or at one; before and after it rests."""
        inner = np.clip(np.asarray(time), 0.0, self.time[-1])
        piece = np.clip(np.searchsorted(self.time, inner, side='right') - 1, 0, len(self.time) - 2)
        span = np.diff(self.time)[piece]
        tau = ((inner - self.time[piece]) / span)[..., None]
        c, k = np.moveaxis(self.coefficients[piece], -2, 0), np.arange(6.0)
        powers = tau**k  # (..., 6)
        theta = np.einsum('k...d,...k->...d', c, powers)
        velocity = np.einsum('k...d,...k->...d', c[1:], k[1:] * powers[..., :-1])
        acceleration = np.einsum('k...d,...k->...d', c[2:], k[2:] * k[1:-1] * powers[..., :-2])
        rate = (1.0 / span)[..., None]
        moving = ((np.asarray(time) >= 0.0) & (np.asarray(time) < self.duration))[..., None]
        return Setpoint(theta, moving * velocity * rate, moving * acceleration * rate**2)

    def scaled(self, slower: float) -> Trajectory:
        """Return one whose points come so many times later."""
        return self._joined(self.start, self.points.later(slower), self.slowed * slower)


def _halt(start: Setpoint, robot: Robot) -> Array:
    """Return θ [rad] (D,) where a motion comes to rest within a moment."""
    return np.clip(start.theta + 0.5 * STOPPING * start.velocity, robot.lower, robot.upper)
