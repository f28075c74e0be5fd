# SPDX-License-Identifier: Apache-2.0
"""Activations and their derivatives, compiled by numba.

    tanh u ≈ u P(u²) / Q(u²),  |u| ≤ 7.9

This rational function, taken from Eigen, is exact to single precision, and a core evaluates it for
eight units at once. If NumPy computed the activations, they would take as long as the matrix
products of a layer.
"""

import numpy as np
from numba import njit

from musculoskeletal_ae.arrays import Singles

# Constants in single precision; with Python's floats, numba would compute in double precision.
# Clip the argument of tanh to ±LARGEST, where tanh is ±1 in single precision.
ONE, TWO, LARGEST = np.float32(1.0), np.float32(2.0), np.float32(7.9)
P0, P1, P2, P3, P4, P5, P6 = np.array(
    [4.89352455891786e-3, 6.37261928875436e-4, 1.48572235717979e-5, 5.12229709037114e-8,
     -8.60467152213735e-11, 2.00018790482477e-13, -2.76076847742355e-16], np.float32,
)  # fmt: skip
Q0, Q1, Q2, Q3 = np.array(
    [4.89352518554385e-3, 2.26843463243900e-3, 1.18534705686654e-4, 1.19825839466702e-6], np.float32
)


@njit(cache=True, fastmath=True, error_model='numpy')
def _tanh(u: np.float32) -> np.float32:
    u = min(max(u, -LARGEST), LARGEST)
    y = u * u
    above = P0 + y * (P1 + y * (P2 + y * (P3 + y * (P4 + y * (P5 + y * P6)))))
    return u * above / (Q0 + y * (Q1 + y * (Q2 + y * Q3)))


@njit(cache=True, fastmath=True, error_model='numpy', nogil=True)
def tanh_slope(u: Singles, bias: Singles) -> tuple[Singles, Singles]:
    """Overwrite u (N, units) with h = tanh(u + bias); return h and dh/du."""
    slope = np.empty_like(u)
    for n in range(u.shape[0]):
        for i in range(u.shape[1]):
            u[n, i] = _tanh(u[n, i] + bias[i])
            slope[n, i] = ONE - u[n, i] * u[n, i]
    return u, slope


@njit(cache=True, fastmath=True, error_model='numpy', nogil=True)
def silu_slope(u: Singles, bias: Singles) -> tuple[Singles, Singles]:
    """Overwrite u (N, units) with h = 2 v σ(2 v), v = u + bias; return h and dh/du."""
    slope = np.empty_like(u)
    for n in range(u.shape[0]):
        for i in range(u.shape[1]):
            v = u[n, i] + bias[i]
            t = ONE + _tanh(v)
            h = v * t
            u[n, i], slope[n, i] = h, t + h * (TWO - t)
    return u, slope


#: compiled functions of each activation that return its value and slope
WITH_SLOPE = {'tanh': tanh_slope, 'silu': silu_slope}
