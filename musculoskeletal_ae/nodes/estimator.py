# SPDX-License-Identifier: Apache-2.0
"""The node `estimator`: estimates joint angles from muscle length and tension, detects anomalies.

muscle_states → estimated_joint_states with estimated_joint_covariance, estimated_muscle_states,
anomaly, body_state, joint_sensor_trust, estimated_external_wrench, estimated/markers; on request
muscle_joint_states.
mae_checkpoint → accepted_checkpoint, the networks that have passed the validation, and
rejected_checkpoint, the versions of those that have not.
marker_pose → vision_joint_states, the joint angles measured by a camera.
joint_states are optional. They are used by the length calibration, by the validation of
checkpoints, and by the detectors that compare them with the lengths.
"""

import time
from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, Vector3, WrenchStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray
from std_srvs.srv import Trigger

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.conditions import Condition, ConditionKind
from musculoskeletal_ae.estimation.body_memory import BodyMemory
from musculoskeletal_ae.estimation.estimator import Estimator, Output
from musculoskeletal_ae.estimation.lengths.length_calibration import stated_theta
from musculoskeletal_ae.estimation.lengths.length_trust import Evidence
from musculoskeletal_ae.estimation.suspect_verification import VerificationVerdict
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.messages.message_reading import read_pose
from musculoskeletal_ae.nodes.arm_node import Markers
from musculoskeletal_ae.nodes.candidates import Candidates
from musculoskeletal_ae.nodes.shell import Shell
from musculoskeletal_ae.robot.drawing import Line, draw_arm
from musculoskeletal_ae.ros.latched_values import LatchedPublisher
from musculoskeletal_ae.ros.message_building import (
    RELIABLE,
    SENSOR,
    array_message,
    is_heard,
    joint_message,
    posture_message,
    serve,
)
from musculoskeletal_ae.ros.second_publishers import AUTHORS
from musculoskeletal_ae.signals.body_state import BodyState
from musculoskeletal_ae.signals.joint_trust_message import JointTrust
from musculoskeletal_ae.signals.muscle_stream import MuscleSample, RejectionError

OWN_TOPICS = [topic for topic, author in AUTHORS.items() if author == 'the estimator']


class EstimatorNode(Shell):
    """Passes messages, parameters and services to the core estimator; publishes its results."""

    def __init__(self, **options: Any) -> None:
        super().__init__('estimator', **options)
        self.memory = BodyMemory(self.state_directory(), self.robot.muscles, self.robot.joints)
        found = self.memory.found
        # The time distinguishes the body states of this estimator from those of an earlier one.
        generation = max(time.time_ns() // 1_000_000, 0 if found is None else found.generation + 1)
        self.core = Estimator(self.robot, self.parameter('preset'), generation)
        self.core.doubt_joint_sensors(self.memory.doubts, time.monotonic())
        #: what was last saved: the body state, and the joints whose sensors are in doubt
        self.remembered: tuple[BodyState, tuple[int, ...]] | None = None
        self.candidates = Candidates(self, self.core.networks)
        self.core.networks.accepted = self._accepted
        self._advertise()
        self.sources.watch(*OWN_TOPICS)
        self.published_trust: JointTrust | None = None  # None if none was published yet
        #: the last logged verdict on a muscle, with its index
        self.logged_verdict: tuple[int, VerificationVerdict] | None = None
        self.needed.add('muscle_states')
        if not self.get_parameter('use_sim_time').value:  # simulated time may be slow
            self.needed.expect_rate('muscle_states', self.rate)
        self.parameters.follow('on_anomaly', self._on_anomaly)
        self.parameters.follow('zero_posture', partial(stated_theta, self.robot))
        if self.parameter('zero_at_start'):
            self.core.distrust_lengths(Evidence.NOT_CALIBRATED)
        elif found is not None and not found.offsets.known:
            self.core.distrust_lengths(Evidence.RESTARTED, found.offsets.offset)
        self.parameters.follow('isolate_muscles', self.robot.muscle_indices)
        self.core.isolate([*self._muscles_to_isolate, *(() if found is None else found.isolated)])
        self.candidates.subscribe()
        self.follow_muscle_messages(self._on_muscles)
        self.follow_posture('joint_states', self._on_joints, some=True)
        self._publish_body()
        self._publish_joint_trust()
        for kind in ('length', 'tension'):
            self.follow_muscles(f'muscle_{kind}_command', partial(self._on_command, kind))
        self.listen(PoseStamped, 'marker_pose', self._on_marker, SENSOR)
        Markers(self, 'estimated', self._lines)
        serve(self, Trigger, 'estimator/reset', self._reset_or_confirm)
        serve(self, Trigger, 'estimator/zero', self._calibrate)
        serve(self, Trigger, 'estimator/isolate', self._isolate_more)
        serve(self, Trigger, 'estimator/restore', self._restore)

    def _advertise(self) -> None:
        publisher = self.create_publisher
        self.joints = publisher(JointState, 'estimated_joint_states', RELIABLE)
        self.covariance = publisher(Float64MultiArray, 'estimated_joint_covariance', RELIABLE)
        self.muscles = publisher(Float64MultiArray, 'estimated_muscle_states', RELIABLE)
        self.anomaly = publisher(Float64, 'anomaly', RELIABLE)
        self.wrench = publisher(WrenchStamped, 'estimated_external_wrench', RELIABLE)
        self.by_camera = publisher(JointState, 'vision_joint_states', RELIABLE)
        self.bodies = LatchedPublisher(self, Float64MultiArray, 'body_state')
        self.trust = LatchedPublisher(self, Float64MultiArray, 'joint_sensor_trust')
        self.mirror = None
        if self.parameter('mirror_muscles'):
            self.mirror = publisher(JointState, 'muscle_joint_states', RELIABLE)

    # -- parameters and services ----------------------------------------------------------------

    def _accepted(self, mae: Mae) -> None:
        self.candidates.publish(mae)
        # The length calibration needs a network, so it begins with the first one. A network that is
        # used again because of an anomaly is not the first one.
        is_first = Evidence.NOT_CALIBRATED in self.core.trust.evidence
        if is_first and not self.core.body.has_anomaly:
            self.core.calibrate_lengths(self.parameter('zero_posture'))
            self._publish_body()

    @property
    def _muscles_to_isolate(self) -> tuple[int, ...]:
        return tuple(self.robot.muscle_indices(self.parameter('isolate_muscles')))

    def _on_anomaly(self, response: str) -> None:
        self.core.suspects.isolates = response == 'isolate'

    def _calibrate(self, _: Trigger.Request) -> str:
        self.core.calibrate_lengths(self.parameter('zero_posture'))
        self._publish_body()
        self._report()
        if self.parameter('zero_posture'):
            doing = 'hold the arm still in zero_posture'
        else:
            doing = 'call controller/explore, unless the arm is already exploring'
        return f'calibrating length offsets: {doing}; /diagnostics shows the progress'

    def _isolate_more(self, _: Trigger.Request) -> str:
        if not self._muscles_to_isolate:
            raise MusculoskeletalError(
                '`isolate_muscles` names no muscle; set that parameter first'
            )
        self.core.reset(isolating=self._muscles_to_isolate)
        self._publish_body()
        self._report()
        return self._isolated

    def _restore(self, _: Trigger.Request) -> str:
        isolated = self.core.body.isolated
        restored = self._muscles_to_isolate or isolated  # all muscles if the parameter names none
        self.core.restore(restored)
        self.core.networks.declare_repaired(restored, time.monotonic())
        self._publish_body()
        return self._isolated

    @property
    def _isolated(self) -> str:
        return f'isolated: {self.robot.names(self.core.body.isolated) or "none"}'

    def _reset_or_confirm(self, request: Trigger.Request) -> str:
        """End the anomaly; if there is none, accept the joint sensors that are in doubt."""
        if not self.core.cause and (joints := self.core.confirm_joint_sensors()):
            self._publish_joint_trust()
            names = ', '.join(self.robot.joints[joint] for joint in joints)
            return f'joint sensors accepted without a further check: {names}'
        return self._reset(request)

    def _reset(self, _: Trigger.Request) -> str:
        finding = self.core.suspects.finding
        self.core.reset()
        if finding is not None:
            self.core.networks.declare_repaired(finding.muscles, time.monotonic())
        self._publish_body()
        self._report()
        if finding is None:
            return 'no anomaly was detected'
        muscle = self.robot.muscles[finding.muscle]
        return f'cleared the anomaly of {muscle}; a fault that persists will be detected again'

    # -- messages -------------------------------------------------------------------------------

    def _on_joints(self, theta: Array) -> None:
        self.core.joints(theta, time.monotonic())

    def _on_command(self, kind: str, command: Array) -> None:
        if kind == 'length':
            command = command - self.core.body.offsets.offset
        self.core.commanded(time.monotonic(), **{kind: command})

    def _on_muscles(self, message: Float64MultiArray, now: float, delay: float) -> None:
        clock = self.get_clock().now()
        try:
            output = self.core.take(message, clock.nanoseconds * 1e-9, now, delay)
        except RejectionError:
            self._publish_body()  # a rejected message may also show a fault
            raise
        self._publish_body()
        self._publish_joint_trust()
        sample = self.core.sample
        if self.mirror is not None and self.core.body.offsets.known and sample is not None:
            self._publish_mirror(sample, clock.to_msg())
        if output is not None:
            self._publish(output, clock.to_msg())

    def _on_marker(self, message: PoseStamped) -> None:
        theta = self.core.posture_of_marker(read_pose(message, self.root_frame))
        known = np.isfinite(theta)
        joints = [joint for joint, is_known in zip(self.robot.joints, known) if is_known]
        position = self.robot.units.to_position(theta)[known]
        self.by_camera.publish(joint_message(joints, position, message.header.stamp))

    # -- publishing -----------------------------------------------------------------------------

    def _publish(self, output: Output, stamp: Any) -> None:
        state = output.state
        self.joints.publish(posture_message(self.robot.units, state.theta, stamp))
        known = None if self.core.mae is None else self.core.mae.covariance
        if known is not None and is_heard(self.covariance):
            covariance = self.robot.units.covariance_of_positions(known)
            self.covariance.publish(array_message(covariance, 'joint', 'joint'))
        if is_heard(self.muscles):
            reconstructed = np.array([state.length, state.tension])
            self.muscles.publish(array_message(reconstructed, 'quantity', 'muscle'))
        if is_heard(self.anomaly):
            self.anomaly.publish(Float64(data=output.anomaly))
        if output.contact is not None and is_heard(self.wrench):
            wrench = WrenchStamped()
            wrench.header.stamp, wrench.header.frame_id = stamp, self.root_frame
            force = output.contact.force().tolist()
            wrench.wrench.force = Vector3(**dict(zip('xyz', force)))
            self.wrench.publish(wrench)

    def _publish_mirror(self, sample: MuscleSample, stamp: Any) -> None:
        assert self.mirror is not None
        message = joint_message(self.robot.muscles, sample.length, stamp)
        message.effort = self.robot.tension_source.known(sample.motor_tension).tolist()
        self.mirror.publish(message)

    def _publish_body(self) -> None:
        """Publish the body state if it has changed, and act on the change."""
        body, before, suspects = self.core.body, self.body, self.core.suspects
        self._remember()
        if body is before:
            return
        self.body = body
        self.bodies.publish(array_message(body.rows, 'quantity', 'muscle'))
        if suspects.last_verdict is not self.logged_verdict:
            self.logged_verdict = suspects.last_verdict
            self.get_logger().warning(suspects.last_verification)
        if body.has_anomaly and not before.has_anomaly:
            text = f'anomaly detected: {self.core.cause}; {self.core.advice}'
            self.get_logger().warning(text)
            self.candidates.give_up()
        if body.has_anomaly != before.has_anomaly:
            self._report()  # at once, because the report names the suspect

    def _remember(self) -> None:
        """Save what a restarted estimator has to know, if it has changed."""
        remembered = self.core.body_after_restart, self.core.joint_trust.doubted
        # Repeat an attempt to save that has failed.
        if remembered != self.remembered or self.memory.problem:
            self.remembered = remembered
            self.memory.note(remembered[0], self.core.joint_doubts)

    def conditions(self) -> Iterable[Condition]:
        """Yield the conditions of the core, and one if the body state could not be saved."""
        yield from super().conditions()
        if problem := self.memory.problem:
            yield ConditionKind.STATE_NOT_SAVED.condition(problem, ['estimator'])

    def _publish_joint_trust(self) -> None:
        trust, before = self.core.joint_trust, self.published_trust
        if trust is before:
            return
        self.published_trust = trust
        self._remember()
        rows = trust.rows(time.monotonic())
        rows[-1] = self.robot.units.to_position(trust.deviation)
        self.trust.publish(array_message(rows, 'quantity', 'joint'))
        if before is not None:
            names = ', '.join(self.robot.joints[joint] for joint in trust.unused)
            self.get_logger().warning(f'joint sensors that are not used: {names or "none"}')
            self._report()

    def _lines(self) -> list[Line]:
        output = self.core.output
        if output is None:
            return []
        return draw_arm(self.robot, output.state.theta, output.sample.motor_tension)
