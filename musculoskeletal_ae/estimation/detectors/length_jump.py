# SPDX-License-Identifier: Apache-2.0
"""Detect that lengths jumped and stayed at another level, as of modules that lost their count.

`signals/muscle_stream.py` rejects messages with a jump. It accepts the new level once it has
lasted, and says so in the sample.
"""

from musculoskeletal_ae.estimation.finding import Detector, Finding, Kind, Observation


class LengthJump(Detector):
    """Reports the muscles that the muscle stream names."""

    def step(self, observation: Observation) -> Finding | None:
        """Take a message."""
        jumped = observation.sample.jumped
        if not jumped or not observation.lengths_known:
            return None
        return finding_of(jumped)


def finding_of(jumped: tuple[int, ...]) -> Finding:
    """Return the finding of muscles whose lengths have jumped, one or several."""
    if len(jumped) == 1:
        return Finding(jumped[0], Kind.LENGTH_JUMP, 'its length jumped')
    evidence = f'its length jumped, and {len(jumped) - 1} others'
    return Finding(jumped[0], Kind.LENGTHS_JUMPED, evidence)
