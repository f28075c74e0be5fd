# SPDX-License-Identifier: Apache-2.0
"""Find the zeros of the length sensors after power-on: what every reading is too long by.

    l_read = l(θ, T) + o                       M equations a moment, D unknown angles
    0 = g(θ) + G(θ, T)ᵀ T                      D more while the arm moves slowly

With θ known, from a stated posture or joint sensors, o is what is left of the first line. Without,
o and the postures of all moments are found together, by maximum likelihood with Student's noise and
the network's ① for l and G: muscles outnumber joints, and G changes from posture to posture, so one
o explains all of them while the arm wanders; the weight says where it stands (before anything else,
from a single posture). Damped Gauss–Newton with the postures eliminated, from the best of many
random first postures. Friction lengthens and shortens by turns, so postures must be many and be
reached from different sides; only messages at which the arm has moved on count.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

WINDOW = 0.25  # [s] that one moment averages
MOVED = 0.002  # [m] of some muscle since the last moment that counts
FASTEST = 0.05  # [m/s] of a muscle, above which inertia is no longer small beside the weight
#: [s] of gentle motion that are enough with joint angles and without, and of a stated posture
ENOUGH_SEEN, ENOUGH, STANDING = 20.0, 50.0, 1.0
FIRST, AGAIN = 0.5, 2.0  # [s] until the first guess, between later ones
SETTLED = 20.0  # [s] of motion after which the guess is only made better
MOST = 240  # moments

LENGTH_NOISE, TORQUE_NOISE = 0.001, 0.6  # [m], [N·m] of network and friction together
OFFSET, OUTSIDE = 0.1, 0.05  # [m] of a zero before anything is known; [rad] beyond the joint limits
FREEDOM = 4.0  # of the Student distribution
#: postures tried as the first one, moments that tell how good they are, those that are pursued
POSTURES, TOLD_BY, SHORTLIST, PURSUED = 400, 24, 30, 4
COARSE = 0.01, 2.0, 0.1  # [m], [N·m], [rad]: deviations that count little or much in that choice
FARTHEST = 0.3  # [m] of a zero; [rad] of a step
ROUNDS, FIRST_ROUNDS = 20, 6
STEP = 1e-3  # [rad] of differences
#: [m] median of what is left, beyond which zeros are not found but guessed wrong
LARGEST_LEFT = 0.004
UNKNOWN = 1.0  # [m] standard deviation of a zero that is being found
KNOWN = 0.05  # [m] and below, of one that was


class Zeros(NamedTuple):
    """Zeros of the length sensors and how well they are known."""

    offset: Array  # o [m], (M,)
    deviation: Array  # standard deviation [m], (M,)

    @property
    def known(self) -> bool:
        """Whether lengths can be relied on."""
        return bool(self.deviation.max() < KNOWN)


def no_offset(muscles: int) -> Zeros:
    """Return the zeros of sensors that know them."""
    return Zeros(np.zeros(muscles), np.zeros(muscles))


class Fit(NamedTuple):
    """Zeros with the postures [rad] (K, D) of K moments."""

    cost: float
    offset: Array
    theta: Array


class Parts(NamedTuple):
    """Residuals of K moments, each in its noise; and G."""

    length: Array  # (K, M)
    torque: Array  # (K, D)
    outside: Array  # (K, D)
    jacobian: Array  # [m/rad] (K, M, D)


class Zeroing:
    """Collects moments and finds the zeros a little at every message. Lengths here are readings."""

    def __init__(self, robot: Robot, mae: Mae, posture: Array | None = None, seed: int = 0) -> None:
        """Find zeros with a network; `posture` [rad] (D,) if the arm stands in a known one."""
        self._robot, self._mae, self._posture = robot, mae, posture
        self._rng = np.random.default_rng([seed, 0x2E])
        self._window: list[tuple[Array, Array, Array]] = []
        self._moments: list[tuple[Array, Array, Array]] = []  # T, l_read, θ or NaN
        self._before: Array = np.zeros(robot.muscle_count)  # l_read of the last moment that moved
        self._span = self.moving = self._since = 0.0  # [s]; of motion that counted
        self._work: Generator[None, None, Fit] | None = None
        self._fit: Fit | None = None  # the best so far
        self.zeros: Zeros | None = None  # the guess so far, known or not; None before the first
        self.trouble = ''

    @property
    def stands(self) -> bool:
        """Whether the arm is said to stand in a posture."""
        return self._posture is not None

    @property
    def enough(self) -> float:
        """Seconds of gentle motion that it takes, or of standing still where the arm is said to."""
        if self._posture is not None:
            return STANDING
        return ENOUGH_SEEN if self._seen else ENOUGH

    @property
    def _seen(self) -> bool:
        return bool(self._moments) and not np.isnan(self._moments[-1][2]).any()

    @property
    def progress(self) -> str:
        """How far it is, and what is in its way."""
        how = 'of standing still' if self._posture is not None else 'of gentle motion'
        told = f'{self.moving:.0f} of {self.enough:.0f} s {how}'
        return f'{told}; {self.trouble}' if self.trouble else told

    @property
    def done(self) -> bool:
        """Whether the zeros are known."""
        return self.zeros is not None and self.zeros.known

    def step(self, tension: Array, length: Array, dt: float, theta: Array | None = None) -> None:
        """Take T [N] and readings of l [m] (M,), dt [s] after the last, and θ (D,) if measured."""
        if self.done:
            return
        known = self._posture if self._posture is not None else theta
        unknown = np.full(self._robot.joint_count, np.nan)
        self._window.append((tension, length, unknown if known is None else known))
        self._span += dt
        self._since += dt
        if self._span >= WINDOW:
            self._take(*(np.mean(part, axis=0) for part in zip(*self._window)))
            self._window, self._span = [], 0.0
        if self._work is not None:
            try:
                next(self._work)
            except StopIteration as ended:
                self._work = None
                self._judge(ended.value)
        elif self._since >= (AGAIN if self._fit else FIRST) and self._moments:
            self._since = 0.0
            tensions, lengths, angles = map(np.array, zip(*self._moments))
            if np.isnan(angles).any():
                self._work = self._search(tensions, lengths)
            else:
                self._judge(_seen(self._mae, tensions, lengths, angles))

    def _take(self, tension: Array, length: Array, theta: Array) -> None:
        if self._moments:
            before = self._moments[0][1] if self.stands else self._before
            gone = np.abs(length - before).max()
            if self.stands and gone > MOVED:  # it does not
                self._moments, self.moving = [], 0.0
            elif not self.stands and gone < MOVED:
                return
            self._before = length
            if not self.stands and gone > FASTEST * WINDOW:
                return
            self.moving += WINDOW
        self._before = length
        if len(self._moments) >= MOST:
            del self._moments[1]
        self._moments.append((tension, length, theta))

    def _judge(self, fit: Fit) -> None:
        """Take a fit as the guess, or as known when it rests on enough."""
        tension, length, _ = map(np.array, zip(*self._moments[: len(fit.theta)]))
        left = np.abs(length - fit.offset - self._mae.lengths(fit.theta, tension))
        bad = float(np.median(left, axis=0).max())
        self._fit = fit
        enough = self.moving >= self.enough
        self.trouble = ''
        if enough and bad > LARGEST_LEFT:
            name = self._robot.muscles[int(np.median(left, axis=0).argmax())]
            self.trouble = f'{1e3 * bad:.1f} mm of {name} are left unexplained'
        deviation = np.full(len(fit.offset), UNKNOWN)
        if enough and not self.trouble:
            deviation = 1.48 * np.median(left, axis=0) / np.sqrt(max(1.0, len(left) / 10.0))
        self.zeros = Zeros(fit.offset, deviation)

    # -- without joint angles -------------------------------------------------------------------

    def _search(self, tension: Array, length: Array) -> Generator[None, None, Fit]:
        """Find zeros and postures of T [N] and readings [m] (K, M); yields between its parts."""
        guesses = [] if self._fit is None else [self._fit.offset]
        if self.moving < SETTLED:
            guesses += [*(yield from self._guesses(tension, length))]
        rows = np.unique(np.linspace(0, len(tension) - 1, TOLD_BY).astype(int))
        best: Fit | None = None
        for offset in guesses:
            fit = self._start(offset, tension[rows], length[rows])
            fit = yield from self._refine(fit, tension[rows], length[rows], FIRST_ROUNDS)
            if best is None or fit.cost < best.cost:
                best = fit
        assert best is not None
        return (yield from self._refine(self._start(best.offset, tension, length), tension, length))

    def _start(self, offset: Array, tension: Array, length: Array) -> Fit:
        theta = self._mae.estimate(tension, length - offset).theta
        return Fit(np.inf, offset, np.clip(theta, self._robot.lower, self._robot.upper))

    def _guesses(self, tension: Array, length: Array) -> Generator[None, None, Array]:
        """Return the zeros (PURSUED, M) of the likeliest random first postures."""
        robot, mae = self._robot, self._mae
        first = robot.random_postures(POSTURES, self._rng)
        offset = length[0] - mae.lengths(
            first, np.broadcast_to(tension[0], (POSTURES, len(length[0])))
        )
        offset = offset[np.argsort(np.abs(offset).max(axis=1))]
        offset = offset[: max(PURSUED, int((np.abs(offset).max(axis=1) < FARTHEST).sum()))]
        rows = np.unique(np.linspace(0, len(tension) - 1, TOLD_BY).astype(int))
        cost, postures = np.empty(len(offset)), np.empty((len(offset), len(rows), len(robot.lower)))
        for n, zero in enumerate(offset):
            theta = postures[n] = mae.estimate(tension[rows], length[rows] - zero).theta
            left = length[rows] - zero - mae.lengths(theta, tension[rows])
            parts = left / COARSE[0], self._outside(theta) / COARSE[2]
            cost[n] = sum(np.log1p(part**2).sum() for part in parts)
            if n % 40 == 39:
                yield
        order = np.argsort(cost)[:SHORTLIST]
        for n in order:
            torque, _ = self._torque(postures[n], tension[rows])
            cost[n] += np.log1p((torque / COARSE[1]) ** 2).sum()
            yield
        return offset[order[np.argsort(cost[order])][:PURSUED]]

    def _outside(self, theta: Array) -> Array:
        robot = self._robot
        return np.maximum(theta - robot.upper, 0.0) + np.minimum(theta - robot.lower, 0.0)

    def _torque(self, theta: Array, tension: Array) -> tuple[Array, Array]:
        """Return what torque is not balanced [N·m] (K, D), and G."""
        jacobian = self._mae.muscle_jacobian(theta, tension)
        pull = np.einsum('kmd,km->kd', jacobian, tension)
        return self._robot.kinematics.holding_torque(theta) + pull, jacobian

    def _parts(self, fit: Fit, tension: Array, length: Array) -> Parts:
        left = length - fit.offset - self._mae.lengths(fit.theta, tension)
        torque, jacobian = self._torque(fit.theta, tension)
        outside = self._outside(fit.theta) / OUTSIDE
        return Parts(left / LENGTH_NOISE, torque / TORQUE_NOISE, outside, jacobian)

    def _cost(self, parts: Parts, offset: Array) -> float:
        student = sum(np.log1p(part**2 / FREEDOM).sum() for part in parts[:2])
        plain = np.square(parts.outside).sum() + np.square(offset / OFFSET).sum()
        return float((FREEDOM + 1.0) * student + plain)

    def _refine(
        self, fit: Fit, tension: Array, length: Array, rounds: int = ROUNDS
    ) -> Generator[None, None, Fit]:
        """Return the best fit near one, after so many Gauss–Newton steps at most."""
        eye = np.eye(self._robot.joint_count)
        muscles, damping = np.eye(length.shape[1]), 1e-3
        parts = self._parts(fit, tension, length)
        fit = fit._replace(cost=self._cost(parts, fit.offset))
        for _ in range(rounds):
            yield
            turned = [self._torque(fit.theta + STEP * row, tension)[0] for row in eye]
            slope = (np.stack(turned, axis=-1) / TORQUE_NOISE - parts.torque[..., None]) / STEP
            along = -parts.jacobian / LENGTH_NOISE
            weight, weight_torque = (
                (FREEDOM + 1.0) / (FREEDOM + part**2) for part in (parts.length, parts.torque)
            )
            normal = np.einsum('kmi,km,kmj->kij', along, weight, along)
            normal += np.einsum('kdi,kd,kdj->kij', slope, weight_torque, slope)
            normal += (parts.outside != 0.0)[:, :, None] * eye / OUTSIDE**2
            gradient = np.einsum('kmi,km->ki', along, weight * parts.length)
            gradient += np.einsum('kdi,kd->ki', slope, weight_torque * parts.torque)
            gradient += parts.outside / OUTSIDE
            cross = -along * weight[..., None] / LENGTH_NOISE
            own = np.diag((weight / LENGTH_NOISE**2).sum(axis=0) + OFFSET**-2)
            down = fit.offset / OFFSET**2 - (weight * parts.length / LENGTH_NOISE).sum(axis=0)
            before = fit.cost
            while damping < 1e4:
                damped = normal * (1.0 + damping * eye) + 1e-6 * eye
                inverse = np.linalg.inv(damped)
                through = cross @ inverse
                reduced = own * (1.0 + damping * muscles) - np.einsum('kmi,kni->mn', through, cross)
                shift = -np.linalg.solve(reduced, down - np.einsum('kmi,ki->m', through, gradient))
                turn = gradient + np.einsum('kmi,m->ki', cross, shift)
                turn = np.clip(-np.einsum('kij,kj->ki', inverse, turn), -FARTHEST, FARTHEST)
                tried = Fit(np.inf, fit.offset + shift, fit.theta + turn)
                after = self._parts(tried, tension, length)
                if (cost := self._cost(after, tried.offset)) < fit.cost:
                    break
                damping *= 5.0
                yield
            else:
                break
            fit, parts, damping = tried._replace(cost=cost), after, max(0.2 * damping, 1e-6)
            if before - cost < 1e-3 * before and np.abs(shift).max() < 1e-4:
                break
        return fit


def _seen(mae: Mae, tension: Array, length: Array, theta: Array) -> Fit:
    """Return the zeros that joint angles say."""
    return Fit(0.0, (length - mae.lengths(theta, tension)).mean(axis=0), theta)
