# SPDX-License-Identifier: Apache-2.0
"""One sample: what the sensors said while the arm was at rest, averaged."""

from __future__ import annotations

from typing import NamedTuple

from musculoskeletal_ae.arrays import Array


class Sample(NamedTuple):
    """Means over a rest.

    Attributes:
        theta: θ [rad], shape (D,).
        tension: T [N], shape (M,).
        length: l [m], shape (M,).
        sliding: s of every wire, +1 wound in last, −1 paid out last, shape (M,).
    """

    theta: Array
    tension: Array
    length: Array
    sliding: Array
