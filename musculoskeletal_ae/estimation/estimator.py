# SPDX-License-Identifier: Apache-2.0
"""The core of the node `estimator`: estimates the joint angles and monitors the body's health.

    muscle_states ─► MuscleStream ─► MuscleSample ─►    estimate    ─► Estimate ─► HealthMonitor
                         ▲                │                              │              │ Finding
                         │                ▼                              ▼              ▼
                     BodyState ◄── LengthCalibration              ContactEstimator   SuspectHandling
                         ▲                                                              │
                         └───────── isolated muscles, anomaly ──────────────────────────┘

The body state consists of the length offsets, the isolated muscles and the anomaly. Only the
estimator creates a new body state, whenever one of these three changes, and its node publishes it.
`length_trust.py` decides which length offsets are known, on the evidence of the other parts. During
a length calibration, only the detectors that do not need lengths report findings. `isolation.py`
describes the sequence from a rupture to resuming.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple, NoReturn

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.conditions import Condition, ConditionKind
from musculoskeletal_ae.estimation import estimator_status
from musculoskeletal_ae.estimation.contact import Contact, ContactEstimator
from musculoskeletal_ae.estimation.detectors.joint_sensor_trust import SensorDoubt
from musculoskeletal_ae.estimation.estimate import Estimate, estimate
from musculoskeletal_ae.estimation.finding import Finding, Observation, jump_finding
from musculoskeletal_ae.estimation.further_loss import needed_muscles
from musculoskeletal_ae.estimation.health import HealthMonitor
from musculoskeletal_ae.estimation.healthy_torque import HealthyTorque
from musculoskeletal_ae.estimation.isolation import SuspectHandling
from musculoskeletal_ae.estimation.lengths.length_calibration import LengthCalibration
from musculoskeletal_ae.estimation.lengths.length_trust import Evidence, LengthTrust
from musculoskeletal_ae.estimation.module_commands import ModuleCommands
from musculoskeletal_ae.estimation.network_validation.validator import CheckpointValidator
from musculoskeletal_ae.estimation.repair_check import LARGEST_LEARNED, LARGEST_YOUNG, RepairCheck
from musculoskeletal_ae.estimation.suspect_verification import LONGEST
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.units import State
from musculoskeletal_ae.messages.arrival import INTERRUPTION, LONGEST_STEP, SILENCE, SPACING
from musculoskeletal_ae.remedy_steps import Step, sentence
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.inverse_kinematics import posture_of_marker
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import UNKNOWN, Anomaly, BodyState, LengthOffsets
from musculoskeletal_ae.signals.joint_stream import JointStream
from musculoskeletal_ae.signals.joint_trust_message import JointTrust
from musculoskeletal_ae.signals.muscle_stream import MuscleSample, MuscleStream, RejectionError
from musculoskeletal_ae.signals.reading_limits import Persistence

#: Use measured joint angles with a message of the muscles only if they are younger than this [s]:
#: an older reading belongs to another posture of a moving arm.
JOINTS_AGE = 0.05


class Output(NamedTuple):
    """Results of the estimator for one message.

    Attributes:
        sample: The checked readings of the message.
        state: Joint angles, tensions and lengths that the network estimates from the readings.
        anomaly: Anomaly score A: the size of the network's residual, in scaled units.
        contact: External load; None while the length offsets are unknown, on a robot whose tensions
            are unknown, and for a message that follows the last checked one within 6 ms (SPACING).
    """

    sample: MuscleSample
    state: State
    anomaly: float
    contact: Contact | None = None


class Estimator:
    """Estimates the joint angles from each message, and monitors the health of the body.

    In all methods, `time` comes from the messages' clock [s], and `now` from a steady clock [s].

    Attributes:
        robot: The nominal body, with all muscles.
        body: The body state, with a new generation after each change.
        trust: Decides which length offsets are known.
        stream: Converts messages into samples.
        mae: The network in use, without the isolated muscles; None before the first.
        complete_mae: The same network with all muscles.
        needed_muscles: While a muscle is isolated, the names of the further muscles that the
            estimate needs, each with the reason.
        health: Checks each message with all detectors.
        suspects: The latched fault that a detector found, and the verification of its muscle.
        calibration: The running length calibration, or None.
        contact: Estimates the external load, and detects contact.
        healthy_torque: Measures joint damping, and the torque that is wrongly estimated without
            contact.
        networks: Decides which network is used.
        sample: The last sample; None before the first.
        output: Results of the last message with an estimate; None before the first, and from the
            start of a length calibration until its first estimate.
        joint_stream: Judges single readings of the joint sensors.
        measured: Joint angles from joint sensors [rad], (D,), at the last message with an estimate;
            None unless all joint sensors are trusted and reported a usable value within 0.05 s
            before that message.
        load: The newest external load; None as in `Output`.
        stepped_at: Time on the steady clock at which the last message was accepted while there was
            a network [s].
        received_at: Time on the steady clock of the last message, even if it was rejected [s].
    """

    def __init__(self, robot: Robot, preset: str = 'default', first_generation: int = 1) -> None:
        """Start without a network.

        Args:
            robot: The nominal body.
            preset: Name of the preset that provides the detectors.
            first_generation: Generation of the first body state; it must be larger than those of
                all body states before a restart.
        """
        self.robot = robot
        self.trust = LengthTrust(robot.muscle_count)
        self.body = BodyState(self.trust.offsets, generation=first_generation)
        self.stream = MuscleStream(robot, self.body)
        self.mae: Mae | None = None
        self.complete_mae: Mae | None = None
        self.needed_muscles = dict[str, str]()
        self.health = HealthMonitor(robot, preset)
        self.suspects = SuspectHandling(robot)
        self.calibration: LengthCalibration | None = None
        self.contact = ContactEstimator(robot)
        self.healthy_torque = HealthyTorque(robot)
        self.networks = CheckpointValidator(robot, self.use)
        self.sample: MuscleSample | None = None
        self.output: Output | None = None
        self.measured: Array | None = None
        self.stepped_at = self.received_at = -math.inf
        self.load: Contact | None = None
        #: times since the health of the body was last checked [s]: between receptions, of which
        #: each message adds at most LONGEST_STEP, and between publications
        self._unchecked = self._unchecked_sent = 0.0
        self._commands = ModuleCommands()
        self._rejected = Persistence()  # why messages are rejected
        self.joint_stream = JointStream(robot)
        self._followed_trust = self.joint_trust  # that of the messages of `networks`
        #: usable readings of the joint sensors [rad] and their times [s], (2, D); NaN if unknown
        self._readings = np.full((2, robot.joint_count), np.nan)
        self.networks.follow(self.body, self.received_at)

    @property
    def cause(self) -> str:
        """The latched finding as a text for users; '' if there is none."""
        return self.suspects.cause

    @property
    def remedy(self) -> tuple[Step, ...]:
        """Steps by which a user ends the anomaly; () without an anomaly or during a verification.

        After a repair, the suspect may have another length offset. A reset is then refused, and a
        length calibration ends the anomaly instead.
        """
        finding = self.suspects.finding
        if finding is None or self.suspects.verification is not None:
            return ()
        muscles, check = finding.muscles, self._repair_check
        is_moved = any(self.trust.evidence[muscle] is Evidence.MOVED for muscle in muscles)
        is_repaired = finding.kind is ConditionKind.SLACK_TENDON or is_moved
        if not finding.kind.is_damage or not is_repaired or check is None:
            return finding.kind.steps
        is_wrong = any(map(check.is_taut_with_wrong_length, muscles))
        return (Step.CALIBRATE_LENGTHS,) if is_wrong else finding.kind.steps

    @property
    def advice(self) -> str:
        """Advice on how to end the anomaly, as a text for users; '' without an anomaly."""
        if self.suspects.verification is not None:
            return f'wait for the verification of the muscle, which ends within {LONGEST:g} s'
        return sentence(self.remedy)

    # -- networks and services -------------------------------------------------------------------

    def use(self, mae: Mae) -> Mae:
        """Use another network and its healthy statistics, without the isolated muscles.

        A running length calibration starts again, because its estimate depends on the network.

        Args:
            mae: The network.

        Returns:
            The network with all muscles, and with the damping and the residual torque that were
            measured so far.

        Raises:
            numpy.linalg.LinAlgError: If the network's statistics are singular; the previous network
                then stays in use.
        """
        mae = self.healthy_torque.put_into(mae)
        reduced = mae.without(self.body.isolated)
        self.health.use(reduced)
        self.contact.use(reduced)
        self.stream.use_transmission(reduced.transmission)
        self.complete_mae, self.mae = mae, reduced
        self.needed_muscles = needed_muscles(self.robot, reduced)
        if self.calibration is not None:
            posture = self.calibration.posture
            self.calibration = self._new_calibration(posture, 'the network changed')
        return mae

    def isolate(self, muscles: Iterable[int]) -> None:
        """Isolate exactly the muscles with these indices, and restore all others.

        Restoring a suspect ends its verification; the finding stays latched.
        """
        before = self.body.isolated
        isolated = self.body.with_isolated(muscles).isolated
        self.suspects.on_isolated(isolated)
        self._update_body(isolated=isolated)
        if isolated != before and self.complete_mae is not None:
            self.use(self.complete_mae)
        self.health.reset()

    def distrust_lengths(self, evidence: Evidence, offset: Array | None = None) -> None:
        """Consider all length offsets unknown until the next length calibration.

        Args:
            evidence: Why the offsets are unknown.
            offset: Offsets that are used meanwhile [m], (M,); 0 by default.
        """
        offset = np.zeros(self.robot.muscle_count) if offset is None else offset
        self._note(evidence, found=LengthOffsets.of(offset, UNKNOWN))

    def _new_calibration(self, posture: tuple[float, ...], reason: str = '') -> LengthCalibration:
        """Return a calibration of the offsets that are not certain, or of all if all are certain.

        Only offsets of used muscles can be certain, because lengths of isolated muscles are not
        checked. In a stated posture, all offsets are calibrated, so that they agree with each
        other.

        Args:
            posture: The stated posture; () if the arm moves gently.
            reason: Why an earlier calibration begins again, as a text for users.
        """
        used = self.body.used
        certain = self.trust.is_certain & used
        keeps = certain & (not certain[used].all() and not posture)
        offset = np.where(keeps, self.body.offsets.offset, np.nan)
        return LengthCalibration(self.robot, self.mae, posture, offset, reason)

    def _begin(self, calibration: LengthCalibration) -> None:
        """Begin a calibration; until its first estimate, offsets and posture are unknown."""
        self.calibration = calibration
        unknown = LengthOffsets.unknown(self.robot.muscle_count)
        self._note(Evidence.CALIBRATING, self.calibration.muscles, unknown)
        self.output = self.load = None
        self.contact.reset()

    def calibrate_lengths(self, posture: tuple[float, ...] = ()) -> None:
        """Start a length calibration, during which the arm stands in a posture or moves gently.

        It determines the offsets that are not certain; if all are certain, it determines all anew.

        Args:
            posture: Positions of the joints at which the arm stands [rad or m], (D,); () if the arm
                moves gently.

        Raises:
            MusculoskeletalError: If there is no network, if the posture is not valid, if no posture
                is stated for a robot whose tensions are unknown, or if other readings than the
                length of the suspect muscle show that it is not repaired. Nothing changes then.
        """
        calibration = self._new_calibration(posture)
        finding = self.suspects.finding
        # A length that jumped may be that of a tendon that ruptured while messages were lost.
        if finding is not None and (finding.kind.is_damage or finding.is_of_one_length):
            # The calibration determines the lengths, so they need not fit yet.
            self._refuse_unrepaired(finding.muscles, 'zero', RepairCheck.defect)
        self._begin(calibration)
        self._accept_body()

    def commanded(
        self, now: float, length: Array | None = None, tension: Array | None = None
    ) -> None:
        """Record the target lengths [m] (M,) or tensions [N] (M,) sent to the muscle modules."""
        self._commands.note(now, length, tension)

    def joints(self, theta: Array, now: float) -> None:
        """Record joint angles θ [rad], (D,), that joint sensors measured at `now` [s].

        θ is NaN for joints that the message does not contain. A joint that had readings before is
        reported as missing once it has had no reading for a second.
        """
        usable = self.joint_stream.take(now, theta)
        impossible = self.joint_stream.impossible(now)
        self.health.joint_sensors.use_impossible({j: each.since for j, each in impossible.items()})
        self._follow_joint_trust()
        is_usable = np.isfinite(usable)
        np.copyto(self._readings, [usable, np.full_like(usable, now)], where=is_usable)

    def _follow_joint_trust(self) -> None:
        """Discard the messages for the validation of networks if the trust has changed.

        Readings of joint sensors so far may be wrong.
        """
        if self.joint_trust is not self._followed_trust:
            self._followed_trust = self.joint_trust
            self.networks.messages.clear()

    @property
    def joint_trust(self) -> JointTrust:
        """The trust in each joint sensor, with times on the steady clock."""
        return self.health.joint_sensors.trust

    @property
    def body_after_restart(self) -> BodyState:
        """The body state that a restarted estimator has to begin with."""
        offsets = self.trust.after_restart
        return self.body if offsets is self.body.offsets else self.body.with_offsets(offsets)

    @property
    def joint_doubts(self) -> dict[int, SensorDoubt]:
        """The joint sensors in doubt, with what a restarted estimator has to know of them."""
        return self.health.joint_sensors.doubts

    def doubt_joint_sensors(self, doubts: Mapping[int, SensorDoubt], now: float) -> None:
        """Begin with joint sensors in doubt, because the estimator before a restart doubted them.

        Args:
            doubts: The doubts, by index of the joint.
            now: Time on the steady clock [s].
        """
        self.health.joint_sensors.begin_in_doubt(doubts, now)
        self._follow_joint_trust()

    def confirm_joint_sensors(self) -> tuple[int, ...]:
        """Confirm that the joint sensors are right, because a user says so.

        Sensors in doubt are trusted again, including their readings since the doubt began. Sensors
        without readings are regarded as removed until they report again.

        Returns:
            Indices of the joints whose sensors were in doubt or missing.
        """
        return (*self.health.joint_sensors.confirm(), *self.joint_stream.do_without_missing())

    def restore(self, muscles: Iterable[int]) -> None:
        """Restore isolated muscles (indices); muscles that are not isolated are ignored.

        Raises:
            MusculoskeletalError: If one of these muscles is being verified, or if its readings
                still contradict the rest of the arm (`repair_check`). No muscle is restored then.
        """
        restored = [muscle for muscle in self.body.isolated if muscle in set(muscles)]
        if self.suspects.verified in restored:
            self._refuse_verified('restore', 'if the muscle is still isolated')
        self._refuse_unrepaired(restored, 'restore')
        self._note_checked(restored)
        if self.calibration is not None:  # the lengths of these muscles were not checked meanwhile
            self._note(Evidence.CALIBRATING, restored)
        self.isolate(muscle for muscle in self.body.isolated if muscle not in restored)

    def reset(self, isolating: Iterable[int] = ()) -> None:
        """Reset the anomaly, and consider the body healthy in its present state.

        Args:
            isolating: Muscles (indices) that are isolated in addition; they need not be healthy.

        Raises:
            MusculoskeletalError: If a suspect muscle that is not in `isolating` is being verified,
                or its readings still contradict the rest of the arm (`repair_check`), or if length
                offsets were revoked, which only a length calibration ends. The anomaly then stays.
        """
        isolating = tuple(isolating)
        service, verified = 'isolate' if isolating else 'reset', self.suspects.verified
        if verified is not None and verified not in isolating:
            self._refuse_verified(service, 'if the anomaly is still present')
        suspected = self._suspected(isolating)
        self._refuse_unrepaired(suspected, service)
        self._note_checked(suspected)
        if self.body.offsets.revoked:
            raise MusculoskeletalError(f'{self.cause}; {self.advice}')
        self._accept_body(isolating)

    def _accept_body(self, isolating: tuple[int, ...] = ()) -> None:
        """Consider the body healthy in its present state, and clear a finding."""
        self.health.accept()
        self.isolate([*self.suspects.clear(self.body.isolated), *isolating])

    def clock_jumped_back(self) -> None:
        """Discard earlier messages after the clock jumped back; a latched finding stays."""
        self.sample = None
        self.stream.reset()
        self.health.reset()
        self.contact.reset()

    # -- messages -------------------------------------------------------------------------------

    def take(
        self,
        message: Any,
        time: float,
        now: float,
        delay: float = 0.0,
        recorded: Array | None = None,
    ) -> Output | None:
        """Take a message of muscle_states: estimate the state, and check for faults.

        Args:
            message: The message of `muscle_states`, or `MuscleReadings`.
            time: Time of the message [s].
            now: Time on the steady clock [s].
            delay: How late the message is, compared with the fastest one [s].
            recorded: Joint angles of a recording [rad], (D,), on which networks are validated; None
                for those that joint sensors have measured (`joints`).

        Returns:
            The results; None without a network, or before the first estimate of the length offsets.

        Raises:
            RejectionError: If the message cannot be used.
        """
        self.received_at = now
        try:
            sample = self.stream.take(message, time, now, delay)
        except RejectionError as error:
            self._rejected.note(str(error), now)
            if error.readings is not None:
                self._handle(self.health.read(error.readings, self.body.used, now), now)
            raise
        output = self._use_sample(sample, now)
        if output is not None and self.body.offsets.known:
            used, theta = output.sample, self.measured if recorded is None else recorded
            self.networks.message(used.tension_read, used.length, used.sliding, now, theta)
        return output

    def posture_of_marker(self, pose: pin.SE3) -> Array:
        """Return a posture in which the end effector has a given pose.

        Args:
            pose: The pose in the frame of the root link.

        Returns:
            θ [rad], (D,), with NaN for joints that do not move the end effector.

        Raises:
            MessageError: If the end effector cannot reach the pose.
        """
        middle = 0.5 * (self.robot.lower + self.robot.upper)
        start = middle if self.output is None else self.output.state.theta
        return posture_of_marker(self.robot, pose, start)

    def report(self, now: float) -> Report:
        """Report the status for /diagnostics; `now` is a time on the steady clock [s]."""
        return estimator_status.report(self, now)

    def conditions(self, now: float) -> tuple[Condition, ...]:
        """Return the conditions of readings, body and network that users should know.

        `now` is a time on the steady clock [s].
        """
        return estimator_status.conditions(self, now)

    def rejected_because(self, now: float) -> str:
        """Return why all muscle states have been rejected for longer than 0.1 s; '' otherwise.

        Nothing is rejected once no message has arrived for 1 s (SILENCE).
        """
        return self._rejected.lasting(now) if now - self.received_at <= SILENCE else ''

    def _use_sample(self, sample: MuscleSample, now: float) -> Output | None:
        self._rejected.note('', now)
        read = sample.newest.replace(length=sample.length_read, tension=sample.tension_read)
        self._handle(self.health.read(read, self.body.used, now), now)
        if sample.jumped:
            self._handle_jump(sample.jumped, now)
        before, self.sample = self.sample, sample
        elapsed = sent_apart = 0.0
        if before is not None:
            elapsed = max(sample.time - before.time, 0.0)
            sent_apart = max(sample.sent_at - before.sent_at, 0.0)
        self.joint_stream.pass_time(min(elapsed, LONGEST_STEP))
        self.health.follow(sample, sent_apart)
        if self.mae is None:
            return None
        self.stepped_at = now
        pause = max(elapsed, sent_apart)
        if pause > INTERRUPTION:
            # What happened in the pause is unknown: the driver may have received no commands, or
            # the whole computer may have stopped.
            self.health.reset()
        if pause > SILENCE:
            self.contact.reset()
        return self._estimate(sample, elapsed, sent_apart, now)

    def _estimate(
        self, sample: MuscleSample, elapsed: float, sent_apart: float, now: float
    ) -> Output | None:
        """Estimate the state, and check the health of the body.

        Args:
            sample: The readings of one message.
            elapsed: Time between the receptions of this message and the previous one [s].
            sent_apart: Time between the publications of these two messages [s].
            now: Time on the steady clock [s].

        Returns:
            The results; None before a running length calibration has its first estimate.
        """
        dt, guess = min(elapsed, LONGEST_STEP), self.body.offsets
        if self.calibration is not None:
            before = self.body.offsets
            newest = self._calibrate(self.calibration, sample, dt, now)
            if newest is None:
                return None
            guess = newest
            sample = sample.shifted(self.body.offsets.offset - before.offset)
        assert self.mae is not None
        estimated = estimate(self.mae, sample.bone_tension, sample.length_read - guess.offset)
        if self.suspects.verification is not None:
            self._verify(sample, estimated, dt, now)
        readings = self._fresh_readings(now)
        self.measured = self._measured_theta(readings)
        self._unchecked += dt
        self._unchecked_sent += sent_apart
        contact = None
        if sample.jumped or not 0.0 < self._unchecked_sent < SPACING:
            self._check(sample, estimated, readings, now)
            contact = self.load
        self.output = Output(sample, estimated.state, estimated.anomaly, contact)
        return self.output

    def _check(
        self, sample: MuscleSample, estimated: Estimate, readings: Array, now: float
    ) -> None:
        """Check the health of the body, and estimate its external load (`load`).

        Args:
            sample: The readings.
            estimated: The network's estimate.
            readings: Fresh readings of the joint sensors [rad], (D,); NaN where there are none.
            now: Time on the steady clock [s].
        """
        dt, sent_apart = min(self._unchecked, LONGEST_STEP), self._unchecked_sent
        self._unchecked = self._unchecked_sent = 0.0
        known = self.body.offsets.known
        demand = self._commands.demand(self.robot, sample, now)
        command = self._commands.length(sample, now)
        observation = Observation(
            sample, estimated, demand, dt, known, self.measured, command, joints=readings, now=now
        )
        self._handle(self.health.step(observation), now)
        self.load = None
        if known and self.robot.tension_source.is_known:
            pull = sample.bone_tension * self.body.used
            self.load = self.contact.step(estimated.state.theta, pull, sent_apart)
            if self.suspects.finding is None:
                contact, load = self.contact, self.load
                self.healthy_torque.step(
                    load.torque, contact.velocity, contact.damping, sent_apart, load.distance
                )
                if contact.is_calibrated:
                    contact.threshold = self.healthy_torque.threshold
        if known and self.suspects.finding is None:
            self.health.step_healthy(observation, self.load)
            self._follow_joint_trust()

    # -- findings, verification and calibration -------------------------------------------------

    def _note(
        self,
        evidence: Evidence | ConditionKind,
        muscles: Iterable[int] | None = None,
        found: LengthOffsets | None = None,
    ) -> None:
        """Note evidence on length offsets; if it changes them or their trust, update the body.

        `LengthTrust.take` describes the arguments.
        """
        if self.trust.take(evidence, muscles, found):
            self._update_body(offsets=self.trust.offsets)

    def _update_body(self, **changes: Any) -> None:
        """Change attributes of the body state, and follow the finding of `suspects`.

        If the body state then differs from the previous one, its generation increases by one, and
        all parts follow it.
        """
        finding, before = self.suspects.finding, self.body
        if finding is not None:
            is_verified = self.suspects.verification is not None
            changes['anomaly'] = Anomaly.VERIFYING if is_verified else Anomaly.FOUND
            changes['suspect'] = finding.muscle
        elif before.has_anomaly:
            changes['anomaly'] = Anomaly.ENDED
        body = replace(before, **changes)
        if body == before:
            return
        self.body = replace(body, generation=before.generation + 1)
        self.stream.use_body(self.body)
        self.networks.follow(self.body, self.received_at)
        if body.has_anomaly and not before.has_anomaly:
            self.health.joint_sensors.drop_newest()
        if (body.offsets.offset != before.offsets.offset).any():
            self.health.forget()

    def _measured_theta(self, readings: Array) -> Array | None:
        """Return the readings [rad], (D,), if they show the posture of all joints, else None.

        Every joint must have a fresh reading from a trusted sensor.
        """
        is_known = not self.joint_trust.unused and np.isfinite(readings).all()
        return readings if is_known else None

    def _fresh_readings(self, now: float) -> Array:
        """Return the usable readings of joint sensors [rad], (D,).

        A joint without a reading in the last 0.05 s (JOINTS_AGE) has NaN.
        """
        theta, time = self._readings
        return np.where(now - time < JOINTS_AGE, theta, np.nan)

    def _handle_jump(self, jumped: tuple[int, ...], now: float) -> None:
        """Respond to a jump of lengths in three cases in which `HealthMonitor.step` does not.

        During a length calibration, the calibration starts again. Without a network, the jump is
        latched as a finding. While other offsets are not known, those of the lengths that have
        jumped are revoked as well.
        """
        if self.calibration is not None:
            # Start again, because readings before and after the jump have different offsets.
            self._note(Evidence.CALIBRATING, jumped)
            self._begin(self._new_calibration(self.calibration.posture, 'a length jumped'))
        elif self.mae is None and self.body.offsets.known:
            self._handle(jump_finding(jumped), now)
        elif not self.body.offsets.known:
            self._note(jump_finding(jumped).kind, jumped)

    def _suspected(self, isolating: tuple[int, ...]) -> list[int]:
        """Return the muscles (indices) that must be repaired before the anomaly may end.

        There are none if the suspect muscle is among the muscles `isolating`.
        """
        finding = self.suspects.finding
        if finding is None or not finding.kind.is_damage or finding.muscle in isolating:
            return []
        return [muscle for muscle in finding.muscles if muscle not in isolating]

    def _note_checked(self, muscles: Iterable[int]) -> None:
        """Note that lengths which changed in a repair have been checked."""
        moved = [muscle for muscle in muscles if self.trust.evidence[muscle] is Evidence.MOVED]
        self._note(Evidence.CHECKED, moved)

    def _refuse_verified(self, service: str, condition: str) -> NoReturn:
        """Refuse a service that would end the verification of the suspect without a verdict.

        Args:
            service: Name of the service without `estimator/`.
            condition: When to call it again, as a text for users.

        Raises:
            MusculoskeletalError: The text says how long to wait.
        """
        assert self.suspects.verified is not None
        raise MusculoskeletalError(
            f'{self.robot.muscles[self.suspects.verified]} is being verified; this ends by itself '
            f'within {LONGEST:g} s; wait until then, and call estimator/{service} again {condition}'
        )

    def _refuse_unrepaired(
        self,
        muscles: Iterable[int],
        service: str,
        problem: Callable[[RepairCheck, int], str] = RepairCheck.problem,
    ) -> None:
        """Refuse a service if the readings of these muscles contradict the rest of the arm.

        Args:
            muscles: Indices of the muscles.
            service: Name of the service without `estimator/`.
            problem: Function that returns why a muscle must not be used yet, or ''.

        Raises:
            MusculoskeletalError: The text says what to repair.
        """
        check = self._repair_check
        problems = [] if check is None else [problem(check, muscle) for muscle in muscles]
        if problems := list(filter(None, problems)):
            again = f'then call estimator/{service} again'
            raise MusculoskeletalError(f'{"; ".join(problems)}; {again}')

    @property
    def _repair_check(self) -> RepairCheck | None:
        """Check of repaired muscles by the newest readings; None without readings or a network."""
        sample, mae, body = self.sample, self.complete_mae, self.body
        if sample is None or mae is None:
            return None
        limit = LARGEST_LEARNED if self.health.residual.is_calibrated else LARGEST_YOUNG
        if not body.offsets.known:
            limit = math.inf
        demand = self._commands.demand(self.robot, sample, self.stepped_at)
        jumping, theta = self.stream.jumping, self.measured
        return RepairCheck(self.robot, mae, sample, body.isolated, theta, demand, jumping, limit)

    def _handle(self, finding: Finding | None, now: float) -> None:
        """Latch a finding and isolate its muscle, as its kind and the settings require.

        A finding that makes a single length unreliable also revokes the offset of this length. A
        finding that makes several lengths unreliable revokes all offsets. A wrong length that the
        repair of a suspect explains is only noted.
        """
        if finding is None:
            return
        if self.suspects.explains(finding):
            self._note(Evidence.MOVED, [finding.muscle])
            self.health.reset()  # evidence from before the repair is no longer valid
            return
        has_network = self.mae is not None
        isolated = self.suspects.take(finding, self.body.isolated, now, has_network)
        if set(isolated) != set(self.body.isolated):
            self.isolate(isolated)
        self._update_body()
        if finding.kind.revokes is not None and finding.muscle not in self.body.isolated:
            self._note(finding.kind, [finding.muscle] if finding.is_of_one_length else None)

    def _verify(self, sample: MuscleSample, estimate: Estimate, dt: float, now: float) -> None:
        verification, muscle, mae = self.suspects.verification, self.suspects.verified, self.mae
        assert verification is not None
        assert muscle is not None
        assert mae is not None
        command = self._commands.newest_length(now)
        pull = np.clip(sample.bone_tension, 0.0, self.robot.tension.limit)
        tension = self.robot.tension_source.known(sample.motor_tension)
        verdict = verification.step(
            tension=float(tension[muscle]),
            length=float(sample.length[muscle]),
            command=None if command is None else float(command[muscle]),
            likely=float(mae.lengths(estimate.state.theta, pull)[muscle]),
            dt=dt,
        )
        if verdict is not None:
            self.health.heat.accept(muscle)
            self.isolate(self.suspects.conclude(verdict, self.body.isolated, now))

    def _calibrate(
        self, calibration: LengthCalibration, sample: MuscleSample, dt: float, now: float
    ) -> LengthOffsets | None:
        """Continue the length calibration, and return the newest estimate of the offsets.

        The result is None before the first estimate.
        """
        theta = self._measured_theta(self._fresh_readings(now))
        evidence = calibration.step(sample.motor_tension, sample.length_read, dt, theta)
        if calibration.contradicts_known:
            self._note(Evidence.CALIBRATING)  # no offset is certain any more
            reason = 'readings contradict the known offsets'
            self._begin(self._new_calibration(calibration.posture, reason))
            return None
        if evidence is not None:
            self._note(evidence, calibration.muscles, calibration.offsets)
        if evidence is Evidence.CALIBRATED:
            self.calibration = None
            self.health.reset()
        return calibration.offsets
