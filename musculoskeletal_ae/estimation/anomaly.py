# SPDX-License-Identifier: Apache-2.0
"""Notice that the body is not the one the network knows, and say which muscle it is.

    A = ‖T_est − T‖₂ + ‖l_est − l‖₂          scaled units (paper, section "State Estimation")
    d = √((e − μ)ᵀ Σ⁻¹ (e − μ)),  e = (T_est − T, l_est − l)

A is published as it is. Its healthy size differs from posture to posture, so the decision rests on
d, in which every muscle's residual is measured in units of its healthy spread (detector printed in
arXiv 2407.08050). Healthy statistics come from the real arm; those of the geometric model would
call most healthy postures anomalous, so without calibrated ones nothing is latched from d.

What the network restores is worse in postures that nothing was calibrated in, so the threshold
widens with the distance to the nearest that was (`unfamiliar`); and in proportion to a tension
beyond T_limit, of which networks are shown little. A muscle that is cut pulls nothing, there as
anywhere: while one is slack, nothing widens.

d says that something is wrong, but it is shared by muscles. The suspect is the one without which
the rest is most likely.

Physics needs no statistics: a module holds at least T_bias, so a muscle whose tension stays near
zero while much is commanded has no wire, or a slack one. Slack is wound in by a slow winch, and no
longer than it can be; meanwhile the rule waits. So does d, as long as that muscle reads longer than
② restores it: slack wire is too long, and what is left of a cut one too short.

A winch that is jammed may say nothing that a posture would not explain. But it stands, though its
tension is far from what is commanded.

Preset `paper` decides on A alone, against the checkpoint's threshold of A.
"""

import math
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.estimation.settings import Detection
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import AnomalyStatistics, residuals
from musculoskeletal_ae.mae.units import State
from musculoskeletal_ae.plausibility import ESTIMATE_OUTSIDE, SLACK, outside_limits
from musculoskeletal_ae.presets import preset_named
from musculoskeletal_ae.robot.robot import Robot

#: Names of the thresholds of d and A among those of the checkpoint.
DISTANCE, NORM = 'distance', 'norm'

IN_A_ROW = 5  # messages beyond the threshold that make a decision
DEAD_TIME = 0.5  # [s] a muscle has to stay without tension
#: a winch is jammed that stands, but for so much, so long, so far from the tension it is to have:
#: in newtons and as a share of it, since tension sensors differ in gain
STANDS, JAM_TIME, JAM, JAM_SHARE = 0.001, 1.0, 50.0, 0.3  # [m], [s], [N]
#: from NEAR on, a share of the joint ranges, the threshold grows with the distance, WIDEST times
#: at most, as it does with the highest tension, from T_limit on
NEAR, WIDEST = 0.25, 3.0


class Verdict(NamedTuple):
    """What one message says."""

    anomaly: float  # A, scaled units
    distance: float  # d, in healthy standard deviations; NaN without statistics
    suspect: int  # index of the most suspect muscle
    cause: str  # why this message completes a detection, or ''


class AnomalyDetector:
    """Decides message by message; keeps only its counters. The caller latches.

    A beyond the threshold is an anomaly; with threshold 0 the calibrated detector decides.
    """

    def __init__(
        self, robot: Robot, settings: Detection | None = None, preset: str = 'default'
    ) -> None:
        self._robot, self.whitened = robot, preset_named(preset).whitened
        self.settings = settings or Detection()
        self.judges = True  # whether d and A decide; not while lengths are unknown
        self._statistics: AnomalyStatistics | None = None
        self._farthest = np.inf  # d, or A, of its threshold, where it is calibrated
        #: [s] without tension, without winding in; l [m] beyond what the posture explains when
        #: tension went, and l when it wound last
        self._torn, self._stood, self._tight, self._wound = np.zeros((4, robot.muscle_count))
        #: [s] of a winch that stands, where [m]
        self._jammed, self._stands = np.zeros((2, robot.muscle_count))
        self._winds_slack: Bools = np.zeros(robot.muscle_count, dtype=bool)
        self._beyond = 0
        self.commanded()

    def use(self, mae: Mae) -> None:
        """Take the healthy statistics of a checkpoint."""
        if mae.anomaly is not None:
            self._whiten: Array = np.linalg.inv(np.linalg.cholesky(mae.anomaly.covariance))
            self._spread = np.sqrt(np.diag(mae.anomaly.covariance))
        self._mae, self._statistics, self._farthest = mae, mae.anomaly, np.inf
        if mae.anomaly is not None and mae.anomaly.calibrated:
            name = DISTANCE if self.whitened else NORM
            self._farthest = mae.anomaly.thresholds.get(name, np.inf)

    @property
    def calibrated(self) -> bool:
        """Whether the checkpoint's statistics come from the real arm."""
        return self._statistics is not None and self._statistics.calibrated

    def reset(self) -> None:
        """Forget counts, as after a jump of the clock or a reset by the user."""
        self._torn[:] = self._stood[:] = self._jammed[:] = 0.0
        self._beyond = 0

    def commanded(self, length: Array | None = None, tension: Array | None = None) -> None:
        """Note the targets that the modules follow, [m] or [N] (M,); neither: they follow none."""
        self._length_command, self._tension_command = length, tension

    def step(
        self, state: State, end_tension: Array, tension: Array, length: Array, dt: float
    ) -> Verdict:
        """Judge measured T [N] and l [m] (M,); ② restored the state from T_end and l.

        It came dt [s] after the message before.
        """
        error = residuals(state, end_tension, length, self._robot.isolated)
        muscles, distance, share = len(tension), math.nan, error
        pull, shift = error[:muscles], error[muscles:]
        size = math.sqrt(pull @ pull) + math.sqrt(shift @ shift)
        if self._statistics is not None:
            centred = error - self._statistics.mean
            white = self._whiten @ centred
            distance = math.sqrt(white @ white)
            share = centred / self._spread
        square = share * share
        score = square[:muscles] + square[muscles:]
        demand = None
        if self._length_command is not None:
            demand = self._robot.demanded(length, self._length_command)
        dead = self._dead(state.theta, tension, length, demand, dt)
        if dead is not None and self.whitened:
            return Verdict(size, distance, dead, 'no tension where the command demands it')
        asked = self._tension_command if demand is None else demand
        jammed = self._jam(tension, length, asked, dt)
        if jammed is not None and self.whitened and self.judges:
            return Verdict(size, distance, jammed, 'its winch stands, whatever is commanded')
        # A muscle without tension is the one, whatever the others' residuals make of it.
        slack = self._robot.used & (tension < SLACK * self._robot.tension.bias)
        count, waits, cause = int(np.count_nonzero(slack)), False, ''
        if count:
            score = np.where(slack, score + score.sum() + 1.0, score)
            winds = slack & self._winds_slack & (share[muscles:] < 0.0)
            waits = bool(winds.any()) and self.whitened
        suspect = int(score.argmax())
        if self.judges:
            cause = self._beyond_threshold(size, distance, state.theta, tension, count, waits)
        # Where one is cut, another may be slack for a moment.
        if cause and self._beyond == IN_A_ROW and self.calibrated and count != 1:
            among = slack if count else self._robot.used
            suspect = self._unlikeliest(end_tension, length, among)
        return Verdict(size, distance, suspect, cause)

    def unfamiliar(self, theta: Array) -> float:
        """Return how far θ [rad] (D,) is from all calibrated postures, over NEAR; 1: unfamiliar."""
        known = None if self._statistics is None else self._statistics.postures
        if known is None or not len(known):
            return 0.0
        share = (known - theta) / (self._robot.upper - self._robot.lower)
        return float(np.sqrt(np.square(share).sum(axis=1).min())) / NEAR

    def limit(self, theta: Array, tension: Array) -> float:
        """Return the d, or A, that no healthy arm reaches at θ [rad] (D,) and T [N] (M,), or ∞."""
        if not self.whitened:
            return self._farthest
        used = self._robot.used
        tense = float((tension[used] / self._robot.tension.limit[used]).max(initial=0.0))
        return self._farthest * float(np.clip(max(self.unfamiliar(theta), tense), 1.0, WIDEST))

    def _beyond_threshold(
        self, anomaly: float, distance: float, theta: Array, tension: Array, slack: int,
        waits: bool,
    ) -> str:  # fmt: skip
        limit, value, what, where = self.settings.anomaly_threshold, anomaly, 'A', ''
        if limit <= 0.0:
            if not self.calibrated:
                return ''
            limit = self._farthest
            if self.whitened:
                value, what = distance, 'd'
            if value > limit and not slack and (wider := self.limit(theta, tension)) > limit:
                limit, where = wider, ', wider in an unfamiliar posture or beyond tension.limit,'
        self._beyond = self._beyond + 1 if value > limit and not waits else 0
        if self._beyond < IN_A_ROW:
            return ''
        return f'{what} = {value:.3g} above {limit:.3g}{where} in {IN_A_ROW} messages running'

    def _unlikeliest(self, tension: Array, length: Array, among: Bools) -> int:
        """Return the muscle without which the rest is most likely."""
        isolated, distance = self._robot.isolated, np.full(len(among), np.inf)
        for muscle in np.flatnonzero(among).tolist():
            less = self._mae.without((*isolated, muscle))
            assert less.anomaly is not None
            error = residuals(less.estimate(tension, length), tension, length, less.isolated)
            distance[muscle] = less.anomaly.distances(error[None])[0]
        return int(distance.argmin())

    def _jam(self, tension: Array, length: Array, demand: Array | None, dt: float) -> int | None:
        if demand is None:
            self._jammed[:] = 0.0
            return None
        demand = np.minimum(demand, self._robot.tension.max)
        far = np.abs(tension - demand) > np.maximum(JAM, JAM_SHARE * demand)
        told = far & self._robot.used
        if not np.count_nonzero(told):
            self._stands, self._jammed[:] = length, 0.0
            return None
        stands = told & (np.abs(length - self._stands) < STANDS)
        self._stands = np.where(stands, self._stands, length)
        self._jammed = np.where(stands, self._jammed + dt, 0.0)
        return int(self._jammed.argmax()) if self._jammed.max() >= JAM_TIME else None

    def _dead(
        self, theta: Array, tension: Array, length: Array, demand: Array | None, dt: float
    ) -> int | None:
        bias = self._robot.tension.bias
        demand = self._tension_command if demand is None else demand
        if demand is None:
            # Nobody commands an arm whose estimate makes no sense: then modules hold T_bias.
            lost = outside_limits(self._robot, theta).max() > ESTIMATE_OUTSIDE
            if not lost or (tension < SLACK * bias)[self._robot.used].all():
                self._torn[:] = self._stood[:] = 0.0
                self._winds_slack[:] = False
                return None
            demand = np.full(len(tension), bias)
        torn = (tension < SLACK * demand) & (demand >= bias) & self._robot.used
        if not (np.count_nonzero(torn) or np.count_nonzero(self._torn)):
            self._winds_slack[:] = False
            return None
        begins = torn & (self._torn == 0.0)
        # What an arm that moves makes shorter is no slack.
        beyond = length - self._robot.routes.relative_lengths(theta) if torn.any() else length
        self._tight = np.where(begins, beyond, self._tight)
        self._torn = np.where(torn, self._torn + dt, 0.0)
        # It winds as long as every DEAD_TIME brings a new shortest length, by the slowest winch's.
        winds = begins | (length < self._wound - self.settings.slack_speed * DEAD_TIME)
        self._wound = np.where(winds, length, self._wound)
        self._stood = np.where(winds | ~torn, 0.0, self._stood + dt)
        spent = beyond < self._tight - self.settings.slack_length
        gone = (self._stood >= DEAD_TIME - dt) | spent
        self._winds_slack = torn & ~gone
        dead = (self._torn >= DEAD_TIME) & gone
        return int(np.argmax(np.where(dead, self._torn, 0.0))) if dead.any() else None
