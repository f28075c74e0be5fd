# SPDX-License-Identifier: Apache-2.0
"""The solver: its steps, weights, damping and bounds, and its termination."""

from typing import NamedTuple

import numpy as np
import pytest

from musculoskeletal_ae.gauss_newton import (
    Eliminated,
    Equations,
    RightSides,
    determined,
    minimise,
    minimise_each,
    minimise_in_pieces,
    noise_and_weight,
)


def test_eliminating_the_samples_gives_the_step_of_the_whole_system():
    rng = np.random.default_rng(0)
    count, places, size = 5, 3, 4
    by_sample = rng.standard_normal((count, 8, places))
    by_common = rng.standard_normal((count, 8, size))
    whole = np.zeros((count * 8, count * places + size))
    for n in range(count):
        rows = slice(8 * n, 8 * (n + 1))
        whole[rows, places * n : places * (n + 1)] = by_sample[n]
        whole[rows, -size:] = by_common[n]
    left = rng.standard_normal(count * 8)
    expected = np.linalg.lstsq(whole, left, rcond=None)[0]
    equations = Equations(
        np.einsum('nri,nrj->nij', by_sample, by_sample),
        np.einsum('nri,nrp->nip', by_sample, by_common),
        np.einsum('nrp,nrq->pq', by_common, by_common),
    )
    residual = left.reshape(count, 8)
    right = RightSides(
        np.einsum('nri,nr->ni', by_sample, residual),
        np.einsum('nrp,nr->p', by_common, residual),
    )
    eliminated = Eliminated(equations, 0.0, 0.0)
    step = eliminated.solve(right)
    np.testing.assert_allclose([*step.samples.ravel(), *step.common], expected, atol=1e-10)
    gained = left @ left - np.square(left - whole @ expected).sum()
    assert step.decrease == pytest.approx(gained)
    covariance = np.linalg.inv(whole.T @ whole)[-size:, -size:]
    np.testing.assert_allclose(
        np.linalg.inv(eliminated.root.T @ eliminated.root), covariance, atol=1e-10
    )


class Line(NamedTuple):
    """Slope and offset of a line, and its residuals."""

    values: np.ndarray
    residual: np.ndarray


class LineFit:
    """The problem to fit a and b of y = a x + b; no unknown belongs to a single sample."""

    usual = np.zeros(0), np.full(2, 1e-6)  # a very weak prior

    def __init__(self, x, y):
        self.y, self.jacobian = y[:, None], np.stack([x, np.ones_like(x)], axis=1)
        self.noise, self.costs = np.array([1.0]), []

    def point(self, values):
        return Line(values, self.y - self.jacobian @ values[:, None])

    def weigh(self, point):
        known = np.ones_like(self.y)
        self.noise, weight = noise_and_weight(point.residual, known, self.noise, np.full(1, 2.0), 0)
        self.weight = weight / self.noise**2

    def cost(self, point):
        return float((self.weight * point.residual**2).sum())

    def equations(self, _):
        return Equations.of_common((self.jacobian * self.weight).T @ self.jacobian)

    def right_sides(self, point):
        return RightSides.of_common(self.jacobian.T @ (self.weight * point.residual)[:, 0])

    def moved(self, point, step):
        return self.point(point.values + step.common)


def test_outliers_hardly_move_a_robust_fit():
    rng = np.random.default_rng(1)
    x = rng.uniform(-1.0, 1.0, 200)
    y = 2.0 * x + 1.0 + 0.01 * rng.standard_normal(200)
    y[::10] += 5.0
    fit = LineFit(x, y)
    end = minimise(fit, fit.point(np.zeros(2)), 50, 1e-9)
    np.testing.assert_allclose(end.point.values, [2.0, 1.0], atol=0.005)
    plain = np.linalg.lstsq(fit.jacobian, y, rcond=None)[0]
    assert abs(plain[1] - 1.0) > 0.4


def test_the_noise_of_residuals_without_outliers_is_their_spread():
    rng = np.random.default_rng(2)
    residual = np.array([0.5, 3.0]) * rng.standard_t(4.0, (5000, 2))
    noise, weight = np.ones(2), None
    for _ in range(20):
        noise, weight = noise_and_weight(residual, np.ones_like(residual), noise, np.zeros(2), 1e-9)
    np.testing.assert_allclose(noise, [0.5, 3.0], rtol=0.05)
    assert weight.max() <= 1.25 and weight.min() > 0.0


def test_a_step_that_would_raise_the_cost_is_damped():
    class Curved(LineFit):
        """The fit of an arc tangent; far from its solution, Gauss–Newton steps overshoot."""

        usual = np.zeros(0), np.ones(1)

        def __init__(self):
            super().__init__(np.zeros(1), np.zeros(1))

        def point(self, values):
            return Line(values, -np.arctan(values)[:, None])

        def weigh(self, point):
            self.weight = np.ones((1, 1))
            self.costs.append(self.cost(point))

        def equations(self, point):
            self.jacobian = 1.0 / (1.0 + point.values[:, None] ** 2)
            return super().equations(point)

    fit = Curved()
    end = minimise(fit, fit.point(np.array([3.0])), 30, 1e-12)
    assert abs(end.point.values[0]) < 1e-3
    assert fit.costs == sorted(fit.costs, reverse=True)


def test_residuals_determine_what_the_prior_leaves_open():
    curvature = np.diag([1e6, 1e6, 1e-6])
    assert determined(curvature, np.ones(3)) == pytest.approx(2.0, abs=1e-5)


def test_every_piece_of_work_ends_with_the_same_result_as_the_whole_fit():
    x, y = np.linspace(-1.0, 1.0, 20), np.linspace(0.0, 3.0, 20)
    whole, in_pieces = LineFit(x, y), LineFit(x, y)
    expected = minimise(whole, whole.point(np.zeros(2)), 50, 1e-9)
    pieces, results = 0, []

    def run():
        results.append((yield from minimise_in_pieces(in_pieces, start, 50, 1e-9)))

    start = in_pieces.point(np.zeros(2))
    for _ in run():
        pieces += 1
    assert pieces > 1
    np.testing.assert_array_equal(results[0].point.values, expected.point.values)


def arc_tangents(theta):
    """Return residuals whose undamped Gauss–Newton steps diverge far from the solution, 0."""
    return np.arctan(theta), (1.0 / (1.0 + theta**2))[..., None] * np.eye(theta.shape[-1])


def test_samples_without_shared_unknowns_do_not_affect_each_other():
    start = np.array([[0.1, -0.2], [3.0, 2.0], [-3.0, 0.0]])
    together = minimise_each(arc_tangents, start, 1.0, 30, enough=1e-12)
    alone = [minimise_each(arc_tangents, one, 1.0, 30, enough=1e-12) for one in start]
    np.testing.assert_allclose(together, alone, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(together, 0.0, atol=1e-6)


def test_an_unknown_at_its_bound_is_held_while_the_others_go_on():
    turn = np.array([[1.0, 0.8], [0.0, 0.6]])  # the residuals depend on both unknowns
    wanted = np.array([2.0, 1.0])
    end = minimise_each(
        lambda theta: (turn @ (theta - wanted), turn),
        np.zeros(2),
        1.0,
        30,
        bounds=(np.full(2, -1.0), np.array([1.5, 5.0])),
        enough=1e-12,
    )
    # With θ₁ = 1.5, the sum (θ₁ − 2 + 0.8 u)² + (0.6 u)² is least at u = 0.4, and θ₂ = 1 + u.
    np.testing.assert_allclose(end, [1.5, 1.4], atol=1e-6)


def test_least_damping_keeps_unknowns_that_the_residuals_do_not_determine():
    def residuals(theta):
        return theta[:1] - 1.0 + 1e-4 * theta[1:], np.array([[1.0, 1e-4]])

    end = minimise_each(residuals, np.zeros(2), 1.0, 30, least_damping=1.0, enough=1e-12)
    np.testing.assert_allclose(end, [1.0, 0.0], atol=1e-3)
