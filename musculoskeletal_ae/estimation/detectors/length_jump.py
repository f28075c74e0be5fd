# SPDX-License-Identifier: Apache-2.0
"""Detect that the length of one muscle, and of no other, jumped and stayed at another level.

`signals/muscle_stream.py` rejects messages with a jump. It accepts the new level once it has
lasted, and says so in the sample.
"""

from musculoskeletal_ae.estimation.finding import Detector, Finding, Kind, Observation


class LengthJump(Detector):
    """Reports the muscle that the muscle stream names."""

    def step(self, observation: Observation) -> Finding | None:
        """Take a message."""
        muscle = observation.sample.jumped
        if muscle is None or not observation.lengths_known:
            return None
        return Finding(muscle, Kind.LENGTH_JUMP, 'its length jumped')
