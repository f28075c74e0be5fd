# SPDX-License-Identifier: Apache-2.0
"""The two presets of presets.yaml: one record each, the only place where they differ.

`paper` is what the paper prints (network layout, learning procedure, solvers, constants); `default`
is the best that this project can measure. Code asks a field of the record, never for a name.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Literal

from msgspec import Meta

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.files import read_table
from musculoskeletal_ae.schema import Strict

if TYPE_CHECKING:  # options are read without numpy
    from musculoskeletal_ae.robot.groups import Group

Activation = Literal['tanh', 'silu']
Count = Annotated[int, Meta(ge=1)]
Positive = Annotated[float, Meta(gt=0.0)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
NotNegative = Annotated[float, Meta(ge=0.0)]

#: where networks are trained
DEVICES = 'cpu', 'cuda'
REFERENCE = 5 + 10  # D + M of the arm that the numbers of preset `default` are for


class NetworkSettings(Strict, frozen=True):
    """Shape of a network."""

    hidden: tuple[Count, ...]  # units of the encoder's hidden layers; the decoder's are the reverse
    #: after every layer but the latent and the last one, which are linear
    activation: Activation
    standardise: bool  # centre inputs and divide by their spread in training; undone at the output
    #: a block of its own for each group of joints and muscles that share nothing with the others,
    #: whose layers grow with the group; else one network of `hidden` for any body
    grouped: bool = False


class TrainingSettings(Strict, frozen=True):
    """How a network is trained on the geometric model."""

    steps: Count  # mini-batches in all
    batch: Count  # samples in a mini-batch
    samples: Count  # drawn from the geometric model, then shuffled epoch by epoch
    optimiser: Literal['adam', 'muon']
    step_size: Positive  # Adam's; with Muon that of the biases
    annealed: bool  # raised over the first twentieth, then lowered to zero by a cosine
    every_mask: bool  # enter each sample by all three masks instead of one at random
    weights: tuple[NotNegative, NotNegative, NotNegative]  # w_θ, w_T, w_l
    standard_norms: bool  # take each norm in units of the spread of the data
    slope_weight: NotNegative = 0.0  # w_G of the slope ∂l/∂θ through ①; needs samples in twins


class Preset(Strict, frozen=True):
    """Everything in which two presets differ.

    The numbers of `default` are those of an arm of 5 joints and 10 muscles. In proportion to
    the D + M of a larger group its layers grow (by the root of it the error of θ does, from 0.0030
    to 0.0045 rad a joint at 17 × 40), and by its power of 1.5 in the largest group of a body the
    mini-batches of initial training (in proportion, ② is worse at 17 × 40 than at 5 × 10; so it is
    a tenth better). An update has as many for any body: it is to be short.
    """

    name: str
    network: NetworkSettings
    training: TrainingSettings  # initial training
    corrected_body: bool  # learn online by fitting the calibrated body; else on the samples alone
    least_samples: Count  # from how many samples on it learns online
    #: the learner validates what it learned (`estimation.checkpoint_validation`); as printed not
    gated: bool
    equilibrium: bool  # control, simulate by the solved balance of torques; else as printed
    to_limits: Share  # share of a joint's targets that exploration takes at its limits
    whitened: bool  # d, physics and posture decide what is an anomaly; else A alone, as printed

    def grown(self, number: int, groups: Iterable[Group], power: float = 1.0) -> int:
        """Return a number of units of a group's layer, or of steps, as it is for given groups."""
        times = max(1.0, max(sum(map(len, group)) for group in groups) / REFERENCE)
        return round(number * times**power) if self.network.grouped else number

    def steps(self, groups: Iterable[Group]) -> int:
        """Return the mini-batches of initial training for given groups."""
        return self.grown(self.training.steps, groups, 1.5)

    def blocks(self, groups: Iterable[Group]) -> dict[Group, tuple[int, ...]]:
        """Return the groups that have a block of the network each, with its hidden layers."""
        hidden, of = self.network.hidden, groups if self.network.grouped else ()
        return {group: tuple(self.grown(units, [group]) for units in hidden) for group in of}


PRESETS = read_table(__file__, 'presets.yaml', dict[str, Preset])
DEFAULT, PAPER = PRESETS['default'], PRESETS['paper']


def preset_named(name: str) -> Preset:
    """Return the preset of that name.

    Raises:
        MusculoskeletalError: If there is none.
    """
    if name not in PRESETS:
        raise MusculoskeletalError(f'preset {name!r} is unknown; legal: {", ".join(PRESETS)}')
    return PRESETS[name]
