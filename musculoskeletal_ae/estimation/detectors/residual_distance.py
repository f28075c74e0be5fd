# SPDX-License-Identifier: Apache-2.0
"""Detects an anomaly by the Mahalanobis distance of the network's residual.

    d = √((e − μ)ᵀ Σ⁻¹ (e − μ)),  e = (T_est − T, l_est − l)      (arXiv 2407.08050)

The residual e is the difference between the tensions and lengths that the network reconstructs from
all readings (T_est, l_est) and the readings themselves (T, l). Its size A is published, but the
healthy value of A varies with the posture. The decision is based on d instead, which relates the
residual of every muscle to its healthy spread. The healthy mean μ and covariance Σ have to be
measured on the real arm: with statistics of the geometric model, most healthy postures would count
as anomalous. Without calibrated statistics, d is published, but not compared with a threshold.

Threshold. Far from calibrated postures, the network is less accurate, so the threshold grows with
the distance to the nearest one (`unfamiliarity`). It also grows in proportion to a tension above
T_limit, because networks have learned few tensions that are so high. While a tendon is slack the
threshold does not grow, because a ruptured muscle has no tension in any posture.

Suspect. An anomaly affects the residuals of all muscles. The suspect of a finding is the muscle
without which the remaining residual is most likely. Other muscles without which it is nearly as
likely are named as well, because in one posture, muscles that span the same joints can explain an
anomaly equally well. If tendons are slack, only they can be suspect.

Slack. While a slack tendon is being wound in, its measured length is longer than the reconstructed
length, and messages are no evidence. The measured length of a ruptured tendon is shorter than the
reconstructed length, so its messages are evidence.
"""

import math
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.detectors.slack_tendon import SlackTendon
from musculoskeletal_ae.estimation.finding import Detector, Finding, Observation
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import AnomalyStatistics, residuals
from musculoskeletal_ae.report import distinct
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_stream import MuscleSample
from musculoskeletal_ae.signals.reading_limits import slack_tension

DISTANCE = 'distance'  # name under which a checkpoint stores the threshold of the distance d

#: name a further muscle besides the suspect if d without that muscle is below the threshold, and at
#: most this multiple of d without the suspect
EQUALLY_LIKELY = 1.5
IN_A_ROW = 5  # report the suspect after this many consecutive messages above the threshold
#: raise the threshold if the posture is further than this [joint ranges] from the nearest
#: calibrated posture, because the network is less accurate there
NEAR = 0.25
WIDEST = 3.0  # multiply the threshold by at most this factor, so that ruptures are still detected


class Reading(NamedTuple):
    """The residual distance of one message, and its most suspect muscle."""

    distance: float  # d, in healthy standard deviations; NaN without statistics
    suspect: int  # index of the most suspect muscle


class ResidualDistance(Detector):
    """Reports the most suspect muscle if the residual distance d exceeds its threshold.

    A subclass may use a statistic of the residual other than d.

    Attributes:
        symbol: Symbol of the statistic in messages to users, such as 'd'.
        threshold_name: Name under which the checkpoint stores the threshold of the statistic.
        threshold: Threshold of the statistic; ∞ if it has not been calibrated.
        reading: Distance and most suspect muscle of the last message; None before the first.
    """

    symbol, threshold_name = 'd', DISTANCE

    def __init__(self, robot: Robot, slack: SlackTendon | None = None) -> None:
        """Start without a network.

        Args:
            robot: The nominal body.
            slack: The detector that knows which slack tendons are being wound in; meanwhile,
                messages are ignored. With None, no message is ignored.
        """
        self._robot = robot
        self._slack = slack
        self._mae: Mae | None = None
        self._statistics: AnomalyStatistics | None = None
        self.threshold = np.inf
        self._beyond = 0  # consecutive messages above the threshold
        self.reading: Reading | None = None

    @property
    def is_calibrated(self) -> bool:
        """Whether mean and covariance of healthy residuals were measured on the real arm."""
        return self._statistics is not None and self._statistics.calibrated

    def use(self, mae: Mae) -> None:
        """Use another network with its healthy statistics; its isolated muscles are ignored."""
        statistics = mae.anomaly
        if statistics is not None:
            self._whiten: Array = np.linalg.inv(np.linalg.cholesky(statistics.covariance))
            self._spread = np.sqrt(np.diag(statistics.covariance))
        self._mae, self._statistics, self.threshold = mae, statistics, np.inf
        if statistics is not None and statistics.calibrated:
            self.threshold = statistics.thresholds.get(self.threshold_name, np.inf)

    def reset(self) -> None:
        """Reset the detector: discard the count of messages above the threshold."""
        self._beyond = 0

    def step(self, observation: Observation) -> Finding | None:
        """Update `reading`; report the suspect after five consecutive messages above the threshold.

        The result is None if there is nothing to report.
        """
        sample, error = observation.sample, observation.estimate.residual
        tension, muscle_count = sample.motor_tension, len(sample.motor_tension)
        distance, share = math.nan, error
        if self._statistics is not None:
            centred = error - self._statistics.mean
            white = self._whiten @ centred
            distance = math.sqrt(white @ white)
            share = centred / self._spread
        square = share * share
        score = square[:muscle_count] + square[muscle_count:]
        is_slack = sample.usable & (tension < slack_tension(self._robot.tension.bias))
        slack_count = int(np.count_nonzero(is_slack))
        waits = False
        if slack_count:
            # A muscle without tension is more suspect than any other.
            score = np.where(is_slack, score + score.sum() + 1.0, score)
            if self._slack is not None:
                reads_longer = share[muscle_count:] < 0.0
                waits = bool((is_slack & self._slack.is_winding_in & reads_longer).any())
        suspect, others = int(score.argmax()), list[int]()
        evidence = ''
        if observation.lengths_known:
            evidence = self._evidence(observation, distance, slack_count > 0, waits)
        # If exactly one tendon is slack, it stays the suspect. If several are slack, some may be
        # healthy tendons that a rupture has made slack for a moment. The likelihood then decides
        # among the slack tendons. If no tendon is slack, the likelihood decides among all muscles
        # in use.
        is_first = evidence and self._beyond == IN_A_ROW
        if is_first and self.is_calibrated and slack_count != 1:
            candidates = is_slack if slack_count else sample.usable
            suspect, *others = self._suspects(sample.bone_tension, sample.length, candidates)
            if others:
                names = ' or '.join(self._robot.muscles[muscle] for muscle in others)
                evidence += f'; a fault of {names} would explain this as well'
        self.reading = Reading(distance, suspect)
        if not evidence:
            return None
        return Finding(suspect, ConditionKind.RESIDUAL_DISTANCE, evidence, tuple(others))

    def unfamiliarity(self, theta: Array) -> float:
        """Return how far a posture is from the nearest one in which the detector was calibrated.

        The distance is the root sum square of the joints' differences, each divided by the joint's
        range. It is divided by 0.25 (NEAR), so that a posture is unfamiliar above 1. Without
        calibrated postures, the result is 0.

        Args:
            theta: Joint angles [rad], (D,).
        """
        postures = None if self._statistics is None else self._statistics.postures
        if postures is None or not len(postures):
            return 0.0
        share = (postures - theta) / (self._robot.upper - self._robot.lower)
        return float(np.sqrt(np.square(share).sum(axis=1).min())) / NEAR

    def limit(self, theta: Array, sample: MuscleSample) -> float:
        """Return the threshold of the statistic in a posture; ∞ if it is not calibrated.

        Args:
            theta: Joint angles [rad], (D,).
            sample: The readings.
        """
        used = sample.usable
        highest = float(
            (sample.motor_tension[used] / self._robot.tension.limit[used]).max(initial=0.0)
        )
        factor = np.clip(max(self.unfamiliarity(theta), highest), 1.0, WIDEST)
        return self.threshold * float(factor)

    def statistic(self, observation: Observation, distance: float) -> float:  # noqa: ARG002
        """Return the statistic that is compared with the threshold: here, the distance d itself."""
        return distance

    def _evidence(
        self, observation: Observation, distance: float, has_slack: bool, waits: bool
    ) -> str:
        """Return the evidence for users after five messages in a row above the threshold, else ''.

        Args:
            observation: The message.
            distance: Residual distance d of the message.
            has_slack: Whether a tendon is slack. If so, the threshold does not grow.
            waits: Whether a slack tendon is being wound in. If so, the message is ignored.
        """
        if not self.is_calibrated:
            return ''
        limit, where = self.threshold, ''
        value = self.statistic(observation, distance)
        if value > limit and not has_slack:
            wider = self.limit(observation.estimate.state.theta, observation.sample)
            if wider > limit:
                limit = wider
                where = ' (raised for an unfamiliar posture or a tension above tension.limit)'
        self._beyond = self._beyond + 1 if value > limit and not waits else 0
        if self._beyond < IN_A_ROW:
            return ''
        reached, most = distinct(value, limit)
        exceeded = f'{self.symbol} = {reached} exceeded its threshold {most}{where}'
        return f'{exceeded} in {IN_A_ROW} consecutive messages'

    def _suspects(self, bone_tension: Array, length: Array, candidates: Bools) -> list[int]:
        """Return the indices of the suspect muscles among the candidates, the most suspect first.

        Without the first muscle, the residual of the other muscles is most likely on a healthy arm.
        The further muscles are those without which it is nearly as likely.

        Args:
            bone_tension: Bone-side tensions [N], (M,).
            length: Muscle lengths [m], (M,).
            candidates: The muscles that can be suspect, (M,).
        """
        assert self._mae is not None
        distance = np.full(len(candidates), np.inf)
        for muscle in np.flatnonzero(candidates).tolist():
            reduced = self._mae.without((*self._mae.isolated, muscle))
            assert reduced.anomaly is not None
            state = reduced.estimate(bone_tension, length)
            error = residuals(state, bone_tension, length, reduced.isolated)
            distance[muscle] = reduced.anomaly.distances(error[None])[0]
        suspect = int(distance.argmin())
        assert self._statistics is not None
        usual = self._statistics.thresholds.get(DISTANCE, np.inf)
        limit = min(usual, EQUALLY_LIKELY * distance[suspect])
        others = [m for m in np.flatnonzero(distance < limit).tolist() if m != suspect]
        return [suspect, *others]
