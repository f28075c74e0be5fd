# SPDX-License-Identifier: Apache-2.0
"""Lengths of passive tendons as polynomials of the joint angles (`robot/passive_tendons.py`).

The physics engine of the imported format (MuJoCo, for example) computes the lengths. The polynomial
has the lowest degree at which it agrees with them to ACCURACY. If no degree does, it is the best
polynomial with at most MOST_TERMS terms.
"""

from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array

ACCURACY = 5e-3  # accept a polynomial if its slope is wrong by at most this share
HIGHEST = 9  # try polynomials up to this degree
MOST_TERMS = 130  # try no polynomial with more terms than this
SAMPLES = 600  # fit a polynomial in this many postures, and compare it in as many others


class Polynomial(NamedTuple):
    """Length of one tendon: Σ_r coefficient_r Π_j (q_j − centre_j)^power_rj."""

    powers: Array  # powers of the joint positions in the R terms, (R, joints)
    coefficient: Array  # factor of each term [m/rad^p], (R,)
    #: root mean square error of the length [m] in postures that were not used for the fit
    error: float
    degree: int


def powers(joints: int, degree: int) -> Array:
    """Return the powers (R, joints) of all monomials up to a degree."""
    rows = [
        np.bincount(chosen, minlength=joints)
        for total in range(degree + 1)
        for chosen in combinations_with_replacement(range(joints), total)
    ]
    # The shape has to be stated for 0 joints.
    return np.array([np.asarray(row, dtype=np.int64) for row in rows]).reshape(-1, joints)


def fitted(share: Array, half: Array, length: Array) -> Polynomial:
    """Fit a polynomial to the lengths of a tendon.

    Args:
        share: Positions of the joints that move the tendon, from −1 to 1 within their limits,
            (2 · SAMPLES, joints). The polynomial is fitted to the first half.
        half: Half the range of each joint [rad or m], (joints,).
        length: Lengths [m], (2 · SAMPLES,).
    """
    count, best = len(share) // 2, None
    spread = max(float(length.std()), 1e-9)
    for degree in range(1, HIGHEST + 1):
        terms = powers(share.shape[1], degree)
        if best is not None and len(terms) > MOST_TERMS:
            break
        values = np.prod(share[:, None] ** terms, axis=2)
        own = np.linalg.lstsq(values[:count], length[:count], rcond=None)[0]
        error = float(np.sqrt(np.mean((values[count:] @ own - length[count:]) ** 2)))
        if best is None or error < best.error:
            best = Polynomial(terms, own / np.prod(half**terms, axis=1), error, degree)
        if error < ACCURACY * spread / degree:
            break
    assert best is not None
    return best
