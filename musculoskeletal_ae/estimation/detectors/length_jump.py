# SPDX-License-Identifier: Apache-2.0
"""Detects lengths that have jumped and stay at their new values.

This happens, for example, if muscle modules lose their length offsets. `signals/length_jumps.py`
rejects messages with a jump. If the new lengths persist, messages are accepted again, and the first
accepted sample names the muscles whose lengths have jumped.
"""

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.finding import Detector, Finding, Observation


class LengthJump(Detector):
    """Reports muscles whose lengths have jumped and have stayed at the new values."""

    def step(self, observation: Observation) -> Finding | None:
        """Report the muscles whose lengths have jumped (`MuscleSample.jumped`), or return None.

        Nothing is reported while the length offsets are unknown.
        """
        jumped = observation.sample.jumped
        if not jumped or not observation.lengths_known:
            return None
        return finding_of(jumped)


def finding_of(jumped: tuple[int, ...]) -> Finding:
    """Return the finding for one or several muscles whose lengths have jumped."""
    if len(jumped) == 1:
        return Finding(jumped[0], ConditionKind.LENGTH_JUMP, 'its length jumped')
    others = '1 other length' if len(jumped) == 2 else f'{len(jumped) - 1} other lengths'
    evidence = f'its length and {others} jumped'
    return Finding(jumped[0], ConditionKind.LENGTHS_JUMPED, evidence)
