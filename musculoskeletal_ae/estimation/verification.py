# SPDX-License-Identifier: Apache-2.0
"""Verifies whether a suspect muscle is faulty, by its response to being wound in slightly.

The arm has stopped, and the estimate does not use the suspect. The controller lowers the length
command of the suspect by a few millimetres. Its readings T and l are compared with the tension that
muscle stiffness control demands, and with the length l' estimated from the other muscles:

    T_ref = T_bias + K (l − l_target)

The first row that applies decides:

    l does not change at all                     length_sensor_frozen
    T near zero, and l' − l > FAR or growing     ruptured: the winch winds in the rest of the tendon
    T does not change at all                     tension_sensor_frozen
    |l − l'| > FAR                               length_sensor_offset
    l stays, and T does not rise with T_ref      jammed
    T near zero all the same                     tension_sensor_frozen
    T follows T_ref                              healthy
    otherwise                                    jammed

The noise of a working sensor changes every reading. Therefore readings that never change come from
a broken one. A suspect that is not wound in within PATIENCE seconds stays isolated.
"""

import math
from enum import Enum
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.signals.limits import LIMITS

BEGUN = 0.001  # decrease of the command from which on the suspect counts as being wound in [m]
JUDGED = 0.8  # time of being wound in after which the suspect is classified [s]
PATIENCE = 8.0  # longest time without being wound in [s]
FAR = 0.025  # smallest |l − l'| that noise and network errors do not explain [m]
FOLLOWED = 0.005  # decrease of l − l' that shows the rest of a ruptured tendon being wound in [m]
USUAL_BIAS = 30.0  # T_bias for which the tensions below apply; for other arms they are scaled [N]
CLOSE = 8.0  # absolute tolerance of T relative to T_ref [N]
SHARE = 0.35  # relative tolerance, as a share of T_ref − T_bias
TIGHT = 20.0  # excess over T_ref that shows a jam although the suspect was not wound in [N]
STANDS = 0.0005  # largest motion of a jammed muscle module [m]
FROZEN = 1e-6  # largest range of the readings of a frozen sensor [m], [N]


class Outcome(Enum):
    """Outcomes of a verification. The values are published in /diagnostics."""

    HEALTHY = 'healthy'
    RUPTURED = 'ruptured'
    JAMMED = 'jammed'
    LENGTH_SENSOR_FROZEN = 'length_sensor_frozen'
    LENGTH_SENSOR_OFFSET = 'length_sensor_offset'
    TENSION_SENSOR_FROZEN = 'tension_sensor_frozen'
    NOT_WOUND_IN = 'not_wound_in'
    VALUES_MISSING = 'values_missing'  # isolated at once, without a verification


_TEXTS = {
    Outcome.HEALTHY: 'healthy',
    Outcome.RUPTURED: 'ruptured',
    Outcome.JAMMED: 'jammed',
    Outcome.LENGTH_SENSOR_FROZEN: 'its length sensor is frozen',
    Outcome.LENGTH_SENSOR_OFFSET: 'its length sensor is off',
    Outcome.TENSION_SENSOR_FROZEN: 'its tension sensor is frozen',
    Outcome.NOT_WOUND_IN: 'not verified, since nobody wound it in',
    Outcome.VALUES_MISSING: 'a sensor does not report a number',
}


class Verdict(NamedTuple):
    """The outcome of a verification, with its evidence."""

    outcome: Outcome
    evidence: str = ''  # such as 'by 50 mm'

    def __str__(self) -> str:
        text = _TEXTS[self.outcome]
        return f'{text} {self.evidence}' if self.evidence else text


class _Row(NamedTuple):
    """Readings of the suspect at one moment while it was wound in."""

    tension: float  # T [N]
    length: float  # l [m]
    demand: float  # T_ref [N]
    excess: float  # l − l' [m]


class Verification:
    """Verifies one suspect muscle, starting with the message after its finding."""

    def __init__(self, muscle: int, bias: float, stiffness: float) -> None:
        """Start the verification.

        Args:
            muscle: Index of the suspect.
            bias: Its T_bias [N].
            stiffness: Its K of muscle stiffness control [N/m].
        """
        self.muscle, self._bias, self._stiffness = muscle, bias, stiffness
        self._scale = min(1.0, bias / USUAL_BIAS)
        self._time = 0.0
        self._highest_command = -math.inf
        self._before = bias, bias  # T and T_ref before it was wound in
        self._rows: list[_Row] = []
        self._watched = 0.0  # time of being wound in [s]

    def step(
        self, tension: float, length: float, command: float | None, likely: float, dt: float
    ) -> Verdict | None:
        """Take the readings of one message.

        Args:
            tension: T [N].
            length: l [m].
            command: l_target [m]; None if no length is commanded.
            likely: l' [m].
            dt: Time since the previous message [s].

        Returns:
            The verdict once the verification is complete, else None.
        """
        self._time += dt
        demand = math.inf
        if command is not None:
            demand = self._bias + max(0.0, self._stiffness * (length - command))
            if command >= self._highest_command:
                self._highest_command = command
                self._before = tension, demand
            if command < self._highest_command - BEGUN:
                self._watched += dt
                self._rows.append(_Row(tension, length, demand, length - likely))
        if self._watched >= JUDGED:
            return self._judge()
        if self._time < PATIENCE:
            return None
        if tension > demand + TIGHT * self._scale:
            return Verdict(Outcome.JAMMED)  # its tension is high although it was not wound in
        return Verdict(Outcome.NOT_WOUND_IN)

    def _judge(self) -> Verdict:
        tension, length, demand, excess = np.array(self._rows).T
        first_quarter = slice(max(len(tension) // 4, 1))
        last_quarter = slice(-max(len(tension) // 4, 1), None)
        reached, wanted, beside = map(_late_median, (tension, demand, excess))
        is_slack = reached < LIMITS.slack_share * self._bias
        follows_the_winch = excess[0] - excess[-1] > FOLLOWED
        if np.ptp(length) < FROZEN:
            return Verdict(Outcome.LENGTH_SENSOR_FROZEN)
        if is_slack and (beside < -FAR or follows_the_winch):
            return Verdict(Outcome.RUPTURED)
        if np.ptp(tension) < FROZEN:
            return Verdict(Outcome.TENSION_SENSOR_FROZEN)
        if not is_slack and abs(beside) > FAR:
            return Verdict(Outcome.LENGTH_SENSOR_OFFSET, f'by {1e3 * beside:.0f} mm')
        stands = abs(length[first_quarter].mean() - length[last_quarter].mean()) < STANDS
        close = CLOSE * self._scale
        rise, demanded_rise = reached - self._before[0], wanted - self._before[1]
        rises = rise >= SHARE * demanded_rise or demanded_rise <= close
        if stands and (is_slack or not rises):
            return Verdict(Outcome.JAMMED)
        if is_slack:
            return Verdict(Outcome.TENSION_SENSOR_FROZEN)
        if abs(reached - wanted) < close + SHARE * (wanted - self._bias):
            return Verdict(Outcome.HEALTHY)
        return Verdict(Outcome.JAMMED)


def _late_median(values: Array) -> float:
    """Return the median of the second half of values (N,)."""
    return float(np.median(values[len(values) // 2 :]))
