# SPDX-License-Identifier: Apache-2.0
"""Settings of the estimator, from which the parameters of its node are generated."""

from dataclasses import dataclass

from musculoskeletal_ae.parameters import CheckedSettings, settable

STOP, ISOLATE = ON_ANOMALY = ('stop', 'isolate')  # legal values of the parameter `on_anomaly`


@dataclass(frozen=True)
class EstimatorSettings(CheckedSettings):
    """How the estimator reacts to an anomaly. `Estimator.configure` applies changed settings."""

    on_anomaly: str = settable(
        STOP,
        '`stop`: the arm stops until estimator/reset is called; `isolate`: the suspect muscle is '
        'verified and, if it is faulty, isolated; then the arm resumes',
        legal=ON_ANOMALY,
    )
