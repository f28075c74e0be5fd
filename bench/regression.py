# SPDX-License-Identifier: Apache-2.0
"""Regressions that know nothing of a robot, as baselines: polynomials, kernel ridge, and a GP.

Each is a function of the inputs (N, K) and outputs (N, D) of the training samples. It returns the
model, a function of inputs. The inputs are scaled to mean 0 and standard deviation 1; inputs that
are constant in the training samples are left out. Constants are chosen with the training samples
alone: by cross-validation over five parts, or by the evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import combinations_with_replacement, product

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize

from musculoskeletal_ae.arrays import Array

PARTS = 5  # divide the samples into this many parts for cross-validation
DEGREES = 1, 2, 3  # let cross-validation choose a polynomial of one of these degrees
#: try these penalties of the squared coefficients, relative to N
PENALTIES = 1e-8, 1e-6, 1e-4, 1e-3, 1e-2
MOST_TERMS = 600  # fit no polynomial with more terms than this
#: let cross-validation choose one of these kernel widths, in units of √K
WIDTHS = 0.5, 1.0, 2.0, 4.0, 8.0, 16.0
#: let cross-validation choose one of these penalties of the kernel ridge regression
RIDGES = 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0
JITTER = 1e-8  # add this variance to the diagonal, to keep covariances positive definite

Predict = Callable[[Array], Array]


class Scaling:
    """Scales inputs to mean 0 and deviation 1 of the training; drops inputs constant in them."""

    def __init__(self, inputs: Array) -> None:
        """Compute mean and standard deviation of the training inputs (N, K)."""
        spread = inputs.std(axis=0)
        self._varies = spread > 1e-6 * (1.0 + np.abs(inputs).max(axis=0))
        self._mean, self._spread = inputs.mean(axis=0)[self._varies], spread[self._varies]

    def __call__(self, inputs: Array) -> Array:
        """Return inputs (N, K), scaled like the training inputs."""
        scaled: Array = (inputs[:, self._varies] - self._mean) / self._spread
        return scaled


def _squares(one: Array, other: Array) -> Array:
    squares: Array = np.square(one[:, None] - other[None]).sum(axis=2)
    return squares


def _chosen(
    inputs: Array, outputs: Array, candidates: Iterator[Callable[[Array, Array], Predict]]
) -> Predict:
    """Return the candidate with the smallest error in cross-validation, fitted to all samples.

    The samples are `inputs` and `outputs`, with one row for each. A candidate is a function that
    returns a model fitted to such arrays.
    """
    parts = np.array_split(np.random.default_rng(0).permutation(len(inputs)), PARTS)

    def error(fit: Callable[[Array, Array], Predict]) -> float:
        total = 0.0
        for part in parts:
            rest = np.setdiff1d(np.arange(len(inputs)), part)
            missed = fit(inputs[rest], outputs[rest])(inputs[part]) - outputs[part]
            total += float(np.linalg.norm(missed, axis=1).sum())
        return total

    return min(candidates, key=error)(inputs, outputs)


def polynomial(inputs: Array, outputs: Array) -> Predict:
    """Return a polynomial whose degree and penalty are chosen by cross-validation."""

    def of(degree: int, penalty: float) -> Callable[[Array, Array], Predict]:
        def fit(own: Array, targets: Array) -> Predict:
            scaling = Scaling(own)
            powers = [
                list(which)
                for power in range(degree + 1)
                for which in combinations_with_replacement(range(scaling(own).shape[1]), power)
            ]

            def terms(asked: Array) -> Array:
                scaled = scaling(asked)
                return np.stack([scaled[:, which].prod(axis=1) for which in powers], axis=1)

            values = terms(own)
            ridge = penalty * len(own) * np.eye(len(powers))
            ridge[0, 0] = JITTER
            weights = np.linalg.solve(values.T @ values + ridge, values.T @ targets)
            return lambda asked: np.asarray(terms(asked) @ weights)

        return fit

    count = Scaling(inputs)(inputs).shape[1]
    degrees = [
        d for d in DEGREES if np.prod([(count + k) / k for k in range(1, d + 1)]) < MOST_TERMS
    ]
    return _chosen(inputs, outputs, (of(*each) for each in product(degrees, PENALTIES)))


def kernel_ridge(inputs: Array, outputs: Array) -> Predict:
    """Return a kernel ridge regression whose width and ridge are chosen by cross-validation."""

    def of(width: float, ridge: float) -> Callable[[Array, Array], Predict]:
        def fit(own: Array, targets: Array) -> Predict:
            scaling, mean = Scaling(own), targets.mean(axis=0)
            scaled = scaling(own)

            def kernel(asked: Array) -> Array:
                squares = _squares(asked, scaled) / scaled.shape[1]
                return np.asarray(np.exp(-0.5 * squares / width**2))

            weights = np.linalg.solve(kernel(scaled) + ridge * np.eye(len(own)), targets - mean)
            return lambda asked: np.asarray(kernel(scaling(asked)) @ weights + mean)

        return fit

    return _chosen(inputs, outputs, (of(*each) for each in product(WIDTHS, RIDGES)))


def gaussian_process(inputs: Array, outputs: Array) -> Predict:
    """Return a Gaussian process whose kernel is the sum of a smooth and a linear one.

    The constants of the kernel maximise the evidence (marginal likelihood), and are common to all
    outputs.
    """
    scaling, mean, unit = Scaling(inputs), outputs.mean(axis=0), outputs.std(axis=0) + 1e-12
    scaled, targets = scaling(inputs), (outputs - mean) / unit
    squares, count = _squares(scaled, scaled), scaled.shape[1]
    usual = np.array([0.0, -2.0, 0.0, 0.5 * np.log(count + 1.0)])

    def kernel(between: Array, products: Array, logarithms: Array) -> Array:
        amplitude, _, slope, width = np.exp(2.0 * logarithms)
        smooth = amplitude * np.exp(-0.5 * between / width)
        return np.asarray(smooth + slope * products / count + 0.3)

    def covariance(logarithms: Array) -> Array:
        noise = np.exp(2.0 * logarithms[1]) + JITTER
        return kernel(squares, scaled @ scaled.T, logarithms) + noise * np.eye(len(scaled))

    def evidence(logarithms: Array) -> float:
        try:
            root = cholesky(covariance(logarithms), lower=True, check_finite=False)
        except LinAlgError:
            return 1e10
        white = solve_triangular(root, targets, lower=True, check_finite=False)
        volume = targets.shape[1] * np.log(np.diag(root)).sum()
        prior = np.square((logarithms - usual) / 3.0).sum()
        return float(0.5 * np.square(white).sum() + volume + 0.5 * prior)

    bounds = (-8.0, 4.0), (-8.0, 2.0), (-8.0, 4.0), (-2.0, 5.0)
    found = [
        minimize(
            evidence,
            usual + [0.0, 0.0, 0.0, start],
            method='L-BFGS-B',
            bounds=bounds,
            options={'maxiter': 40},
        )
        for start in (0.0, -1.2)
    ]
    logarithms = min(found, key=lambda result: result.fun).x
    root = cholesky(covariance(logarithms), lower=True)
    weights = cho_solve((root, True), targets)

    def predict(asked: Array) -> Array:
        own = scaling(asked)
        across = kernel(_squares(own, scaled), own @ scaled.T, logarithms)
        return np.asarray(across @ weights * unit + mean)

    return predict


BASELINES: dict[str, Callable[[Array, Array], Predict]] = {
    'polynomial': polynomial,
    'kernel ridge': kernel_ridge,
    'GP': gaussian_process,
}
