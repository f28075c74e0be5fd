# SPDX-License-Identifier: Apache-2.0
"""The paper's descent in the latent space, which control and simulation share.

    L(z)  = Σ_k w_k ‖A_k y − b_k‖₂,   y = f_decode(z) in scaled units
    z     ← z − γ g/‖g‖₂,             g = dL/dz

with the best of N step sizes γ in [0, γ_max], C times (paper, section "Control Using
Musculoskeletal AutoEncoder"). A task is data: how to enter, a list of terms, what to read.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae

# Norms have no gradient at zero; below this they count as reached.
TINY = 1e-12


class Term(NamedTuple):
    """One norm of the loss: weight · ‖matrix @ y − target‖₂.

    Attributes:
        weight: w_k.
        matrix: A_k, shape (rows, D+2M), acts on scaled (θ, T, l).
        target: b_k, shape (rows,).
    """

    weight: float
    matrix: Array
    target: Array


class StepSearch(NamedTuple):
    """Constants of the descent: γ_max, N (the paper's C_batch) and C (its C_epoch)."""

    largest_step: float
    candidates: int
    epochs: int


class _Stacked(NamedTuple):
    """All terms as one affine map, since many small products cost more than a large one."""

    weights: Array
    matrix: Array
    target: Array
    first_rows: NDArray[np.int_]
    term_of_row: NDArray[np.int_]

    @classmethod
    def of(cls, terms: Sequence[Term]) -> _Stacked:
        rows = np.array([len(term.target) for term in terms])
        return cls(
            np.array([term.weight for term in terms]),
            np.concatenate([term.matrix for term in terms]),
            np.concatenate([term.target for term in terms]),
            np.concatenate([[0], np.cumsum(rows)[:-1]]),
            np.repeat(np.arange(len(terms)), rows),
        )

    def norms(self, y: Array) -> tuple[Array, Array]:
        """Return all residuals (..., rows) and the norm of each term (..., K)."""
        residual = y @ self.matrix.T
        residual -= self.target
        squares = np.add.reduceat(residual * residual, self.first_rows, axis=-1)
        return residual, np.sqrt(squares)

    def loss(self, y: Array) -> Array:
        total: Array = self.norms(y)[1] @ self.weights
        return total

    def gradient(self, y: Array) -> Array:
        residual, norms = self.norms(y)
        slope: Array = (residual * (self.weights / (norms + TINY))[self.term_of_row]) @ self.matrix
        return slope


def loss(terms: Sequence[Term], y: Array) -> Array:
    """Return L for outputs y of shape (..., D+2M)."""
    return _Stacked.of(terms).loss(y)


def loss_gradient(terms: Sequence[Term], y: Array) -> Array:
    """Return dL/dy for one output y of shape (D+2M,)."""
    return _Stacked.of(terms).gradient(y)


def descend(mae: Mae, z: Array, terms: Sequence[Term], search: StepSearch) -> Array:
    """Return z after the paper's descent, from z of shape (D+M,)."""
    stacked = _Stacked.of(terms)
    # γ = 0 is a candidate, so that the loss never rises.
    steps = np.linspace(0.0, search.largest_step, search.candidates + 1)[:, None]
    for _ in range(search.epochs):
        y, pullback = mae.decode_pullback(z)
        gradient = pullback(stacked.gradient(y))
        candidates = z - steps * (gradient / (np.sqrt(gradient @ gradient) + TINY))
        z = candidates[np.argmin(stacked.loss(mae.decode_scaled(candidates)))]
    return z
