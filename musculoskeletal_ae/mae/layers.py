# SPDX-License-Identifier: Apache-2.0
"""Fully connected layers in numpy: run, gradient and Jacobian, for one input or a batch."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array

#: (weight, bias) of one layer
Layer = tuple[Array, Array]


class Activation(NamedTuple):
    """An activation h(x), and (h, h') together; both may overwrite x."""

    value: Callable[[Array], Array]
    with_slope: Callable[[Array], tuple[Array, Array]]


def _tanh(x: Array) -> Array:
    result: Array = np.tanh(x, out=x)
    return result


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
    'tanh': Activation(_tanh, _tanh_slope),
    'silu': Activation(_silu, _silu_slope),
}


def transposed(weight: Array, bias: Array) -> Layer:
    """Return a layer as x @ weight + bias wants it: weight (in, out), contiguous, read-only."""
    flipped = np.ascontiguousarray(weight.T, dtype=np.float64)
    flipped.setflags(write=False)
    return flipped, np.array(bias, dtype=np.float64)


def run(layers: tuple[Layer, ...], activation: Activation, x: Array) -> Array:
    """Return the output (..., out) of layers for x (..., in); the last one is linear."""
    for weight, bias in layers[:-1]:
        x = x @ weight
        x += bias
        x = activation.value(x)
    weight, bias = layers[-1]
    x = x @ weight
    x += bias
    return x


def run_with_pullback(
    layers: tuple[Layer, ...], activation: Activation, x: Array
) -> tuple[Array, Callable[[Array], Array]]:
    """Return the output and the function that maps a gradient by it to one by x."""
    slopes = []
    for weight, bias in layers[:-1]:
        x = x @ weight
        x += bias
        x, slope = activation.with_slope(x)
        slopes.append(slope)
    last, last_bias = layers[-1]

    def pullback(gradient: Array) -> Array:
        gradient = gradient @ last.T
        for (weight, _), slope in zip(layers[-2::-1], slopes[::-1], strict=True):
            gradient *= slope
            gradient = gradient @ weight.T
        return gradient

    return x @ last + last_bias, pullback


def run_with_jacobian(
    layers: tuple[Layer, ...],
    activation: Activation,
    x: Array,
    inputs: int | None = None,
    tangent: Array | None = None,
) -> tuple[Array, Array]:
    """Return the output and its derivative, transposed: (..., inputs, out).

    Args:
        layers: As in `run`.
        activation: As in `run`.
        x: Input, shape (..., in).
        inputs: Differentiate by the first so many inputs only; all by default.
        tangent: Derivative of x itself, shape (..., inputs, in), to continue a chain.
    """
    for i, (weight, bias) in enumerate(layers):
        if tangent is None:
            tangent = np.broadcast_to(weight[:inputs], (*x.shape[:-1], *weight[:inputs].shape))
        else:
            tangent = tangent @ weight
        x = x @ weight + bias
        if i < len(layers) - 1:
            x, slope = activation.with_slope(x)
            tangent = tangent * slope[..., None, :]
    assert tangent is not None  # there is at least one layer
    return x, tangent
