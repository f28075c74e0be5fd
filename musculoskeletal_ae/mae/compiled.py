# SPDX-License-Identifier: Apache-2.0
"""Activations with their slopes, compiled by numba: numpy's take as long as a layer's products.

    tanh u ≈ u P(u²) / Q(u²),  |u| ≤ 7.9

a rational function that is as exact as single precision can tell (as in Eigen), and that a core
computes for eight units at once.
"""

import numpy as np
from numba import njit

from musculoskeletal_ae.arrays import Singles

# numba would compute in double precision with Python's numbers.
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
    """Return tanh(u + bias) in the place of u (N, units), and its derivative."""
    slope = np.empty_like(u)
    for n in range(u.shape[0]):
        for i in range(u.shape[1]):
            u[n, i] = _tanh(u[n, i] + bias[i])
            slope[n, i] = ONE - u[n, i] * u[n, i]
    return u, slope


@njit(cache=True, fastmath=True, error_model='numpy', nogil=True)
def silu_slope(u: Singles, bias: Singles) -> tuple[Singles, Singles]:
    """Return h = 2 v σ(2 v), v = u + bias, in the place of u (N, units), and dh/du."""
    slope = np.empty_like(u)
    for n in range(u.shape[0]):
        for i in range(u.shape[1]):
            v = u[n, i] + bias[i]
            t = ONE + _tanh(v)
            h = v * t
            u[n, i], slope[n, i] = h, t + h * (TWO - t)
    return u, slope


WITH_SLOPE = {'tanh': tanh_slope, 'silu': silu_slope}
