# SPDX-License-Identifier: Apache-2.0
"""Detect a muscle that does not pull although it is commanded to: its tendon ruptured or is slack.

    T < slack_share · T_ref for DEAD_TIME, and not being wound in

This rule is physics and needs no statistics: a module holds at least T_bias. Slack is wound in by a
slow winch, for as long as there can be slack (parameters `slack_speed`, `slack_length`). Meanwhile
the rule waits. What an arm in motion makes shorter is no slack that was wound in.
"""

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.estimation.finding import Detector, Finding, Kind, Observation
from musculoskeletal_ae.estimation.settings import Detection
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.limits import LIMITS, share_outside

DEAD_TIME = 0.5  # [s] that a muscle has to be without tension


class SlackTendon(Detector):
    """Measures for how long each tendon has been slack, and whether its winch takes it up.

    Attributes:
        is_winding_in: Which slack tendons are being taken up, (M,).
    """

    def __init__(self, robot: Robot, settings: Detection) -> None:
        self._robot = self._complete_robot = robot
        self._settings = settings
        muscle_count = robot.muscle_count
        self._slack_time: Array = np.zeros(muscle_count)  # [s] without tension
        self._idle_time: Array = np.zeros(muscle_count)  # [s] of that without winding in
        self._taut_excess: Array = np.zeros(muscle_count)  # `excess` [m] when the tension went
        self._wound_length: Array = np.zeros(muscle_count)  # l [m] when it was last wound in
        self.is_winding_in: Bools = np.zeros(muscle_count, dtype=bool)

    def use(self, mae: Mae) -> None:
        """Judge the muscles that are not isolated in this network."""
        self._robot = self._complete_robot.without(mae.isolated)

    def configure(self, settings: Detection) -> None:
        """Use these settings."""
        self._settings = settings

    def reset(self) -> None:
        """Begin to measure times again."""
        self._slack_time[:] = self._idle_time[:] = 0.0

    def step(self, observation: Observation) -> Finding | None:
        """Take a message."""
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
        # What the posture does not explain of the length.
        excess = length - self._robot.routes.relative_lengths(theta) if is_slack.any() else length
        self._taut_excess = np.where(begins, excess, self._taut_excess)
        self._slack_time = np.where(is_slack, self._slack_time + dt, 0.0)
        # A winch winds in as long as every DEAD_TIME brings a new shortest length, at its speed.
        advance = self._settings.slack_speed * DEAD_TIME
        winds = begins | (length < self._wound_length - advance)
        self._wound_length = np.where(winds, length, self._wound_length)
        self._idle_time = np.where(winds | ~is_slack, 0.0, self._idle_time + dt)
        all_taken_up = excess < self._taut_excess - self._settings.slack_length
        has_ended = (self._idle_time >= DEAD_TIME - dt) | all_taken_up
        self.is_winding_in = is_slack & ~has_ended
        is_dead = (self._slack_time >= DEAD_TIME) & has_ended
        if not is_dead.any():
            return None
        muscle = int(np.argmax(np.where(is_dead, self._slack_time, 0.0)))
        return Finding(muscle, Kind.SLACK_TENDON, 'no tension where the command demands it')

    def _demand(self, observation: Observation) -> Array | None:
        """Return T that the muscles have to pull with [N], (M,), or None where it is unknown.

        While the estimate is impossible, the controller sends no commands, and the modules hold
        T_bias.
        """
        if observation.demand is not None:
            return observation.demand
        bias, theta = self._robot.tension.bias, observation.estimate.state.theta
        is_senseless = share_outside(self._robot, theta).max() > LIMITS.estimate_outside
        is_slack = observation.sample.motor_tension < LIMITS.slack_share * bias
        if not is_senseless or is_slack[self._robot.used].all():
            return None
        return np.full(len(is_slack), bias)
