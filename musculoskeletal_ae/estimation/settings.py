# SPDX-License-Identifier: Apache-2.0
"""Settings of anomaly detection, from which the node `estimator` also makes its parameters."""

from dataclasses import dataclass

from musculoskeletal_ae.parameters import CheckedSettings, settable

STOP, ISOLATE = ON_ANOMALY = ('stop', 'isolate')


@dataclass(frozen=True)
class Detection(CheckedSettings):
    """Settings of the detectors, of winding in slack, and of the reaction to an anomaly."""

    anomaly_threshold: float = settable(
        0.0,
        'value of A above which 5 consecutive messages are an anomaly '
        '(0: decide by the calibrated detector instead)',
        'scaled units',
        0.0,
        1e6,
    )
    slack_length: float = settable(
        0.06, 'longest slack that a muscle module may wind in', 'm', 0.0, 1.0
    )
    slack_speed: float = settable(
        0.005, 'winding speed below which a muscle module counts as stationary', 'm/s', 1e-4, 1.0
    )
    on_anomaly: str = settable(
        'stop',
        '`stop`: the arm stops until estimator/reset is called; `isolate`: the suspect muscle is '
        'verified and, if it is faulty, isolated; then the arm resumes',
        legal=ON_ANOMALY,
    )
