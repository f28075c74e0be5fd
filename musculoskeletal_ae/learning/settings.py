# SPDX-License-Identifier: Apache-2.0
"""What a user may choose about learning: one table for the core and the node's parameters."""

from dataclasses import dataclass

from musculoskeletal_ae.parameters import Parameter

STEPS = 50  # of training in one update of preset default; with 100 the error is 3 % less


@dataclass(frozen=True)
class Settings:
    """What counts as rest, and how far a new sample has to be from every stored one."""

    rest_time: float = Parameter(0.3, 'how long the arm has to be still', 's', (0.0, 10.0)).field()
    rest_joint_rate: float = Parameter(
        0.02,
        'fastest joint of a resting arm (times 0.06 m where it slides)',
        'rad/s',
        (0.0, 1.0),
    ).field()
    rest_length_rate: float = Parameter(
        0.002, 'fastest muscle of a resting arm', 'm/s', (0.0, 1.0)
    ).field()
    new_joint_distance: float = Parameter(
        0.05,
        'least distance of a new sample in one joint (times 0.06 m where it slides)',
        'rad',
        (0.0, 3.0),
    ).field()
    new_tension_distance: float = Parameter(
        10.0, 'least distance of a new sample in one tension', 'N', (0.0, 500.0)
    ).field()


DEFAULT = Settings()
