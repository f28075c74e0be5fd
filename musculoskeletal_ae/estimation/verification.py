# SPDX-License-Identifier: Apache-2.0
"""Find out whether a suspect muscle is broken, by what it does while it is wound in a little.

The arm has stopped, and the estimate is made without the suspect already. The controller lowers
the length command of the suspect by a few millimetres. What the suspect then reads, T and l, is
compared with the tension that muscle stiffness control demands of it, and with the length l' that
the other muscles make likely:

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

BEGUN = 0.001  # [m] by which the command has fallen when the suspect counts as being wound in
JUDGED = 0.8  # [s] of being wound in, after which it is judged
PATIENCE = 8.0  # [s] without an answer
FAR = 0.025  # [m] between l and l' that noise and the network's error do not explain
FOLLOWED = 0.005  # [m] by which l − l' falls while the rest of a ruptured tendon is wound in
USUAL_BIAS = 30.0  # [N] T_bias of the arms that the tensions below hold for; others scale them
CLOSE = 8.0  # [N] by which T may differ from T_ref
SHARE = 0.35  # of the demand beyond T_bias, the same
TIGHT = 20.0  # [N] beyond T_ref: the tendon is pulled although nobody wound it in
STANDS = 0.0005  # [m] by which a jammed winch moves at most while it is wound in
FROZEN = 1e-6  # [m], [N] range of the readings of a frozen sensor


class Outcome(Enum):
    """What a suspect muscle turned out to be. The values are published in /diagnostics."""

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
    """The outcome of a verification, and the figures behind it."""

    outcome: Outcome
    evidence: str = ''  # such as 'by 50 mm'

    def __str__(self) -> str:
        text = _TEXTS[self.outcome]
        return f'{text} {self.evidence}' if self.evidence else text


class _Row(NamedTuple):
    """What the suspect read at one moment while it was wound in."""

    tension: float  # T [N]
    length: float  # l [m]
    demand: float  # T_ref [N]
    excess: float  # l − l' [m]


class Verification:
    """Watches one suspect muscle, beginning with the message after the one that made it suspect."""

    def __init__(self, muscle: int, bias: float, stiffness: float) -> None:
        """Begin.

        Args:
            muscle: The position of the suspect in T and l.
            bias: Its T_bias [N].
            stiffness: Its K of muscle stiffness control [N/m].
        """
        self.muscle, self._bias, self._stiffness = muscle, bias, stiffness
        self._scale = min(1.0, bias / USUAL_BIAS)
        self._time = 0.0
        self._highest_command = -math.inf
        self._before = bias, bias  # T and T_ref where it was not wound in yet
        self._rows: list[_Row] = []
        self._watched = 0.0  # [s] of being wound in

    def step(
        self, tension: float, length: float, command: float | None, likely: float, dt: float
    ) -> Verdict | None:
        """Take the readings of one message.

        Args:
            tension: T [N].
            length: l [m].
            command: l_target [m]; None where no length is commanded.
            likely: l' [m].
            dt: Time since the message before [s].

        Returns:
            The verdict once there is one.
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
            return Verdict(Outcome.JAMMED)  # it pulls as if it were wound in already
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
