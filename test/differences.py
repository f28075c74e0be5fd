# SPDX-License-Identifier: Apache-2.0
"""Numerical derivatives, independent of the code under test."""

import numpy as np


def slopes(function, theta, step=1e-6):
    """Return ∂function/∂θ (..., D) at θ (D,) or (N, D), by central differences."""
    ends = [function(theta + d) - function(theta - d) for d in step * np.eye(theta.shape[-1])]
    return np.stack(ends, axis=-1) / (2 * step)
