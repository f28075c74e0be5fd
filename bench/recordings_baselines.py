# SPDX-License-Identifier: Apache-2.0
"""Models that know nothing of the robot: polynomials, kernel ridge regression, Gaussian process.

Their hyperparameters are chosen by cross-validation or evidence, on the training rows alone. Inputs
are standardised lengths, or lengths and efforts. The output is θ; what was not measured stays 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import product

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from bench.recordings_learn import Model, error, polynomial
from bench.recordings_read import Run
from musculoskeletal_ae.arrays import Array

FOLDS = 5  # divide the training rows into this many parts for cross-validation
DEGREES, RIDGES = (1, 2, 3), (0.0, 1e-6, 1e-4, 1e-2, 1e-1)
WIDTHS, PENALTIES = (0.5, 1.0, 2.0, 4.0, 8.0), (1e-6, 1e-4, 1e-2, 1e-1)
#: start the search for the Gaussian process from these length scales, in standard deviations of
#: inputs
STARTS = 3.0, 1.0


def baselines(training: Run, with_effort: bool) -> Iterator[tuple[str, Model]]:
    """Yield each model that knows nothing of the robot, with its name in the results.

    The models estimate θ from muscle lengths and, if `with_effort`, from motor efforts as well.
    """
    polynomials = [
        partial(polynomial, degree=degree, with_effort=with_effort, ridge=ridge)
        for degree, ridge in product(DEGREES, RIDGES)
    ]
    kernels = [
        partial(kernel_ridge, with_effort=with_effort, width=width, penalty=penalty)
        for width, penalty in product(WIDTHS, PENALTIES)
    ]
    yield 'polynomial (cross-validation)', _best(training, polynomials)
    yield 'kernel ridge (cross-validation)', _best(training, kernels)
    yield 'Gaussian process (evidence)', gaussian_process(training, with_effort)


def _best(training: Run, fits: Sequence[Callable[[Run], Model]]) -> Model:
    """Return the model with the smallest error in cross-validation, fitted to all rows."""
    fold = np.random.default_rng(0).permutation(len(training.length)) % FOLDS
    parts = [(training.at(fold != part), training.at(fold == part)) for part in range(FOLDS)]
    errors = [np.mean([error(fit(known), rest) for known, rest in parts]) for fit in fits]
    return fits[int(np.argmin(errors))](training)


def _inputs(training: Run, with_effort: bool) -> Callable[[Run], Array]:
    def raw(run: Run) -> Array:
        return np.hstack([run.length, run.effort]) if with_effort else run.length

    mean, scale = raw(training).mean(axis=0), raw(training).std(axis=0) + 1e-12
    return lambda run: np.asarray((raw(run) - mean) / scale)


def _centred(training: Run) -> tuple[Array, Array]:
    """Return θ of the training rows minus its mean, and the mean; unmeasured θ counts as 0."""
    theta = np.nan_to_num(training.theta)
    mean = theta.mean(axis=0)
    return theta - mean, mean


def kernel_ridge(training: Run, with_effort: bool, width: float, penalty: float) -> Model:
    """Return kernel ridge regression with a Gaussian kernel.

    `width` is the width of the kernel, and `penalty` that of the squared weights. With
    `with_effort`, the inputs include the efforts.
    """
    inputs, (theta, mean) = _inputs(training, with_effort), _centred(training)
    known = inputs(training)

    def kernel(x: Array) -> Array:
        return np.asarray(np.exp(-0.5 * cdist(x, known, 'sqeuclidean') / width**2))

    weight = np.linalg.solve(kernel(known) + penalty * np.eye(len(known)), theta)
    return lambda run: np.asarray(kernel(inputs(run)) @ weight + mean)


def gaussian_process(training: Run, with_effort: bool) -> Model:
    """Return a Gaussian process with one length scale for each input.

    The length scales maximise the evidence (marginal likelihood). All joints share them, and the
    ratio of noise and signal.
    """
    inputs, (theta, mean) = _inputs(training, with_effort), _centred(training)
    x, count = inputs(training), theta.shape[0]
    spread = theta.std(axis=0)
    measured = spread > 0.0
    y = theta[:, measured] / spread[measured]

    def kernel(a: Array, logs: Array) -> Array:
        scale = np.exp(logs[:-1])
        return np.asarray(np.exp(-0.5 * cdist(a / scale, x / scale, 'sqeuclidean')))

    def cost(logs: Array) -> float:
        """Return −2 log evidence, with the size of the signal maximised in closed form."""
        try:
            factor = cho_factor(kernel(x, logs) + np.exp(logs[-1]) * np.eye(count), lower=True)
        except np.linalg.LinAlgError:
            return 1e12
        size = (y * cho_solve(factor, y)).sum(axis=0) / count
        determinant = 2.0 * np.log(np.diag(factor[0])).sum()
        return float(y.shape[1] * determinant + count * np.log(size).sum())

    bounds = [(-2.0, 4.0)] * x.shape[1] + [(-16.0, 2.0)]
    starts = [np.append(np.full(x.shape[1], np.log(start)), -5.0) for start in STARTS]
    fits = [minimize(cost, start, method='L-BFGS-B', bounds=bounds) for start in starts]
    logs = min(fits, key=lambda fit: fit.fun).x
    weight = np.zeros(theta.shape)
    factor = cho_factor(kernel(x, logs) + np.exp(logs[-1]) * np.eye(count), lower=True)
    weight[:, measured] = cho_solve(factor, y) * spread[measured]
    return lambda run: np.asarray(kernel(inputs(run), logs) @ weight + mean)
