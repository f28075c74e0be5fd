# SPDX-License-Identifier: Apache-2.0
"""The trained Musculoskeletal AutoEncoder as the nodes use it: numpy only, immutable, fast.

    z = f_encode(θ, T, l, mask),   (θ, T, l) = f_decode(z)

(paper, section "Network Structure"). SI units go in and out. The units of the network, its
standardisation and the constant mask inputs are folded into the first and last layers when the
object is made, so one estimate is six small matrix products and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae import layers
from musculoskeletal_ae.mae.anomaly_statistics import AnomalyStatistics
from musculoskeletal_ae.mae.layers import Layer
from musculoskeletal_ae.mae.units import Mask, scale_vector, visible


class State(NamedTuple):
    """What the network says of a body: θ [rad] (..., D), T [N] (..., M), l [m] (..., M)."""

    theta: Array
    tension: Array
    length: Array


@dataclass(frozen=True, eq=False)
class Mae:
    """A trained network and what a checkpoint says of it.

    Attributes:
        joints: Names of the D joints, in the order of θ.
        muscles: Names of the M muscles, in the order of T and l.
        preset: 'paper' or 'default'.
        activation: 'tanh' or 'silu'.
        encoder: (weight (out, in), bias (out,)) of each layer, in scaled, standardised units.
        decoder: The same for the decoder.
        mean: What scaled (θ, T, l) are centred by, shape (D+2M,).
        std: What they are divided by, shape (D+2M,).
        version: Counts up with every checkpoint the learner publishes.
        training: How it was trained, for people to read.
        anomaly: Residuals of healthy data, or None.
    """

    joints: tuple[str, ...]
    muscles: tuple[str, ...]
    preset: str
    activation: str
    encoder: tuple[Layer, ...]
    decoder: tuple[Layer, ...]
    mean: Array
    std: Array
    version: int = 0
    training: str = ''
    anomaly: AnomalyStatistics | None = None
    _enter: dict[Mask, tuple[Layer, ...]] = field(init=False, repr=False)
    _leave: tuple[Layer, ...] = field(init=False, repr=False)
    _leave_scaled: tuple[Layer, ...] = field(init=False, repr=False)
    _act: layers.Activation = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Freeze the arrays and fold units, standardisation and masks into the layers."""
        for name in ('encoder', 'decoder'):
            object.__setattr__(self, name, tuple(map(_frozen, getattr(self, name))))
        for name, value in zip(('mean', 'std'), _frozen((self.mean, self.std)), strict=True):
            object.__setattr__(self, name, value)
        joints, muscles = len(self.joints), len(self.muscles)
        scale = scale_vector(joints, muscles)
        (first, first_bias), (last, last_bias) = self.encoder[0], self.decoder[-1]
        width = len(scale)
        enter = {}
        for mask in Mask:
            seen = visible(mask, joints, muscles)
            columns = first[:, :width][:, seen] / self.std[seen]
            constant = first[:, width:] @ np.array(mask.value, dtype=float)
            bias = first_bias + constant - columns @ self.mean[seen]
            enter[mask] = (layers.transposed(columns * scale[seen], bias),) + tuple(
                layers.transposed(*layer) for layer in self.encoder[1:]
            )
        scaled = (last * self.std[:, None], last_bias * self.std + self.mean)
        inner = tuple(layers.transposed(*layer) for layer in self.decoder[:-1])
        object.__setattr__(self, '_enter', enter)
        object.__setattr__(self, '_leave_scaled', (*inner, layers.transposed(*scaled)))
        si = layers.transposed(scaled[0] / scale[:, None], scaled[1] / scale)
        object.__setattr__(self, '_leave', (*inner, si))
        object.__setattr__(self, '_act', layers.ACTIVATIONS[self.activation])

    @property
    def layer_sizes(self) -> tuple[int, ...]:
        """Units of all layers from input to output."""
        stack = (*self.encoder, *self.decoder)
        return (stack[0][0].shape[1], *(len(bias) for _, bias in stack))

    @property
    def latent_size(self) -> int:
        """D+M."""
        return len(self.joints) + len(self.muscles)

    def encode(
        self,
        mask: Mask,
        theta: Array | None = None,
        tension: Array | None = None,
        length: Array | None = None,
    ) -> Array:
        """Return z of shape (..., D+M) from the two quantities the mask lets in, in SI units.

        Args:
            mask: Which two of the three enter; the third is ignored and may be None.
            theta: θ [rad], shape (..., D).
            tension: T [N], shape (..., M).
            length: l [m], shape (..., M).

        Raises:
            ValueError: If one of the two is missing.
        """
        given = [v for v, m in zip((theta, tension, length), mask.value, strict=True) if m]
        one, two = given
        if one is None or two is None:
            raise ValueError(f'mask {mask.name} needs both of its two quantities')
        x = np.concatenate((one, two), axis=-1)
        return layers.run(self._enter[mask], self._act, x)

    def decode(self, z: Array) -> State:
        """Return (θ, T, l) in SI units from z of shape (..., D+M)."""
        return self._split(layers.run(self._leave, self._act, z))

    def decode_scaled(self, z: Array) -> Array:
        """Return (θ, T, l) in the paper's scaled units, one array (..., D+2M)."""
        return layers.run(self._leave_scaled, self._act, z)

    def decode_pullback(self, z: Array) -> tuple[Array, Callable[[Array], Array]]:
        """Return y = decode_scaled(z) and the function that maps dL/dy to dL/dz.

        Args:
            z: Latent, shape (..., D+M). dL/dy has shape (..., D+2M), dL/dz that of z.
        """
        return layers.run_with_pullback(self._leave_scaled, self._act, z)

    def decode_jacobian_scaled(self, z: Array) -> tuple[Array, Array]:
        """Return y = decode_scaled(z) and ∂y/∂z (..., D+2M, D+M), for Gauss–Newton."""
        y, tangent = layers.run_with_jacobian(self._leave_scaled, self._act, z)
        return y, tangent.swapaxes(-1, -2)

    def decode_jacobian(self, z: Array) -> Array:
        """Return ∂(θ, T, l)/∂z in SI units, shape (..., D+2M, D+M)."""
        return layers.run_with_jacobian(self._leave, self._act, z)[1].swapaxes(-1, -2)

    def estimate(self, tension: Array, length: Array) -> State:
        """Return (θ, T, l) restored from (T, l): decode(encode ②) (paper, "State Estimation")."""
        x = np.concatenate((tension, length), axis=-1)
        z = layers.run(self._enter[Mask.TENSION_LENGTH], self._act, x)
        return self._split(layers.run(self._leave, self._act, z))

    def lengths(self, theta: Array, tension: Array) -> Array:
        """Return l [m] of shape (..., M) at (θ, T): decode(encode ①)."""
        return self.decode(self.encode(Mask.THETA_TENSION, theta, tension)).length

    def lengths_with_pullback(
        self, theta: Array, tension: Array
    ) -> tuple[Array, Callable[[Array], Array]]:
        """Return l [m] (..., M) at (θ, T) through ①, and the function that maps dL/dl to dL/dθ.

        The pullback of T is Gᵀ T, at the price of one more evaluation instead of D.
        """
        joints, muscles = len(self.joints), len(self.muscles)
        x = np.concatenate((theta, tension), axis=-1)
        enter = self._enter[Mask.THETA_TENSION]
        z, to_input = layers.run_with_pullback(enter, self._act, x)
        weight, bias = self._leave[-1]
        leave = (*self._leave[:-1], (weight[:, -muscles:], bias[-muscles:]))
        length, to_latent = layers.run_with_pullback(leave, self._act, z)
        return length, lambda gradient: to_input(to_latent(gradient))[..., :joints]

    def muscle_jacobian(self, theta: Array, tension: Array) -> Array:
        """Return G = ∂l/∂θ [m/rad] at (θ, T) through ①, analytically, shape (..., M, D)."""
        joints, muscles = len(self.joints), len(self.muscles)
        x = np.concatenate((theta, tension), axis=-1)
        enter = self._enter[Mask.THETA_TENSION]
        z, tangent = layers.run_with_jacobian(enter, self._act, x, inputs=joints)
        weight, bias = self._leave[-1]
        leave = (*self._leave[:-1], (weight[:, -muscles:], bias[-muscles:]))
        tangent = layers.run_with_jacobian(leave, self._act, z, tangent=tangent)[1]
        return tangent.swapaxes(-1, -2)

    def muscle_jacobian_difference(self, theta: Array, tension: Array, step: float = 0.01) -> Array:
        """Return G as the paper takes it, by forward difference of ①, shape (..., M, D).

        Args:
            theta: θ [rad], shape (..., D).
            tension: T [N], shape (..., M).
            step: Δθ [rad]; the paper does not print its size.
        """
        joints = len(self.joints)
        offsets = np.vstack([np.zeros(joints), step * np.eye(joints)])
        postures = theta[..., None, :] + offsets  # (..., D+1, D)
        shape = (*postures.shape[:-1], len(self.muscles))
        lengths = self.lengths(postures, np.broadcast_to(tension[..., None, :], shape))
        difference = (lengths[..., 1:, :] - lengths[..., :1, :]) / step
        jacobian: Array = difference.swapaxes(-1, -2)
        return jacobian

    def _split(self, values: Array) -> State:
        joints, muscles = len(self.joints), len(self.muscles)
        return State(
            values[..., :joints],
            values[..., joints : joints + muscles],
            values[..., joints + muscles :],
        )


def _frozen(arrays: Layer) -> Layer:
    first, second = (np.array(value, dtype=np.float64) for value in arrays)
    first.setflags(write=False)
    second.setflags(write=False)
    return first, second
