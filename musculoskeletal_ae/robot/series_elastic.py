# SPDX-License-Identifier: Apache-2.0
"""Elongation of a muscle under tension: series elastic element plus stretch of the tendon.

    L_e(l_abs, T) = ln(1 + T / force) / rate + wire_stretch · l_abs · T

(paper, §III-B: estimated from a testbed of one muscle). L_e is the elongation at the tension T, and
l_abs the length of the tendon. The series elastic element follows T = force · (exp(rate · Δ) − 1),
where Δ is its own elongation. The tendon is Dyneema, whose stretch is proportional to its length.
The default constants are plausible values for Musashi, whose own constants are not public.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musculoskeletal_ae.arrays import Array

#: constants of a muscle whose entry states none: `force` [N], `rate` [1/m], `wire_stretch` [1/N]
DEFAULT = {'force': 100.0, 'rate': 30.0, 'wire_stretch': 2.0e-5}


@dataclass(frozen=True)
class SeriesElastic:
    """Elastic constants of M muscles, each of shape (M,). A negative tension counts as 0."""

    force: Array  # tension at which the elastic element has stretched by ln 2 / rate [N]
    rate: Array  # stiffening rate of the elastic element [1/m]
    wire_stretch: Array  # stretch of the tendon per metre and newton [1/N]

    def of(self, muscle: int) -> SeriesElastic:
        """Return the constants of the muscle with this index, as scalars."""
        return SeriesElastic(*(values[muscle] for values in vars(self).values()))

    def elongation(self, absolute_length: Array, tension: Array | float) -> Array:
        """Return the elongation of series elastic elements and tendons [m], (..., M).

        Args:
            absolute_length: Lengths of the tendons [m], (..., M).
            tension: Tensions [N], (..., M).
        """
        tension = np.maximum(tension, 0.0)
        stretch = self.wire_stretch * absolute_length * tension
        return np.log1p(tension / self.force) / self.rate + stretch

    def compliance(self, absolute_length: Array, tension: Array) -> Array:
        """Return the derivative of the elongation with respect to tension [m/N], (..., M).

        Args:
            absolute_length: Lengths of the tendons [m], (..., M).
            tension: Tensions [N], (..., M).
        """
        element = 1.0 / (self.rate * (self.force + np.maximum(tension, 0.0)))
        return element + self.wire_stretch * absolute_length

    def by_logarithms(self, absolute_length: Array, tension: Array) -> Array:
        """Return the derivatives of one muscle's elongation by the logarithms of its constants.

        Args:
            absolute_length: Lengths of the tendon [m], (N,).
            tension: Tensions [N], (N,).

        Returns:
            The derivatives with respect to ln force, ln rate and ln wire_stretch [m], (N, 3).
        """
        tension = np.maximum(tension, 0.0)
        return np.stack(
            [
                -tension / (self.force + tension) / self.rate,
                -np.log1p(tension / self.force) / self.rate,
                self.wire_stretch * absolute_length * tension,
            ],
            axis=1,
        )

    def length_slope(self, tension: Array) -> Array:
        """Return the derivative of the elongation with respect to the tendon's length, (..., M).

        `tension` are the tensions [N], (..., M).
        """
        return self.wire_stretch * np.maximum(tension, 0.0)
