# SPDX-License-Identifier: Apache-2.0
"""Detects lengths that have jumped and stay at their new values.

This happens, for example, if muscle modules lose their length offsets. `signals/length_jumps.py`
rejects messages with a jump. If the new lengths persist, messages are accepted again, and the first
accepted sample names the muscles whose lengths have jumped.

If a driver restarts with two muscles exchanged, both lengths jump, too. A length calibration would
then be wrong advice. Exchanging these two columns back must restore the healthy anomaly score A. A
network that has learned the arm is exact enough to show this in a single posture
(`signals/wiring.py`). With other networks, the length calibration tests the order, because the arm
then moves.
"""

import math
from collections import deque

import numpy as np

from musculoskeletal_ae.estimation.finding import Detector, Finding, Kind, Observation
from musculoskeletal_ae.estimation.state_estimator import estimate_of
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.signals.muscle_stream import MuscleSample
from musculoskeletal_ae.signals.wiring import Judgement, Wiring, decide, single_faults

USUAL_COUNT = 100  # number of messages whose median A is the usual one
#: columns count as exchanged if A is then below this multiple of the usual A
USUAL = 2.0
#: and if A of the readings as they are is at least this multiple of A after the exchange
BETTER = 2.0


class LengthJump(Detector):
    """Reports muscles whose lengths have jumped and have stayed at the new values."""

    def __init__(self) -> None:
        self._mae: Mae | None = None
        self._anomalies: deque[float] = deque(maxlen=USUAL_COUNT)

    def use(self, mae: Mae) -> None:
        """Use another network; its isolated muscles are ignored."""
        self._mae = mae
        self._anomalies.clear()

    def step(self, observation: Observation) -> Finding | None:
        """Report the muscles that the sample names as having jumped (`MuscleSample.jumped`)."""
        jumped = observation.sample.jumped
        if not observation.lengths_known:
            return None
        if not jumped:
            self._anomalies.append(observation.estimate.anomaly)
            return None
        judgement = self._judge(observation.sample, observation.estimate.anomaly, jumped)
        if judgement is None or not judgement.is_faulty or self._mae is None:
            return finding_of(jumped)
        evidence = f'{judgement.text(self._mae.muscles)}, because their lengths jumped accordingly'
        return Finding(judgement.faulty[0], Kind.MUSCLES_EXCHANGED, evidence)

    def _judge(
        self, sample: MuscleSample, anomaly: float, jumped: tuple[int, ...]
    ) -> Judgement | None:
        """Judge whether an exchange of muscles explains a jump; None if that is unknown.

        A wrong sign is not considered, because a lost length offset of one muscle can look like it
        in a single posture.

        Args:
            sample: The first sample after the jump.
            anomaly: Its anomaly score A.
            jumped: Indices of the muscles whose lengths have jumped.
        """
        mae = self._mae
        if mae is None or mae.anomaly is None or not mae.anomaly.calibrated or not self._anomalies:
            return None
        usual, offset = float(np.median(self._anomalies)), sample.length_read - sample.length

        def anomaly_of(wiring: Wiring) -> float:
            """Return A, or infinity if it is not healthy."""
            tension = wiring.unsigned(sample.bone_tension)
            length = wiring.signed(sample.length_read) - offset
            state = mae.estimate(tension, length)
            value = estimate_of(mae, state, tension, length).anomaly
            return value if value < USUAL * usual else math.inf

        straight = Wiring.straight(len(offset))
        others = [(other, anomaly_of(other)) for other in single_faults(straight, jumped, False)]
        return decide(straight, anomaly, others, BETTER)


def finding_of(jumped: tuple[int, ...]) -> Finding:
    """Return the finding for one or several muscles whose lengths have jumped."""
    if len(jumped) == 1:
        return Finding(jumped[0], Kind.LENGTH_JUMP, 'its length jumped')
    others = '1 other length' if len(jumped) == 2 else f'{len(jumped) - 1} other lengths'
    evidence = f'its length and {others} jumped'
    return Finding(jumped[0], Kind.LENGTHS_JUMPED, evidence)
