# SPDX-License-Identifier: Apache-2.0
"""Detect that the body is not the one that the network knows, by what the network leaves.

    d = √((e − μ)ᵀ Σ⁻¹ (e − μ)),  e = (T_est − T, l_est − l)      (arXiv 2407.08050)

A, the size of e, is published as it is. Its healthy value differs from posture to posture.
Therefore the decision rests on d, which measures the residual of every muscle in units of its
healthy spread. The healthy statistics μ, Σ come from the real arm. Those of the geometric model
would call most healthy postures anomalous: without calibrated ones nothing is decided by d.

The threshold of d widens with the distance to the nearest calibrated posture (`unfamiliarity`),
where the network restores worse, and in proportion to a tension beyond T_limit, of which networks
have learned little. A ruptured muscle has no tension anywhere: while a tendon is slack, nothing
widens.

d tells that something is wrong, but all muscles share it. The suspect is the muscle without which
the remaining residual is most likely.

While slack is being wound in, d waits as long as that muscle reads longer than ② restores it: a
slack tendon is too long, and the rest of a ruptured one is too short.

If the parameter `anomaly_threshold` is set, A decides against it.
"""

import math
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.estimation.detectors.slack_tendon import SlackTendon
from musculoskeletal_ae.estimation.finding import Detector, Finding, Kind, Observation
from musculoskeletal_ae.estimation.settings import Detection
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import AnomalyStatistics, residuals
from musculoskeletal_ae.report import distinct
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.limits import LIMITS

#: Names of the thresholds of d and A among those of the checkpoint.
DISTANCE, NORM = 'distance', 'norm'

IN_A_ROW = 5  # consecutive messages beyond the threshold that make a finding
#: From NEAR on, a share of the joint ranges, the threshold grows with the distance to calibrated
#: postures, to WIDEST times at most. So it does with the highest tension, from T_limit on.
NEAR, WIDEST = 0.25, 3.0


class Reading(NamedTuple):
    """What the detector computed from the last message."""

    distance: float  # d, in healthy standard deviations; NaN without statistics
    suspect: int  # the most suspect muscle


class ResidualDistance(Detector):
    """Decides by d and names the most suspect muscle.

    A subclass may decide by another statistic of the residual.

    Attributes:
        symbol: Of the statistic that decides, for people to read.
        threshold_name: Of its threshold among those of the checkpoint.
        threshold: As it is in the checkpoint, if that is calibrated; ∞ otherwise.
        reading: Of the last message; None before the first.
    """

    symbol, threshold_name = 'd', DISTANCE

    def __init__(self, robot: Robot, settings: Detection, slack: SlackTendon | None = None) -> None:
        """Begin.

        Args:
            robot: The nominal body.
            settings: With the threshold of A, if the user has set one.
            slack: Says which tendons are being taken up, so that d waits; None: it never waits.
        """
        self._robot = self._complete_robot = robot
        self._settings, self._slack = settings, slack
        self._mae: Mae | None = None
        self._statistics: AnomalyStatistics | None = None
        self.threshold = np.inf
        self._beyond = 0  # consecutive messages beyond the threshold
        self.reading: Reading | None = None

    @property
    def is_calibrated(self) -> bool:
        """Whether the healthy statistics come from the real arm."""
        return self._statistics is not None and self._statistics.calibrated

    def use(self, mae: Mae) -> None:
        """Use this network and its healthy statistics."""
        statistics = mae.anomaly
        if statistics is not None:
            self._whiten: Array = np.linalg.inv(np.linalg.cholesky(statistics.covariance))
            self._spread = np.sqrt(np.diag(statistics.covariance))
        self._mae, self._statistics, self.threshold = mae, statistics, np.inf
        self._robot = self._complete_robot.without(mae.isolated)
        if statistics is not None and statistics.calibrated:
            self.threshold = statistics.thresholds.get(self.threshold_name, np.inf)

    def configure(self, settings: Detection) -> None:
        """Use these settings."""
        self._settings = settings

    def reset(self) -> None:
        """Forget the consecutive messages."""
        self._beyond = 0

    def forget_reading(self) -> None:
        """Forget the last message, as when lengths are measured from other offsets."""
        self.reading = None

    def step(self, observation: Observation) -> Finding | None:
        """Take a message."""
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
        is_slack = self._robot.used & (tension < LIMITS.slack_share * self._robot.tension.bias)
        slack_count = int(np.count_nonzero(is_slack))
        waits = False
        if slack_count:
            # The suspect is a muscle without tension, whatever the residuals of the others are.
            score = np.where(is_slack, score + score.sum() + 1.0, score)
            if self._slack is not None:
                reads_longer = share[muscle_count:] < 0.0
                waits = bool((is_slack & self._slack.is_winding_in & reads_longer).any())
        suspect = int(score.argmax())
        evidence = ''
        if observation.lengths_known:
            evidence = self._evidence(observation, distance, slack_count > 0, waits)
        # Where one tendon has ruptured, another may be slack for a moment.
        is_first = evidence and self._beyond == IN_A_ROW
        if is_first and self.is_calibrated and slack_count != 1:
            candidates = is_slack if slack_count else self._robot.used
            suspect = self._least_likely(sample.bone_tension, sample.length, candidates)
        self.reading = Reading(distance, suspect)
        return Finding(suspect, Kind.RESIDUAL_DISTANCE, evidence) if evidence else None

    def unfamiliarity(self, theta: Array) -> float:
        """Return the distance of θ [rad] (D,) to the nearest calibrated posture, over NEAR.

        Beyond 1 the posture is unfamiliar.
        """
        postures = None if self._statistics is None else self._statistics.postures
        if postures is None or not len(postures):
            return 0.0
        share = (postures - theta) / (self._robot.upper - self._robot.lower)
        return float(np.sqrt(np.square(share).sum(axis=1).min())) / NEAR

    def limit(self, theta: Array, tension: Array) -> float:
        """Return the threshold of d at θ [rad] (D,) and T [N] (M,); ∞ without one."""
        used = self._robot.used
        highest = float((tension[used] / self._robot.tension.limit[used]).max(initial=0.0))
        factor = np.clip(max(self.unfamiliarity(theta), highest), 1.0, WIDEST)
        return self.threshold * float(factor)

    def statistic(self, observation: Observation, distance: float) -> float:  # noqa: ARG002
        """Return what decides: d."""
        return distance

    def _evidence(
        self, observation: Observation, distance: float, has_slack: bool, waits: bool
    ) -> str:
        """Count messages beyond the threshold; return the figures once they are enough, or ''."""
        limit, value, name = self._settings.anomaly_threshold, observation.estimate.anomaly, 'A'
        where = ''
        if limit <= 0.0:
            if not self.is_calibrated:
                return ''
            limit = self.threshold
            value, name = self.statistic(observation, distance), self.symbol
            if value > limit and not has_slack:
                theta, tension = observation.estimate.state.theta, observation.sample.motor_tension
                wider = self.limit(theta, tension)
                if wider > limit:
                    limit = wider
                    where = ', wider in an unfamiliar posture or beyond tension.limit,'
        self._beyond = self._beyond + 1 if value > limit and not waits else 0
        if self._beyond < IN_A_ROW:
            return ''
        reached, most = distinct(value, limit)
        return f'{name} = {reached} above {most}{where} in {IN_A_ROW} consecutive messages'

    def _least_likely(self, bone_tension: Array, length: Array, candidates: Bools) -> int:
        """Return the muscle without which the remaining residual is most likely."""
        assert self._mae is not None
        distance = np.full(len(candidates), np.inf)
        for muscle in np.flatnonzero(candidates).tolist():
            reduced = self._mae.without((*self._robot.isolated, muscle))
            assert reduced.anomaly is not None
            state = reduced.estimate(bone_tension, length)
            error = residuals(state, bone_tension, length, reduced.isolated)
            distance[muscle] = reduced.anomaly.distances(error[None])[0]
        return int(distance.argmin())
