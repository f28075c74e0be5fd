# SPDX-License-Identifier: Apache-2.0
"""State estimation and anomaly detection (§III-D).

    (θ_est, T_est, l_est) = f_decode(f_encode,2(T, l))
    A = ‖T_est − T‖₂ + ‖l_est − l‖₂                                                          (4)

Both presets share the estimate (`mae/mae.py`, `Mae.estimate`). This file has the detector of the
paper. The paper leaves three things open, which we chose: the anomaly score A is in scaled units,
its threshold comes from the checkpoint, and a muscle is reported when A exceeds the threshold in
five consecutive messages.
"""

import math

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.detectors.residual_distance import ResidualDistance
from musculoskeletal_ae.estimation.finding import Observation
from musculoskeletal_ae.mae.residuals import NORM
from musculoskeletal_ae.signals.muscle_stream import MuscleSample


class AnomalyNorm(ResidualDistance):
    """Reports the most suspect muscle if the anomaly score A exceeds its threshold.

    This is the detector of the paper, which considers no covariance of the residuals.
    """

    symbol, threshold_name = 'A', NORM

    def statistic(self, observation: Observation, distance: float) -> float:  # noqa: ARG002
        """Return the anomaly A of a message by equation (4); `distance` is not used."""
        count = len(observation.sample.length)
        tension, length = (
            observation.estimate.residual[:count],
            observation.estimate.residual[count:],
        )
        return math.sqrt(tension @ tension) + math.sqrt(length @ length)

    def limit(self, theta: Array, sample: MuscleSample) -> float:  # noqa: ARG002
        """Return the threshold of the anomaly score A for every state; ∞ if there is none."""
        return self.threshold
