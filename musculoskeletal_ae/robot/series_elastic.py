# SPDX-License-Identifier: Apache-2.0
"""Elongation of a muscle under tension: a nonlinear elastic unit plus the stretch of its wire.

    L_e(l_abs, T) = ln(1 + T / force) / rate + wire_stretch · l_abs · T

(paper, section "Initial Training": estimated from a testbed of one muscle). The elastic unit is the
exponential tendon T = force · (exp(rate · Δ) − 1); the wire is Dyneema, whose stretch grows with
its length. The constants are chosen to be plausible for Musashi, which are not public.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musculoskeletal_ae.arrays import Array

#: [N]; [1/m]; [1/N], metres of stretch per metre of wire and newton
DEFAULT = {'force': 100.0, 'rate': 30.0, 'wire_stretch': 2.0e-5}


@dataclass(frozen=True)
class SeriesElastic:
    """Elastic constants of M muscles, one entry each.

    Attributes:
        force: Tension at which the elastic unit has stretched by ln 2 / rate [N], shape (M,).
        rate: Stiffening rate of the elastic unit [1/m], shape (M,).
        wire_stretch: Stretch of the wire per metre and newton [1/N], shape (M,).
    """

    force: Array
    rate: Array
    wire_stretch: Array

    def elongation(self, absolute_length: Array, tension: Array) -> Array:
        """Return L_e(l_abs, T) [m]; tensions below zero count as zero (a wire cannot push).

        Args:
            absolute_length: Muscle length [m], shape (..., M).
            tension: Muscle tension [N], shape (..., M).
        """
        pull = np.maximum(tension, 0.0)
        stretch: Array = self.wire_stretch * absolute_length * pull
        return np.log1p(pull / self.force) / self.rate + stretch

    def compliance(self, absolute_length: Array, tension: Array) -> Array:
        """Return ∂L_e/∂T [m/N], shape (..., M)."""
        pull = np.maximum(tension, 0.0)
        unit: Array = 1.0 / (self.rate * (self.force + pull))
        return unit + self.wire_stretch * absolute_length

    def length_slope(self, tension: Array) -> Array:
        """Return ∂L_e/∂l_abs [m/m], shape (..., M)."""
        slope: Array = self.wire_stretch * np.maximum(tension, 0.0)
        return slope
