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
from musculoskeletal_ae.mae.residuals import AnomalyStatistics
from musculoskeletal_ae.mae.units import Mask, State, scale_vector, visible

#: (weight, bias) of one layer
Layer = tuple[Array, Array]


class Activation(NamedTuple):
    """An activation h(x), and (h, h') together; both may overwrite x."""

    value: Callable[[Array], Array]
    with_slope: Callable[[Array], tuple[Array, Array]]


def _tanh_slope(x: Array) -> tuple[Array, Array]:
    h = np.tanh(x, out=x)
    slope = h * h
    return h, np.subtract(1.0, slope, out=slope)


def _silu(x: Array) -> Array:
    # u (1 + tanh u) with u = x/2: does not overflow, and needs one temporary array.
    x *= 0.5
    result: Array = np.tanh(x)
    result += 1.0
    result *= x
    return result


def _silu_slope(x: Array) -> tuple[Array, Array]:
    # h = x σ and h' = σ + h − h σ, in three arrays: a batch then stays in the cache.
    sigmoid = 0.5 * x
    np.tanh(sigmoid, out=sigmoid)
    sigmoid *= 0.5
    sigmoid += 0.5
    h = x * sigmoid
    np.multiply(h, sigmoid, out=x)
    sigmoid += h
    sigmoid -= x
    return h, sigmoid


ACTIVATIONS = {
    'tanh': Activation(lambda x: np.tanh(x, out=x), _tanh_slope),
    'silu': Activation(_silu, _silu_slope),
}


class Stack(NamedTuple):
    """Layers x @ weight + bias, weight (in, out); the activation follows all but the last."""

    layers: tuple[Layer, ...]
    activation: Activation

    def __call__(self, x: Array) -> Array:
        """Return the output (..., out) for x (..., in)."""
        for weight, bias in self.layers[:-1]:
            x = x @ weight
            x += bias
            x = self.activation.value(x)
        weight, bias = self.layers[-1]
        return x @ weight + bias

    def with_pullback(self, x: Array) -> tuple[Array, Callable[[Array], Array]]:
        """Return the output and the function that maps a gradient by it to one by x."""
        slopes = []
        for weight, bias in self.layers[:-1]:
            x = x @ weight
            x += bias
            x, slope = self.activation.with_slope(x)
            slopes.append(slope)
        last, last_bias = self.layers[-1]

        def pullback(gradient: Array) -> Array:
            gradient = gradient @ last.T
            for (weight, _), slope in zip(self.layers[-2::-1], slopes[::-1], strict=True):
                gradient *= slope
                gradient = gradient @ weight.T
            return gradient

        return x @ last + last_bias, pullback

    def tangent(self, x: Array, tangent: Array) -> tuple[Array, Array]:
        """Return the output and its derivatives (..., K, out) from those of x, (..., K, in)."""
        for i, (weight, bias) in enumerate(self.layers):
            x, tangent = x @ weight + bias, tangent @ weight
            if i < len(self.layers) - 1:
                x, slope = self.activation.with_slope(x)
                tangent = tangent * slope[..., None, :]
        return x, tangent


@dataclass(frozen=True, eq=False)
class Mae:
    """A trained network and what a checkpoint says of it."""

    joints: tuple[str, ...]  # D names, in the order of θ
    muscles: tuple[str, ...]  # M names, in the order of T and l
    preset: str
    activation: str
    encoder: tuple[Layer, ...]  # weight (out, in), bias (out,); in scaled, standardised units
    decoder: tuple[Layer, ...]
    mean: Array  # what scaled (θ, T, l) are centred by, (D+2M,)
    std: Array  # what they are divided by, (D+2M,)
    version: int = 0  # counts up with every checkpoint the learner publishes
    training: str = ''  # how it was trained, for people to read
    anomaly: AnomalyStatistics | None = None  # residuals of healthy data
    _enter: dict[Mask, Stack] = field(init=False, repr=False)
    _leave: Stack = field(init=False, repr=False)
    _leave_length: Stack = field(init=False, repr=False)
    #: z (..., D+M) to (θ, T, l) in the paper's scaled units, one array (..., D+2M)
    decode_scaled: Stack = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Freeze the arrays and fold units, standardisation and masks into the layers."""
        mean, std = map(_frozen, (self.mean, self.std))
        encoder, decoder = (
            tuple((_frozen(weight), _frozen(bias)) for weight, bias in stack)
            for stack in (self.encoder, self.decoder)
        )
        joints, muscles = len(self.joints), len(self.muscles)
        scale = scale_vector(joints, muscles)
        activation = ACTIVATIONS[self.activation]
        (first, first_bias), *rest = encoder
        after = tuple(_transposed(*layer) for layer in rest)
        enter = {}
        for mask in Mask:
            seen = visible(mask, joints, muscles)
            columns = first[:, : len(scale)][:, seen] / std[seen]
            constant = first[:, len(scale) :] @ np.array(mask.value, dtype=float)
            bias = first_bias + constant - columns @ mean[seen]
            enter[mask] = Stack((_transposed(columns * scale[seen], bias), *after), activation)
        *rest, (last, last_bias) = decoder
        before = tuple(_transposed(*layer) for layer in rest)
        weight, bias = last * std[:, None], last_bias * std + mean
        si_weight, si_bias = weight / scale[:, None], bias / scale

        def leave(weight: Array, bias: Array) -> Stack:
            return Stack((*before, _transposed(weight, bias)), activation)

        vars(self).update(  # frozen: no other way in
            mean=mean,
            std=std,
            encoder=encoder,
            decoder=decoder,
            _enter=enter,
            _leave=leave(si_weight, si_bias),
            _leave_length=leave(si_weight[-muscles:], si_bias[-muscles:]),
            decode_scaled=leave(weight, bias),
        )

    @property
    def layer_sizes(self) -> tuple[int, ...]:
        """Units of all layers from input to output; the latent one in the middle has D+M."""
        stack = (*self.encoder, *self.decoder)
        return (stack[0][0].shape[1], *(len(bias) for _, bias in stack))

    def encode(
        self,
        mask: Mask,
        theta: Array | None = None,
        tension: Array | None = None,
        length: Array | None = None,
    ) -> Array:
        """Return z (..., D+M) from θ [rad] (..., D), T [N] (..., M) and l [m] (..., M).

        Only the two that the mask lets in are used, and the third may be None; if one of the two is
        missing, it is a ValueError.
        """
        given = (theta, tension, length)
        one, two = (part for part, seen in zip(given, mask.value, strict=True) if seen)
        if one is None or two is None:
            raise ValueError(f'mask {mask.name} needs both of its two quantities')
        return self._enter[mask](np.concatenate((one, two), axis=-1))

    def decode(self, z: Array) -> State:
        """Return (θ, T, l) in SI units from z of shape (..., D+M)."""
        joints, muscles = len(self.joints), len(self.muscles)
        values = self._leave(z)
        return State(values[..., :joints], values[..., joints:-muscles], values[..., -muscles:])

    def estimate(self, tension: Array, length: Array) -> State:
        """Return (θ, T, l) restored from (T, l): decode(encode ②) (paper, "State Estimation")."""
        return self.decode(self.encode(Mask.TENSION_LENGTH, tension=tension, length=length))

    def lengths(self, theta: Array, tension: Array) -> Array:
        """Return l [m] of shape (..., M) at (θ, T): decode(encode ①)."""
        return self.decode(self.encode(Mask.THETA_TENSION, theta, tension)).length

    def lengths_with_pullback(
        self, theta: Array, tension: Array
    ) -> tuple[Array, Callable[[Array], Array]]:
        """Return l [m] (..., M) at (θ, T) through ①, and the function that maps dL/dl to dL/dθ.

        The pullback of T is Gᵀ T, at the price of one more evaluation instead of D.
        """
        x = np.concatenate((theta, tension), axis=-1)
        z, to_input = self._enter[Mask.THETA_TENSION].with_pullback(x)
        length, to_latent = self._leave_length.with_pullback(z)
        joints = len(self.joints)
        return length, lambda gradient: to_input(to_latent(gradient))[..., :joints]

    def muscle_jacobian(self, theta: Array, tension: Array) -> Array:
        """Return G = ∂l/∂θ [m/rad] at (θ, T) through ①, analytically, shape (..., M, D)."""
        x = np.concatenate((theta, tension), axis=-1)
        turn = np.eye(theta.shape[-1], x.shape[-1])  # each joint by itself
        z, tangent = self._enter[Mask.THETA_TENSION].tangent(x, turn)
        return self._leave_length.tangent(z, tangent)[1].swapaxes(-1, -2)

    def muscle_jacobian_difference(self, theta: Array, tension: Array, step: float = 0.01) -> Array:
        """Return G as the paper takes it, by forward difference of ① (it does not print Δθ)."""
        joints = len(self.joints)
        offsets = np.vstack([np.zeros(joints), step * np.eye(joints)])
        postures = theta[..., None, :] + offsets  # (..., D+1, D)
        shape = (*postures.shape[:-1], len(self.muscles))
        lengths = self.lengths(postures, np.broadcast_to(tension[..., None, :], shape))
        difference: Array = (lengths[..., 1:, :] - lengths[..., :1, :]) / step
        return difference.swapaxes(-1, -2)


def _frozen(array: Array) -> Array:
    copy = np.array(array, dtype=np.float64, order='C')
    copy.setflags(write=False)
    return copy


def _transposed(weight: Array, bias: Array) -> Layer:
    return _frozen(weight.T), _frozen(bias)
