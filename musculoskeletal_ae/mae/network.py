# SPDX-License-Identifier: Apache-2.0
"""The Musculoskeletal AutoEncoder in torch, for training; `mae.py` has the inference.

    z = f_encode(θ, T, l, mask),   (θ, T, l) = f_decode(z),   z of size D+M

(paper, §III-A). All quantities are in scaled units. The mask selects two of the three quantities;
the entries of the third are zero at the input of the first layer.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.mae.mae import Layer, Mae, complete_bases, latent_places, read_groups
from musculoskeletal_ae.mae.units import ActivationName, Mask, visible
from musculoskeletal_ae.robot.groups import Group

#: activations by their names in a checkpoint
ACTIVATIONS: dict[str, type[nn.Module]] = {'tanh': nn.Tanh, 'silu': nn.SiLU}


class Blocks(nn.Module):
    """Parallel stacks of layers; each uses some of the inputs and computes some of the outputs."""

    order: Tensor

    def __init__(self, stacks: list[nn.Sequential], into: list[Ints], out: list[Ints]) -> None:
        super().__init__()
        self.stacks, self._into = nn.ModuleList(stacks), [*map(torch.as_tensor, into)]
        self.register_buffer('order', torch.as_tensor(np.argsort(np.concatenate(out))))

    def forward(self, x: Tensor) -> Tensor:
        """Return the outputs (..., out) of inputs (..., in)."""
        if len(self.stacks) == 1:
            result: Tensor = self.stacks[0](x)
            return result
        each = [stack(x[..., own]) for stack, own in zip(self.stacks, self._into, strict=True)]
        return torch.cat(each, dim=-1)[..., self.order]


class Network(nn.Module):
    """The network of D joints and M muscles.

    Its layers have D+2M+3, *hidden, D+M, *reversed hidden and D+2M units. The inputs are (θ, T, l)
    and the three entries of the mask. With several groups, each group has a separate block of
    layers, with the group's own D, M and hidden layers. A block may have another block as its base,
    as a finger has the wrist. The block then has the inputs of both, and its decoder reads both
    parts of z.
    """

    mean: Tensor
    std: Tensor
    rows: Tensor

    def __init__(
        self,
        joints: int,
        muscles: int,
        blocks: Mapping[Group, tuple[int, ...]],
        activation: ActivationName,
        mean: Array,
        std: Array,
        bases: Sequence[int] = (),
    ) -> None:
        """Initialise the weights with torch's random generator.

        Args:
            joints: Number of joints D.
            muscles: Number of muscles M.
            blocks: Sizes of the encoder's hidden layers in each group's block; the decoder has them
                in reverse order.
            activation: Follows every layer except the latent and the last one, which are linear.
            mean: Mean by which scaled (θ, T, l) are standardised, (D+2M,).
            std: Standard deviation by which scaled (θ, T, l) are standardised, (D+2M,).
            bases: Index of each block's base, or of the block itself if it has none; () if no block
                has a base.
        """
        super().__init__()
        self.joints, self.muscles, self.activation = joints, muscles, activation
        self.groups, self.bases = tuple(blocks), complete_bases(bases, len(blocks))
        values, encoders, decoders = joints + 2 * muscles, [], []
        own = [group.columns(joints, muscles) for group in self.groups]
        latents = latent_places(self.groups, range(len(blocks)))
        read_latents = latent_places(self.groups, self.bases)
        inputs = [
            np.append(group.columns(joints, muscles), values + np.arange(3))
            for group in read_groups(self.groups, self.bases)
        ]
        for g, hidden in enumerate(blocks.values()):
            encoders.append(self._stack((len(inputs[g]), *hidden, len(latents[g]))))
            decoders.append(self._stack((len(read_latents[g]), *reversed(hidden), len(own[g]))))
        self.encoder = Blocks(encoders, inputs, latents)
        self.decoder = Blocks(decoders, read_latents, own)
        self.register_buffer('mean', torch.tensor(mean, dtype=torch.float32))
        self.register_buffer('std', torch.tensor(std, dtype=torch.float32))
        # One row for each mask: a 1 for each selected entry, then the three mask inputs.
        rows = np.array([[*visible(mask, joints, muscles), *mask.value] for mask in Mask])
        self.register_buffer('rows', torch.tensor(rows, dtype=torch.float32))

    def encode(self, values: Tensor, mask: Tensor) -> Tensor:
        """Return z (N, D+M) of scaled (θ, T, l) (N, D+2M); `mask` (N,) has indices into `Mask`."""
        standard = (values - self.mean) / self.std
        rows = self.rows[mask]  # (N, D+2M+3)
        width = standard.shape[-1]
        x = torch.cat([standard * rows[:, :width], rows[:, width:]], dim=-1)  # (N, D+2M+3)
        return self.encoder(x)  # (N, D+M)

    def decode(self, z: Tensor) -> Tensor:
        """Decode scaled (θ, T, l), (N, D+2M), from z (N, D+M)."""
        return self.decoder(z) * self.std + self.mean

    def forward(self, values: Tensor, mask: Tensor) -> Tensor:
        """Return scaled (θ, T, l), reconstructed from the two quantities that the mask selects."""
        return self.decode(self.encode(values, mask))

    def _stack(self, sizes: tuple[int, ...]) -> nn.Sequential:
        activation = ACTIVATIONS[self.activation]
        layers: list[nn.Module] = []
        for into, out in pairwise(sizes):
            layers += [nn.Linear(into, out), activation()]
        return nn.Sequential(*layers[:-1])


def to_mae(
    network: Network, joints: tuple[str, ...], muscles: tuple[str, ...], preset: str, training: str
) -> Mae:
    """Convert a trained network to the numpy network for inference, with float64 weights."""

    def array(tensor: Tensor) -> Array:
        return tensor.detach().cpu().numpy().astype(np.float64)

    def stack(layers: Blocks) -> tuple[Layer, ...]:
        return tuple((array(layer.weight), array(layer.bias)) for layer in _linear(layers))

    return Mae(
        joints=joints,
        muscles=muscles,
        preset=preset,
        activation=network.activation,
        encoder=stack(network.encoder),
        decoder=stack(network.decoder),
        mean=array(network.mean),
        std=array(network.std),
        training=training,
        groups=network.groups,
        bases=network.bases,
    )


def from_mae(mae: Mae) -> Network:
    """Convert a numpy network to a torch network, to continue its training."""
    hidden = [len(bias) for _, bias in mae.encoder]
    depth = len(hidden) // len(mae.groups)
    blocks = {g: tuple(hidden[i * depth :][: depth - 1]) for i, g in enumerate(mae.groups)}
    sizes = len(mae.joints), len(mae.muscles)
    network = Network(*sizes, blocks, mae.activation, mae.mean, mae.std, mae.bases)
    with torch.no_grad():
        for layers, arrays in ((network.encoder, mae.encoder), (network.decoder, mae.decoder)):
            for layer, (weight, bias) in zip(_linear(layers), arrays, strict=True):
                layer.weight.copy_(torch.tensor(weight))
                layer.bias.copy_(torch.tensor(bias))
    return network


def _linear(layers: nn.Module) -> list[nn.Linear]:
    return [layer for layer in layers.modules() if isinstance(layer, nn.Linear)]
