# SPDX-License-Identifier: Apache-2.0
"""Turns raw messages into samples: new rests of the arm that are safe to learn from.

    l, T ─► plausible (`signals.muscle_stream`) ─┐
    θ ─► plausible and trusted (`joint_stream`) ─┤
    gravity ─────────────────────────────────────┴► paired by time (`pairing`)
         ─► at rest (`rest`) ─► no anomaly near (`anomaly_margin`) ─► new (`samples`)

Values of isolated muscles are replaced by 0 before messages are paired. The store records which
muscles a sample describes.
"""

import math
from collections import Counter
from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.body_model.observations import NOTHING, Sample
from musculoskeletal_ae.learning.anomaly_margin import AnomalyMargin
from musculoskeletal_ae.learning.detector_calibration import Reservoir
from musculoskeletal_ae.learning.rest import REST_TIME, RestDetector
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.learning.slow_moments import SlowMoments
from musculoskeletal_ae.messages.arrival import Arrival
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import BodyState
from musculoskeletal_ae.signals.joint_stream import JointStream
from musculoskeletal_ae.signals.joint_trust_message import JointTrust
from musculoskeletal_ae.signals.muscle_stream import MuscleSample, MuscleStream, RejectionError
from musculoskeletal_ae.signals.pairing import Paired, Pairing
from musculoskeletal_ae.signals.reading_limits import LIMITS

#: sources of θ: sensors of some or all joints, a camera at irregular intervals, or none
SENSOR, MARKER, NONE = 'sensor', 'marker', 'none'
NO_MESSAGES = 'no muscle_states are received'  # obstacle for users: no message has arrived
#: obstacle for users: messages arrive, but none with a joint angle that the learner requires
NO_JOINTS = 'muscle_states are received without usable joint angles'
SPREAD = 0.02  # assume that θ measured by a camera has this standard deviation [rad]


class SampleCollector:
    """Collects samples of one arm from its messages.

    Attributes:
        samples: The samples so far.
        healthy: Messages of the healthy arm, from motion and rest.
        rejected: Number of messages and rest samples that were not used, by reason.
        usable: Arrival of the messages that were suitable for learning, on the clock of the
            messages.
        obstacle: Why all messages since the last suitable one were unsuitable, for users.
        joint_trust: Which joint sensors the estimator trusts.
    """

    def __init__(
        self,
        robot: Robot,
        samples: SampleStore,
        healthy: Reservoir,
        period: float = 0.01,
        joint_source: str = SENSOR,
        *,
        from_motion: bool = False,
    ) -> None:
        """Start without any messages.

        Args:
            robot: The nominal body.
            samples: Stores new samples.
            healthy: Stores messages of the healthy arm.
            period: Period of the muscle modules' messages [s].
            joint_source: Source of θ: `SENSOR`, `MARKER` or `NONE`.
            from_motion: Whether slow moments of a moving arm are samples, instead of rests.
        """
        self.samples, self.healthy = samples, healthy
        self.rejected: Counter[str] = Counter()
        self.usable, self.obstacle = Arrival(), NO_MESSAGES
        self._needs_joints = joint_source == SENSOR
        self._robot = robot
        self._stream = MuscleStream(robot)
        self._joint_stream = JointStream(robot)
        self.joint_trust = JointTrust.full(robot.joint_count)
        self._pairing = Pairing[MuscleSample](period)
        self._detector: RestDetector | SlowMoments = (
            SlowMoments() if from_motion else RestDetector(joint_source != SENSOR)
        )
        self._margin = AnomalyMargin()
        self._spread = np.full(robot.joint_count, SPREAD) if joint_source == MARKER else NOTHING
        # θ and the directions of gravity (see `Sample`) are paired as one array.
        self._unmeasured = np.full(
            robot.joint_count + 3 * len(robot.kinematics.tree.parent), np.nan
        )
        self._longest_pause = max(LIMITS.pause, REST_TIME)

    @property
    def body(self) -> BodyState:
        """The body state under which samples are taken."""
        return self._stream.body

    # -- messages -------------------------------------------------------------------------------

    def joints(self, time: float, theta: Array) -> None:
        """Record θ [rad] (D,) received at `time` [s], with NaN for unmeasured joints.

        It is paired with the message of muscle_states that is nearest in time. Impossible readings
        are not used, and no readings of joint sensors that the estimator does not use. The
        estimator counts and reports both.
        """
        usable = self._joint_stream.take(time, theta)
        if unused := self.joint_trust.unused:
            usable[list(unused)] = np.nan
        self._measure(time, 0, usable)

    def imu(self, time: float, link: str, acceleration: Array) -> None:
        """Record an accelerometer reading [m/s²] (3,) in the axes of a link.

        At rest, the reading points opposite to gravity and thus shows the direction of gravity.
        Readings during motion are not used.
        """
        joint, placement = self._robot.kinematics.placement(link)
        down = -placement.rotation @ acceleration / np.linalg.norm(acceleration)
        self._measure(time, self._robot.joint_count + 3 * joint, down)

    def _measure(self, time: float, first: int, values: Array) -> None:
        measured = self._unmeasured.copy()
        measured[first : first + len(values)] = values
        self._pairing.joints(time, measured)

    def take(self, time: float, message: Any, delay: float = 0.0) -> Paired[MuscleSample] | None:
        """Take a message of muscle_states: check it, and pair it with θ.

        Args:
            time: Time of reception [s].
            message: The message of `muscle_states`, or `MuscleReadings`.
            delay: How late the message is (`Arrival.delay`) [s].

        Returns:
            The previous message with its θ, or None if there is none.

        Raises:
            RejectionError: If the message cannot be used; it is also counted in `rejected`.
        """
        try:
            sample = self._stream.take(message, time, delay=delay)
        except RejectionError as error:
            self.rejected[error.reason] += 1
            self.obstacle = f'muscle_states are rejected: {error}'
            raise
        return self._paired(time, sample)

    def _paired(self, time: float, sample: MuscleSample) -> Paired[MuscleSample] | None:
        if self.body.isolated:
            sample = sample.without_isolated()
        return self._pairing.muscles(time, sample)

    def collect(self, paired: Paired[MuscleSample], now: float = math.nan) -> list[Sample]:
        """Use a message and its θ to detect rests; return the samples that were stored.

        A message is used only after `anomaly_margin` has held it back for some time. Messages
        during an anomaly and shortly after it are ignored.

        Args:
            paired: The message and its θ.
            now: The present time, at which new samples are accepted [s], if it is known.
        """
        dt = min(paired.dt, self._longest_pause)
        measured = self._unmeasured if paired.theta is None else paired.theta
        theta, gravity = np.split(measured, [self._robot.joint_count])
        if self._needs_joints and np.isnan(theta).all():
            self.obstacle = NO_JOINTS
        else:
            self.usable.use(paired.time)
            self.obstacle = NO_MESSAGES
        message = paired.message
        reading = Sample(
            theta,
            message.tension_read,
            message.length,
            message.sliding,
            self._spread,
            gravity,
        )
        self._margin.pass_time(dt)
        rest = self._detector.step(reading, dt)
        if rest is not None and np.isnan(rest.gravity).all():
            rest = rest._replace(gravity=NOTHING)
        if self.body.has_anomaly or self._margin.is_closed:
            if rest is not None:
                self.rejected['anomaly'] += 1
            return []
        new = []
        for waited in self._margin.hold(dt, reading, rest):
            # No muscle has been isolated or restored since this message, as `use_body` resets.
            self.healthy.step(waited.reading, waited.dt, self.body.isolated)
            if waited.rest is not None and self._is_new(waited.rest):
                self.accept(waited.rest, now)
                new.append(waited.rest)
        return new

    def _is_new(self, rest: Sample) -> bool:
        self.healthy.rest(rest)
        if self.samples.is_new(rest):
            return True
        self.rejected['like a stored one'] += 1
        return False

    def accept(self, sample: Sample, now: float = math.nan) -> None:
        """Accept a sample: store it, as a description of the muscles that are not isolated.

        `now` is the time at which it is accepted [s], if it is known.
        """
        self.samples.add(sample, self.body.used.copy(), time=now)

    # -- changes of state -----------------------------------------------------------------------

    def use_body(self, body: BodyState) -> None:
        """Use another body state from now on.

        Incomplete samples are discarded, unless only the anomaly has changed. From 2 s before an
        anomaly until 2 s after its end (DETECTION_DELAY), no samples are collected.
        """
        before = self.body
        self._stream.use_body(body)
        if body.has_anomaly and not before.has_anomaly and (lost := self._margin.discard()):
            self.rejected['anomaly'] += lost
        if before.has_anomaly and not body.has_anomaly:
            self._margin.close()
        if (body.offsets, body.isolated) != (before.offsets, before.isolated):
            self.healthy.use_isolated(body.isolated)
            self.reset()

    def use_joint_trust(self, trust: JointTrust) -> None:
        """Use no readings from now on of joint sensors that the estimator does not trust."""
        self.joint_trust = trust

    def reset(self) -> None:
        """Reset the collector: discard incomplete samples, for example after a clock jump."""
        self._stream.reset()
        self._joint_stream.reset()
        self._pairing.reset()
        self._detector.reset()
        self._margin.discard()
