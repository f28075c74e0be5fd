# SPDX-License-Identifier: Apache-2.0
"""The Musculoskeletal AutoEncoder in torch: what is trained. `mae.py` is what runs.

    z = f_encode(θ, T, l, mask),   (θ, T, l) = f_decode(z),   z of size D+M

(paper, section "Network Structure"). Everything is in scaled units; a masked entry is zero where it
enters the first layer.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Layer, Mae
from musculoskeletal_ae.mae.units import Mask, visible
from musculoskeletal_ae.presets import PRESETS, NetworkSettings

ACTIVATIONS: dict[str, type[nn.Module]] = {'tanh': nn.Tanh, 'silu': nn.SiLU}


class Network(nn.Module):
    """D joints, M muscles: layers (D+2M+3, *hidden, D+M, *reversed hidden, D+2M)."""

    mean: Tensor
    std: Tensor
    rows: Tensor

    def __init__(
        self, joints: int, muscles: int, settings: NetworkSettings, mean: Array, std: Array
    ) -> None:
        """Start from torch's random weights; (θ, T, l) are centred by mean, divided by std."""
        super().__init__()
        self.joints, self.muscles, self.settings = joints, muscles, settings
        values, latent = joints + 2 * muscles, joints + muscles
        encoder = (values + 3, *settings.hidden, latent)
        decoder = (latent, *reversed(settings.hidden), values)
        self.encoder, self.decoder = self._stack(encoder), self._stack(decoder)
        self.register_buffer('mean', torch.tensor(mean, dtype=torch.float32))
        self.register_buffer('std', torch.tensor(std, dtype=torch.float32))
        # One row per mask: which entries pass, then the three mask inputs themselves.
        rows = np.array([[*visible(mask, joints, muscles), *mask.value] for mask in Mask])
        self.register_buffer('rows', torch.tensor(rows, dtype=torch.float32))

    def encode(self, values: Tensor, mask: Tensor) -> Tensor:
        """Return z: scaled (θ, T, l) of shape (N, D+2M), mask indices (N,) into `Mask`."""
        standard = (values - self.mean) / self.std
        rows = self.rows[mask]  # (N, D+2M+3)
        width = standard.shape[-1]
        x = torch.cat([standard * rows[:, :width], rows[:, width:]], dim=-1)  # (N, D+2M+3)
        return self.encoder(x)  # (N, D+M)

    def decode(self, z: Tensor) -> Tensor:
        """Return scaled (θ, T, l), shape (N, D+2M); `decoder` gives them standardised."""
        return self.decoder(z) * self.std + self.mean

    def forward(self, values: Tensor, mask: Tensor) -> Tensor:
        """Return what the network restores of scaled (θ, T, l) from two of the three."""
        return self.decode(self.encode(values, mask))

    def _stack(self, sizes: tuple[int, ...]) -> nn.Sequential:
        activation = ACTIVATIONS[self.settings.activation]
        layers: list[nn.Module] = []
        for into, out in pairwise(sizes):
            layers += [nn.Linear(into, out), activation()]
        return nn.Sequential(*layers[:-1])


def to_mae(
    network: Network, joints: tuple[str, ...], muscles: tuple[str, ...], preset: str, training: str
) -> Mae:
    """Return the numpy network that runs, with float64 copies of a trained network's weights."""

    def array(tensor: Tensor) -> Array:
        return tensor.detach().cpu().numpy().astype(np.float64)

    def stack(layers: nn.Sequential) -> tuple[Layer, ...]:
        return tuple((array(layer.weight), array(layer.bias)) for layer in _linear(layers))

    return Mae(
        joints=joints,
        muscles=muscles,
        preset=preset,
        activation=network.settings.activation,
        encoder=stack(network.encoder),
        decoder=stack(network.decoder),
        mean=array(network.mean),
        std=array(network.std),
        training=training,
    )


def from_mae(mae: Mae) -> Network:
    """Return a torch network with the weights of a numpy one, to go on learning from."""
    settings = NetworkSettings(
        hidden=tuple(len(bias) for _, bias in mae.encoder[:-1]),
        activation=mae.activation,
        standardise=PRESETS[mae.preset].network.standardise,
    )
    network = Network(len(mae.joints), len(mae.muscles), settings, mae.mean, mae.std)
    with torch.no_grad():
        for layers, arrays in ((network.encoder, mae.encoder), (network.decoder, mae.decoder)):
            for layer, (weight, bias) in zip(_linear(layers), arrays, strict=True):
                layer.weight.copy_(torch.tensor(weight))
                layer.bias.copy_(torch.tensor(bias))
    return network


def _linear(layers: nn.Sequential) -> list[nn.Linear]:
    return [layer for layer in layers if isinstance(layer, nn.Linear)]
