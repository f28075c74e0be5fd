# SPDX-License-Identifier: Apache-2.0
"""Detects a muscle that has no tension although tension is commanded: it is ruptured or slack.

    T < SLACK_SHARE · T_ref for DEAD_TIME, and the tendon is not being wound in

T is the measured and T_ref the demanded tension. The rule needs no statistics, because a healthy
module maintains at least T_bias. A slow winch takes time to wind in slack. The detector waits while
the winch moves at SLACK_SPEED or faster, until it has wound in SLACK_LENGTH. Changes of length that
are due to the motion of the arm do not count towards SLACK_LENGTH, but they do count towards the
speed.

A position-controlled module maintains no tension, so a healthy tendon is slack if a long length is
commanded. Such a module is reported if its tendon is stretched, but has no tension:

    T < T_slack for DEAD_TIME, and d − d̄ > SIGMAS · σ,   d = l(θ, T_slack) − l
    T_slack = SLACK_SHARE · T_bias

d is the stretch: the length that the network computes for a barely taut tendon, minus the measured
length l. The joint angles θ are estimated from the tendons that are not slack. d contains errors of
the network, which may be centimetres before the network has learned the arm. Mean d̄ and standard
deviation σ of these errors follow from the readings with which the tendon was last taut, and from
the covariance of the network's errors (`estimation/lengths/length_errors.py`). Just after a loss of
tension, σ is small. The farther the arm moves from the posture in which the tendon was taut, the
larger σ becomes. If a tendon ruptures while it carries no load, the rupture is detected as soon as
the tendon should carry load.
"""

from collections import deque

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.finding import Detector, Finding, Observation
from musculoskeletal_ae.estimation.lengths.length_errors import LengthErrors, Prediction
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_stream import MuscleSample
from musculoskeletal_ae.signals.reading_limits import LIMITS, share_outside, slack_tension

#: report a tendon without tension if its stretch exceeds the expected stretch by this many standard
#: deviations
SIGMAS = 3.0
#: Treat a tendon as taut if its tension exceeds T_slack by this many standard deviations. Tensions
#: from motor currents are uncertain; the standard deviation of a tension sensor is taken as 0.
SURE = 2.0
#: Take the stretch of a taut tendon from the first of this many consecutive messages in which it
#: was taut: that message certainly came before the tendon began to lose its tension.
RECENT = 5
#: while a muscle module winds in slack, wait until it has wound in this length before the muscle is
#: reported [m]
SLACK_LENGTH = 0.06
SLACK_SPEED = 0.005  # stop waiting for a muscle module that winds in more slowly than this [m/s]
DEAD_TIME = 0.5  # report a muscle that has had no tension for this long [s]


class SlackTendon(Detector):
    """Reports a muscle whose tendon has been slack for some time and is not being wound in.

    Attributes:
        is_winding_in: Which tendons are slack and still being wound in, (M,).
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        muscle_count = robot.muscle_count
        self._slack_time: Array = np.zeros(muscle_count)  # time without tension [s]
        #: time without tension and without winding in [s]
        self._idle_time: Array = np.zeros(muscle_count)
        #: measured length minus route length when the tendon became slack [m]
        self._taut_excess: Array = np.zeros(muscle_count)
        self._wound_length: Array = np.zeros(muscle_count)  # length when last wound in [m]
        self.is_winding_in: Bools = np.zeros(muscle_count, dtype=bool)

    def reset(self) -> None:
        """Reset the detector: measure anew how long tendons have been slack."""
        self._slack_time[:] = self._idle_time[:] = 0.0

    def step(self, observation: Observation) -> Finding | None:
        """Report a muscle that has been slack for 0.5 s and is not being wound in.

        The result is None if there is no such muscle.
        """
        sample, theta, dt = observation.sample, observation.estimate.state.theta, observation.dt
        tension, length = sample.motor_tension, sample.length
        demand = self._demand(observation)
        if demand is None:
            self.reset()
            self.is_winding_in[:] = False
            return None
        bias = self._robot.tension.bias
        is_slack = (tension < slack_tension(demand)) & (demand >= bias) & sample.usable
        if not (np.count_nonzero(is_slack) or np.count_nonzero(self._slack_time)):
            self.is_winding_in[:] = False
            return None
        begins = is_slack & (self._slack_time == 0.0)
        # Subtract the part of the length that the estimated posture explains.
        excess = length - self._robot.routes.relative_lengths(theta) if is_slack.any() else length
        self._taut_excess = np.where(begins, excess, self._taut_excess)
        self._slack_time = np.where(is_slack, self._slack_time + dt, 0.0)
        # The winch is winding in if l decreases by at least SLACK_SPEED · DEAD_TIME in DEAD_TIME.
        advance = SLACK_SPEED * DEAD_TIME
        winds = begins | (length < self._wound_length - advance)
        self._wound_length = np.where(winds, length, self._wound_length)
        self._idle_time = np.where(winds | ~is_slack, 0.0, self._idle_time + dt)
        has_wound_all = excess < self._taut_excess - SLACK_LENGTH
        has_ended = (self._idle_time >= DEAD_TIME - dt) | has_wound_all
        self.is_winding_in = is_slack & ~has_ended
        is_dead = (self._slack_time >= DEAD_TIME) & has_ended
        if not is_dead.any():
            return None
        muscle = int(np.argmax(np.where(is_dead, self._slack_time, 0.0)))
        shown, demanded = round(float(tension[muscle])), round(float(demand[muscle]))
        evidence = f'its tension is {shown} N, but {demanded} N are demanded'
        return Finding(muscle, ConditionKind.SLACK_TENDON, evidence)

    def _demand(self, observation: Observation) -> Array | None:
        """Return the demanded tension [N] (M,), or None if it is unknown.

        The demand is unknown without a command, with one exception: while the estimate is
        implausible, the controller sends no commands, and the modules hold T_bias. Then T_bias is
        returned, unless all muscles are slack.
        """
        if observation.demand is not None:
            return observation.demand
        bias, theta = self._robot.tension.bias, observation.estimate.state.theta
        is_implausible = share_outside(self._robot, theta).max() > LIMITS.estimate_outside
        sample = observation.sample
        is_slack = sample.motor_tension < slack_tension(bias)
        if not is_implausible or is_slack[sample.usable].all():
            return None
        return np.full(len(is_slack), bias)


class StretchedTendon(SlackTendon):
    """Reports a muscle whose tendon has had no tension for some time although it is stretched.

    A tendon is stretched if its length is so short that a healthy tendon would have tension. This
    class is for position-controlled modules. They do not wind in slack by themselves, so
    `is_winding_in` stays False.
    """

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self._recent: deque[MuscleSample] = deque(maxlen=RECENT)
        #: number of consecutive messages in which each tendon has been taut, (M,)
        self._taut_count: Ints = np.zeros(robot.muscle_count, dtype=int)
        #: for each muscle, the first of the last RECENT consecutive messages in which it was taut
        self._taut = dict[int, MuscleSample]()
        #: for each slack muscle, its message in `_taut`, the muscles that were not slack, and the
        #: prediction from that message by these muscles
        self._taut_predictions = dict[int, tuple[MuscleSample, Bools, Prediction]]()

    def use(self, mae: Mae) -> None:
        """Use another network to predict lengths."""
        self._errors = LengthErrors(self._robot, mae)
        self._taut_predictions.clear()

    def reset(self) -> None:
        """Reset the detector: measure anew how long tendons have been stretched without tension."""
        super().reset()
        self._recent.clear()
        self._taut_count[:] = 0
        self._taut.clear()
        self._taut_predictions.clear()

    def step(self, observation: Observation) -> Finding | None:
        """Report a muscle that has been stretched without tension for 0.5 s.

        The result is None if there is no such muscle.
        """
        sample, used = observation.sample, observation.sample.usable
        lowest = self._slack_tension
        is_slack = (sample.motor_tension < lowest) & used
        self._recent.append(sample)
        is_taut = sample.motor_tension - SURE * sample.tension_spread >= lowest
        self._taut_count = np.where(is_taut & used, self._taut_count + 1, 0)
        for m in np.flatnonzero(self._taut_count >= RECENT).tolist():
            self._taut[m] = self._recent[0]
        is_dead = is_slack & observation.lengths_known
        if np.count_nonzero(is_dead):
            is_dead &= self._is_stretched(sample, is_slack, observation.estimate.state.theta)
        self._slack_time = np.where(is_dead, self._slack_time + observation.dt, 0.0)
        if self._slack_time.max() < DEAD_TIME - 1e-9:
            return None
        muscle = int(self._slack_time.argmax())
        shown = round(float(sample.motor_tension[muscle]))
        evidence = f'it is so short that it should have tension, but its tension is {shown} N'
        return Finding(muscle, ConditionKind.SLACK_TENDON, evidence)

    @property
    def _slack_tension(self) -> Array:
        """Tension below which each tendon is regarded as slack [N], (M,): SLACK_SHARE · T_bias."""
        return slack_tension(self._robot.tension.bias)

    def _is_stretched(self, sample: MuscleSample, is_slack: Bools, start: Array) -> Bools:
        """Return which slack tendons are so short that a healthy tendon would have tension, (M,).

        Args:
            sample: The readings.
            is_slack: The muscles without tension, (M,).
            start: Initial values of the joint angles, which are fitted to the lengths of the
                muscles with tension [rad], (D,).
        """
        used = sample.usable & ~is_slack
        tension = np.where(is_slack, self._slack_tension, sample.bone_tension)
        now = self._errors.predict(sample.length, tension, sample.tension_spread, used, start)
        is_stretched = np.zeros(len(is_slack), dtype=bool)
        for m in np.flatnonzero(is_slack).tolist():
            prediction = now
            if m in self._taut:
                taut = self._taut_prediction(m, used, now.theta)
                prediction = self._errors.given(now, taut, m)
            is_stretched[m] = prediction.excess[m] > prediction.limit(m, SIGMAS)
        return is_stretched

    def _taut_prediction(self, muscle: int, used: Bools, start: Array) -> Prediction:
        """Predict the lengths at the last moment when a tendon, which is now slack, was taut.

        The posture of that moment is fitted to the lengths of the same muscles as the present
        posture, so that the errors of both predictions can be compared.

        Args:
            muscle: Index of the slack muscle.
            used: The muscles to whose lengths the posture is fitted, (M,).
            start: Initial values of the joint angles [rad], (D,).
        """
        sample = self._taut[muscle]
        if muscle in self._taut_predictions:
            stored, used_then, prediction = self._taut_predictions[muscle]
            if stored is sample and (used_then == used).all():
                return prediction
        prediction = self._errors.predict(
            sample.length, sample.bone_tension, sample.tension_spread, used, start
        )
        self._taut_predictions[muscle] = sample, used, prediction
        return prediction
