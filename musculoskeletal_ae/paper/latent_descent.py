# SPDX-License-Identifier: Apache-2.0
"""The descent in the latent space (§III-E), which control and simulation share.

    g = dL/dz                                                                               (10)
    z ← z − γ g/‖g‖₂                                                                        (11)

Each of C iterations takes the best of N step sizes. They are the lower ends γ_k = k γ_max/N, k = 0
… N − 1, of N equal parts of [0, γ_max]; because 0 is one of them, the loss never rises. The paper
does not state which point of each part to use. The losses (9), (13) and (14) are sums of norms of
affine maps of the decoded state:

    L(z) = Σ_k w_k ‖A_k y − b_k‖₂,   y = f_decode(z) in scaled units
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae

TINY = 1e-12  # add this to every norm that is a divisor, because a norm may be zero


class Term(NamedTuple):
    """One term w_k ‖A_k y − b_k‖₂ of the loss, where y is scaled (θ, T, l)."""

    weight: float  # w_k: weight of the term in the loss
    matrix: Array  # A_k: rows that map y to the quantity of the term, (rows, D+2M)
    target: Array  # b_k: target of this quantity, (rows,)


class Loss:
    """The loss L, a weighted sum of terms.

    A single matrix product evaluates all terms, which is faster than one product for each term.
    """

    def __init__(self, terms: Sequence[Term]) -> None:
        """Prepare the loss: stack the matrices and targets of all terms."""
        rows = np.array([len(term.target) for term in terms])
        self._weights = np.array([term.weight for term in terms])
        self._matrix = np.concatenate([term.matrix for term in terms])
        self._target = np.concatenate([term.target for term in terms])
        self._first_rows = np.cumsum(rows) - rows
        self._term_of_row = np.repeat(np.arange(len(terms)), rows)

    def _norms(self, y: Array) -> tuple[Array, Array]:
        residual = y @ self._matrix.T
        residual -= self._target
        squares = np.add.reduceat(residual * residual, self._first_rows, axis=-1)
        return residual, np.sqrt(squares)

    def __call__(self, y: Array) -> Array:
        """Return L for outputs y of shape (..., D+2M)."""
        total: Array = self._norms(y)[1] @ self._weights
        return total

    def gradient(self, y: Array) -> Array:
        """Return dL/dy for one output y of shape (D+2M,)."""
        residual, norms = self._norms(y)
        slope: Array = residual * (self._weights / (norms + TINY))[self._term_of_row]
        return slope @ self._matrix


def descend(
    mae: Mae,
    z: Array,
    terms: Sequence[Term],
    largest_step: float,
    candidate_count: int,
    epochs: int,
) -> Array:
    """Return the latent vector z (D+M,) that minimises the loss of `terms`, starting from `z`.

    Args:
        mae: The network that decodes z.
        z: The latent vector at the start, (D+M,).
        terms: The terms of the loss.
        largest_step: γ_max: all step sizes are below this.
        candidate_count: N: number of step sizes in each iteration; C_batch in the paper's list.
        epochs: C_epoch: number of iterations.
    """
    loss = Loss(terms)
    steps = largest_step * np.arange(candidate_count)[:, None] / candidate_count
    for _ in range(epochs):
        y, pullback = mae.decode_scaled.with_pullback(z)
        gradient = pullback(loss.gradient(y))
        candidates = z - steps * (gradient / (np.sqrt(gradient @ gradient) + TINY))
        z = candidates[np.argmin(loss(mae.decode_scaled(candidates)))]
    return z
