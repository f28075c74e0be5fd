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

from musculoskeletal_ae.mae.mae import Mae

Array = NDArray[np.float64]

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


def loss(terms: Sequence[Term], y: Array) -> Array:
    """Return L for outputs y of shape (..., D+2M)."""
    total = np.zeros(y.shape[:-1])
    for weight, matrix, target in terms:
        total += weight * np.sqrt(np.square(y @ matrix.T - target).sum(axis=-1))
    return total


def loss_gradient(terms: Sequence[Term], y: Array) -> Array:
    """Return dL/dy for one output y of shape (D+2M,)."""
    gradient = np.zeros_like(y)
    for weight, matrix, target in terms:
        residual = matrix @ y - target
        gradient += (weight / (np.sqrt(residual @ residual) + TINY)) * (residual @ matrix)
    return gradient


def descend(mae: Mae, z: Array, terms: Sequence[Term], search: StepSearch) -> Array:
    """Return z after the paper's descent, from z of shape (D+M,)."""
    # γ = 0 is a candidate, so that the loss never rises.
    steps = np.linspace(0.0, search.largest_step, search.candidates + 1)[:, None]
    for _ in range(search.epochs):
        y, pullback = mae.decode_pullback(z)
        gradient = pullback(loss_gradient(terms, y))
        candidates = z - steps * (gradient / (np.sqrt(gradient @ gradient) + TINY))
        z = candidates[np.argmin(loss(terms, mae.decode_scaled(candidates)))]
    return z
