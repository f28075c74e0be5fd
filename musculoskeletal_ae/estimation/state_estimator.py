# SPDX-License-Identifier: Apache-2.0
"""Estimates the joint angles from one sample of muscle length and tension.

(T_end, l) ─② of the MAE→ θ, T_est, l_est      (paper, §III-D)
e = (T_est − T, l_est − l),   A = ‖T_est − T‖₂ + ‖l_est − l‖₂          scaled units
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import residuals
from musculoskeletal_ae.mae.units import State


@dataclass(frozen=True, eq=False)
class Estimate:
    """The network's estimate for one sample.

    Attributes:
        state: θ [rad] (D,), and T [N] and l [m] (M,) as the network restores them.
        residual: e, 0 for isolated muscles, (2M,).
        anomaly: A.
        covariance: Covariance of θ [rad²], (D, D); None if the network has none.
    """

    state: State
    residual: Array
    anomaly: float
    covariance: Array | None


class StateEstimator:
    """Estimates the state from the muscles that are not isolated.

    Attributes:
        mae: The network in use, without the isolated muscles; None before the first.
        complete_mae: The same network as it was received.
    """

    def __init__(self) -> None:
        self.mae: Mae | None = None
        self.complete_mae: Mae | None = None

    def use(self, mae: Mae, isolated: Iterable[int]) -> None:
        """Use another network, and isolate the muscles with the indices `isolated` in it."""
        self.complete_mae, self.mae = mae, mae.without(isolated)

    def step(self, bone_tension: Array, length: Array) -> Estimate:
        """Return the estimate from T_end [N] and l [m], (M,); call `use` first."""
        assert self.mae is not None
        state = self.mae.estimate(bone_tension, length)
        return estimate_of(self.mae, state, bone_tension, length)


def estimate_of(mae: Mae, state: State, bone_tension: Array, length: Array) -> Estimate:
    """Return the estimate for a state that a network restored from T_end [N] and l [m], (M,)."""
    error = residuals(state, bone_tension, length, mae.isolated)
    tension_error, length_error = error[: len(length)], error[len(length) :]
    anomaly = math.sqrt(tension_error @ tension_error) + math.sqrt(length_error @ length_error)
    return Estimate(state, error, anomaly, mae.covariance)
