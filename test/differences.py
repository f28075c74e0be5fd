# SPDX-License-Identifier: Apache-2.0
"""Derivatives of whatever is under test, without its help."""

import numpy as np


def slopes(function, theta, step=1e-6):
    """Return ∂function/∂θ (..., D) at θ (D,) or (N, D), by central differences."""
    ends = [function(theta + d) - function(theta - d) for d in step * np.eye(theta.shape[-1])]
    return np.stack(ends, axis=-1) / (2 * step)
