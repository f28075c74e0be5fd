# SPDX-License-Identifier: Apache-2.0
"""Detects a muscle that has no tension although tension is commanded: it is ruptured or slack.

    T < slack_share · T_ref for DEAD_TIME, and the tendon is not being wound in

The rule needs no statistics, because a healthy module maintains at least T_bias. A slow winch takes
time to wind in slack. The detector waits while the winch moves at `slack_speed` or faster, until it
has wound in `slack_length`. Changes of length that are due to the motion of the arm do not count.

A position-controlled module maintains no tension, so a healthy tendon is slack if a long length is
commanded. For these modules, the rule is that a tendon is stretched, but has no tension:

    T < slack_share · T_bias for DEAD_TIME, and x and x − x₀ > STRETCH · L_e(T_bias)
    x = l(θ, 0) − l,   x₀ = x − L_e(T) when the tendon was last taut

θ is estimated from the tendons that are not slack. x contains the error of the network, which may
be centimetres before the network has learned the arm. The readings just before the tension was lost
reveal this error, x₀. Both x and x − x₀ must be large. If a tendon ruptures while it carries no
load, the rupture is detected as soon as the tendon should carry load.
"""

from collections import deque

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.estimation.finding import Detector, Finding, Kind, Observation
from musculoskeletal_ae.estimation.settings import Detection
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.limits import LIMITS, share_outside
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

#: stretch of a tendon without tension above which it is ruptured, relative to the stretch at T_bias
STRETCH = 1.5
#: STRETCH without calibrated statistics: a network that has not learned the arm can estimate a
#: stretch of up to 1.5 for a healthy slack tendon
UNCALIBRATED_STRETCH = 3.0
#: STRETCH with motor currents, whose tensions are uncertain because of drive friction
CURRENT_STRETCH = 2.0
#: number of messages that are kept; the oldest one precedes a loss of tension in the newest one
RECENT = 5
DEAD_TIME = 0.5  # time without tension after which a muscle is reported [s]


class SlackTendon(Detector):
    """Measures how long each tendon has been slack, and whether it is being wound in.

    Attributes:
        is_winding_in: Whether each tendon is slack and being wound in, (M,).
    """

    def __init__(self, robot: Robot, settings: Detection) -> None:
        self._robot = self._complete_robot = robot
        self._settings = settings
        muscle_count = robot.muscle_count
        self._slack_time: Array = np.zeros(muscle_count)  # time without tension [s]
        #: time without tension and without winding in [s]
        self._idle_time: Array = np.zeros(muscle_count)
        self._taut_excess: Array = np.zeros(muscle_count)  # `excess` when the tension was lost [m]
        self._wound_length: Array = np.zeros(muscle_count)  # l when it was last wound in [m]
        self.is_winding_in: Bools = np.zeros(muscle_count, dtype=bool)

    def use(self, mae: Mae) -> None:
        """Monitor the muscles that are not isolated in this network."""
        self._mae, self._reduced = mae, dict[tuple[int, ...], Mae]()
        self._robot = self._complete_robot.without(mae.isolated)

    def configure(self, settings: Detection) -> None:
        """Use these settings."""
        self._settings = settings

    def reset(self) -> None:
        """Restart the measurement of how long tendons have been slack."""
        self._slack_time[:] = self._idle_time[:] = 0.0

    def step(self, observation: Observation) -> Finding | None:
        """Report a muscle that has been slack for DEAD_TIME seconds and is not being wound in."""
        sample, theta, dt = observation.sample, observation.estimate.state.theta, observation.dt
        tension, length = sample.motor_tension, sample.length
        demand = self._demand(observation)
        if demand is None:
            self.reset()
            self.is_winding_in[:] = False
            return None
        bias = self._robot.tension.bias
        is_slack = (tension < LIMITS.slack_share * demand) & (demand >= bias) & self._robot.used
        if not (np.count_nonzero(is_slack) or np.count_nonzero(self._slack_time)):
            self.is_winding_in[:] = False
            return None
        begins = is_slack & (self._slack_time == 0.0)
        # Remove the part of the length that the posture explains.
        excess = length - self._robot.routes.relative_lengths(theta) if is_slack.any() else length
        self._taut_excess = np.where(begins, excess, self._taut_excess)
        self._slack_time = np.where(is_slack, self._slack_time + dt, 0.0)
        # The winch is winding in if l decreases by at least slack_speed · DEAD_TIME in DEAD_TIME.
        advance = self._settings.slack_speed * DEAD_TIME
        winds = begins | (length < self._wound_length - advance)
        self._wound_length = np.where(winds, length, self._wound_length)
        self._idle_time = np.where(winds | ~is_slack, 0.0, self._idle_time + dt)
        has_wound_all = excess < self._taut_excess - self._settings.slack_length
        has_ended = (self._idle_time >= DEAD_TIME - dt) | has_wound_all
        self.is_winding_in = is_slack & ~has_ended
        is_dead = (self._slack_time >= DEAD_TIME) & has_ended
        if not is_dead.any():
            return None
        muscle = int(np.argmax(np.where(is_dead, self._slack_time, 0.0)))
        return Finding(
            muscle, Kind.SLACK_TENDON, 'it has no tension although the command demands tension'
        )

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
        is_slack = observation.sample.motor_tension < LIMITS.slack_share * bias
        if not is_implausible or is_slack[self._robot.used].all():
            return None
        return np.full(len(is_slack), bias)


class StretchedTendon(SlackTendon):
    """Measures how long each tendon has been stretched without tension.

    This class is for position-controlled modules. They do not wind in slack by themselves, so
    `is_winding_in` stays False.
    """

    def __init__(self, robot: Robot, settings: Detection) -> None:
        super().__init__(robot, settings)
        self._recent: deque[MuscleSample] = deque(maxlen=RECENT)
        #: the last message in which each slack tendon was taut, by muscle
        self._taut = dict[int, MuscleSample]()
        self._is_slack: Bools = np.zeros(robot.muscle_count, dtype=bool)

    def reset(self) -> None:
        """Restart the measurement of how long tendons have been stretched without tension."""
        super().reset()
        self._recent.clear()
        self._taut.clear()
        self._is_slack[:] = False

    def step(self, observation: Observation) -> Finding | None:
        """Report a muscle that has been stretched without tension for DEAD_TIME seconds."""
        sample, bias = observation.sample, self._robot.tension.bias
        is_slack = (sample.motor_tension < LIMITS.slack_share * bias) & self._robot.used
        if self._recent:
            for m in np.flatnonzero(is_slack & ~self._is_slack).tolist():
                self._taut[m] = self._recent[0]
        self._recent.append(sample)
        self._is_slack = is_slack
        is_dead = is_slack & observation.lengths_known
        if np.count_nonzero(is_dead):
            is_dead &= self._is_stretched(sample, tuple(np.flatnonzero(is_slack).tolist()))
        self._slack_time = np.where(is_dead, self._slack_time + observation.dt, 0.0)
        if self._slack_time.max() < DEAD_TIME - 1e-9:
            return None
        muscle = int(self._slack_time.argmax())
        return Finding(muscle, Kind.SLACK_TENDON, 'it is stretched, but has no tension')

    def _is_stretched(self, sample: MuscleSample, slack: tuple[int, ...]) -> Bools:
        """Return a mask (M,) of slack muscles so short that a healthy tendon would have tension."""
        robot, mae = self._robot, self._mae
        isolated = tuple(sorted({*robot.isolated, *slack}))
        if robot.muscle_count - len(isolated) <= robot.joint_count:
            return np.zeros(robot.muscle_count, dtype=bool)  # the other muscles do not determine θ
        if isolated not in self._reduced:
            self._reduced[isolated] = mae.without(isolated)
        is_calibrated = mae.anomaly is not None and mae.anomaly.calibrated
        share = STRETCH if is_calibrated else UNCALIBRATED_STRETCH
        if is_calibrated and robot.tension_source.is_current:
            share = CURRENT_STRETCH
        enough = share * robot.elongation(robot.description.tension.bias)
        stretch = self._stretch(sample, isolated)
        is_stretched: Bools = stretch > enough
        for m in np.flatnonzero(is_stretched & self._is_slack).tolist():
            if (taut := self._taut.get(m)) is None:
                continue
            error = self._stretch(taut, isolated)[m] - robot.elongation(taut.bone_tension)[m]
            is_stretched[m] = stretch[m] - error > enough[m]
        return is_stretched

    def _stretch(self, sample: MuscleSample, isolated: tuple[int, ...]) -> Array:
        """Return x [m] (M,), for which θ is estimated without the `isolated` muscles."""
        theta = self._reduced[isolated].estimate(sample.bone_tension, sample.length).theta
        tension = sample.bone_tension.copy()
        tension[list(isolated)] = 0.0
        stretch: Array = self._mae.lengths(theta, tension) - sample.length
        return stretch
