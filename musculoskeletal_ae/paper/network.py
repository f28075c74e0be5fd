# SPDX-License-Identifier: Apache-2.0
"""The network (§III-A).

    z = f_encode(θ, T, l, mask),   (θ, T, l) = f_decode(z)
    layers (D+2M+3, 200, 30, D+M, 30, 200, D+2M)

    ① f_encode,1(θ, T) = f_encode(θ, T, 0, (1, 1, 0))
    ② f_encode,2(T, l) = f_encode(0, T, l, (0, 1, 1))
    ③ f_encode,3(θ, l) = f_encode(θ, 0, l, (1, 0, 1))

The inputs θ, T and l are in [rad], [N/200] and [mm/100] (`mae/units.py`), without any other
scaling. The latent layer and the output layer are linear.
"""

import numpy as np
import torch

from musculoskeletal_ae.mae.network import Network
from musculoskeletal_ae.paper.constants import ACTIVATION, HIDDEN
from musculoskeletal_ae.robot.groups import Group


def new_network(
    joints: int, muscles: int, seed: int = 0, hidden: tuple[int, ...] = HIDDEN
) -> Network:
    """Return a network of D joints and M muscles with random weights.

    Args:
        joints: Number of joints D.
        muscles: Number of muscles M.
        seed: Random seed of the weights.
        hidden: Numbers of units in the encoder's hidden layers; the decoder has the reverse order.
    """
    values = joints + 2 * muscles
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        blocks = {Group.whole(joints, muscles): hidden}
        return Network(joints, muscles, blocks, ACTIVATION, np.zeros(values), np.ones(values))
