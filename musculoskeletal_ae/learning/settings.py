# SPDX-License-Identifier: Apache-2.0
"""Settings of learning, from which the parameters of the learner node are derived as well."""

from dataclasses import dataclass

from musculoskeletal_ae.parameters import Parameter

STEPS = 50  # training steps in one update of preset `default`; 100 would reduce the error by 3 %


@dataclass(frozen=True)
class Settings:
    """Thresholds for rest, and for the distance of a new sample from every stored one."""

    rest_time: float = Parameter(
        0.3, 'time for which the arm has to be still before it counts as at rest', 's', (0.0, 10.0)
    ).field()
    rest_joint_rate: float = Parameter(
        0.02,
        'largest joint speed of an arm at rest (for prismatic joints times 0.06 m)',
        'rad/s',
        (0.0, 1.0),
    ).field()
    rest_length_rate: float = Parameter(
        0.002, 'largest muscle speed of an arm at rest', 'm/s', (0.0, 1.0)
    ).field()
    new_joint_distance: float = Parameter(
        0.05,
        'difference of a joint angle above which two samples count as different '
        '(for prismatic joints times 0.06 m)',
        'rad',
        (0.0, 3.0),
    ).field()
    new_tension_distance: float = Parameter(
        10.0,
        'difference of a tension above which two samples count as different',
        'N',
        (0.0, 500.0),
    ).field()


DEFAULT = Settings()
