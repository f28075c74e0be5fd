# SPDX-License-Identifier: Apache-2.0
"""Fits the length offsets, and the postures of all moments, to readings of length and tension.

A moment is the mean of the readings over a short window; `length_model` describes its equations. If
the joint angles were measured, the offsets are the mean residuals of the lengths. Otherwise the
offsets and the postures of all moments are estimated together, by the solver `gauss_newton`.
Because muscles outnumber joints and G = ∂l/∂θ changes with the posture, only one set of offsets
explains all moments of a moving arm. The balance of torques already restricts the posture at the
first moment, when the lengths alone do not. The fit starts from the best of many random postures of
the first moment.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.estimation.lengths.length_model import LengthModel, MomentFit
from musculoskeletal_ae.estimation.lengths.length_moments import Moments
from musculoskeletal_ae.gauss_newton import minimise_in_pieces
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.wiring import Wiring, WiringJudgement, decide, single_faults

# Constants of the search for initial values.
#: draw this many random postures, and compare how well their torques balance at the first moment
DRAWN_POSTURES = 3200
FITTED_POSTURES = 400  # fit this many of the best drawn postures coarsely to the lengths
COMPARED_FITS = 30  # compare this many of the best coarse fits by torque as well
REFINED_FITS = 6  # refine this many of the best coarse fits
FEW_MOMENTS = 24  # compare initial values on this many moments (means over 0.25 s), not on all
BATCH = 20  # fit this many postures in one piece of work, which runs between two messages
COARSE_LENGTH = 0.01  # assume this standard deviation of a length in coarse fits [m]
COARSE_TORQUE = 2.0  # assume this standard deviation of a torque in coarse fits [N·m]
#: assume this standard deviation of the excess over joint limits in coarse fits [rad]
COARSE_ANGLE = 0.1

# Constants of the judgement of the wiring.
#: after all possible wirings have been fitted to a few moments, fit this many of the best to all
LIKELY = 3
MOST_FAULTS = 3  # search for at most this many exchanged pairs and reversed signs in total

FARTHEST = 0.3  # prefer drawn postures that imply no larger offset than this [m]
ROUNDS = 20  # end the fit after this many Gauss–Newton steps
FIRST_ROUNDS = 6  # end a fit in the search for initial values after this many Gauss–Newton steps
LEAST_DECREASE = 3e-5  # end a fit if a step lowers the cost by less than this, per residual


class Fit(NamedTuple):
    """Length offsets and other constants that were fitted to the readings of K moments.

    Attributes:
        cost: −2 times the logarithm of the posterior, up to a constant; 0 if the joint angles were
            measured.
        constants: Length offsets [m], friction coefficients of the tendons, offsets of the tension
            sensors [N], and Coulomb friction torques of the joints [N·m], (3M + D,).
        theta: Postures [rad], (K, D).
    """

    cost: float
    constants: Array
    theta: Array


#: a fit in steps: yields after each short piece of work, and finally returns the fit
Steps = Generator[None, None, Fit]


class LengthFit:
    """Fits the length offsets of all muscles to readings, with the lengths of one network.

    Attributes:
        used: Whether each muscle is used, that is, not isolated, (M,).
    """

    def __init__(self, robot: Robot, mae: Mae, known: Array) -> None:
        """Prepare fits in which some offsets are known.

        Args:
            robot: The robot.
            mae: The network.
            known: Known offsets [m], (M,); NaN for all others. Without joint angles, the fit may
                change them by about a millimetre.
        """
        robot = robot.with_elasticity(mae.elasticity)
        self._robot, self._mae, self._known = robot, mae, known
        self._rng = np.random.default_rng([0, 0x2E])
        self._model = LengthModel(robot, mae, known, self._rng)
        self.used = self._model.used

    def known_angles(self, moments: Moments) -> Fit:
        """Fit the offsets to moments whose joint angles were measured.

        A moment is the mean of the readings over a short window.
        """
        residual = moments.length - self._mae.lengths(moments.theta, moments.tension)
        muscle_count = self._robot.muscle_count
        offset = self.with_known(residual.mean(axis=0))
        constants = np.concatenate([offset, self._model.prior_mean[muscle_count:]])
        return Fit(0.0, constants, moments.theta)

    def with_known(self, offset: Array) -> Array:
        """Return offsets [m] (..., M) in which the known ones have their known values."""
        return np.where(np.isnan(self._known), offset, self._known)

    def unknown_angles(self, moments: Moments, before: Fit | None) -> Steps:
        """Fit the offsets to moments whose joint angles were not measured.

        The generator yields after each short piece of work, and returns the fit at the end.

        Args:
            moments: The moments.
            before: An earlier fit, or None. The new fit also starts from its constants, and the
                better result is returned.
        """
        few = moments.rows(_few(moments))
        guesses = yield from self._guesses(moments, few)
        likeliest = yield from self._best(guesses, few, FIRST_ROUNDS)
        # Let all moments decide between the new start and the earlier fit: a few moments may
        # mislead.
        candidates = [likeliest.constants]
        if before is not None:
            candidates.append(before.constants)
        return (yield from self._best(candidates, moments, ROUNDS))

    def wiring(self, fit: Fit, moments: Moments) -> Generator[None, None, WiringJudgement]:
        """Judge whether columns are exchanged or have a wrong sign.

        Each wiring that differs by one fault is fitted to a few moments. The fit begins with the
        postures of `fit`, which are roughly right although some columns are wrong. All moments
        decide among the likeliest wirings. If a fault is found, the search continues for a further
        fault. The generator yields after each short piece of work.

        Args:
            fit: The fit to the readings as they are.
            moments: The moments to which it was fitted.
        """
        wiring = Wiring.straight(self._robot.muscle_count)
        judgement = WiringJudgement(wiring, (wiring,), (), fit.cost)
        columns = np.flatnonzero(self.used)
        rows = _few(moments)
        for _ in range(MOST_FAULTS):
            wiring, coarse = judgement.wiring, list[tuple[float, Wiring]]()
            for other in single_faults(wiring, columns.tolist()):
                start = self._start(fit, moments, wiring, other, rows)
                few = _rewired(moments.rows(rows), other)
                coarse.append(((yield from self._refine(start, few, FIRST_ROUNDS)).cost, other))
            likely, fits = sorted(coarse, key=lambda each: each[0])[:LIKELY], dict[Wiring, Fit]()
            for _, other in likely:
                start = self._start(fit, moments, wiring, other, np.arange(len(moments.length)))
                fits[other] = yield from self._refine(start, _rewired(moments, other), ROUNDS)
            costs = [(other, max(other_fit.cost, 0.0)) for other, other_fit in fits.items()]
            newest = decide(wiring, fit.cost, costs)
            if newest.wiring == wiring:
                break
            judgement, fit = newest, fits[newest.wiring]
        return judgement

    def _start(self, fit: Fit, moments: Moments, before: Wiring, after: Wiring, rows: Ints) -> Fit:
        """Start the fit of one wiring: return initial values, from a fit of another wiring.

        The postures are kept, and so are all constants except the length offsets of the muscles
        whose columns change.

        Args:
            fit: The fit to all moments with the wiring `before`.
            moments: The moments.
            before: The wiring of `fit`.
            after: The wiring of the result.
            rows: Indices of the moments to which the result applies.
        """
        few, theta, constants = _rewired(moments.rows(rows), after), fit.theta[rows], fit.constants
        constants = constants.copy()
        changed = [
            muscle
            for now, then in zip(zip(*before), zip(*after))
            for muscle in (now[0], then[0])
            if now != then
        ]
        error = few.length - self._mae.lengths(theta, few.tension)
        constants[changed] = np.median(error[:, changed], axis=0)
        return Fit(np.inf, constants, theta)

    def cost_per_residual(self, fit: Fit) -> float:
        """Return the cost of a fit, divided by the number of its length and torque residuals."""
        return fit.cost / self._count(fit.theta)

    def _count(self, theta: Array) -> int:
        """Count the length and torque residuals in the postures `theta`, (K, D)."""
        return len(theta) * (self._robot.muscle_count + self._robot.joint_count)

    # -- search for a start ---------------------------------------------------------------------

    def _best(self, guesses: list[Array], moments: Moments, rounds: int) -> Steps:
        """Refine each guess of the constants by up to `rounds` steps; return the best fit."""
        fits = list[Fit]()
        for constants in guesses:
            length = moments.length - constants[: self._robot.muscle_count]
            theta = self._mae.estimate(moments.tension, length).theta
            theta = np.clip(theta, self._robot.lower, self._robot.upper)
            fits.append((yield from self._refine(Fit(np.inf, constants, theta), moments, rounds)))
        return min(fits, key=lambda fit: fit.cost)

    def _guesses(self, moments: Moments, few: Moments) -> Generator[None, None, list[Array]]:
        """Search for initial values of the constants by drawing postures of the first moment.

        Each posture of the first moment implies offsets. The search compares how well the offsets
        explain the other moments. It yields after each short piece of work.

        Args:
            moments: All moments.
            few: The moments on which the search compares postures.

        Returns:
            The best initial values, each an array of all constants, (3M + D,).
        """
        mae = self._mae
        tension = np.tile(moments.tension[0], (FITTED_POSTURES, 1))
        # Keep the postures whose torques balance best; this needs no offsets.
        drawn, unbalanced = list[Array](), list[Array]()
        for _ in range(DRAWN_POSTURES // FITTED_POSTURES):
            drawn.append(self._robot.random_postures(FITTED_POSTURES, self._rng))
            torque = self._model.torque(drawn[-1], tension)[0]
            unbalanced.append(np.linalg.norm(torque, axis=1))
            yield
        first = np.concatenate(drawn)[np.argsort(np.concatenate(unbalanced))[:FITTED_POSTURES]]
        offset = self.with_known(moments.length[0] - mae.lengths(first, tension))
        largest = np.abs(offset * self.used * np.isnan(self._known)).max(axis=1)
        plausible = max(REFINED_FITS, int((largest < FARTHEST).sum()))
        offset = offset[np.argsort(largest)[:plausible]]
        cost, postures = np.empty(len(offset)), list[Array]()
        for n in range(0, len(offset), BATCH):
            length = few.length - offset[n : n + BATCH, None]
            tension = np.broadcast_to(few.tension, length.shape)
            theta = mae.estimate(tension, length).theta
            residual = self.used * (length - mae.lengths(theta, tension))
            parts = (
                residual / COARSE_LENGTH,
                self._model.outside(theta) / COARSE_ANGLE,
            )
            costs = [np.log1p(each**2).sum(axis=(1, 2)) for each in parts]
            cost[n : n + BATCH] = np.sum(costs, axis=0)
            postures.extend(theta)
            yield
        order = np.argsort(cost)[:COMPARED_FITS]
        for n in order:
            torque = self._model.torque(postures[n], few.tension)[0] / COARSE_TORQUE
            cost[n] += np.log1p(torque**2).sum()
            yield
        best = order[np.argsort(cost[order])][:REFINED_FITS]
        others = self._model.prior_mean[self._robot.muscle_count :]
        return [np.concatenate([offset[n], others]) for n in best]

    def _refine(self, fit: Fit, moments: Moments, rounds: int) -> Steps:
        """Refine a fit by at most `rounds` Gauss–Newton steps."""
        problem = MomentFit(self._model, moments, fit.theta)
        start, enough = problem.point(fit.constants, fit.theta), self._count(fit.theta)
        work = minimise_in_pieces(problem, start, rounds, LEAST_DECREASE * enough)
        point = (yield from work).point
        return Fit(problem.log_cost(point), point.constants, point.theta)


def _few(moments: Moments) -> Ints:
    """Return the indices of at most FEW_MOMENTS evenly distributed moments."""
    last = len(moments.length) - 1
    few: Ints = np.unique(np.linspace(0, last, FEW_MOMENTS).astype(np.int64))
    return few


def _rewired(moments: Moments, wiring: Wiring) -> Moments:
    """Return moments in the order and with the signs of the muscles, according to a wiring."""
    return Moments(
        wiring.unsigned(moments.tension),
        wiring.signed(moments.length),
        wiring.signed(moments.sliding),
        wiring.signed(moments.read),
        moments.theta,
    )
