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

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.friction import FrictionDirection
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

WINDOW = 0.25  # [s] that one moment averages
MOVED = 0.002  # [m] of some muscle since the last moment that counts
FASTEST = 0.05  # [m/s] of a muscle, above which inertia is no longer small beside the weight
#: [s] of gentle motion that are enough with joint angles and without, and of a stated posture
ENOUGH_SEEN, ENOUGH, STANDING = 20.0, 38.0, 1.0
FIRST, AGAIN = 0.5, 2.0  # [s] until the first guess, between later ones
MOST = 240  # moments

# Where a joint slides, [rad] below are times RACK [m], [N·m] over RACK [N].
LENGTH_NOISE, TORQUE_NOISE = 0.0004, 0.4  # [m], [N·m] of the network, beyond friction
WORST = 0.3, 5.0  # times LENGTH_NOISE, the muscles that a network knows best and least
FRICTION = 0.05  # μ of a wire, give or take as much
JOINT_FRICTION = 0.03  # Coulomb torque of a joint over the largest that the weight needs
TENSION_ZERO = 1.5  # [N] of a tension sensor, in which its gain's error hides
STICKING = 0.003  # [rad] that turn a joint's friction round
AT_STOP = 0.03  # [rad] from a joint limit, where its stop may bear torque
OFFSET, OUTSIDE = 0.1, 0.05  # [m] of a zero before anything is known; [rad] beyond the joint limits
FREEDOM = 4.0  # of the Student distribution
#: postures drawn and tried as the first one, moments that tell how good they are, and those pursued
DRAWN, POSTURES, TOLD_BY, SHORTLIST, PURSUED = 3200, 400, 24, 30, 6
TOGETHER = 20  # of those tried, at one message
COARSE = 0.01, 2.0, 0.1  # [m], [N·m], [rad]: deviations that count little or much in that choice
FARTHEST = 0.3  # [m] of a zero; [rad] of a step
ROUNDS, FIRST_ROUNDS = 20, 6
STEP = 1e-3  # of differences
UNHEARD = 1e-6  # what lengths of isolated muscles count
LIGHTEST = 0.1  # of what T_bias exerts at joints: the least that a weight counts for
#: [m] median of what is left, and cost of a residual (0.95 if all is noise), beyond which zeros are
#: not found but guessed wrong: right ones leave 0.3 mm and cost 0.2–0.5, of a wrong posture 1.1
LARGEST_LEFT, LARGEST_COST = 0.02, 0.75
UNKNOWN = 1.0  # [m] standard deviation of a zero that is being found
KNOWN = 0.05  # [m] and below, of one that was


class Zeros(NamedTuple):
    """Zeros of the length sensors and how well they are known."""

    offset: Array  # o [m], (M,)
    deviation: Array  # standard deviation [m], (M,)

    @property
    def known(self) -> bool:
        """Whether lengths can be relied on."""
        return bool(self.deviation[self.deviation.argmax()] < KNOWN)

    @staticmethod
    def of(muscles: int, deviation: float = 0.0) -> Zeros:
        """Return zeros without an offset, known but for a deviation; `UNKNOWN`: not at all."""
        return Zeros(np.zeros(muscles), np.full(muscles, deviation))


class Moments(NamedTuple):
    """Means of K short windows."""

    tension: Array  # T [N], (K, M)
    length: Array  # l as it was read [m], (K, M)
    direction: Array  # s of every wire's friction: +1 wound in last, −1 paid out last, (K, M)
    read: Array  # l of all muscles, also of those that do not count [m], (K, M)
    theta: Array  # θ [rad] or NaN, (K, D)

    def some(self, rows: Ints) -> Moments:
        """Return some of them."""
        return Moments(*(part[rows] for part in self))


class Fit(NamedTuple):
    """What explains K moments."""

    cost: float
    #: o [m], μ of the wires, zeros of the tensions [N], Coulomb torques [N·m], (3M + D,)
    constants: Array
    theta: Array  # postures [rad], (K, D)


Fitting = Generator[None, None, Fit]  # yields between short pieces of work


class Zeroing:
    """Collects moments and finds the zeros a little at every message. Lengths here are readings."""

    def __init__(self, robot: Robot, mae: Mae, posture: Array | None = None) -> None:
        """Find zeros with a network; `posture` [rad] (D,) if the arm stands in a known one."""
        self._robot, self._mae, self.posture = robot, mae, posture
        self._rng = np.random.default_rng([0, 0x2E])
        self._direction = FrictionDirection()
        self._window: list[tuple[Array, ...]] = []  # T, l, s, l as it was read
        self._angles: list[Array] = []  # θ in the same time, where measured
        self._moments: list[tuple[Array, ...]] = []
        muscles, joints = robot.muscle_count, robot.joint_count
        self._radian = radian = robot.kinematics.radian
        postures = robot.random_postures(64, self._rng)
        weight = np.abs(radian * robot.kinematics.holding_torque(postures)).max()
        levers = np.abs(radian * robot.routes.muscle_jacobian(postures))
        # One that carries nothing, as with upright axes, has joints that rub all the same.
        weight = max(weight, LIGHTEST * (robot.description.tension.bias @ levers).max())
        counts = muscles, muscles, muscles, joints
        self._mean = np.repeat([0.0, FRICTION, 0.0, 0.0], counts)  # of the constants, beforehand
        spread = OFFSET, FRICTION, TENSION_ZERO, JOINT_FRICTION * weight
        self._spread = np.repeat(spread, counts)
        self._spread[-joints:] /= radian
        self._torque_noise = TORQUE_NOISE / radian
        self._used = ~np.isin(np.arange(muscles), mae.isolated)
        noise = (
            LENGTH_NOISE * _worse(mae) / np.where(self._used, 1.0, UNHEARD),
            self._torque_noise,
            OUTSIDE * radian,
        )
        self._noise = np.concatenate(noise)  # of the residuals, (M + 2D,)
        self._before: Array = np.zeros(muscles)  # l_read of the last moment that moved
        self._span = self.moving = self._since = 0.0  # [s]; of motion that counted
        self._work: Generator[None, None, tuple[Fit, Moments]] | None = None
        self._fit: Fit | None = None  # the best so far, and whether joint sensors told it
        self._sees = False
        self.zeros: Zeros | None = None  # the guess so far, known or not; None before the first
        self.trouble = ''

    @property
    def stands(self) -> bool:
        """Whether the arm is said to stand in a posture."""
        return self.posture is not None

    @property
    def enough(self) -> float:
        """Seconds of gentle motion that it takes, or of standing still where the arm is said to."""
        if self.stands:
            return STANDING
        return ENOUGH_SEEN if self._sees else ENOUGH

    @property
    def progress(self) -> str:
        """How far it is, and what is in its way."""
        how = 'of standing still' if self.stands else 'of gentle motion'
        told = f'{self.moving:.0f} of {self.enough:.0f} s {how}'
        return f'{told}; {self.trouble}' if self.trouble else told

    @property
    def done(self) -> bool:
        """Whether the zeros are known."""
        return self.zeros is not None and self.zeros.known

    def step(self, tension: Array, length: Array, dt: float, theta: Array | None = None) -> None:
        """Take T [N] and readings of l [m] (M,), dt [s] after the last, and θ (D,) if measured."""
        if self.done or (self.stands and self.trouble):
            return
        known = self.posture if self.stands else theta
        tension, read, length = tension * self._used, length, length * self._used
        self._window.append((tension, length, self._direction.step(length), read))
        self._angles += [] if known is None else [known]
        self._span += dt
        self._since += dt
        if self._span >= WINDOW:
            unknown = [np.full(self._robot.joint_count, np.nan)]
            parts = *zip(*self._window), self._angles or unknown
            self._take(*(np.mean(part, axis=0) for part in parts))
            self._window, self._angles, self._span = [], [], 0.0
        if self._work is not None:
            try:
                next(self._work)
            except StopIteration as ended:
                self._work = None
                self._judge(*ended.value)
        elif self._since >= (AGAIN if self._fit and not self.stands else FIRST) and self._moments:
            self._since = 0.0
            seen = Moments(*map(np.array, zip(*self._moments)))
            told = np.flatnonzero(~np.isnan(seen.theta).any(axis=1))
            self._sees = 2 * len(told) > len(seen.theta)
            if not self._sees:
                self._work = self._search(seen)
            else:  # with the angles known, zeros are what is left
                seen = seen.some(told)
                left = seen.length - self._mae.lengths(seen.theta, seen.tension)
                constants = np.concatenate([left.mean(axis=0), self._mean[len(tension) :]])
                self._judge(Fit(0.0, constants, seen.theta), seen)

    def _take(self, *moment: Array) -> None:
        length, first = moment[1], not self._moments
        gone = 0.0 if first else float(np.abs(length - self._before).max())
        if self.stands and gone > MOVED:
            self.trouble = 'it moved away from there; let it stand and call estimator/zero again'
            return
        if not (self.stands or first) and gone < MOVED:
            return
        if first or not self.stands:
            self._before = length
        if self.stands or gone <= FASTEST * WINDOW:
            self.moving += 0.0 if first else WINDOW
            self._moments = [*self._moments[1 - MOST :], moment]

    def _judge(self, fit: Fit, seen: Moments) -> None:
        """Take a fit as the guess, or as known when it rests on enough and explains that."""
        count, muscles = len(fit.theta), self._robot.muscle_count
        # Who is commanded l of an isolated one is to mean what it reads, as well as that is known.
        ideal = self._mae.lengths(fit.theta, seen.tension)
        unheard = np.clip(np.median(seen.read - ideal, axis=0), -FARTHEST, FARTHEST)
        offset = np.where(self._used, fit.constants[:muscles], unheard)
        left = self._used * (seen.length - offset - ideal)
        typical = np.median(np.abs(left), axis=0)
        cost = fit.cost / (count * (len(self._noise) - self._robot.joint_count))
        self._fit, self.trouble, deviation = fit, '', np.full(muscles, UNKNOWN)
        if self.moving >= self.enough:
            if typical.max() > LARGEST_LEFT:
                name = self._robot.muscles[int(typical.argmax())]
                self.trouble = f'{1e3 * typical.max():.1f} mm of {name} are left unexplained'
            elif not cost <= LARGEST_COST:  # found without angles: another posture may look alike
                self.trouble = f'lengths and tensions do not agree: {cost:.2f} of {LARGEST_COST:g}'
            else:
                deviation = 1.48 * typical / np.sqrt(max(1.0, count / 10.0))
                deviation[~self._used] = LARGEST_LEFT
        self.zeros = Zeros(offset, deviation)

    # -- without joint angles -------------------------------------------------------------------

    def _search(self, seen: Moments) -> Generator[None, None, tuple[Fit, Moments]]:
        """Find what explains the moments."""
        few = seen.some(np.unique(np.linspace(0, len(seen.length) - 1, TOLD_BY).astype(np.int64)))
        guesses = yield from self._guesses(seen, few)
        likeliest = yield from self._best(guesses, few, FIRST_ROUNDS)
        # Few moments may be mistaken: all of them choose between the newest guess and the last.
        last = [] if self._fit is None else [self._fit.constants]
        return (yield from self._best([likeliest.constants, *last], seen, ROUNDS)), seen

    def _best(self, guesses: list[Array], seen: Moments, rounds: int) -> Fitting:
        """Return the best of the fits near each guess of the constants."""
        fits, (low, high) = [], (self._robot.lower, self._robot.upper)
        for constants in guesses:
            length = seen.length - constants[: self._robot.muscle_count]
            theta = np.clip(self._mae.estimate(seen.tension, length).theta, low, high)
            fits.append((yield from self._refine(Fit(np.inf, constants, theta), seen, rounds)))
        return min(fits, key=lambda fit: fit.cost)

    def _guesses(self, seen: Moments, few: Moments) -> Generator[None, None, list[Array]]:
        """Return constants with the zeros of the likeliest of many random first postures."""
        mae, pull = self._mae, np.tile(seen.tension[0], (POSTURES, 1))
        # The weight tells most postures from the first one before lengths say anything.
        drawn, size = [], []
        for _ in range(DRAWN // POSTURES):
            drawn.append(self._robot.random_postures(POSTURES, self._rng))
            size.append(np.linalg.norm(self._radian * self._torque(drawn[-1], pull)[0], axis=1))
            yield
        first = np.concatenate(drawn)[np.argsort(np.concatenate(size))[:POSTURES]]
        offset = seen.length[0] - mae.lengths(first, pull)
        largest = np.abs(offset * self._used).max(axis=1)
        offset = offset[np.argsort(largest)[: max(PURSUED, int((largest < FARTHEST).sum()))]]
        cost, postures = np.empty(len(offset)), list[Array]()
        for n in range(0, len(offset), TOGETHER):
            zero = offset[n : n + TOGETHER, None]
            length = few.length - zero
            pull = np.broadcast_to(few.tension, length.shape)
            theta = mae.estimate(pull, length).theta
            left = self._used * (length - mae.lengths(theta, pull))
            parts = left / COARSE[0], self._outside(theta) / (COARSE[2] * self._radian)
            counted = [np.log1p(each**2).sum(axis=(1, 2)) for each in parts]
            cost[n : n + TOGETHER] = np.sum(counted, axis=0)
            postures.extend(theta)
            yield
        order = np.argsort(cost)[:SHORTLIST]
        for n in order:
            torque = self._radian * self._torque(postures[n], few.tension)[0] / COARSE[1]
            cost[n] += np.log1p(torque**2).sum()
            yield
        best = order[np.argsort(cost[order])][:PURSUED]
        return [np.concatenate([offset[n], self._mean[len(offset[n]) :]]) for n in best]

    def _outside(self, theta: Array) -> Array:
        return theta - np.clip(theta, self._robot.lower, self._robot.upper)

    def _torque(self, theta: Array, tension: Array) -> tuple[Array, Array]:
        """Return what torque is not balanced [N·m] (K, D), and G (K, M, D)."""
        jacobian = self._mae.muscle_jacobian(theta, tension)
        pull = np.einsum('kmd,km->kd', jacobian, tension)
        return self._robot.kinematics.holding_torque(theta) + pull, jacobian

    def _residuals(
        self, fit: Fit, seen: Moments, turning: Array, slopes: bool = False
    ) -> tuple[Array, ...]:
        """Return lengths, torques and angles outside that are left, in their noise (K, M + 2D).

        `turning` is which way joints turned last; `slopes`: derivatives by θ and constants too.
        """
        theta, muscles, joints = fit.theta, self._robot.muscle_count, self._robot.joint_count
        ends = [muscles, 2 * muscles, 3 * muscles]
        offset, friction, zero, sticking = np.split(fit.constants, ends)
        passed = np.exp(-friction * seen.direction)  # from the motor to the elastic unit
        end, pull = seen.tension * passed, (seen.tension - zero) * passed
        length, outside = self._mae.lengths(theta, end), self._outside(theta)
        unheld, jacobian = self._torque(theta, pull)
        torque = unheld + sticking * turning
        # A stop takes any torque: there the balance says nothing, at the price of a usual residual.
        at_stop = AT_STOP * self._radian
        low, high = self._robot.lower + at_stop, self._robot.upper - at_stop
        free = (low < theta) & (theta < high)
        left = [seen.length - offset - length, np.where(free, torque, self._torque_noise), outside]
        value = np.concatenate(left, axis=1) / self._noise
        if not slopes:
            return (value,)
        turned = [self._torque(theta + STEP * row, pull)[0] for row in np.eye(joints)]
        slope = (np.stack(turned, axis=-1) - unheld[..., None]) / STEP * free[..., None]
        beyond = (outside != 0.0)[..., None] * np.eye(joints)
        by_theta = np.concatenate([-jacobian, slope, beyond], axis=1)
        by_constants = np.zeros((*value.shape, len(fit.constants)))
        m, j = np.arange(muscles), np.arange(joints)
        by_constants[:, m, m] = -1.0
        rubbed = self._mae.lengths(theta, end * np.exp(-STEP * seen.direction))
        by_constants[:, m, muscles + m] = (length - rubbed) / STEP
        arm = -np.swapaxes(jacobian, 1, 2) * free[..., None]
        by_constants[:, muscles:-joints, m + muscles] = arm * (pull * seen.direction)[:, None]
        by_constants[:, muscles:-joints, m + 2 * muscles] = arm * passed[:, None]
        by_constants[:, muscles + j, 3 * muscles + j] = turning * free
        return value, by_theta / self._noise[:, None], by_constants / self._noise[:, None]

    def _cost(self, value: Array, constants: Array) -> float:
        noisy, outside = np.split(value, [-self._robot.joint_count], axis=1)
        student = (FREEDOM + 1.0) * np.log1p(noisy**2 / FREEDOM).sum()
        prior = np.square((constants - self._mean) / self._spread).sum()
        return float(student + np.square(outside).sum() + prior)

    def _refine(self, fit: Fit, seen: Moments, rounds: int) -> Fitting:
        """Return the best fit near one, after so many Gauss–Newton steps at most."""
        eye, own_eye, damping = np.eye(self._robot.joint_count), np.eye(len(self._mean)), 1e-3
        turning = _turning(fit.theta, STICKING * self._radian)
        farthest = FARTHEST * self._radian
        fit = fit._replace(cost=self._cost(self._residuals(fit, seen, turning)[0], fit.constants))
        for _ in range(rounds):
            yield
            value, by_theta, by_constants = self._residuals(fit, seen, turning, slopes=True)
            weight = (FREEDOM + 1.0) / (FREEDOM + value**2)
            weight[:, -len(eye) :] = 1.0
            weighted = weight[..., None] * by_theta
            normal = np.swapaxes(by_theta, 1, 2) @ weighted
            gradient = np.einsum('krd,kr->kd', weighted, value)
            cross = np.swapaxes(by_constants, 1, 2) @ weighted
            own = np.einsum('krp,kr,krq->pq', by_constants, weight, by_constants, optimize=True)
            own += np.diag(self._spread**-2)
            down = np.einsum('krp,kr->p', by_constants, weight * value)
            down += (fit.constants - self._mean) / self._spread**2
            before = fit.cost
            while damping < 1e4:
                inverse = np.linalg.inv(normal * (1.0 + damping * eye) + 1e-6 * eye)
                through = cross @ inverse
                reduced = own * (1.0 + damping * own_eye)
                reduced = reduced - np.einsum('kpd,kqd->pq', through, cross)
                shift = -np.linalg.solve(reduced, down - np.einsum('kpd,kd->p', through, gradient))
                turn = gradient + np.einsum('kpd,p->kd', cross, shift)
                turn = np.clip(-np.einsum('kij,kj->ki', inverse, turn), -farthest, farthest)
                tried = Fit(np.inf, fit.constants + shift, fit.theta + turn)
                cost = self._cost(self._residuals(tried, seen, turning)[0], tried.constants)
                if cost < before:
                    break
                damping *= 5.0
                yield
            else:
                break
            fit, damping = tried._replace(cost=cost), max(0.2 * damping, 1e-6)
            if before - cost < 1e-4 * before and np.abs(shift).max() < 1e-4:
                break
        return fit


def _turning(theta: Array, sticking: Array) -> Array:
    """Return which way each joint turned last, in [−1, 1], for the K postures of a way (K, D).

    Its friction turns round over `sticking` [rad] (D,).
    """
    result, reference = np.zeros_like(theta), theta[0].copy()
    for k, posture in enumerate(theta):
        reference = np.clip(reference, posture - sticking, posture + sticking)
        result[k] = (posture - reference) / sticking
    return result


def _worse(mae: Mae) -> Array:
    """Return how much worse than the middle one the network knows each muscle, (M,).

    A muscle that ② restores badly from healthy messages pulls the zeros of all others along, since
    a network's error is the same in neighbouring postures: its weight falls as that grows squared.
    """
    if mae.anomaly is None:
        return np.ones(len(mae.muscles))
    variance = np.diag(mae.anomaly.covariance)[len(mae.muscles) :]
    return np.clip(variance / np.median(variance), *WORST)
