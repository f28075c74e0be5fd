# SPDX-License-Identifier: Apache-2.0
"""Robust Gauss–Newton with a prior; unknowns that belong to one sample each are eliminated.

    min over w, θ_1 … θ_N of   Σ_nr ω_nr ρ_nr(θ_n, w)² / σ_r²  +  Σ_k ((w_k − w̄_k) / s_k)²

w are the unknowns that all samples share (P of them), as the parameters of a body. θ_n are those of
sample n alone (D of them), as the posture in which it was taken. With D = 0 this is an ordinary
robust fit.

Weights. The residuals ρ have a Student distribution with ν = `FREEDOM` degrees of freedom, so that
outliers count little. Weights and noise come from the EM algorithm (Lange, Little and Taylor 1989,
"Robust statistical modeling using the t distribution"), with a weak prior at the least noise σ₀:

    ω = (ν + 1) / (ν + (ρ/σ)²)
    σ² = (Σ ω ρ² + 4 σ₀²) / (f + 4),   f = number of residuals − number of unknowns they determine

Step. With the weights as they are, a step (Δθ, Δw) solves the normal equations. A has one block
for each sample, so that θ is eliminated and what remains has the size of w (Schur complement):

    ⎡ A   B ⎤ ⎡ Δθ ⎤   ⎡ a ⎤        (C − Bᵀ A⁻¹ B) Δw = c − Bᵀ A⁻¹ a
    ⎣ Bᵀ  C ⎦ ⎣ Δw ⎦ = ⎣ c ⎦        Δθ = A⁻¹ (a − B Δw)

A is (N, D, D), B is (N, D, P), C is (P, P) and contains the prior. The inverse of the Schur
complement is the covariance of w at the solution.

Damping. A + λ diag(e_θ), C + λ diag(e_w), where e is one over the square of a usual step. Of the λ
in `DAMPING`, the smallest that lowers the cost is taken, beginning one below that of the last
round.

Stopping. The fit ends when a step lowers the cost, or is expected to lower it, by less than
`enough`, or after a number of rounds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from scipy.linalg import cho_solve, cholesky

from musculoskeletal_ae.arrays import Array

FREEDOM = 4.0  # ν of the Student distribution
PRIOR_COUNT = 4.0  # residuals that the least noise counts for
WEIGHTINGS = 3  # steps of the EM algorithm in each round
DAMPING = (0.0, 0.1, 1.0, 10.0, 100.0)  # λ
SMALL = 1e-6  # added to the diagonal of C


def student(score: Array) -> Array:
    """Return the weights ω of residuals in units of their noise."""
    weight: Array = (FREEDOM + 1.0) / (FREEDOM + score**2)
    return weight


def noise_and_weight(
    residual: Array, known: Array, noise: Array, determined: Array, least: float
) -> tuple[Array, Array]:
    """Return noise and weights of residuals by a few steps of the EM algorithm.

    Args:
        residual: ρ of N samples in M columns, (N, M).
        known: 1 where a sample says something, else 0, (N, M).
        noise: σ of each column so far, (M,).
        determined: How many unknowns each column determines, (M,).
        least: σ₀, in the unit of the residuals.

    Returns:
        σ (M,) and ω (N, M), which is 0 where a sample says nothing.
    """
    freedom = np.maximum(1.0, known.sum(axis=0) - determined)
    for _ in range(WEIGHTINGS):
        weight = known * student(residual / noise)
        square = (weight * residual**2).sum(axis=0) + PRIOR_COUNT * least**2
        noise = np.maximum(least, np.sqrt(square / (freedom + PRIOR_COUNT)))
    return noise, weight


def determined(curvature: Array, precision: Array) -> float:
    """Return how many unknowns residuals determine, beside a prior.

    That is tr((H + S)⁻¹ H), with the curvature H (P, P) of the cost of the residuals and the
    diagonal S (P,) of the prior.
    """
    return float(np.trace(np.linalg.solve(curvature + np.diag(precision), curvature)))


class Equations(NamedTuple):
    """The matrix of the normal equations."""

    samples: Array  # A, (N, D, D)
    mixed: Array  # B, (N, D, P)
    common: Array  # C, (P, P)

    @classmethod
    def of_common(cls, common: Array) -> Equations:
        """Return those of a fit without unknowns of single samples."""
        return cls(np.zeros((0, 0, 0)), np.zeros((0, 0, len(common))), common)


class RightSides(NamedTuple):
    """The right sides of the normal equations."""

    samples: Array  # a, (N, D)
    common: Array  # c, (P,)

    @classmethod
    def of_common(cls, common: Array) -> RightSides:
        """Return those of a fit without unknowns of single samples."""
        return cls(np.zeros((0, 0)), common)


class Step(NamedTuple):
    """A solution of the normal equations."""

    samples: Array  # Δθ, (N, D)
    common: Array  # Δw, (P,)
    decrease: float  # of the cost, as it is expected


class Eliminated:
    """Normal equations in which the unknowns of single samples are eliminated.

    Attributes:
        root: R with Rᵀ R the Schur complement of w, upper triangular, (P, P).
    """

    def __init__(
        self, equations: Equations, sample_damping: Array | float, common_damping: Array | float
    ) -> None:
        """Factorise.

        Args:
            equations: The matrix; A and the Schur complement have to be positive definite.
            sample_damping: Added to the diagonals of A, (D,) or (N, D).
            common_damping: Added to the diagonal of C, (P,).
        """
        samples, mixed, common = equations
        eye = np.eye(samples.shape[-1])
        damped = samples + np.asarray(sample_damping)[..., None] * eye
        # A⁻¹ = Lᵀ L with L the inverse of the Cholesky factor: products with it are cheaper.
        self._inverse = np.linalg.inv(np.linalg.cholesky(damped))
        self._reduced = self._inverse @ mixed  # L B
        tall = self._reduced.reshape(-1, len(common))
        diagonal = np.broadcast_to(common_damping, len(common))
        self.root: Array = cholesky(common + np.diag(diagonal) - tall.T @ tall)

    def solve(self, right: RightSides) -> Step:
        """Return the step."""
        inverse, reduced = self._inverse, self._reduced
        last = (inverse @ right.samples[:, :, None])[:, :, 0]
        common = cho_solve((self.root, False), right.common - np.tensordot(last, reduced, 2))
        samples = (inverse.swapaxes(1, 2) @ (last - reduced @ common)[:, :, None])[:, :, 0]
        decrease = float(common @ right.common + (samples * right.samples).sum())
        return Step(samples, common, decrease)


Point = TypeVar('Point')


class Problem(Protocol[Point]):
    """What is to be fitted. A point is a value of all unknowns, with its residuals."""

    #: e_θ (D,) and e_w (P,): 1 over the square of a usual step
    usual: tuple[Array, Array]

    def weigh(self, point: Point) -> None:
        """Take noise and weights from the residuals at a point."""
        ...

    def cost(self, point: Point) -> float:
        """Return what is to be minimised, with the weights as they are."""
        ...

    def equations(self, point: Point) -> Equations:
        """Return the normal equations at a point, with the weights as they are."""
        ...

    def right_sides(self, point: Point) -> RightSides:
        """Return their right sides; derivatives may be those of the last `equations`."""
        ...

    def moved(self, point: Point, step: Step) -> Point:
        """Return the point after a step."""
        ...


@dataclass(frozen=True)
class Result(Generic[Point]):
    """Where a fit is.

    Attributes:
        point: The unknowns and their residuals.
        eliminated: The normal equations as they were solved last; None before the first round.
        level: Which of `DAMPING` they have.
        decrease: By how much the last step lowered the cost; 0 if no step was worth it.
    """

    point: Point
    eliminated: Eliminated | None = None
    level: int = 0
    decrease: float = 0.0


def minimise(problem: Problem[Point], start: Point, rounds: int, enough: float) -> Result[Point]:
    """Fit from a point on.

    Args:
        problem: What is to be fitted.
        start: Where to begin.
        rounds: How many steps to go at most.
        enough: The decrease of cost that is not worth a step.

    Returns:
        Where it ended. The weights of the problem are those of that point.
    """
    fit = Result(start)
    for _ in range(rounds):
        problem.weigh(fit.point)
        if fit.eliminated is not None and fit.level == 0:
            # By the equations of the last round, which hardly differ.
            right = problem.right_sides(fit.point)
            if fit.eliminated.solve(right).decrease < enough:
                break
        fit = _descend(problem, fit, enough)
        if fit.decrease < enough:
            break
    problem.weigh(fit.point)
    return fit


def _descend(problem: Problem[Point], fit: Result[Point], enough: float) -> Result[Point]:
    """Go the step with the least damping that lowers the cost, or none."""
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
    return Result(fit.point, eliminated, level)
