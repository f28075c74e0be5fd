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

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.mae.residuals import AnomalyStatistics
from musculoskeletal_ae.mae.units import Mask, State, scale_vector, visible
from musculoskeletal_ae.robot.groups import Group

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


#: places of its inputs, a stack, places of its outputs
Block = tuple[Ints | slice, Stack, Ints | slice]


class Blocks(NamedTuple):
    """Stacks side by side, each with inputs and outputs of its own: a block-diagonal network."""

    blocks: tuple[Block, ...]
    outputs: int

    def __call__(self, x: Array) -> Array:
        """Return the output (..., out) for x (..., in)."""
        if len(self.blocks) == 1:
            return self.blocks[0][1](x)
        result = np.empty((*x.shape[:-1], self.outputs))
        for into, stack, out in self.blocks:
            result[..., out] = stack(x[..., into])
        return result

    def with_pullback(self, x: Array) -> tuple[Array, Callable[[Array], Array]]:
        """Return the output and the function that maps a gradient by it to one by x."""
        result, pulls = np.empty((*x.shape[:-1], self.outputs)), []
        for into, stack, out in self.blocks:
            result[..., out], pull = stack.with_pullback(x[..., into])
            pulls.append(pull)

        def pullback(gradient: Array) -> Array:
            by_x = np.empty_like(x)
            for (into, _, out), pull in zip(self.blocks, pulls, strict=True):
                by_x[..., into] = pull(gradient[..., out])
            return by_x

        return result, pullback


@dataclass(frozen=True, eq=False)
class Mae:
    """A trained network and what a checkpoint says of it."""

    joints: tuple[str, ...]  # D names, in the order of θ
    muscles: tuple[str, ...]  # M names, in the order of T and l
    preset: str
    activation: str
    #: weight (out, in), bias (out,), in scaled, standardised units; one group after the other
    encoder: tuple[Layer, ...]
    decoder: tuple[Layer, ...]
    mean: Array  # what scaled (θ, T, l) are centred by, (D+2M,)
    std: Array  # what they are divided by, (D+2M,)
    version: int = 0  # counts up with every checkpoint the learner publishes
    training: str = ''  # how it was trained, for people to read
    anomaly: AnomalyStatistics | None = None  # residuals of healthy data
    groups: tuple[Group, ...] = ()  # with a block of the network each; none: it is all one
    _enter: dict[Mask, Blocks] = field(init=False, repr=False)
    _leave: Blocks = field(init=False, repr=False)
    _leave_length: Blocks = field(init=False, repr=False)
    #: z (..., D+M) to (θ, T, l) in the paper's scaled units, one array (..., D+2M)
    decode_scaled: Blocks = field(init=False, repr=False)

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
        groups = self.groups or (Group.whole(joints, muscles),)
        enter: dict[Mask, list[Block]] = {mask: [] for mask in Mask}
        leave, leave_length, leave_scaled = list[Block](), list[Block](), list[Block]()
        depth, start = len(encoder) // len(groups), 0
        for g, group in enumerate(groups):
            layers = slice(g * depth, (g + 1) * depth)
            own, sizes = group.columns(joints, muscles), tuple(map(len, group))
            (first, first_bias), *rest = encoder[layers]
            after = tuple(_transposed(*layer) for layer in rest)
            latent = slice(start, start := start + sum(sizes))
            for mask in Mask:
                seen = visible(mask, *sizes)
                columns = first[:, : len(own)][:, seen] / std[own][seen]
                constant = first[:, len(own) :] @ np.array(mask.value, dtype=float)
                bias = first_bias + constant - columns @ mean[own][seen]
                into = np.flatnonzero(np.isin(np.flatnonzero(visible(mask, joints, muscles)), own))
                stack = Stack((_transposed(columns * scale[own][seen], bias), *after), activation)
                enter[mask].append((into, stack, latent))
            *rest, (last, last_bias) = decoder[layers]
            before = tuple(_transposed(*layer) for layer in rest)
            weight, bias = last * std[own][:, None], last_bias * std[own] + mean[own]
            si_weight, si_bias = weight / scale[own][:, None], bias / scale[own]
            lengths = np.s_[-sizes[1] :]
            for blocks, layer, out in (
                (leave, (si_weight, si_bias), own),
                (leave_length, (si_weight[lengths], si_bias[lengths]), np.array(group.muscles)),
                (leave_scaled, (weight, bias), own),
            ):
                stack = Stack((*before, _transposed(*layer)), activation)
                blocks.append((latent, stack, out))

        vars(self).update(  # frozen: no other way in
            mean=mean,
            std=std,
            encoder=encoder,
            decoder=decoder,
            groups=groups,
            _enter={mask: Blocks(tuple(blocks), start) for mask, blocks in enter.items()},
            _leave=Blocks(tuple(leave), len(scale)),
            _leave_length=Blocks(tuple(leave_length), muscles),
            decode_scaled=Blocks(tuple(leave_scaled), len(scale)),
        )

    @property
    def layer_sizes(self) -> tuple[int, ...]:
        """Units of all layers from input to output, one group after the other.

        The latent one in the middle has D+M of the group.
        """
        each, depth = len(self.groups), len(self.encoder) // len(self.groups)
        stacks = ((*self.encoder[i : i + depth], *self.decoder[i : i + depth])
                  for i in range(0, each * depth, depth))  # fmt: skip
        return tuple(
            size
            for stack in stacks
            for size in (stack[0][0].shape[1], *(len(bias) for _, bias in stack))
        )

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
        result = np.zeros((*x.shape[:-1], len(self.muscles), len(self.joints)))
        enter, leave = self._enter[Mask.THETA_TENSION].blocks, self._leave_length.blocks
        for group, (into, to_latent, _), (_, to_length, _) in zip(self.groups, enter, leave):
            turn = np.eye(len(group.joints), sum(map(len, group)))  # each joint by itself
            z, tangent = to_latent.tangent(x[..., into], turn)
            slopes = to_length.tangent(z, tangent)[1].swapaxes(-1, -2)
            muscles, joints = np.ix_(group.muscles, group.joints)
            result[..., muscles, joints] = slopes
        return result

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
