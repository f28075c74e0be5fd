# SPDX-License-Identifier: Apache-2.0
"""The core of the node `estimator`: estimate the joint angles and watch the body's health.

    muscle_states ─► MuscleStream ─► MuscleSample ─► StateEstimator ─► Estimate ─► HealthMonitor
                         ▲                │                              │              │ Finding
                         │                ▼                              ▼              ▼
                     BodyState ◄── LengthCalibration              ContactEstimator   SuspectHandling
                         ▲                                                              │
                         └────────────── isolated muscles ──────────────────────────────┘

The estimator owns the body state. Whenever isolated muscles or length offsets change, it makes a
new one, which its node publishes. While the offsets are being found, only those detectors decide
that do not need lengths. `suspects.py` describes the sequence from a rupture to moving on.
"""

import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation import status
from musculoskeletal_ae.estimation.contact import Contact, ContactEstimator
from musculoskeletal_ae.estimation.detectors.length_jump import finding_of
from musculoskeletal_ae.estimation.finding import REVOKING, Finding, Observation
from musculoskeletal_ae.estimation.health import HealthMonitor
from musculoskeletal_ae.estimation.length_calibration import (
    LengthCalibration,
    check_stated_posture,
)
from musculoskeletal_ae.estimation.marker import posture_of_marker
from musculoskeletal_ae.estimation.module_commands import ModuleCommands
from musculoskeletal_ae.estimation.settings import Detection
from musculoskeletal_ae.estimation.state_estimator import Estimate, StateEstimator
from musculoskeletal_ae.estimation.status import SILENCE
from musculoskeletal_ae.estimation.suspects import SuspectHandling
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.units import State
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import BodyState, LengthOffsets
from musculoskeletal_ae.signals.heat import Heat
from musculoskeletal_ae.signals.muscle_stream import MuscleSample, MuscleStream, RejectionError

#: A pause in the messages counts as at most this much of the time that detectors measure.
LONGEST_PERIOD = 0.1  # [s]
JOINTS_AGE = 0.05  # [s] for which measured joint angles belong to a message
SHIFTED = 0.02  # [m] by which a guess of an offset has to change before it is published again


class Output(NamedTuple):
    """What one message gives.

    Attributes:
        sample: What was read.
        state: (θ, T, l) as the network restores them.
        covariance: Of θ [rad²], (D, D), or None.
        anomaly: A, scaled units.
        detected: Whether this message latches a finding.
        contact: What acts from outside; None while the length offsets are unknown.
    """

    sample: MuscleSample
    state: State
    covariance: Array | None
    anomaly: float
    detected: bool
    contact: Contact | None = None


class Estimator:
    """Composes the parts. `time` is the clock of the messages [s], `now` a steady one [s].

    Attributes:
        robot: The nominal body, with all muscles.
        body: Isolated muscles and length offsets.
        stream: Turns messages into samples.
        heat: Thermal models of the modules.
        state: The state estimator.
        health: The detectors.
        suspects: The latched finding and its verification.
        calibration: The length calibration while it runs, or None.
        contact: The contact estimator.
        sample: The last one that was read; None before the first.
        output: Of the last message with an estimate; None before the first, and when a length
            calibration begins.
        measured: θ by joint sensors [rad] (D,) of that message; None where not all reported.
        stepped_at: When the last message with an estimate came, by the steady clock [s].
    """

    def __init__(self, robot: Robot, preset: str = 'default') -> None:
        """Wait for a network; the preset says what decides that there is an anomaly."""
        self.robot = robot
        self.body = BodyState.healthy(robot.muscle_count)
        self.stream = MuscleStream(robot, self.body)
        self.heat = Heat(robot)
        self.state = StateEstimator()
        self.health = HealthMonitor(robot, preset, heat=self.heat)
        self.suspects = SuspectHandling(robot)
        self.calibration: LengthCalibration | None = None
        self.contact = ContactEstimator(robot)
        self.sample: MuscleSample | None = None
        self.output: Output | None = None
        self.measured: Array | None = None
        self.stepped_at = -math.inf
        self._stated_posture: tuple[float, ...] = ()  # of the last length calibration
        self._jumps = 0  # of lengths, that were handled
        self._valid_offsets = self.body.offsets  # the last ones that were known
        self._commands = ModuleCommands()
        self._measured: tuple[float, Array | None] = -math.inf, None  # θ, and when it came
        #: whether the network says which muscles are isolated: until this estimator decides
        self._follows_network = True

    @property
    def mae(self) -> Mae | None:
        """The network in use, without the isolated muscles."""
        return self.state.mae

    @property
    def cause(self) -> str:
        """The latched finding, for people, or ''."""
        return self.suspects.cause

    # -- what is set ----------------------------------------------------------------------------

    def configure(self, settings: Detection) -> None:
        """Use these settings of detection."""
        self.health.configure(settings)
        self.suspects.settings = settings

    def use(self, mae: Mae) -> None:
        """Use this network and its healthy statistics, without the isolated muscles.

        Until this estimator has isolated or found anything, or `keep_isolated` was called, those
        are the muscles that were isolated when the network was learned. A length calibration
        begins again: its guess depends on the network.

        Raises:
            numpy.linalg.LinAlgError: If its statistics are singular; the network before stays.
        """
        isolated = mae.isolated if self._follows_network else self.body.isolated
        reduced = mae.without(isolated)
        self.health.use(reduced)
        self.contact.use(reduced)
        self.stream.use_friction(reduced.friction)
        self.state.use(mae, isolated)
        self._use_body(self.body.with_isolated(isolated))
        if self.calibration is not None:
            self.calibration = LengthCalibration(self.robot, reduced, self.calibration.posture)

    def keep_isolated(self) -> None:
        """Follow no network any more in which muscles are isolated: from now on we know."""
        self._follows_network = False

    def isolate(self, muscles: Iterable[int]) -> None:
        """Isolate these muscles (positions in T and l), and restore all others.

        A suspect among the others is verified no longer; what was found stays latched.
        """
        self._follows_network = False
        body = self.body.with_isolated(muscles)
        has_changed = body is not self.body
        self._use_body(body)
        self.suspects.on_isolated(body.isolated)
        if has_changed and self.state.complete_mae is not None:
            self.use(self.state.complete_mae)
        self.health.reset()

    def forget_offsets(self) -> None:
        """Consider the length offsets unknown, until a calibration finds them."""
        self._use_body(self.body.with_offsets(LengthOffsets.unknown(self.robot.muscle_count)))

    def calibrate_lengths(self, posture: tuple[float, ...] = ()) -> None:
        """Begin to find the length offsets, while the arm stands in a posture or moves gently.

        Args:
            posture: θ in which the arm stands [rad], (D,); () if it moves gently.

        Raises:
            MusculoskeletalError: If there is no network, or no such posture.
        """
        if self.mae is None:
            raise MusculoskeletalError('no checkpoint, and length offsets are found with a network')
        check_stated_posture(self.robot, posture)
        self._stated_posture = posture
        stated = np.array(posture) if posture else None
        self.calibration = LengthCalibration(self.robot, self.mae, stated)
        self.forget_offsets()
        self.health.residual.forget_reading()
        self.output = None
        self.contact.reset()
        self.reset()
        self.health.joints.forget()

    def commanded(
        self, now: float, length: Array | None = None, tension: Array | None = None
    ) -> None:
        """Note the target lengths [m] or tensions [N] (M,) sent to the modules."""
        self._commands.note(now, length, tension)

    def joints(self, theta: Array, now: float) -> None:
        """Note measured θ [rad] (D,), which length calibration uses."""
        self._measured = now, theta

    def reset(self) -> None:
        """Clear the anomaly: the body is considered healthy as it is.

        Raises:
            MusculoskeletalError: If the length offsets have been revoked, and joint sensors do not
                agree with the lengths.
        """
        if self.body.offsets.is_suspect:
            if not self.health.joints.agrees:
                raise MusculoskeletalError(self.cause)
            self._use_body(self.body.with_offsets(self._valid_offsets))
        self.health.accept(range(self.robot.muscle_count))
        self._clear(self.suspects.clear(self.body.isolated))

    def clock_jumped_back(self) -> None:
        """Forget what came before; a latched finding stays."""
        self.sample = None
        self.stream.reset()
        self.health.reset()
        self.contact.reset()

    # -- messages -------------------------------------------------------------------------------

    def take(self, message: Any, time: float, now: float) -> Output | None:
        """Take a muscle_states message; see `step`.

        Raises:
            RejectionError: If the message cannot be used.
        """
        return self._take(partial(self.stream.take, message, time, now), now)

    def step(self, states: Array, time: float, now: float) -> Output | None:
        """Take l as it was read [m], T [N] and temperature [°C], (3, M).

        Returns:
            The estimate; None without a network, or while nothing is known of the length offsets.

        Raises:
            RejectionError: If the values are not plausible.
        """
        return self._take(partial(self.stream.take_states, states, time, now), now)

    def posture_of_marker(self, pose: pin.SE3) -> Array:
        """Return θ [rad] (D,) that brings the end effector to a pose in the frame of the root link.

        NaN for joints that do not move it.

        Raises:
            MessageError: If the pose is out of reach.
        """
        middle = 0.5 * (self.robot.lower + self.robot.upper)
        start = middle if self.output is None else self.output.state.theta
        return posture_of_marker(self.robot, pose, start)

    def report(self, now: float) -> Report:
        """Return what /diagnostics shows."""
        return status.report(self, now)

    def _take(self, take: Callable[[], MuscleSample], now: float) -> Output | None:
        try:
            sample = take()
        except RejectionError as error:
            if error.states is not None:
                self._handle(self.health.read(error.states, self.body.used, now), now)
            raise
        self._handle(self.health.read(sample.newest, self.body.used, now), now)
        self._handle_jump(now)
        before, self.sample = self.sample, sample
        elapsed = 0.0 if before is None else max(sample.time - before.time, 0.0)
        temperature = np.where(self.body.used, sample.temperature, np.nan)
        self.heat.step(sample.motor_tension, temperature, elapsed)
        if self.mae is None:
            return None
        self.stepped_at = now
        if elapsed > SILENCE:
            self.contact.reset()
        return self._estimate(sample, elapsed, now)

    def _estimate(self, sample: MuscleSample, elapsed: float, now: float) -> Output | None:
        dt, guess = min(elapsed, LONGEST_PERIOD), self.body.offsets
        if self.calibration is not None:
            before = self.body.offsets
            newest = self._calibrate(self.calibration, sample, dt, now)
            if newest is None:
                return None
            guess = newest
            sample = sample.shifted(self.body.offsets.offset - before.offset)
        estimate = self.state.step(sample.bone_tension, sample.length_read - guess.offset)
        if self.suspects.verification is not None:
            self._verify(sample, estimate, dt, now)
        demand = self._commands.demand(self.robot, sample.length, now)
        known = self.body.offsets.known
        self.measured = self._measured_theta(now)
        finding = self.health.step(Observation(sample, estimate, demand, dt, known, self.measured))
        detected = self._handle(finding, now)
        contact = None
        if known:
            pull = sample.bone_tension * self.body.used
            contact = self.contact.step(estimate.state.theta, pull, elapsed)
        self.output = Output(
            sample, estimate.state, estimate.covariance, estimate.anomaly, detected, contact
        )
        return self.output

    # -- what follows ---------------------------------------------------------------------------

    def _use_body(self, body: BodyState) -> None:
        if body.offsets.known:
            self._valid_offsets = body.offsets
        self.body = body
        self.stream.use_body(body)

    def _measured_theta(self, now: float) -> Array | None:
        """Return θ [rad] (D,) by joint sensors, if all have reported it with this message."""
        came, theta = self._measured
        if theta is None or now - came >= JOINTS_AGE or not np.isfinite(theta).all():
            return None
        return theta

    def _handle_jump(self, now: float) -> None:
        """Take that lengths have jumped, where detectors do not see it."""
        if self.stream.jumps == self._jumps:
            return
        self._jumps = self.stream.jumps
        jumped = tuple(sorted(self.stream.displaced))
        if self.calibration is not None:  # what it has collected is of other offsets
            self.calibrate_lengths(self._stated_posture)
        elif self.mae is None and self.body.offsets.known and jumped:
            self._handle(finding_of(jumped), now)

    def _handle(self, finding: Finding | None, now: float) -> bool:
        """Take what detectors found, if anything; return whether it is latched now, and new."""
        if finding is None:
            return False
        before = self.suspects.finding
        isolated = self.suspects.take(finding, self.body.isolated, now)
        if set(isolated) != set(self.body.isolated):
            self.isolate(isolated)
        revokes = finding.kind in REVOKING and finding.muscle not in self.body.isolated
        if revokes and self.body.offsets.known:
            self._use_body(self.body.with_offsets(self.body.offsets.revoked()))
        is_latched = before is None and self.suspects.finding is not None
        if is_latched:
            self._follows_network = False
        return is_latched

    def _verify(self, sample: MuscleSample, estimate: Estimate, dt: float, now: float) -> None:
        verification, mae = self.suspects.verification, self.mae
        assert verification is not None
        assert mae is not None
        muscle, command = verification.muscle, self._commands.length(now)
        pull = np.clip(sample.bone_tension, 0.0, self.robot.tension.limit)
        verdict = verification.step(
            tension=float(sample.motor_tension[muscle]),
            length=float(sample.length[muscle]),
            command=None if command is None else float(command[muscle]),
            likely=float(mae.lengths(estimate.state.theta, pull)[muscle]),
            dt=dt,
        )
        if verdict is not None:
            self.health.accept([muscle])
            self._clear(self.suspects.conclude(verdict, self.body.isolated, now))

    def _clear(self, isolated: tuple[int, ...]) -> None:
        if isolated != self.body.isolated:
            self.isolate(isolated)
        self.health.reset()

    def _calibrate(
        self, calibration: LengthCalibration, sample: MuscleSample, dt: float, now: float
    ) -> LengthOffsets | None:
        """Go on with the length calibration; return the newest guess of the offsets, if any."""
        measured = self._measured_theta(now)
        calibration.step(sample.motor_tension, sample.length_read, dt, measured)
        guess = calibration.offsets
        if guess is None or (calibration.is_standing and not calibration.is_done):
            return None  # nobody may move a standing arm
        # A guess is published again only if it has changed: who follows it goes on from there.
        difference = np.abs(guess.offset - self.body.offsets.offset).max()
        if guess.known or self.output is None or difference > SHIFTED:
            self._use_body(self.body.with_offsets(guess))
        if calibration.is_done:
            self.calibration = None
            self.health.reset()
        return guess
