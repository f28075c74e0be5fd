# SPDX-License-Identifier: Apache-2.0
"""What a user may choose about the detector: one table for the core and the node's parameters."""

from __future__ import annotations

from dataclasses import dataclass

from musculoskeletal_ae.parameters import Parameter


@dataclass(frozen=True)
class Slack:
    """What a module does that takes up slack wire, so that no tension is no cut muscle yet."""

    slack_length: float = Parameter(
        0.06, 'longest slack that a module may wind in', 'm', (0.0, 1.0), settable=True
    ).field()
    slack_speed: float = Parameter(
        0.005, 'a module that winds in slower stands', 'm/s', (1e-4, 1.0), settable=True
    ).field()
