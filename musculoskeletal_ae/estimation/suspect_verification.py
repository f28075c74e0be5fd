# SPDX-License-Identifier: Apache-2.0
"""Verifies whether a suspect muscle is faulty, by its response to being wound in slightly.

The arm has stopped, and the estimate does not use the suspect. The controller lowers the length
command l_target of the suspect by a few millimetres. The length l of the suspect is compared with
the length l' that is estimated from the other muscles. Its tension T is compared with the tension
T_ref that muscle stiffness control demands:

    T_ref = T_bias + K (l − l_target)

Position-controlled modules do not regulate tension. Their T_ref is the tension that follows from
the stretch x of the series elastic element with the elongation L_e(T). T_0 and x_0 are tension and
stretch before winding in:

    L_e(T_ref) = L_e(T_0) + x − x_0,   x = l' − l + L_e(T)

Their tendons may be slack at first. The suspect is wound in until it has tension, or until it is so
short that a healthy tendon would have tension. For position-controlled modules, the first row that
applies decides:

    l does not change at all                     length_sensor_frozen
    l does not follow l_target                   jammed
    T near zero, and x > STRETCHED · L_e(T_bias) ruptured
    T does not change at all                     tension_sensor_frozen
    T near zero otherwise                        not_wound_in
    T is unknown                                 tension_unknown
    |l − l'| > FAR                               length_sensor_offset
    T rises with T_ref                           healthy
    otherwise                                    tension_sensor_frozen

Under muscle stiffness control, the first row that applies decides:

    l does not change at all                     length_sensor_frozen
    T near zero, and l' − l > FAR or growing     ruptured: the winch winds in the rest of the tendon
    T does not change at all                     tension_sensor_frozen
    T not near zero, and |l − l'| > FAR          length_sensor_offset
    l stays, and T near zero or not rising       jammed
    T near zero otherwise                        tension_sensor_frozen
    T follows T_ref                              healthy
    otherwise                                    jammed

The noise of a working sensor changes every reading. Therefore readings that never change come from
a broken sensor. A suspect that is not wound in within 8 s (PATIENCE) stays isolated. Every
verification therefore ends within 10 s (LONGEST) of accepted messages.
"""

import math
from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.signals.reading_limits import slack_tension

#: conclude that the suspect is being wound in once its length command has decreased by more than
#: this [m]
WINDING_CHANGE = 0.001
CLASSIFICATION_TIME = 0.8  # classify the suspect after it was wound in for this time [s]
PATIENCE = 8.0  # end the verification of a suspect that was not wound in within this time [s]
LONGEST = 10.0  # end a verification within this time, including the time for winding in [s]
#: conclude a fault if the measured length l differs from the estimated length l' by more than this
#: [m]; noise and network errors are smaller
FAR = 0.025
#: conclude a rupture if l − l' falls by this much while a slack suspect is wound in [m]: the winch
#: winds in the loose end of the tendon
RUPTURE_CHANGE = 0.005
#: reduce the limits CLOSE and JAM_EXCESS in proportion for a T_bias below this [N]
USUAL_BIAS = 30.0
CLOSE = 8.0  # tolerate this difference between the tension T and the demanded tension T_ref [N]
#: tolerate, in addition to CLOSE, this share of T_ref − T_bias; conclude that T does not follow if
#: it rises by less than this share of the rise of T_ref
SHARE = 0.35
#: conclude that a suspect is jammed, although it was not wound in, if its tension T exceeds the
#: demanded tension T_ref by more than this [N]
JAM_EXCESS = 20.0
#: conclude that a slack tendon is ruptured if its stretch exceeds the stretch at T_bias by this
#: factor, because a healthy tendon would then have tension
STRETCHED = 1.5
#: wait at most this long for tension in the tendon of a position-controlled module that winds in
#: [s]
LONGEST_WINDING = 2.5
BEHIND = 0.005  # judge whether a module follows once its position command has decreased by this [m]
STANDS = 0.0005  # treat a winch as standing still if the length changes by less than this [m]
# T_ref of a position-controlled module is found by bisection between 0 and HIGHEST_TENSION.
HIGHEST_TENSION = 5000.0  # search for T_ref up to this tension [N]
HALVINGS = 40  # halve the range of T_ref this many times, to far below 1 mN
FROZEN = 1e-6  # call a sensor frozen if its readings vary by less than this [m] or [N]


class Outcome(Enum):
    """Outcomes of a verification. The values are published in /diagnostics."""

    HEALTHY = 'healthy'
    RUPTURED = 'ruptured'
    JAMMED = 'jammed'
    LENGTH_SENSOR_FROZEN = 'length_sensor_frozen'
    LENGTH_SENSOR_OFFSET = 'length_sensor_offset'
    TENSION_SENSOR_FROZEN = 'tension_sensor_frozen'
    NOT_WOUND_IN = 'not_wound_in'
    TENSION_UNKNOWN = 'tension_unknown'
    # outcomes of muscles that are isolated at once, without a verification
    VALUES_MISSING = 'values_missing'
    SENSOR_SATURATED = 'sensor_saturated'


#: outcomes as texts for users
_TEXTS = {
    Outcome.HEALTHY: 'healthy',
    Outcome.RUPTURED: 'ruptured',
    Outcome.JAMMED: 'jammed',
    Outcome.LENGTH_SENSOR_FROZEN: 'its length sensor is frozen',
    Outcome.LENGTH_SENSOR_OFFSET: 'its length sensor has an offset',
    Outcome.TENSION_SENSOR_FROZEN: 'its tension sensor is frozen',
    Outcome.NOT_WOUND_IN: 'not verified, because it was not wound in',
    Outcome.TENSION_UNKNOWN: 'not verified, because its tension is unknown (tension_source: none)',
    Outcome.VALUES_MISSING: 'a sensor reports NaN instead of a number',
    Outcome.SENSOR_SATURATED: 'its tension sensor saturates or is frozen',
}


class VerificationVerdict(NamedTuple):
    """The verdict on a suspect muscle: the outcome of its verification, with its evidence."""

    outcome: Outcome
    evidence: str = ''  # size of the fault, such as '50 mm'

    def __str__(self) -> str:
        text = _TEXTS[self.outcome]
        return f'{text} of {self.evidence}' if self.evidence else text


class _Moment(NamedTuple):
    """The readings of the suspect at one moment, and the demand and stretch computed from them."""

    tension: float  # measured tension T [N]
    length: float  # measured length l [m]
    command: float  # length command l_target [m]
    likely: float  # length l' that the other muscles indicate [m]
    demand: float = math.nan  # tension T_ref that a healthy muscle would have [N]
    stretch: float = math.nan  # stretch x of the series elastic element [m]


class Verification:
    """Verifies one suspect muscle, starting with the message after its finding."""

    def __init__(
        self,
        bias: float,
        stiffness: float = math.nan,
        elongation: Callable[[float], float] | None = None,
    ) -> None:
        """Start the verification.

        Args:
            bias: Tension bias [N].
            stiffness: Control stiffness [N/m] of a module under muscle stiffness control.
            elongation: For a position-controlled module, a function that returns the elongation L_e
                of the series elastic element [m] at a tension [N]; otherwise None.
        """
        self._bias = bias
        self._stiffness, self._elongation = stiffness, elongation
        self._reference = 0.0  # x_0 − L_e(T_0) [m]
        self._scale = min(1.0, bias / USUAL_BIAS)
        self._time = 0.0
        self._highest_command = -math.inf
        self._before = bias, bias  # T and T_ref before the suspect was wound in [N]
        self._rows: list[_Moment] = []  # readings while the suspect was wound in
        self._watched = 0.0  # duration of winding in so far [s]

    def step(
        self, tension: float, length: float, command: float | None, likely: float, dt: float
    ) -> VerificationVerdict | None:
        """Record the readings of one message, and classify the suspect once there are enough.

        Args:
            tension: Tension of the suspect [N].
            length: Length of the suspect [m].
            command: Target length of the suspect [m]; None if no length is commanded.
            likely: Length of the suspect, estimated from the other muscles [m].
            dt: Time since the previous message [s].

        Returns:
            The verdict when the verification is complete, None before.
        """
        self._time += dt
        demand = math.inf
        if command is not None:
            is_reference = command >= self._highest_command
            row = self._with_demand(_Moment(tension, length, command, likely), is_reference)
            demand = row.demand
            if is_reference:
                self._highest_command = command
                self._before = tension, demand
            if command < self._highest_command - WINDING_CHANGE:
                self._watched += dt
                self._rows.append(row)
        if self._watched >= CLASSIFICATION_TIME:
            return self._judge() if self._elongation is None else self._judge_position()
        if self._time < PATIENCE:
            return None
        if tension > demand + JAM_EXCESS * self._scale:
            # The tension is too high although the suspect was not wound in.
            return VerificationVerdict(Outcome.JAMMED)
        return VerificationVerdict(Outcome.NOT_WOUND_IN)

    def _with_demand(self, row: _Moment, is_reference: bool) -> _Moment:
        """Return a row with the tension T_ref that a healthy muscle would have.

        Under muscle stiffness control, the command demands it. With a position-controlled module,
        it follows from the stretch x of the series elastic element: the length that the other
        muscles indicate, minus the measured length, plus the elongation that the measured tension
        explains.

        Args:
            row: Readings of the suspect, and its command.
            is_reference: Whether the suspect has not been wound in yet. Changes of the stretch are
                measured from this row on.
        """
        if self._elongation is None:
            lag = max(0.0, self._stiffness * (row.length - row.command))
            return row._replace(demand=self._bias + lag)
        stretch = row.likely - row.length + self._elongation(row.tension)
        if is_reference:  # x_0 − L_e(T_0) is unknown for a slack tendon, and assumed to be 0 then
            is_slack = row.tension < slack_tension(self._bias)
            self._reference = 0.0 if is_slack else stretch - self._elongation(row.tension)
        wanted, low, high = stretch - self._reference, 0.0, HIGHEST_TENSION
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self._elongation(middle) < wanted else (low, middle)
        return row._replace(demand=low, stretch=stretch)

    def _judge(self) -> VerificationVerdict:
        tension, length, _, likely, demand, _ = np.array(self._rows).T
        excess = length - likely
        first_quarter = slice(max(len(tension) // 4, 1))
        last_quarter = slice(-max(len(tension) // 4, 1), None)
        reached, wanted, beside = map(_late_median, (tension, demand, excess))
        is_slack = reached < slack_tension(self._bias)
        follows_the_winch = excess[0] - excess[-1] > RUPTURE_CHANGE
        if np.ptp(length) < FROZEN:
            return VerificationVerdict(Outcome.LENGTH_SENSOR_FROZEN)
        if is_slack and (beside < -FAR or follows_the_winch):
            return VerificationVerdict(Outcome.RUPTURED)
        if np.ptp(tension) < FROZEN:
            return VerificationVerdict(Outcome.TENSION_SENSOR_FROZEN)
        if not is_slack and abs(beside) > FAR:
            return VerificationVerdict(Outcome.LENGTH_SENSOR_OFFSET, f'{1e3 * beside:.0f} mm')
        stands = abs(length[first_quarter].mean() - length[last_quarter].mean()) < STANDS
        close = CLOSE * self._scale
        rise, demanded_rise = reached - self._before[0], wanted - self._before[1]
        rises = rise >= SHARE * demanded_rise or demanded_rise <= close
        if stands and (is_slack or not rises):
            return VerificationVerdict(Outcome.JAMMED)
        if is_slack:
            return VerificationVerdict(Outcome.TENSION_SENSOR_FROZEN)
        if abs(reached - wanted) < close + SHARE * (wanted - self._bias):
            return VerificationVerdict(Outcome.HEALTHY)
        return VerificationVerdict(Outcome.JAMMED)

    def _judge_position(self) -> VerificationVerdict | None:
        assert self._elongation is not None
        rows = self._rows[len(self._rows) // 2 :]
        newest = np.array(rows[-10:])
        tension, length, command, _, demand, stretch = np.median(newest, axis=0)
        excess = np.median(newest[:, 1] - newest[:, 3])
        is_slack = tension < slack_tension(self._bias)
        # A healthy tendon that is stretched further than this has tension.
        is_stretched = stretch > STRETCHED * self._elongation(self._bias)
        may_wait = self._watched < LONGEST_WINDING and self._time < LONGEST
        if is_slack and not is_stretched and may_wait:
            return None
        spread: Array = np.ptp([(row.tension, row.length) for row in self._rows], axis=0)
        first = self._rows[0]
        followed, asked = first.length - length, first.command - command
        if spread[1] < FROZEN:
            return VerificationVerdict(Outcome.LENGTH_SENSOR_FROZEN)
        if asked > BEHIND and followed < 0.5 * asked:
            return VerificationVerdict(Outcome.JAMMED)
        if is_slack and is_stretched:
            return VerificationVerdict(Outcome.RUPTURED)
        if spread[0] < FROZEN:
            return VerificationVerdict(Outcome.TENSION_SENSOR_FROZEN)
        if is_slack:
            return VerificationVerdict(Outcome.NOT_WOUND_IN)
        if math.isnan(tension):
            return VerificationVerdict(Outcome.TENSION_UNKNOWN)
        if abs(excess) > FAR:
            return VerificationVerdict(Outcome.LENGTH_SENSOR_OFFSET, f'{1e3 * excess:.0f} mm')
        rise, demanded = tension - self._before[0], demand - self._before[1]
        if rise >= SHARE * demanded or demanded <= CLOSE * self._scale:
            return VerificationVerdict(Outcome.HEALTHY)
        return VerificationVerdict(Outcome.TENSION_SENSOR_FROZEN)


def _late_median(values: Array) -> float:
    """Return the median of the later half of values (N,): by then, the suspect has responded."""
    return float(np.median(values[len(values) // 2 :]))
