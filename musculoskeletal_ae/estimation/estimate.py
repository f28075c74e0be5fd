# SPDX-License-Identifier: Apache-2.0
"""Estimates the joint angles from one sample of muscle length and tension.

    (T_end, l) → θ, T_est, l_est      by the network with mask ② (paper, §III-D)
    e = (T_est − T_end, l_est − l)
    A = ‖T_est − T_end‖₂ + ‖l_est − l‖₂

From the bone-side tensions T_end and the lengths l, the network estimates the joint angles θ and
reconstructs tensions and lengths. e is the residual and A the anomaly score, both in scaled units.
"""

import math
from dataclasses import dataclass

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import residuals
from musculoskeletal_ae.mae.units import State


@dataclass(frozen=True, eq=False)
class Estimate:
    """The network's estimate for one sample.

    Attributes:
        state: Joint angles [rad], (D,), and tensions [N] and lengths [m], (M,), as the network
            reconstructs them.
        residual: Reconstructed minus measured tensions and lengths in scaled units, 0 for isolated
            muscles, (2M,).
        anomaly: Anomaly score A, the size of the residual.
    """

    state: State
    residual: Array
    anomaly: float


def estimate(mae: Mae, bone_tension: Array, length: Array, state: State | None = None) -> Estimate:
    """Return the estimate of a network for one sample.

    Args:
        mae: The network; its isolated muscles are ignored.
        bone_tension: Bone-side tensions [N], (M,).
        length: Muscle lengths [m], (M,).
        state: The state that the network reconstructs from these readings; None to compute it here.
    """
    state = mae.estimate(bone_tension, length) if state is None else state
    error = residuals(state, bone_tension, length, mae.isolated)
    tension_error, length_error = error[: len(length)], error[len(length) :]
    anomaly = math.sqrt(tension_error @ tension_error) + math.sqrt(length_error @ length_error)
    return Estimate(state, error, anomaly)
