# SPDX-License-Identifier: Apache-2.0
"""Damped, robust Gauss–Newton: the one solver of this package.

`minimise` fits unknowns of single samples and unknowns that all samples share. `minimise_each` fits
samples that share no unknowns, for example the posture at every message of a recording.

    min over w, θ_1 … θ_N of   Σ_nr ω_nr ρ_nr(θ_n, w)² / σ_r²  +  Σ_k ((w_k − w̄_k) / s_k)²

w are the P unknowns that all samples share, such as the parameters of a body. θ_n are the D
unknowns of sample n alone, such as the posture in which it was taken. ρ_nr is residual r of sample
n, ω_nr its weight, and σ_r the noise of residual r. The prior of w_k has the mean w̄_k and the
standard deviation s_k. With D = 0 this is an ordinary robust fit.

Weights. The residuals ρ have a Student distribution with ν = `FREEDOM` degrees of freedom, which
gives outliers little weight. Weights and noise come from the EM algorithm (Lange, Little and Taylor
1989, "Robust statistical modeling using the t distribution"), with a weak prior at the lowest noise
σ₀:

    ω = (ν + 1) / (ν + (ρ/σ)²)
    σ² = (Σ ω ρ² + 4 σ₀²) / (f + 4),   f = number of residuals − number of unknowns they determine

Step. With the weights fixed, a step (Δθ, Δw) solves the normal equations. A has one block for each
sample. Eliminating θ therefore leaves a system of the size of w (Schur complement):

    ⎡ A   B ⎤ ⎡ Δθ ⎤   ⎡ a ⎤        (C − Bᵀ A⁻¹ B) Δw = c − Bᵀ A⁻¹ a
    ⎣ Bᵀ  C ⎦ ⎣ Δw ⎦ = ⎣ c ⎦        Δθ = A⁻¹ (a − B Δw)

A is (N, D, D), B is (N, D, P), C is (P, P) and contains the prior. The inverse of the Schur
complement is the covariance of w at the solution.

Damping. A + λ diag(e_θ) replaces A, and C + λ diag(e_w) replaces C, where e is 1 over the square of
a typical step. Each round tries the values of λ in `DAMPING` in ascending order, and takes the
first one with which the step lowers the cost. The first value tried is one level below the λ of the
previous round.

Stopping. The fit ends after a number of rounds, or when a step lowers the cost, or is predicted to
lower it, by less than `enough`.

Samples without shared unknowns. `minimise_each` solves, for every sample n alone,

    min over θ_n of  ‖r(θ_n)‖²   with  θ_low ≤ θ_n ≤ θ_high

Each sample has its own damping, and stops on its own. r contains the roots of weights, and the
prior as further rows. An unknown at its bound is held if the step would move it beyond.

Two problems of this package have their own solver. The steps of `simulation/equilibrium.py` are
compiled, because a simulation takes thousands of them. Each step of `motion/methods.py` is a
quadratic programme, because tensions have to balance the torque and stay within their limits.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from musculoskeletal_ae.arrays import Array

#: degrees of freedom ν of the Student distribution of the residuals; small values tolerate outliers
FREEDOM = 4.0
PRIOR_COUNT = 4.0  # weight of the prior at σ₀ when the noise is estimated, as a number of residuals
WEIGHTINGS = 3  # number of steps of the EM algorithm in each round
DAMPING = (0.0, 0.1, 1.0, 10.0, 100.0)  # damping factors λ that a round tries, in this order
SMALL = 1e-6  # added to the diagonal of C, so that the Schur complement is positive definite
#: damping factors λ of `minimise_each`; there are more of them, because a start may be far from the
#: solution
LADDER = np.array([0.0, *np.logspace(-1.0, 9.0, 11)])
#: let `minimise_each` end after a step that is predicted to lower ‖r‖² by less than this, which
#: moves the solution by less than a third of a standard deviation
SETTLED = 0.1


def student(score: Array) -> Array:
    """Return the weights ω of Student's t distribution for scaled residuals, in the same shape."""
    weight: Array = (FREEDOM + 1.0) / (FREEDOM + score**2)
    return weight


def student_cost(score: Array) -> float:
    """Return −2 times the log-likelihood of scaled residuals (`score`), up to a constant.

    The residuals have Student's t distribution with FREEDOM degrees of freedom.
    """
    return float((FREEDOM + 1.0) * np.log1p(score**2 / FREEDOM).sum())


def whitening(covariance: Array) -> Array:
    """Return R with RᵀR = Σ⁻¹ for a covariance Σ of residuals ρ, (R, R) each.

    The elements of R ρ are independent, with standard deviation 1.
    """
    root: Array = np.linalg.inv(np.linalg.cholesky(covariance))
    return root


def noise_and_weight(
    residual: Array, known: Array, noise: Array, determined: Array, least: float
) -> tuple[Array, Array]:
    """Estimate noise and weights of residuals by a few steps of the EM algorithm.

    Args:
        residual: ρ of N samples in M columns, (N, M).
        known: 1 where a residual was measured, else 0, (N, M).
        noise: σ of each column so far, (M,).
        determined: Number of unknowns that each column determines, (M,).
        least: σ₀, in the unit of the residuals.

    Returns:
        σ (M,) and ω (N, M), which is 0 where no residual was measured.
    """
    freedom = np.maximum(1.0, known.sum(axis=0) - determined)
    for _ in range(WEIGHTINGS):
        weight = known * student(residual / noise)
        square = (weight * residual**2).sum(axis=0) + PRIOR_COUNT * least**2
        noise = np.maximum(least, np.sqrt(square / (freedom + PRIOR_COUNT)))
    return noise, weight


def determined(curvature: Array, precision: Array) -> float:
    """Return the effective number of unknowns that the residuals determine, tr((H + S)⁻¹ H).

    Args:
        curvature: H, the Hessian of the residuals' cost, (P, P).
        precision: S, the diagonal of the prior's precision, (P,).
    """
    return float(np.trace(np.linalg.solve(curvature + np.diag(precision), curvature)))


class Equations(NamedTuple):
    """The blocks of the normal equations' matrix."""

    samples: Array  # blocks A of the unknowns of single samples, (N, D, D)
    mixed: Array  # blocks B that couple these unknowns with the shared ones, (N, D, P)
    common: Array  # block C of the shared unknowns, (P, P)

    @classmethod
    def of_common(cls, common: Array) -> Equations:
        """Return the matrix of a fit whose samples have no unknowns of their own.

        Args:
            common: The block C of the unknowns that all samples share, (P, P).
        """
        return cls(np.zeros((0, 0, 0)), np.zeros((0, 0, len(common))), common)


class RightSides(NamedTuple):
    """The right sides of the normal equations."""

    samples: Array  # part a, which belongs to the unknowns of single samples, (N, D)
    common: Array  # part c, which belongs to the shared unknowns, (P,)

    @classmethod
    def of_common(cls, common: Array) -> RightSides:
        """Return the right sides of a fit whose samples have no unknowns of their own.

        Args:
            common: Part c of the right side, which belongs to the unknowns that all samples
                share, (P,).
        """
        return cls(np.zeros((0, 0)), common)


class SolvedStep(NamedTuple):
    """A step of the unknowns that solves the normal equations."""

    samples: Array  # step Δθ of the unknowns of single samples, (N, D)
    common: Array  # step Δw of the shared unknowns, (P,)
    decrease: float  # predicted decrease of the cost by the step


class Eliminated:
    """Factorised normal equations with the unknowns of individual samples eliminated.

    Attributes:
        root: Upper triangular R (P, P); Rᵀ R is the Schur complement of A in the damped matrix.
    """

    def __init__(
        self, equations: Equations, sample_damping: Array | float, common_damping: Array | float
    ) -> None:
        """Factorise the matrix.

        Args:
            equations: The matrix; A and the Schur complement must be positive definite.
            sample_damping: Added to the diagonals of A, (D,) or (N, D).
            common_damping: Added to the diagonal of C, (P,).
        """
        samples, mixed, common = equations
        eye = np.eye(samples.shape[-1])
        damped = samples + np.asarray(sample_damping)[..., None] * eye
        #: L, the inverse of the Cholesky factor of A, so that A⁻¹ = Lᵀ L. Products with L are
        #: cheaper than triangular solves.
        self._inverse = np.linalg.inv(np.linalg.cholesky(damped))
        self._reduced = self._inverse @ mixed  # the product L B
        tall = self._reduced.reshape(-1, len(common))
        diagonal = np.broadcast_to(common_damping, len(common))
        # Use numpy only, because nodes would wait 0.3 s for the import of scipy.linalg.
        self._complement = common + np.diag(diagonal) - tall.T @ tall
        self.root: Array = np.linalg.cholesky(self._complement).T.astype(float, copy=False)

    def solve(self, right: RightSides) -> SolvedStep:
        """Return the step that solves the equations for these right sides."""
        inverse, reduced = self._inverse, self._reduced
        last = (inverse @ right.samples[:, :, None])[:, :, 0]
        right_common = right.common - np.tensordot(last, reduced, 2)
        solution = np.linalg.solve(self._complement, right_common)
        common: Array = solution.astype(float, copy=False)
        samples = (inverse.swapaxes(1, 2) @ (last - reduced @ common)[:, :, None])[:, :, 0]
        decrease = float(common @ right.common + (samples * right.samples).sum())
        return SolvedStep(samples, common, decrease)


Point = TypeVar('Point')


class Problem(Protocol[Point]):
    """A problem to fit. A point holds values of all unknowns and the residuals at these values."""

    #: e_θ (D,) and e_w (P,): 1 over the square of a typical step
    usual: tuple[Array, Array]

    def weigh(self, point: Point) -> None:
        """Update noise and weights from the residuals at a point."""
        ...

    def cost(self, point: Point) -> float:
        """Return the cost to minimise, with the current weights."""
        ...

    def equations(self, point: Point) -> Equations:
        """Return the matrix of the normal equations at a point, with the current weights."""
        ...

    def right_sides(self, point: Point) -> RightSides:
        """Return the right sides at a point.

        They may use the derivatives of the last call of `equations`, even if that was at another
        point.
        """
        ...

    def moved(self, point: Point, step: SolvedStep) -> Point:
        """Return the point that is reached from `point` by a step."""
        ...


@dataclass(frozen=True)
class Result(Generic[Point]):
    """State of a fit after a round.

    Attributes:
        point: Values of the unknowns, and the residuals at these values.
        eliminated: The normal equations solved last; None before the first round.
        level: Index into `DAMPING` of the damping in `eliminated`.
        decrease: Decrease of the cost by the last step; 0 if no step was taken.
    """

    point: Point
    eliminated: Eliminated | None = None
    level: int = 0
    decrease: float = 0.0


Work = Generator[None, None, Result[Point]]  # yields before each short piece of work


def minimise(problem: Problem[Point], start: Point, rounds: int, enough: float) -> Result[Point]:
    """Minimise the cost of a problem, beginning at a point.

    Args:
        problem: The problem to fit.
        start: Point at which the fit begins.
        rounds: Largest number of steps.
        enough: The fit ends when a step lowers the cost, or is predicted to lower it, by less than
            this value.

    Returns:
        The state after the last round. The weights of the problem then belong to its point.
    """
    work = minimise_in_pieces(problem, start, rounds, enough)
    while True:
        try:
            next(work)
        except StopIteration as end:
            result: Result[Point] = end.value
            return result


def minimise_in_pieces(
    problem: Problem[Point], start: Point, rounds: int, enough: float
) -> Work[Point]:
    """Minimise as `minimise` does, but yield before every evaluation of a new point."""
    fit = Result(start)
    for _ in range(rounds):
        problem.weigh(fit.point)
        if fit.eliminated is not None and fit.level == 0:
            # The equations of the previous round predict the decrease well enough to end the fit
            # without solving new ones.
            right = problem.right_sides(fit.point)
            if fit.eliminated.solve(right).decrease < enough:
                break
        fit = yield from _descend(problem, fit, enough)
        if fit.decrease < enough:
            break
    problem.weigh(fit.point)
    return fit


def _descend(problem: Problem[Point], fit: Result[Point], enough: float) -> Work[Point]:
    """Take the step with the least damping that lowers the cost; return the new state.

    If no step lowers the cost enough, the state keeps its point.
    """
    yield
    before = problem.cost(fit.point)
    equations = problem.equations(fit.point)
    right = problem.right_sides(fit.point)
    of_samples, of_common = problem.usual
    for level in range(max(0, fit.level - 1), len(DAMPING)):
        damping = DAMPING[level]
        eliminated = Eliminated(equations, damping * of_samples, SMALL + damping * of_common)
        step = eliminated.solve(right)
        if step.decrease < enough:
            break
        point = problem.moved(fit.point, step)
        after = problem.cost(point)
        if after <= before:
            return Result(point, eliminated, level, before - after)
        yield
    return Result(fit.point, eliminated, level)


#: maps θ (..., D) to residuals r (..., R) and their derivatives ∂r/∂θ (..., R, D)
Residuals = Callable[[Array], tuple[Array, Array]]


def minimise_each(
    residuals: Residuals,
    start: Array,
    usual: Array | float,
    rounds: int,
    *,
    bounds: tuple[Array, Array] | None = None,
    least_damping: float = SMALL,
    enough: float = SETTLED,
) -> Array:
    """Minimise ‖r(θ)‖² of every sample alone, beginning at `start`.

    Args:
        residuals: The residuals r(θ), in standard deviations, and their derivatives.
        start: The first θ, (..., D).
        usual: e_θ, 1 over the square of a typical step, (D,).
        rounds: Largest number of steps.
        bounds: θ_low and θ_high, (D,) each; None without bounds.
        least_damping: Smallest λ. With a large value, residuals that hardly depend on an unknown do
            not move this unknown far.
        enough: A sample ends with the first step that is predicted to lower ‖r‖² by less than this
            value. This last step is taken without checking that it lowers ‖r‖².

    Returns:
        θ, (..., D).
    """
    theta = start if bounds is None else np.clip(start, *bounds)
    ladder, unit = np.maximum(least_damping, LADDER), usual * np.eye(theta.shape[-1])
    level = np.zeros(theta.shape[:-1], dtype=np.int64)
    value, slope = residuals(theta)
    cost = _dot(value, value)
    for _ in range(rounds):
        gradient = (value[..., None, :] @ slope)[..., 0, :]
        if bounds is not None:
            lower, upper = bounds
            held = (theta <= lower) & (gradient > 0.0) | (theta >= upper) & (gradient < 0.0)
            if held.any():
                slope = np.where(held[..., None, :], 0.0, slope)
                gradient = np.where(held, 0.0, gradient)
        matrix = slope.swapaxes(-1, -2) @ slope + ladder[level][..., None, None] * unit
        step = -np.linalg.solve(matrix, gradient[..., None])[..., 0]
        tried = theta + step if bounds is None else np.clip(theta + step, *bounds)
        is_last = -_dot(step, gradient) < enough
        if is_last.all():
            return tried
        tried_value, tried_slope = residuals(tried)
        tried_cost = _dot(tried_value, tried_value)
        is_better = ~is_last & (tried_cost <= cost)
        if is_better.all():
            theta, value, slope, cost = tried, tried_value, tried_slope, tried_cost
            level = np.maximum(level - 1, 0)
        else:
            # A finished sample keeps its point, so that its last step stays the same.
            theta = np.where(is_better[..., None], tried, theta)
            value = np.where(is_better[..., None], tried_value, value)
            slope = np.where(is_better[..., None, None], tried_slope, slope)
            cost = np.where(is_better, tried_cost, cost)
            change = np.where(is_better, -1, np.where(is_last, 0, 1))
            level = np.clip(level + change, 0, len(ladder) - 1)
    result: Array = np.where(is_last[..., None], tried, theta)
    return result


def _dot(one: Array, other: Array) -> Array:
    result: Array = np.einsum('...i,...i->...', one, other)
    return result
