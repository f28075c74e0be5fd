# SPDX-License-Identifier: Apache-2.0
"""Decides whether a restart of the driver, or a wrong wiring, explains a finding.

If a driver restarts with two muscles exchanged, in readings and commands, their lengths jump or no
longer fit the rest of the arm. The same applies if it reverses the sign of a length. Detectors then
report lost length offsets or a damaged muscle, and the advice that follows would be wrong. Two
observations reveal what the driver has done:

Silence. A driver that restarts is silent for a moment, in which the arm moves little. Putting
exchanged columns back therefore makes their lengths continue those before the silence. If neither
an exchange nor a reversed sign explains why several lengths have changed, and the readings do not
fit the learned body, then these lengths have lost their offsets.

Anomaly score. If muscles are exchanged, putting the two columns back restores the usual anomaly
score A in all recent messages (`signals/wiring.py`). Only a network that has learned the arm is
exact enough for this. With any other network, the length calibration judges the order, because the
arm moves during the calibration. Shortly after a silence, wrong signs are judged by the anomaly
score as well, because a length near 0 hardly changes when its sign is reversed. Without a silence,
signs are not judged: no driver has restarted, and a lost length offset could look like a wrong
sign.
"""

import math
from collections import deque

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.finding import Detector, Finding, Observation, jump_finding
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import anomaly, residuals
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_states import MuscleReadings
from musculoskeletal_ae.signals.reading_limits import slack_tension
from musculoskeletal_ae.signals.wiring import Wiring, WiringJudgement, decide, single_faults

SPACING = 0.25  # store at most one message in this time [s]
#: take the median anomaly score A of at most this many stored messages as the usual score
USUAL_COUNT = 120
ENOUGH = 20  # judge no finding before this many messages have been stored
RECENT = 20  # judge a finding by this many of the newest messages
#: judge a finding only by recent messages whose anomaly score A exceeds this multiple of the usual
#: score, because the others are from before the fault
ANOMALOUS = 2.0
#: assume an exchange only if the anomaly score, with the columns put back, is below this multiple
#: of the usual score
USUAL = 1.5
#: Assume an exchange only if putting the columns back divides the anomaly score by at least this
#: factor. On messages of two learned arms, USUAL and BETTER together blamed an exchange for 3 of
#: 475 shifts of one or two lengths, and recognised 194 of 229 exchanges.
BETTER = 3.0
#: assume that the driver may have restarted after a pause of all messages of this length [s]
SILENT = 0.3
#: for this time after a pause of all messages [s], compare the lengths before and after the pause
#: to explain a finding
RESTARTED = 5.0
#: suspect that a column belongs to another muscle, or has lost its offset, if its length has
#: changed by more than this during the pause [m]
DISCONTINUOUS = 0.02
#: Blame exchanged or reversed columns for changes of lengths over a pause only if putting the
#: columns right divides these changes by this factor. The changes must also exceed those of all
#: other lengths by this factor.
CONTINUOUS = 3.0
#: look for exchanged muscles only after one of these findings: an exchange causes no others
EXPLAINED = frozenset(
    {
        ConditionKind.LENGTHS_JUMPED,
        ConditionKind.LENGTHS_DISAGREE,
        ConditionKind.LENGTH_DISAGREES,
        ConditionKind.RESIDUAL_DISTANCE,
    }
)
#: compare the lengths before and after a pause of the messages only after a finding of one of these
#: kinds
EXPLAINED_BY_SILENCE = EXPLAINED | {ConditionKind.LENGTH_JUMP}


class ExchangeCheck(Detector):
    """Checks whether a fault of the driver explains a finding, and then reports that fault instead.

    The fault is a wrong order of the muscles, a wrong sign of a length, or lost length offsets.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._mae: Mae | None = None
        #: bone-side tensions, and lengths as read, of recent messages
        self._messages: deque[tuple[Array, Array]] = deque(maxlen=USUAL_COUNT)
        self._since = 0.0  # time since a message was last kept [s]
        #: time [s] and lengths as read [m], (M,), of the newest message, accepted or not
        self._newest: tuple[float, Array] | None = None
        #: time of the first message after the last silence [s], and the lengths as read before the
        #: silence and in this message [m], (M,) each
        self._silence: tuple[float, Array, Array] | None = None

    def use(self, mae: Mae) -> None:
        """Use another network; its isolated muscles are ignored."""
        self._mae = mae

    def forget(self) -> None:
        """Forget the messages, because the length offsets have changed."""
        self._messages.clear()

    def read(self, readings: MuscleReadings, usable: Bools, now: float) -> None:  # noqa: ARG002
        """Read the lengths of a message, accepted or not, to notice a pause of the driver."""
        length = readings.length
        if not np.isfinite(length).all():
            return
        if self._newest is not None and now - self._newest[0] > SILENT:
            self._silence = now, self._newest[1], length
        self._newest = now, length

    def step(self, observation: Observation) -> None:
        """Store a message, at most one in 0.25 s, while the length offsets are known."""
        self._since += observation.dt
        if self._since < SPACING - 1e-9:
            return
        self._since = 0.0
        if observation.lengths_known:
            sample = observation.sample
            self._messages.append((sample.bone_tension, sample.length_read))

    def explain(self, finding: Finding | None, observation: Observation) -> Finding | None:
        """Explain a finding: return the finding of the driver's fault that explains it, if any.

        Exchanged muscles or a reversed length are considered first. If neither explains `finding`,
        lost length offsets may explain it: `finding` must only state that the readings do not fit
        the learned body, and several lengths must have changed in a recent pause of the messages.
        Otherwise, the result is `finding`.
        """
        if finding is None or finding.kind not in EXPLAINED_BY_SILENCE:
            return finding
        if not observation.lengths_known:
            return finding
        judgement, reason = None, 'if this is corrected, the lengths continue those before a pause'
        if self._may_have_restarted:
            judgement = self._judge_silence()
        is_explained = judgement is not None and judgement.is_faulty
        if not is_explained and finding.kind in EXPLAINED:
            judgement = self._judge(observation)
            reason = 'if this is corrected, the lengths fit the arm'
        if judgement is None or not judgement.is_faulty:
            is_vague = finding.kind is ConditionKind.RESIDUAL_DISTANCE
            return (self._jumped_in_silence() if is_vague else None) or finding
        text = f'{judgement.text(self._robot.muscles)}: {reason}'
        first, *others = judgement.faulty
        return Finding(first, ConditionKind.MUSCLES_EXCHANGED, text, tuple(others))

    @property
    def _may_have_restarted(self) -> bool:
        """Whether all messages paused recently, as when a driver restarts."""
        if self._silence is None or self._newest is None:
            return False
        return self._newest[0] - self._silence[0] <= RESTARTED

    def _jumped_in_silence(self) -> Finding | None:
        """Return the finding of several lengths that jumped in a recent pause of the messages.

        The result is None if fewer than two lengths have changed. A driver that counts lengths from
        0 again changes all of them. An arm that has moved in the pause changes them as well, but
        its readings fit the learned body and cause no finding.
        """
        if not self._may_have_restarted or self._silence is None or self._mae is None:
            return None
        _, before, after = self._silence
        has_changed = np.abs(after - before) > DISCONTINUOUS
        has_changed[list(self._mae.isolated)] = False
        changed = tuple(np.flatnonzero(has_changed).tolist())
        return jump_finding(changed) if len(changed) > 1 else None

    def _judge_silence(self) -> WiringJudgement | None:
        """Judge which order and signs make the lengths continue over the last pause of messages.

        The result is None if no pause has been observed, or without a network.
        """
        if self._silence is None or self._mae is None:
            return None
        _, before, after = self._silence
        used = ~np.isin(np.arange(self._robot.muscle_count), self._mae.isolated)
        straight = Wiring.straight(self._robot.muscle_count)

        def change(wiring: Wiring, columns: Bools) -> float:
            """Return the root mean square change of lengths over the pause with this wiring [m]."""
            gap = wiring.signed(after) - before
            return float(np.sqrt(np.square(gap[columns]).mean())) if columns.any() else 0.0

        explaining = list[tuple[float, Wiring]]()
        for wiring in single_faults(straight, np.flatnonzero(used).tolist()):
            concerned = np.isin(np.arange(self._robot.muscle_count), wiring.faulty)
            now, then = change(straight, concerned), change(wiring, concerned)
            elsewhere = change(straight, used & ~concerned)
            if now > max(DISCONTINUOUS, CONTINUOUS * then, CONTINUOUS * elsewhere):
                explaining.append((then, wiring))
        if not explaining:
            return WiringJudgement(straight, (straight,), (), 0.0)
        explaining.sort()
        least, best = explaining[0]
        return WiringJudgement(best, tuple(wiring for _, wiring in explaining), (), least)

    def _judge(self, observation: Observation) -> WiringJudgement | None:
        """Judge which order and signs restore the usual anomaly score; None if that is unclear.

        It is unclear if the network is not calibrated, if there are too few messages, or if a
        tendon is slack.
        """
        mae, sample = self._mae, observation.sample
        if mae is None or not mae.is_calibrated:
            return None
        used = ~np.isin(np.arange(self._robot.muscle_count), mae.isolated)
        slack = sample.motor_tension < slack_tension(self._robot.description.tension.bias)
        if len(self._messages) < ENOUGH or (slack & used).any():
            return None  # an exchange makes no tendon slack
        offset = _offset(observation)
        messages = *self._messages, (sample.bone_tension, sample.length_read)
        tension, length = (np.array(part) for part in zip(*messages))

        def scores(wiring: Wiring) -> Array:
            """Return the anomaly scores of all messages, with the columns put right by `wiring`."""
            ordered, shifted = wiring.unsigned(tension), wiring.signed(length) - offset
            state = mae.estimate(ordered, shifted)
            return anomaly(residuals(state, ordered, shifted, mae.isolated))

        straight = Wiring.straight(self._robot.muscle_count)
        present = scores(straight)
        usual = float(np.median(present))
        is_anomalous = present > ANOMALOUS * usual
        is_anomalous[: -RECENT - 1] = False
        if not is_anomalous.any():
            return None
        tension, length = tension[is_anomalous], length[is_anomalous]

        def cost(wiring: Wiring) -> float:
            """Return the median anomaly score under a wiring; ∞ if it stays unusually high."""
            value = float(np.median(scores(wiring)))
            return value if value < USUAL * usual else math.inf

        # Consider only the lengths that jumped, if any: an exchange makes both lengths jump.
        columns = sample.jumped or np.flatnonzero(used).tolist()
        faults = single_faults(straight, columns, signs=self._may_have_restarted)
        others = [(other, cost(other)) for other in faults]
        return decide(straight, float(np.median(present[is_anomalous])), others, BETTER)


def _offset(observation: Observation) -> Array:
    """Return the length offsets of a message [m], (M,)."""
    return observation.sample.length_read - observation.sample.length
