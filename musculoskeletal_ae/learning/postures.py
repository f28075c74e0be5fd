# SPDX-License-Identifier: Apache-2.0
"""The body and the postures of its samples, found together from whatever sensors there are.

    min  Σ ω (l_nm − l_m(θ_n, T_n; w))²/σ_m² + Σ ω (g(θ_n) + Gᵀ T_end)_j²/σ_τ²
         + Σ (θ_nj + z_j − y_nj)²/σ_y² + Σ ‖R_iᵀ(θ_n) ĝ − u_ni‖²/σ_u² + Σ ((w − w̄)/s)²
         + Σ ((z − z̄)/s_z)²

over the parameters w of the calibrated body, the postures θ_n and the zeros z of the joint sensors,
by Gauss–Newton. z̄ and s_z are what the joints' stops tell (`stops`). y are joint angles that a
sensor read (with its zero z), a camera saw or somebody stated, u directions of gravity in links
that carry an IMU; any of them may be missing anywhere.
M > D makes that possible: N rests give N (M − D) equations of length more than there are angles,
and N D of torque. A joint that muscles push against its stop harder than friction holds is taken to
be there; one that is beyond it is drawn back. Postures enter few rows each, so that they are
eliminated (Schur complement), and what is solved has the size of w and z. All rows are robust:
ω are the weights of a Student distribution. Joints and muscles of one group at a time.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.friction import end_tension
from musculoskeletal_ae.learning.samples import Observations
from musculoskeletal_ae.learning.stops import STOP, ZERO, sensor_zeros
from musculoskeletal_ae.robot.stiffness import muscle_hessian

if TYPE_CHECKING:
    from musculoskeletal_ae.learning.body import CorrectedBody

DIFFERENCE = 1e-6  # [rad] or [m]
# Where a joint slides, [rad] below are times RACK [m].
#: What the body does not know is common to all samples, so that they count as no more than these
#: in what they say of a zero; and torque and stops of joints that no sensor reads, in how much all
#: that leaves open.
ALIKE = 10.0
SENSOR = 0.002  # σ_y of a joint sensor [rad]
GRAVITY = 0.02  # σ_u: an accelerometer's error and how it is mounted [rad]
#: σ of a length at first, and at least in what it says of postures: what no body explains [m]
FIRST_NOISE, LEAST_NOISE = 0.002, 0.0008
#: σ_τ as a share of what the muscles exert at a joint, whichever way. It is wide, because friction
#: and the zeros of the tension sensors are common to all samples.
TORQUE = 0.3
LEAST_TORQUE = 0.01  # of the torque that is usually left, as such a share
#: from a limit, where a joint that muscles push there is taken to be at its stop [rad], and how
#: many such spreads that takes
NEAR_STOP, PUSHED = 0.05, 3.0
ROUNDS = 12
#: decrease, in variances for each length, that ends the rounds: the step was then far shorter than
#: what the samples leave open, and the noise has settled (with ten times as much, a joint sensor
#: that slipped is taken for a changed muscle more often)
ENOUGH = 3e-4
#: of a step, tried until one lowers the cost; from one below the last that did
DAMPING = (0.0, 0.1, 1.0, 10.0, 100.0)
EXPECTED = 0.3  # step of a posture [rad]
BENT = 0.05  # turn of a joint over which Σ T ∂²l/∂θ² of the geometric model is as it was [rad]
FREEDOM = 4.0  # of the Student distribution
SMALL = 1e-6


class _Rows(NamedTuple):
    """Residuals and derivatives at one point, of a group of D joints and M muscles."""

    length: Array  # (N, M)
    muscle_jacobian: Array  # G, (N, M, D)
    by_body: list[Array]  # ∂l/∂w of each muscle, (N, P)
    torque: Array  # (N, D)
    torque_by_body: Array  # ∂τ/∂w, (N, D, W)
    load: Array  # what muscles exert at each joint, whichever way [N·m], (D,)
    angle: Array  # (N, D); 0 where nothing is known
    gravity: Array  # (N, 3J)
    gravity_by_posture: Array  # (N, 3J, D)
    prior: Array  # (W,)


class Bent(NamedTuple):
    """Σ T ∂²l/∂θ² of the geometric model, which hardly changes between fits."""

    theta: Array  # where it was taken last [rad], (N, D)
    stiffness: Array  # [N·m/rad], (N, D, D)

    @classmethod
    def unknown(cls, count: int, places: int) -> Bent:
        """Return that of postures it has never been taken of."""
        return cls(np.full((count, places), np.nan), np.zeros((count, places, places)))


class _GroupFit:
    """Rounds of Gauss–Newton on the joints and muscles of one group."""

    def __init__(
        self,
        body: CorrectedBody,
        seen: Observations,
        joints: Ints,
        muscles: Ints,
        mean: list[Array],
        spread: list[Array],
        least_noise: float,
        bent: Bent,
    ) -> None:
        self._bent, self._bend = bent, bent.stiffness[:, joints[:, None], joints]
        self._kinematics, self._joints = body.robot.kinematics, joints  # of the whole body
        self._body, self._seen = body.limb(joints, muscles), seen.limb(joints, muscles)
        self._mean = np.concatenate([mean[m] for m in muscles])
        self._precision = np.concatenate([1.0 / spread[m] ** 2 for m in muscles])
        ends = np.cumsum([0, *(layout.size for layout in self._body.layouts)])
        self._columns = [slice(*pair) for pair in pairwise(ends.tolist())]
        self._least, seen, robot = least_noise, self._seen, self._body.robot
        self._radian = robot.kinematics.radian
        self._known = seen.known.astype(float)
        self._enough = ENOUGH * self._known.sum()
        self._crossed = robot.routes.crossed
        of_muscle = np.repeat(self._crossed, np.diff(ends), axis=0).T
        self._acting = [np.flatnonzero(own) for own in of_muscle]  # parameters, by joint
        # The torque of a muscle that was changed since is not that of the one there is.
        changed = ~seen.known & (seen.tension > 0.0)  # 0 N: isolated
        self._balanced = ~(changed @ self._crossed)
        self._read = np.isfinite(seen.theta)
        self._own = self._read & (seen.spread == 0.0)  # read by a joint sensor
        spread_y = np.where(self._own, SENSOR * self._radian, seen.spread)
        self._angle_precision = np.where(self._read, 1.0 / np.maximum(spread_y, SMALL) ** 2, 0.0)
        self._lower, self._upper = robot.lower, robot.upper
        self._tilted = np.isfinite(seen.gravity)
        self._tilt = np.where(self._tilted, seen.gravity, 0.0)
        self.noise = np.full(len(muscles), FIRST_NOISE)
        self._repeated = np.maximum(1.0, self._own.sum(axis=0) / ALIKE)
        read = np.where(self._own, seen.theta, np.nan)
        self._zero, zero_spread = sensor_zeros(read, robot.lower, robot.upper, self._radian)
        self._zero_precision = self._repeated / zero_spread**2
        self._unread = np.maximum(1.0, (~self._own).sum(axis=0) / ALIKE)
        self._near = self._radian * np.where(self._own, 2.0 * ZERO, NEAR_STOP)
        self._at = np.full(self._own.shape, np.nan)  # the stops that joints lean on [rad]

    # -- one point ------------------------------------------------------------------------------

    def rows(self, theta: Array, zero: Array) -> _Rows:
        """Return residuals at θ of all joints (N, D), the body's parameters, and zeros (D,)."""
        body, seen, joints = self._body, self._seen, self._joints
        own, (count, places) = theta[:, joints], seen.theta.shape
        flat = np.concatenate([own[None], own + DIFFERENCE * np.eye(places)[:, None]])
        flat = flat.reshape(-1, places)
        poses = body.poses(flat)
        length, end = np.empty_like(seen.length), np.empty_like(seen.length)
        slope = np.zeros((*length.shape, places))
        by_body, columns = [], self._columns
        torque_by_body = np.zeros((count, places, columns[-1].stop))
        for m in range(length.shape[1]):
            pull, way = seen.tension[:, m], seen.direction[:, m]
            turns = np.flatnonzero(self._crossed[m])  # the other joints do not move it
            parts = np.append(0, 1 + turns)
            at = (count * parts[:, None] + np.arange(count)).ravel()
            placed = type(poses)(*(part[np.append(at, -1)] for part in poses))
            pulls, ways, age = (np.tile(part, len(parts)) for part in (pull, way, seen.age))
            still = body.smooth[m].at(own)
            turned = still + DIFFERENCE * body.smooth[m].slope(own, turns)
            smooth = np.concatenate([still, *turned])
            l_m, j_m = body.linearised(placed, smooth, pulls, ways, m, age)
            l_m, j_m = l_m.reshape(len(parts), count), j_m.reshape(len(parts), count, -1)
            length[:, m] = seen.length[:, m] - l_m[0]
            by_body.append(j_m[0])
            slope[:, m, turns] = (l_m[1:] - l_m[0]).T / DIFFERENCE
            end[:, m] = end_tension(body.friction(m), pull, way)
            block = (j_m[1:] - j_m[0]) * (end[:, m, None] / DIFFERENCE)
            block[:, :, body.layouts[m].friction] -= way * end[:, m] * slope[:, m, turns].T
            torque_by_body[:, turns, columns[m]] = block.swapaxes(0, 1)
        muscular = end[:, :, None] * slope
        weight = self._kinematics.holding_torque(theta)[:, joints]
        down = self._down(theta)
        return _Rows(
            length,
            slope,
            by_body,
            -weight - muscular.sum(axis=1),
            torque_by_body,
            np.median(np.abs(muscular).sum(axis=1), axis=0),
            np.where(self._read, seen.theta - own - self._own * zero, 0.0),
            self._tilted * (self._tilt - down[0]),
            np.moveaxis(down[1:] - down[0], 0, -1) / DIFFERENCE,
            self._mean - np.concatenate(body.parameters),
        )

    def _down(self, theta: Array) -> Array:
        """Return gravity's direction in the frames of the tree's joints, (1+D, N, 3J).

        At θ, then with each joint of the group turned by `DIFFERENCE`; 0 columns without an IMU.
        """
        if not self._tilt.size:
            return np.zeros((1 + len(self._joints), len(theta), 0))
        gravity = self._kinematics.model.gravity.linear
        turned = theta + DIFFERENCE * np.eye(theta.shape[1])[self._joints, None]
        flat = np.concatenate([theta[None], turned]).reshape(-1, theta.shape[1])
        rotation = self._kinematics.joint_poses(flat).rotation
        down = np.einsum('njba,b->nja', rotation, gravity / max(np.linalg.norm(gravity), SMALL))
        return down.reshape(-1, *self._tilt.shape)

    # -- weights --------------------------------------------------------------------------------

    def weigh(self, rows: _Rows, theta: Array, determined: Array) -> None:
        """Take noise, robust weights and stops at a point; `determined`: unknowns per muscle."""
        known = self._known
        for _ in range(3):
            weight = known * student(rows.length / self.noise)
            freedom = np.maximum(1.0, known.sum(axis=0) - determined)
            square = (weight * rows.length**2).sum(axis=0) + 4.0 * self._least**2
            self.noise = np.maximum(self._least, np.sqrt(square / (freedom + 4.0)))
        self.weight = weight
        self._by_length = weight / np.maximum(self.noise, LEAST_NOISE) ** 2
        typical = 1.5 * np.median(np.abs(rows.torque), axis=0)
        sigma = np.maximum(typical, LEAST_TORQUE * rows.load + SMALL)
        score = rows.torque / sigma
        own = theta[:, self._joints]
        # What is left of the torque on a joint pushes it; at a stop that is the stop's own.
        # One that a sensor sees lean on it does until it would have to be held there; another would
        # be held by a stop that it was taken to once, and all others bent after it.
        enough = np.where(self._own & np.isfinite(self._at), 0.0, PUSHED)
        above = self._balanced & (own > self._upper - self._near) & (score > enough)
        below = self._balanced & (own < self._lower + self._near) & (score < -enough)
        self._at = np.where(above, self._upper, np.where(below, self._lower, np.nan))
        free = ~(above | below)
        wide = np.maximum(sigma, TORQUE * rows.load)
        self._by_torque = self._balanced * free * student(rows.torque / wide) / wide**2
        y = self._angle_precision
        self._by_angle = y * student(rows.angle * np.sqrt(y))
        self._by_gravity = self._tilted / GRAVITY**2

    def _stops(self, theta: Array) -> tuple[Array, Array]:
        """Return how far joints are from the stops they lean on or passed [rad], and weights."""
        own = theta[:, self._joints]
        goal = np.where(np.isnan(self._at), np.clip(own, self._lower, self._upper), self._at)
        leaning = ~np.isnan(self._at) | (goal != own)
        return goal - own, leaning / (STOP * self._radian) ** 2 / self._repeated

    def cost(self, rows: _Rows, theta: Array, zero: Array) -> float:
        """Return what is to be minimised, with the weights as they are."""
        stop, by_stop = self._stops(theta)
        return float(
            (self._by_length * rows.length**2).sum()
            + (self._by_torque * rows.torque**2).sum()
            + (self._by_angle * rows.angle**2).sum()
            + (by_stop * stop**2).sum()
            + (self._by_gravity * rows.gravity**2).sum()
            + self._precision @ rows.prior**2
            + self._zero_precision @ (zero - self._zero) ** 2
        )

    # -- one step -------------------------------------------------------------------------------

    def system(self, rows: _Rows, theta: Array) -> tuple[Array, ...]:
        """Return the normal equations: of θ, mixed, of w and z."""
        joints, (count, places), size = self._joints, self._seen.theta.shape, len(self._mean)
        stiffness = np.stack([self._kinematics.gravity_gradient(row) for row in theta])
        stiffness = stiffness[:, joints[:, None], joints]
        stiffness += self._bend_stiffness(theta[:, joints])
        self._stiffness = stiffness
        a, b, slope = self._by_length, self._by_torque, rows.muscle_jacobian
        turned, e = rows.gravity_by_posture, self._by_gravity
        inner = np.einsum('nmi,nm,nmj->nij', slope, a, slope)
        inner += np.einsum('nki,nk,nkj->nij', stiffness, b, stiffness)
        inner += np.einsum('nki,nk,nkj->nij', turned, e, turned)
        _, by_stop = self._stops(theta)
        diagonal = self._by_angle + by_stop + SMALL / (STOP * self._radian) ** 2
        inner += diagonal[:, :, None] * np.eye(places)

        outer = np.zeros((size + places, size + places))
        mixed = np.zeros((count, places, size + places))
        by_torque = rows.torque_by_body
        for j, acting in enumerate(self._acting):
            weighted = by_torque[:, j, acting] * np.sqrt(b[:, j, None])
            outer[np.ix_(acting, acting)] += weighted.T @ weighted
        mixed[:, :, :size] = stiffness.swapaxes(1, 2) @ (b[:, :, None] * by_torque)
        self.curvature = []
        for i, (column, by_body) in enumerate(zip(self._columns, rows.by_body)):
            weighted = by_body * a[:, i, None]
            self.curvature.append(weighted.T @ by_body)
            outer[column, column] += self.curvature[-1]
            mixed[:, :, column] += slope[:, i, :, None] * weighted[:, None]
        own = self._by_angle * self._own
        zeros = size + np.arange(places)
        mixed[:, np.arange(places), zeros] = own
        outer[zeros, zeros] = own.sum(axis=0) + self._zero_precision
        outer[np.arange(size), np.arange(size)] += self._precision

        self.leverage = np.einsum('nmi,nij,nmj->nm', slope, np.linalg.inv(inner), slope) * a
        return inner, mixed, outer

    def right_sides(self, rows: _Rows, theta: Array, zero: Array) -> tuple[Array, Array]:
        """Return those of the normal equations: of θ (N, D), of w and z."""
        length, torque = self._by_length * rows.length, self._by_torque * rows.torque
        stop, by_stop = self._stops(theta)
        pulled = np.einsum('nmi,nm->ni', rows.muscle_jacobian, length)
        pulled += np.einsum('nki,nk->ni', self._stiffness, torque)
        pulled += np.einsum('nki,nk->ni', rows.gravity_by_posture, self._by_gravity * rows.gravity)
        pulled += self._by_angle * rows.angle + by_stop * stop
        by_body = [at.T @ pull for at, pull in zip(rows.by_body, length.T)]
        right = np.concatenate(by_body) + self._precision * rows.prior
        right += np.tensordot(torque, rows.torque_by_body, 2)
        angle = (self._by_angle * self._own * rows.angle).sum(axis=0)
        return pulled, np.append(right, angle + self._zero_precision * (self._zero - zero))

    def _bend_stiffness(self, own: Array) -> Array:
        """Return Σ T ∂²l/∂θ² of the geometric model (N, D, D), at about θ (N, D)."""
        at, joints = self._bent.theta[:, self._joints], self._joints
        moved = np.flatnonzero(~(np.abs(own - at) < BENT * self._radian).all(axis=1))
        bend = muscle_hessian(self._body.robot.routes.muscle_jacobian, own[moved])
        self._bend[moved] = np.einsum('nm,nmij->nij', self._seen.tension[moved], bend)
        self._bent.theta[np.ix_(moved, joints)] = own[moved]
        self._bent.stiffness[np.ix_(moved, joints, joints)] = self._bend[moved]
        return self._bend

    def factor(self, system: tuple[Array, ...], damping: float = 0.0) -> None:
        """Prepare to solve; note the root of the equations of w and z.

        The damping counts steps in units of what is expected: s of w and z, `EXPECTED` of θ.
        """
        inner, mixed, outer = system
        usual = np.append(self._precision, self._zero_precision)
        step = damping / (EXPECTED * self._radian) ** 2
        # Products with the inverse are cheaper.
        self._inverse = np.linalg.inv(np.linalg.cholesky(inner + np.diag(step)))
        self._reduced = self._inverse @ mixed
        tall = self._reduced.reshape(-1, len(outer))
        self.root = cholesky(outer + np.diag(SMALL + damping * usual) - tall.T @ tall)

    def solve(self, pulled: Array, right: Array) -> tuple[Array, Array, float]:
        """Return how θ changes, and w with z; and the decrease of cost that is expected."""
        inverse, reduced = self._inverse, self._reduced
        last = (inverse @ pulled[:, :, None])[:, :, 0]
        change = cho_solve((self.root, False), right - np.tensordot(last, reduced, 2))
        turn = (inverse.swapaxes(1, 2) @ (last - reduced @ change)[:, :, None])[:, :, 0]
        return turn, change, float(change @ right + (turn * pulled).sum())

    def determined(self) -> Array:
        """Return how many unknowns each muscle's lengths pin down, (M,)."""
        body = [
            np.trace(np.linalg.solve(c + np.diag(self._precision[column]), c))
            for c, column in zip(self.curvature, self._columns)
        ]
        return np.array(body) + self.leverage.sum(axis=0)

    def run(self, theta: Array, zero: Array) -> list[Array]:
        """Bring θ (N, D) and zeros (D,) of all joints in line, in place; return the parameters."""
        body, joints = self._body, self._joints
        rows, determined, level = self.rows(theta, zero[joints]), np.zeros(len(self.noise)), 0
        for n in range(ROUNDS):
            self.weigh(rows, theta, determined)
            if n and not level:  # by the last round's equations, which hardly differ
                *_, expected = self.solve(*self.right_sides(rows, theta, zero[joints]))
                if expected < self._enough:
                    break
            system = self.system(rows, theta)
            determined = self.determined()
            rows, level, gained = self._step(rows, system, theta, zero, max(0, level - 1))
            if gained < self._enough:
                break
        self.weigh(rows, theta, determined)
        if level or (self._unread > 1.0).any():
            self._by_torque /= self._unread
            self._repeated *= self._unread
            self.factor(self.system(rows, theta))
        for i in np.flatnonzero((self._known == 0.0).any(axis=0)):
            # A muscle that is learned anew is trusted no more than it is known.
            wide = np.zeros((len(self.root), len(theta)))
            wide[self._columns[i]] = rows.by_body[i].T
            unknown = np.square(solve_triangular(self.root, wide, trans='T')).sum(axis=0)
            self.noise[i] = np.hypot(self.noise[i], np.sqrt(unknown.mean()))
        return body.parameters

    def _step(
        self, rows: _Rows, system: tuple[Array, ...], theta: Array, zero: Array, first: int
    ) -> tuple[_Rows, int, float]:
        """Go a step, in place, with the least damping from `first` on that lowers the cost.

        Returns the rows there, the damping, and by how much: 0 where no step is worth it.
        """
        body, joints = self._body, self._joints
        before = self.cost(rows, theta, zero[joints])
        old = body.parameters, theta.copy(), zero.copy()
        right_sides = self.right_sides(rows, theta, zero[joints])
        for level in range(first, len(DAMPING)):
            self.factor(system, DAMPING[level])
            turn, change, expected = self.solve(*right_sides)
            if expected < self._enough:
                break
            body.parameters = [at + change[own] for at, own in zip(old[0], self._columns)]
            theta[:, joints] = old[1][:, joints] + turn
            zero[joints] = old[2][joints] + change[len(self._mean) :]
            there = self.rows(theta, zero[joints])
            now = self.cost(there, theta, zero[joints])
            if now <= before:
                return there, level, before - now
        body.parameters, theta[:], zero[:] = old
        return rows, level, 0.0


def student(score: Array) -> Array:
    """Return weights ω of residuals, which come in units of their spread."""
    return (FREEDOM + 1.0) / (FREEDOM + score**2)


def fit_jointly(
    body: CorrectedBody,
    seen: Observations,
    start: Array,
    mean: list[Array],
    spread: list[Array],
    least_noise: float,
) -> tuple[Array, Array, Array, Array, list[tuple[Ints, Array]]]:
    """Fit body and zeros of joint sensors (in place), and postures from `start` [rad] (N, D).

    Returns what `Fit` holds.
    """
    own, zero = np.isfinite(seen.theta) & (seen.spread == 0.0), body.zero
    theta, samples = start - own * zero, [length.tobytes() for length in seen.length]
    bent = Bent.unknown(*theta.shape)
    for n, sample in enumerate(samples):
        if sample in body.found:
            theta[n], bent.theta[n], bent.stiffness[n] = body.found[sample]
    weight = np.zeros_like(seen.length)
    noise, root = np.empty(seen.length.shape[1]), []
    for group in body.robot.groups:
        joints, muscles = np.array(group.joints), np.array(group.muscles)
        fit = _GroupFit(body, seen, joints, muscles, mean, spread, least_noise, bent)
        fitted = fit.run(theta, zero)
        for m, parameters in zip(muscles, fitted):
            body.parameters[m] = parameters
        noise[muscles], weight[:, muscles] = fit.noise, fit.weight
        root.append((muscles, fit.root))
    body.found = dict(zip(samples, zip(theta, *bent), strict=True))
    # At angles as they were read, a joint sensor that slipped shows in all muscles of that joint.
    read = np.where(np.isnan(seen.theta), theta, seen.theta - own * zero)
    (length,) = body.lengths(read, seen.tension, seen.direction)
    return seen.length + body.crept(seen.age) - length, noise, weight, theta, root
