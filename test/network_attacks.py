# SPDX-License-Identifier: Apache-2.0
"""Networks that must be rejected: falsified copies of a healthy one, for tests and `bench gate`."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae

Attack = Callable[[Mae], Mae]


def _weights(times: Callable[[Array], Array]) -> Attack:
    def attack(mae: Mae) -> Mae:
        stacks = (
            tuple((times(weight), times(bias)) for weight, bias in stack)
            for stack in (mae.encoder, mae.decoder)
        )
        return replace(mae, **dict(zip(('encoder', 'decoder'), stacks, strict=True)))

    return attack


def _noise(mae: Mae) -> Mae:
    rng = np.random.default_rng(0)
    return _weights(lambda w: w * (1.0 + rng.standard_normal(w.shape)))(mae)


def _last(quantity: int, change: Callable[[Array, Array, Array], None]) -> Attack:
    """Return an attack that changes the decoder's last layer for θ (0), T (1) or l (2).

    `change` modifies weight and bias in place; its third argument has the rows of the quantity.
    """

    def attack(mae: Mae) -> Mae:
        joints, muscles = len(mae.joints), len(mae.muscles)
        starts = np.cumsum([0, joints, muscles])
        weight, bias = (part.copy() for part in mae.decoder[-1])
        change(weight, bias, starts[quantity] + np.arange(2))
        return replace(mae, decoder=(*mae.decoder[:-1], (weight, bias)))

    return attack


def _swap(weight: Array, bias: Array, rows: Array) -> None:
    weight[rows], bias[rows] = weight[rows[::-1]], bias[rows[::-1]]


def _flip(weight: Array, _: Array, rows: Array) -> None:
    weight[rows[0]] *= -1.0


def _scaled_std(times: float, part: slice) -> Attack:
    def attack(mae: Mae) -> Mae:
        scale = np.ones(len(mae.std))
        scale[len(mae.joints) :][part] = times
        return replace(mae, std=mae.std * scale, mean=mae.mean * scale)

    return attack


def _lengths(times: float) -> Attack:
    return lambda mae: _scaled_std(times, slice(len(mae.muscles), None))(mae)


def _shifted(quantity: int, scaled: float) -> Attack:
    """Return an attack that adds an offset to the first element of a quantity in the output.

    Args:
        quantity: The quantity: θ (0), T (1) or l (2).
        scaled: The offset, in the unit in which the network scales the quantity.
    """

    def attack(mae: Mae) -> Mae:
        row = (0, len(mae.joints), len(mae.joints) + len(mae.muscles))[quantity]

        def change(_: Array, bias: Array, rows: Array) -> None:
            bias[rows[0]] += scaled / mae.std[row]

        return _last(quantity, change)(mae)

    return attack


ATTACKS: Mapping[str, Attack] = {
    **{f'weights × {k:g}': _weights(lambda w, k=k: k * w) for k in (1.5, 1.7, 2.0, -1.0)},
    'noise of 100 %': _noise,  # a network with 50 % noise sometimes passes the checks
    'lengths × 10': _lengths(10.0),
    'lengths × 2': _lengths(2.0),
    'two joints swapped': _last(0, _swap),
    'two tensions swapped': _last(1, _swap),
    'two lengths swapped': _last(2, _swap),
    'one joint the other way': _last(0, _flip),
    'one length the other way': _last(2, _flip),
    'one joint 1.5 rad off': _shifted(0, 1.5),
    'one length 0.2 m off': _shifted(2, 2.0),
    'standardisation × 2': _scaled_std(2.0, slice(None)),
}
SCALED = 10.0  # factor by which the network scales lengths [1/m]
#: bad networks that only a comparison with the arm's own messages reveals
ON_MESSAGES: Mapping[str, Attack] = {'one tension 50 N off': _shifted(1, 0.25)}


def _other_lengths(times: float = 1.0, more: float = 0.0, part: slice = slice(None)) -> Attack:
    """Return an attack that falsifies the muscle lengths in inputs and outputs.

    Args:
        times: Factor of the lengths.
        more: Offset of the lengths [m], with alternating signs from muscle to muscle.
        part: The muscles to which this applies; by default all.
    """

    def attack(mae: Mae) -> Mae:
        std, mean = mae.std.copy(), mae.mean.copy()
        rows = np.arange(len(std))[len(mae.joints) + len(mae.muscles) :][part]
        std[rows] *= times
        mean[rows] = mean[rows] * times + SCALED * more * np.where(
            np.arange(len(rows)) % 2, 1.0, -1.0
        )
        return replace(mae, std=std, mean=mean)

    return attack


def _other_joint(mae: Mae) -> Mae:
    """Return the network with the sign of its first joint reversed in all inputs and outputs."""
    std = mae.std.copy()
    std[0] *= -1.0
    return replace(mae, std=std)


#: networks that are consistent in themselves, but describe another arm
CONSISTENT: Mapping[str, Attack] = {
    'all lengths × 0.5': _other_lengths(0.5),
    'all lengths × 1.5': _other_lengths(1.5),
    'lengths ± 80 mm': _other_lengths(more=0.08),
    'flexors the other way': _other_lengths(-1.0, part=slice(0, None, 2)),
    'a joint the other way for all': _other_joint,
}
