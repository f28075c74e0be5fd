# SPDX-License-Identifier: Apache-2.0
"""What is known of a body before any sample: physical spreads round the geometric model."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.body import Layout


@dataclass(frozen=True)
class Prior:
    """How much a body differs from its geometric model (one standard deviation each)."""

    attachment: float = 0.007  # each coordinate of each route point [m]
    elastic: float = 0.2  # logarithm of each elastic constant
    friction: float = 0.05  # relative tension loss along the route, around its mean
    friction_mean: float = 0.05
    offset: float = 0.001  # zero of the length sensor [m]
    creep: float = 1e-5  # of a wire, from one sample to the next [m]
    smooth: float = 0.002  # the residual model [m]

    def spread(self, layout: Layout) -> Array:
        """Return s of every parameter of a muscle."""
        spread = np.empty(layout.size)
        spread[layout.attachment] = self.attachment
        spread[layout.elastic] = self.elastic
        spread[layout.friction] = self.friction
        spread[layout.offset], spread[layout.creep] = self.offset, self.creep
        spread[layout.rest] = self.smooth
        return spread

    def mean(self, layout: Layout) -> Array:
        """Return the prior mean of every parameter of a muscle."""
        mean = np.zeros(layout.size)
        mean[layout.friction] = self.friction_mean
        return mean


PRIOR = Prior()
#: of a muscle that was replaced or re-wired, around what it was before
REOPENED = Prior(attachment=0.004, elastic=0.3, offset=0.03, smooth=0.001)


class MusclePrior(NamedTuple):
    """Mean w̄ and spread s of the parameters of one muscle, (P,) each."""

    mean: Array
    spread: Array
