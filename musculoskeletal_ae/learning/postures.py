# SPDX-License-Identifier: Apache-2.0
"""The body and the postures of its samples, found together from whatever sensors there are.

    min  Σ ω (l_nm − l_m(θ_n, T_n; w))²/σ_m² + Σ ω (g(θ_n) + Gᵀ T_end)_j²/σ_τ²
         + Σ (θ_nj + z_j − y_nj)²/σ_y² + Σ ‖R_iᵀ(θ_n) ĝ − u_ni‖²/σ_u² + Σ ((w − w̄)/s)² + Σ (z/s_z)²

over the parameters w of the corrected body, the postures θ_n and the zeros z of the joint sensors,
by Gauss–Newton. y are joint angles that a sensor read (with its zero z), a camera saw or somebody
stated, u directions of gravity in links that carry an IMU; any of them may be missing anywhere.
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
from musculoskeletal_ae.learning.samples import Observations
from musculoskeletal_ae.robot.stiffness import muscle_hessian

if TYPE_CHECKING:
    from musculoskeletal_ae.learning.body import CorrectedBody

DIFFERENCE = 1e-3  # [rad]
ZERO = np.deg2rad(2.0)  # spread of the joint sensors' zeros [rad]
#: What the body does not know is common to all samples, so that they count as no more than these
#: in what they say of a zero.
ZERO_SAMPLES = 10.0
SENSOR = 0.002  # σ_y of a joint sensor [rad]
GRAVITY = 0.02  # σ_u: an accelerometer's error and how it is mounted [rad]
#: σ of a length at first, and at least in what it says of postures: what no body explains [m]
FIRST_NOISE, LEAST_NOISE = 0.002, 0.0008
#: σ_τ as a share of what the muscles exert at a joint, whichever way. It is wide, because friction
#: and the zeros of the tension sensors are common to all samples.
TORQUE = 0.3
LEAST_TORQUE = 0.01  # of the torque that is usually left, as such a share
#: from a limit, where a joint that muscles push there is taken to be at its stop, how many such
#: spreads that takes, and how far such a joint is from the limit [rad]
NEAR_STOP, PUSHED, STOP = 0.15, 3.0, 0.01
LARGEST_STEP = 0.3  # of a posture [rad]
ENOUGH = 1e-3  # relative decrease of the cost that ends the rounds
ROUNDS = 8
SHARES = (1.0, 0.5, 0.25, 0.125)  # of a step, tried until one lowers the cost
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
    ) -> None:
        self._body, self._seen, self._joints, self._muscles = body, seen, joints, muscles
        self._mean = np.concatenate([mean[m] for m in muscles])
        self._precision = np.concatenate([1.0 / spread[m] ** 2 for m in muscles])
        ends = np.cumsum([0, *(body.layouts[m].size for m in muscles)])
        self._columns = [slice(*pair) for pair in pairwise(ends.tolist())]
        self._least = least_noise
        self._known = seen.known[:, muscles].astype(float)
        # The torque of a muscle that was changed since is not that of the one there is.
        crossed = body.robot.routes.crossed[np.ix_(muscles, joints)]
        changed = ~seen.known[:, muscles] & (seen.tension[:, muscles] > 0.0)  # 0 N: isolated
        self._balanced = ~(changed @ crossed)
        self._read = np.isfinite(seen.theta[:, joints])
        self._own = self._read & (seen.spread[:, joints] == 0.0)  # read by a joint sensor
        spread_y = np.where(self._own, SENSOR, seen.spread[:, joints])
        self._angle_precision = np.where(self._read, 1.0 / np.maximum(spread_y, SMALL) ** 2, 0.0)
        self._lower = body.robot.lower[joints]
        self._upper = body.robot.upper[joints]
        links = 3 * len(body.robot.kinematics.parent)
        tilt = seen.gravity if seen.gravity.size else np.full((len(seen), links), np.nan)
        self._tilted = np.isfinite(tilt)
        self._tilt = np.where(self._tilted, tilt, 0.0)
        self.noise = np.full(len(muscles), FIRST_NOISE)
        self._repeated = np.maximum(1.0, self._own.sum(axis=0) / ZERO_SAMPLES)
        self._zero_precision = self._repeated / ZERO**2
        self._near = np.where(self._own, 2.0 * ZERO, NEAR_STOP)

    # -- one point ------------------------------------------------------------------------------

    def rows(self, theta: Array, zero: Array) -> _Rows:
        """Return residuals at θ of all joints (N, D), the body's parameters, and zeros (D,)."""
        body, seen, joints, muscles = self._body, self._seen, self._joints, self._muscles
        count, steps = len(theta), DIFFERENCE * np.eye(theta.shape[1])[joints]
        moved = np.concatenate([theta[None], theta + steps[:, None], theta - steps[:, None]])
        parts, flat = len(moved), moved.reshape(-1, theta.shape[1])
        poses, places = body.poses(flat), len(joints)
        length = np.empty((count, len(muscles)))
        slope = np.empty((count, len(muscles), places))
        by_body, columns = [], self._columns
        torque_by_body = np.empty((count, places, columns[-1].stop))
        end = np.empty_like(length)
        for i, m in enumerate(muscles):
            pull, way = seen.tension[:, m], seen.direction[:, m]
            l_m, j_m = body.linearised(poses, flat, np.tile(pull, parts), np.tile(way, parts), m)
            l_m, j_m = l_m.reshape(parts, count), j_m.reshape(parts, count, -1)
            length[:, i] = seen.length[:, m] - l_m[0]
            by_body.append(j_m[0])
            slope[:, i] = (l_m[1 : 1 + places] - l_m[1 + places :]).T / (2.0 * DIFFERENCE)
            turn = (j_m[1 : 1 + places] - j_m[1 + places :]) / (2.0 * DIFFERENCE)
            end[:, i] = pull * np.exp(-body.friction(m) * way)
            block = turn.swapaxes(0, 1) * end[:, i, None, None]
            block[:, :, body.layouts[m].friction] -= (way * end[:, i])[:, None] * slope[:, i]
            torque_by_body[:, :, columns[i]] = block
        muscular = end[:, :, None] * slope
        weight = body.robot.kinematics.holding_torque(theta)[:, joints]
        down = self._down(poses.rotation[:-1].reshape(parts, count, -1, 3, 3))
        return _Rows(
            length,
            slope,
            by_body,
            -weight - muscular.sum(axis=1),
            torque_by_body,
            np.median(np.abs(muscular).sum(axis=1), axis=0),
            np.where(self._read, seen.theta[:, joints] - theta[:, joints] - self._own * zero, 0.0),
            self._tilted * (self._tilt - down[0]),
            np.moveaxis(down[1 : 1 + places] - down[1 + places :], 0, -1) / (2.0 * DIFFERENCE),
            self._mean - np.concatenate([body.parameters[m] for m in muscles]),
        )

    def _down(self, rotation: Array) -> Array:
        """Return the direction of gravity in all joints' frames, (..., 3J)."""
        gravity = self._body.robot.kinematics.model.gravity.linear
        norm = np.linalg.norm(gravity)
        down = np.einsum('...jba,b->...ja', rotation, gravity / max(norm, SMALL))
        return down.reshape(*down.shape[:-2], -1)

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
        above = self._balanced & (own > self._upper - self._near) & (score > PUSHED)
        below = self._balanced & (own < self._lower + self._near) & (score < -PUSHED)
        at = np.where(above, self._upper, np.where(below, self._lower, own))
        free = ~(above | below)
        wide = np.maximum(sigma, TORQUE * rows.load)
        self._by_torque = self._balanced * free * student(rows.torque / wide) / wide**2
        self._target = np.clip(at, self._lower, self._upper)
        outside = above | below | (self._target != own)
        self._by_stop = outside / STOP**2 / self._repeated
        y = self._angle_precision
        self._by_angle = y * student(rows.angle * np.sqrt(y))
        self._by_gravity = self._tilted / GRAVITY**2

    def cost(self, rows: _Rows, theta: Array, zero: Array) -> float:
        """Return what is to be minimised, with the weights as they are."""
        stop = self._target - theta[:, self._joints]
        return float(
            (self._by_length * rows.length**2).sum()
            + (self._by_torque * rows.torque**2).sum()
            + (self._by_angle * rows.angle**2).sum()
            + (self._by_stop * stop**2).sum()
            + (self._by_gravity * rows.gravity**2).sum()
            + self._precision @ rows.prior**2
            + self._zero_precision @ zero**2
        )

    # -- one step -------------------------------------------------------------------------------

    def step(self, rows: _Rows, theta: Array, zero: Array) -> tuple[Array, Array, Array]:
        """Return how w, θ and z change."""
        joints, kinematics = self._joints, self._body.robot.kinematics
        count, places, size = len(theta), len(joints), len(self._mean)
        stiffness = np.stack([kinematics.gravity_gradient(row) for row in theta])
        stiffness = stiffness[:, joints[:, None], joints]
        robot, tension = self._body.robot, self._seen.tension[:, self._muscles]
        bend = muscle_hessian(robot.routes.muscle_jacobian, theta, groups=robot.groups)
        bend = bend[:, self._muscles[:, None, None], joints[:, None], joints]
        stiffness += np.einsum('nm,nmij->nij', tension, bend)
        a, b, slope = self._by_length, self._by_torque, rows.muscle_jacobian
        turned, e = rows.gravity_by_posture, self._by_gravity
        inner = np.einsum('nmi,nm,nmj->nij', slope, a, slope)
        inner += np.einsum('nki,nk,nkj->nij', stiffness, b, stiffness)
        inner += np.einsum('nki,nk,nkj->nij', turned, e, turned)
        diagonal = self._by_angle + self._by_stop + SMALL / STOP**2
        inner += diagonal[:, :, None] * np.eye(places)
        pulled = np.einsum('nmi,nm->ni', slope, a * rows.length)
        pulled += np.einsum('nki,nk->ni', stiffness, b * rows.torque)
        pulled += np.einsum('nki,nk->ni', turned, e * rows.gravity)
        pulled += self._by_angle * rows.angle
        pulled += self._by_stop * (self._target - theta[:, joints])

        outer = np.zeros((size + places, size + places))
        right = np.zeros(size + places)
        mixed = np.zeros((count, places, size + places))
        by_torque = rows.torque_by_body
        flat = (by_torque * np.sqrt(b)[:, :, None]).reshape(-1, size)
        outer[:size, :size] = flat.T @ flat
        right[:size] = flat.T @ (np.sqrt(b) * rows.torque).ravel()
        mixed[:, :, :size] = stiffness.swapaxes(1, 2) @ (b[:, :, None] * by_torque)
        self.curvature = []
        for i, (column, by_body) in enumerate(zip(self._columns, rows.by_body)):
            weighted = by_body * a[:, i, None]
            self.curvature.append(weighted.T @ by_body)
            outer[column, column] += self.curvature[-1]
            right[column] += weighted.T @ rows.length[:, i]
            mixed[:, :, column] += slope[:, i, :, None] * weighted[:, None]
        own = self._by_angle * self._own
        zeros = size + np.arange(places)
        mixed[:, np.arange(places), zeros] = own
        outer[zeros, zeros] = own.sum(axis=0) + self._zero_precision
        right[zeros] = (own * rows.angle).sum(axis=0) - self._zero_precision * zero
        outer[np.arange(size), np.arange(size)] += self._precision
        right[:size] += self._precision * rows.prior

        lower = np.linalg.cholesky(inner)
        joined = np.concatenate([mixed, pulled[:, :, None]], axis=2)
        reduced = np.linalg.solve(lower, joined)
        last = reduced[:, :, -1]
        tall = reduced[:, :, :-1].reshape(-1, size + places)
        schur = outer - tall.T @ tall
        self.leverage = np.einsum('nmi,nij,nmj->nm', slope, np.linalg.inv(inner), slope) * a
        self.root = cholesky(schur + SMALL * np.eye(len(schur)))
        solved = cho_solve((self.root, False), right - tall.T @ last.ravel())
        back = last - reduced[:, :, :-1] @ solved
        posture = np.linalg.solve(lower.swapaxes(1, 2), back[:, :, None])[:, :, 0]
        step = np.clip(posture, -LARGEST_STEP, LARGEST_STEP)
        return solved[:size], step, solved[size:]

    def determined(self) -> Array:
        """Return how many unknowns each muscle's lengths pin down, (M,)."""
        body = [
            np.trace(np.linalg.solve(c + np.diag(self._precision[column]), c))
            for c, column in zip(self.curvature, self._columns)
        ]
        return np.array(body) + self.leverage.sum(axis=0)

    def run(self, theta: Array, zero: Array) -> None:
        """Bring body, θ (N, D) and zeros (D,) of all joints in line, in place."""
        body, joints = self._body, self._joints
        rows = self.rows(theta, zero[joints])
        determined = np.zeros(len(self._muscles))
        for _ in range(ROUNDS):
            self.weigh(rows, theta, determined)
            before = self.cost(rows, theta, zero[joints])
            change, turn, shift = self.step(rows, theta, zero[joints])
            determined = self.determined()
            old = [body.parameters[m] for m in self._muscles], theta.copy(), zero.copy()
            for share in (*SHARES, 0.0):
                for m, at, column in zip(self._muscles, old[0], self._columns):
                    body.parameters[m] = at + share * change[column]
                theta[:, joints] = old[1][:, joints] + share * turn
                zero[joints] = old[2][joints] + share * shift
                rows = self.rows(theta, zero[joints])
                after = self.cost(rows, theta, zero[joints])
                if after <= before:
                    break
            if before - after < ENOUGH * before:
                break
        self.weigh(rows, theta, determined)
        for i in np.flatnonzero((self._known == 0.0).any(axis=0)):
            # A muscle that is learned anew is trusted no more than it is known.
            wide = np.zeros((len(self.root), len(theta)))
            wide[self._columns[i]] = rows.by_body[i].T
            unknown = np.square(solve_triangular(self.root, wide, trans='T')).sum(axis=0)
            self.noise[i] = np.hypot(self.noise[i], np.sqrt(unknown.mean()))


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
    """Fit body (in place), postures from `start` [rad] (N, D), and zeros of joint sensors.

    Returns what `Fit` holds.
    """
    theta, zero = start.copy(), np.zeros(start.shape[1])
    weight = np.zeros_like(seen.length)
    noise, root = np.empty(seen.length.shape[1]), []
    for group in body.robot.groups:
        joints, muscles = np.array(group.joints), np.array(group.muscles)
        fit = _GroupFit(body, seen, joints, muscles, mean, spread, least_noise)
        fit.run(theta, zero)
        noise[muscles], weight[:, muscles] = fit.noise, fit.weight
        root.append((muscles, fit.root))
    # At angles as they were read, a joint sensor that slipped shows in all muscles of that joint.
    read = np.where(np.isnan(seen.theta), theta, seen.theta - zero * (seen.spread == 0.0))
    (length,) = body.lengths(read, seen.tension, seen.direction)
    return seen.length - length, noise, weight, theta, root
