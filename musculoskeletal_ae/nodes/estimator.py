# SPDX-License-Identifier: Apache-2.0
"""The node `estimator`: joint angles from muscle length and tension; is the body healthy.

muscle_states → estimated_joint_states with estimated_joint_covariance, estimated_muscle_states,
anomaly, anomaly_detected, estimated_external_wrench, isolated_muscles, muscle_length_zeros
(joint_states help to find those), estimated/markers; on request muscle_joint_states and /tf;
marker_pose → vision_joint_states, the joint angles that a camera sees.
"""

import time
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, Vector3, WrenchStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64, Float64MultiArray, String
from std_srvs.srv import Trigger

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.estimator import Estimator as Core
from musculoskeletal_ae.estimation.settings import Detection
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.nodes.arm import Frames, Markers
from musculoskeletal_ae.nodes.messages import (
    LATCHED,
    RELIABLE,
    SENSOR,
    array_message,
    is_heard,
    joint_message,
    serve,
)
from musculoskeletal_ae.nodes.shell import Shell
from musculoskeletal_ae.parameters import parameters_of
from musculoskeletal_ae.plausibility import Plausibility
from musculoskeletal_ae.robot.drawing import draw_arm
from musculoskeletal_ae.signals.body_state import LengthOffsets
from musculoskeletal_ae.validity import read_pose


class Estimator(Shell):
    """Node shell of the MAE's estimate ② and the anomaly detector."""

    def __init__(self, **options: Any) -> None:
        super().__init__('estimator', **options)
        self.core = Core(self.robot, self.parameter('preset'))
        self.plausibility = Plausibility(self.core.robot)
        self.joints = self.create_publisher(JointState, 'estimated_joint_states', RELIABLE)
        self.muscles = self.create_publisher(Float64MultiArray, 'estimated_muscle_states', RELIABLE)
        topic = 'estimated_joint_covariance'
        self.covariance = self.create_publisher(Float64MultiArray, topic, RELIABLE)
        self.anomaly = self.create_publisher(Float64, 'anomaly', RELIABLE)
        self.wrench = self.create_publisher(WrenchStamped, 'estimated_external_wrench', RELIABLE)
        self.detected = self.create_publisher(Bool, 'anomaly_detected', LATCHED)
        self.detected.publish(Bool(data=False))
        self.latched = False
        self.isolated = self.create_publisher(String, 'isolated_muscles', LATCHED)
        self.told_isolated: tuple[int, ...] | None = None
        self.chosen = False  # who is isolated; else what the network in use says counts
        self.muscles_to_isolate: tuple[int, ...] = ()
        self.seen = self.create_publisher(JointState, 'vision_joint_states', RELIABLE)
        self.needed.append('muscle_states')
        self.posture: tuple[float, ...] = ()
        self.follow_parameter('zero_posture', self._take_posture)
        self.unzeroed = self.parameter('zero_at_start')
        if self.unzeroed:  # nobody moves on what sensors say before the network is there
            self.core.zeros = LengthOffsets.unknown(self.robot.muscle_count)
        self.follow_parameter('isolate_muscles', self._choose_muscles)
        self.follow_checkpoints(self._use)
        if self.parameter('isolate_muscles'):
            self._isolate(self.muscles_to_isolate)
        for name in parameters_of(Detection):
            self.follow_parameter(name, partial(self._configure, name))
        self.told = self.create_publisher(Float64MultiArray, 'muscle_length_zeros', LATCHED)
        # As the sensors read them: the core knows the zeros first.
        self.follow_muscle_states(self._estimate, as_read=True, unread=self._unread)
        self.follow_posture('joint_states', self._measured, some=True)
        self._tell_zeros()
        for kind in ('length', 'tension'):
            self.follow_muscles(f'muscle_{kind}_command', partial(self._commanded, kind))
        self.listen(PoseStamped, 'marker_pose', self._see, SENSOR)
        self.drawn: tuple[Array, Array] | None = None  # θ, T
        Markers(self, 'estimated', lambda: draw_arm(self.robot, *self.drawn) if self.drawn else [])
        self.mirror = None
        if self.parameter('mirror_muscles'):
            self.mirror = self.create_publisher(JointState, 'muscle_joint_states', RELIABLE)
        self.tf_source = self.parameter('publish_tf')
        self.frames = None if self.tf_source == 'none' else Frames(self)
        serve(self, Trigger, 'estimator/reset', self._reset)
        serve(self, Trigger, 'estimator/zero', self._zero)
        serve(self, Trigger, 'estimator/isolate', self._isolate_asked)
        serve(self, Trigger, 'estimator/restore', self._restore_asked)

    def _measured(self, theta: Array) -> None:
        if np.isnan(theta).any():
            return  # some sensors tell neither zeros nor where the arm is
        self.core.joints(theta, time.monotonic())
        if self.frames is not None and self.tf_source == 'sensor':
            self.frames.publish(theta)

    def _use(self, mae: Mae) -> None:
        self.core.use(mae)
        if mae.isolated != self.core.robot.isolated:
            if not self.chosen:
                self.core.isolate(mae.isolated)
            self.told_isolated = None  # a learner that starts anew is to hear it
        self._tell_isolated()
        if self.unzeroed:
            self.unzeroed = False
            self.core.zero(self.posture)

    def _configure(self, name: str, value: float) -> None:
        detector = self.core.detector
        detector.settings = replace(detector.settings, **{name: value})

    def _take_posture(self, posture: tuple[float, ...]) -> None:
        self.core.check_posture(posture)
        self.posture = posture

    def _zero(self, _: Trigger.Request) -> str:
        self.core.zero(self.posture)
        self._tell_zeros()
        self._reset(_)
        what = 'while the arm stands in zero_posture' if self.posture else 'while it moves gently'
        return f'finding the zeros of the lengths {what}; /diagnostics says how far it is'

    def _choose_muscles(self, names: tuple[str, ...]) -> None:
        self.muscles_to_isolate = tuple(self.robot.muscle_indices(names))

    def _isolate(self, muscles: Iterable[int]) -> str:
        self.chosen = True
        self.core.isolate(set(muscles))
        self._tell_isolated()
        return f'isolated: {self.robot.names(self.core.robot.isolated) or "none"}'

    def _isolate_asked(self, _: Trigger.Request) -> str:
        if not self.muscles_to_isolate:
            raise MusculoskeletalError('name muscles in the parameter isolate_muscles first')
        wanted = *self.core.robot.isolated, *self.muscles_to_isolate
        self.core.reset()  # which would use a suspect again
        answer = self._isolate(wanted)
        self._reset(_)
        return answer

    def _restore_asked(self, _: Trigger.Request) -> str:
        back = self.muscles_to_isolate or self.core.robot.isolated  # none named: all
        return self._isolate(m for m in self.core.robot.isolated if m not in back)

    def _tell_isolated(self) -> None:
        if self.core.robot.isolated != self.told_isolated:
            self.told_isolated = self.gate.isolated = self.left_out = self.core.robot.isolated
            self.isolated.publish(String(data=self.robot.names(self.told_isolated)))

    def _tell_anomaly(self) -> None:
        """Say what has changed: an anomaly, or which muscles are isolated for it."""
        detected, before = bool(self.core.cause), self.latched
        if detected != before:
            self.latched, self.chosen = detected, True
            self.detected.publish(Bool(data=detected))  # which stops the arm: first of all
            told = f'anomaly detected: {self.core.cause}' if detected else self.core.verified
            self.get_logger().warning(told)
            self.take_anomaly(detected)
            self._report()  # what is known of the suspect comes with the news, not a second later
        self._tell_isolated()

    def _tell_zeros(self) -> None:
        if self.core.zeros is not self.zeros:
            self.zeros = self.core.zeros
            self.plausibility = Plausibility(self.core.robot)
            self.gate.forget()
            rows = np.stack([self.zeros.offset, self.zeros.deviation])
            self.told.publish(array_message(rows, 'quantity', 'muscle'))

    def _commanded(self, kind: str, command: Array) -> None:
        if kind == 'length':
            command = command - self.zeros.offset
        self.core.commanded(time.monotonic(), **{kind: command})

    def _estimate(self, states: Array) -> None:
        length, tension, temperature = states
        clock, now = self.get_clock().now(), time.monotonic()
        from_zero = length - self.zeros.offset if self.zeros.known else None
        self.plausibility.check_muscles(tension, from_zero, temperature, now)
        if (jumped := self.plausibility.jumped) is not None:
            self.plausibility.jumped = None
            self.core.jumped(jumped, now)
        seconds = clock.nanoseconds * 1e-9
        estimate = self.core.step(tension, length, seconds, now, temperature)
        self._tell_zeros()
        if self.mirror is not None and from_zero is not None:
            mirrored = joint_message(self.robot.muscles, from_zero, clock.to_msg())
            mirrored.effort = tension.tolist()
            self.mirror.publish(mirrored)
        if estimate is None:
            return
        self.drawn = estimate.state.theta, tension
        if self.frames is not None and self.tf_source == 'estimate':
            self.frames.publish(estimate.state.theta)
        if from_zero is not None:
            self.gate.message(tension, from_zero, now)
        state = estimate.state
        self.joints.publish(joint_message(self.robot.joints, state.theta, clock.to_msg()))
        covariance = None if self.core.mae is None else self.core.mae.covariance
        if covariance is not None and is_heard(self.covariance):
            self.covariance.publish(array_message(covariance, 'joint', 'joint'))
        if is_heard(self.muscles):
            restored = np.array([state.length, state.tension])
            self.muscles.publish(array_message(restored, 'quantity', 'muscle'))
        if is_heard(self.anomaly):
            self.anomaly.publish(Float64(data=estimate.anomaly))
        if (touch := estimate.contact) is not None and is_heard(self.wrench):
            wrench = WrenchStamped()
            wrench.header.stamp, wrench.header.frame_id = clock.to_msg(), self.root_frame
            wrench.wrench.force = Vector3(**dict(zip('xyz', touch.force().tolist())))
            self.wrench.publish(wrench)
        self._tell_anomaly()

    def _unread(self, states: Array) -> None:
        if self.core.unread(states, time.monotonic()):
            self.get_logger().warning(self.core.verified)
            self.chosen = True
            self._tell_isolated()

    def _see(self, message: PoseStamped) -> None:
        theta = self.core.see(read_pose(message, self.root_frame))
        known = np.isfinite(theta)
        joints = [joint for joint, is_known in zip(self.robot.joints, known) if is_known]
        self.seen.publish(joint_message(joints, theta[known], message.header.stamp))

    def clock_jumped_back(self) -> None:
        """Forget what came before, also how long each muscle was; latches stay."""
        super().clock_jumped_back()
        if self.core:
            self.plausibility = Plausibility(self.core.robot)

    def _reset(self, _: Trigger.Request) -> str:
        cause = self.core.cause
        self.core.reset()
        self.latched = False
        self.take_anomaly(False)
        self.detected.publish(Bool(data=False))
        self._tell_isolated()
        return f'cleared: {cause}' if cause else 'nothing was detected'
