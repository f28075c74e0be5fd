# SPDX-License-Identifier: Apache-2.0
"""The controller: connects all parts that turn targets into safe commands.

    target, pose, trajectory ─► planner ─► activity ─┐
                                 causes ─► supervisor ┤─► limiter ─► command
                                            safe stop ┘

The supervisor decides what the arm does (`supervisor`). One object for each activity computes the
commands (`follower`, `ramps`, `torque`, `exploration`, `calibration_motion`). Every command passes
the limiter before it is published.

Plans assume that isolated muscles have no tension, and the modules of isolated muscles are
commanded to keep the tendons slack. While the estimator verifies a suspect, which is a muscle that
may be faulty, the arm is stopped and the suspect is wound in slightly. The arm resumes when the
verification has ended the anomaly, unless another stop cause needs a reset.

`now` is the time of a steady clock [s], and `time` is the time of the messages' clock [s].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.awake_clock import PAUSE, AwakeClock
from musculoskeletal_ae.conditions import ORDER, Condition, ConditionKind
from musculoskeletal_ae.control import controller_status
from musculoskeletal_ae.control.holding import HoldingCheck
from musculoskeletal_ae.control.limiter import CommandLimiter
from musculoskeletal_ae.control.resting_load import RestingLoad
from musculoskeletal_ae.control.settings import Settings, Setup
from musculoskeletal_ae.control.stop_commands import SafeStop
from musculoskeletal_ae.control.supervisor import Activity, Supervisor
from musculoskeletal_ae.control.watchdog import Watchdog
from musculoskeletal_ae.exceptions import MessageError, RobotDescriptionError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.messages.message_reading import TrajectoryPoints
from musculoskeletal_ae.motion.activities import (
    LENGTH,
    TENSION,
    ActivityControl,
    Command,
    Inputs,
)
from musculoskeletal_ae.motion.calibration_motion import Calibrating, gentle_limit
from musculoskeletal_ae.motion.exploration import Exploration, Exploring
from musculoskeletal_ae.motion.follower import Follower
from musculoskeletal_ae.motion.planner import NOT_HOLDABLE, Planner
from musculoskeletal_ae.motion.present_motion import PresentMotion
from musculoskeletal_ae.motion.ramps import LengthRamps, RampedTarget
from musculoskeletal_ae.motion.torque import GravityCompensation, TorqueControl
from musculoskeletal_ae.motion.trajectory import STOPPING, Setpoint, Trajectory
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import BodyState
from musculoskeletal_ae.signals.muscle_states import MuscleReadings
from musculoskeletal_ae.signals.muscle_stream import MuscleSample, MuscleStream, RejectionError
from musculoskeletal_ae.signals.reading_limits import LIMITS, Persistence, check_posture

WINDOW = 3  # take the median of this many messages, so that a single outlier has no effect
RESTORE = 'call estimator/restore to use isolated muscles again'
GUIDED = (
    'with method `float`, the arm is guided by hand; set the parameter `method` to another method'
)
#: after a length calibration has begun, wait this long for its first estimate before the estimate
#: counts as stale [s]; if messages arrive at 10 Hz, a calibration needs 3.5 s
FIRST_ESTIMATE = 5.0


@dataclass
class Target:
    """The last requested target.

    Attributes:
        theta: Posture [rad], (D,); None before the first target.
        effort: Torque in addition to gravity compensation [N·m], (D,).
        clamped: Joints whose target was changed, because it was beyond the joint limits or because
            the posture was not holdable.
        unreachable_reason: Why the arm moves to another posture than the requested one, or has
            forgotten its target, or ''.
    """

    effort: Array
    theta: Array | None = None
    clamped: tuple[str, ...] = ()
    unreachable_reason: str = ''


class Activities:
    """Holds one object for each activity, and switches between them."""

    def __init__(self, setup: Setup, seed: int) -> None:
        self._setup = setup
        self.ramps = LengthRamps(setup)
        self.follower = Follower(setup)
        self.ramped_target = RampedTarget(self.ramps, setup)
        self.exploring = Exploring(Exploration(setup, seed), self.ramps)
        self.calibrating = Calibrating(setup, seed)
        self.torque = TorqueControl(setup)
        self.gravity_compensation = GravityCompensation(setup)
        #: the activity that issued the last command; None if it was interrupted since then
        self.entered: ActivityControl | None = None

    def of(self, activity: Activity) -> ActivityControl | None:
        """Return the object that implements an activity; None for `IDLE`."""
        settings = self._setup.settings
        if activity is Activity.HOLDING:
            if settings.control_method.commands_tension:
                return self.torque
            return self.follower if settings.is_by_follower else self.ramped_target
        others: dict[Activity, ActivityControl] = {
            Activity.MOVING: self.follower,
            Activity.EXPLORING: self.exploring,
            Activity.CALIBRATING: self.calibrating,
            Activity.GRAVITY_COMPENSATION: self.gravity_compensation,
        }
        return others.get(activity)

    def leave(self) -> None:
        """Leave the present activity, because another activity or a stop follows."""
        if self.entered is not None:
            self.entered.leave()
        self.entered = None
        self.follower.leave()  # discards a trajectory that has not begun, too

    def step(self, control: ActivityControl, inputs: Inputs) -> Command | None:
        """Switch to the activity `control` if another one was active, and return its command."""
        if control is not self.entered:
            if self.entered is not None:
                self.entered.leave()
            control.enter(inputs)
            self.entered = control
        return control.step(inputs)


class Controller:
    """Computes motor commands from targets, the estimated posture and muscle states.

    It owns the supervisor, the watchdog, the planner, the activities and the limiter, and passes
    each message and each control step to them. It does not depend on ROS.
    """

    def __init__(
        self,
        robot: Robot,
        settings: Settings | None = None,
        seed: int = 0,
        clock: AwakeClock | None = None,
    ) -> None:
        """Create a controller that has no target and has received no message.

        Args:
            robot: The robot to control.
            settings: The settings; None for the defaults.
            seed: Random seed of the exploration.
            clock: Clock that excludes pauses of the process from the ages of messages; each control
                step ticks it. None to create one.
        """
        self.setup = setup = Setup(robot, settings or Settings())
        setup.settings.check_fit(robot)
        self.mae: Mae | None = None
        self.stream = MuscleStream(robot, window=WINDOW)
        self.sample: MuscleSample | None = None
        #: plausible readings if the newest message was rejected (`RejectionError`), else None
        self.rejected: MuscleReadings | None = None
        #: Estimated θ [rad], (D,), computed with the present length offsets. None while there is no
        #: such estimate, for example after the start of a length calibration; the arm then does not
        #: move.
        self.estimate: Array | None = None
        self.present_motion = PresentMotion()
        self.target_state = Target(np.zeros(robot.joint_count))
        self.supervisor = Supervisor()
        self.watchdog = Watchdog(setup, clock)
        self.planner = Planner(setup)
        self.activities = Activities(setup, seed)
        self.limiter = CommandLimiter(setup)
        self.stopping = SafeStop(setup, self.limiter)
        self.holding = HoldingCheck(robot)
        self.resting_load = RestingLoad(robot)
        self.sent_at = 0.0  # time of the last publication [s]; set by the caller
        self._estimate_problem = Persistence()
        #: number of messages after which the filtered muscle states are newer than the last pause
        self._awaited_samples = 0
        if self.settings.control_method.is_guided:
            self.supervisor.on_request(Activity.GRAVITY_COMPENSATION)

    # -- settings and messages ------------------------------------------------------------------

    @property
    def robot(self) -> Robot:
        """The robot description in use, in which isolated muscles have no tension."""
        return self.setup.robot

    @property
    def settings(self) -> Settings:
        """The settings in use."""
        return self.setup.settings

    def configure(self, settings: Settings) -> None:
        """Configure all parts with new settings.

        If the method or the preset changes while the arm has a target, the arm moves to this
        target anew, starting from the present tensions. After method `float`, the arm stays where
        the hand has led it.

        Raises:
            ParameterError: If the joint stiffness or the method does not fit the robot.
        """
        settings.check_fit(self.robot)
        before, units = self.settings, self.robot.units
        is_stiffer = settings.desired_stiffness(units) != before.desired_stiffness(units)
        self.setup.settings = settings
        is_other = (settings.method, settings.preset) != (before.method, before.preset)
        nothing = np.zeros(self.robot.joint_count)
        if settings.control_method.is_guided:
            self.target_state = Target(nothing)
            self._request(Activity.GRAVITY_COMPENSATION)
        elif before.control_method.is_guided:
            # While length offsets are unknown, the estimated posture may be wrong.
            here = self.estimate if self.stream.body.offsets.known else None
            if here is not None:
                here = np.clip(here, self.robot.lower, self.robot.upper)
            self.target_state = Target(nothing, here)
            self._hold()
        elif is_other and not self.supervisor.explores:
            self._hold()
        if settings.control_method.sets_stiffness and is_stiffer.any():
            self.activities.follower.plan_anew()

    def use(self, mae: Mae) -> None:
        """Use another network, which has been validated."""
        self.mae = mae
        self.present_motion.forget()
        self.stream.use_transmission(mae.transmission)
        robot = self.robot.with_elasticity(mae.elasticity)
        if robot is not self.robot:
            self.setup.robot = robot
        self.activities.follower.plan_anew()
        self.resting_load.use(mae)
        if self.activities.entered is self.activities.ramped_target:
            self.activities.ramps.solve_again()

    def take(self, message: Any, now: float, delay: float = 0.0) -> None:
        """Check and filter a message of muscle_states, and use its values from now on.

        Args:
            message: The message of `muscle_states`, or `MuscleReadings`.
            now: Time of reception by the steady clock [s].
            delay: How late the message is (`Arrival.delay`) [s].

        Raises:
            RejectionError: If the message cannot be used.
        """
        try:
            sample = self.stream.take(message, now, delay=delay)
        except RejectionError as error:
            # The tensions of a rejected message may be right. If one is too high, limiter and
            # watchdog have to react.
            if error.plausible is not None:
                self.rejected = error.plausible
                tension = error.plausible.tension
                self.watchdog.take_rejected(tension, self.stream.body.used, now, delay)
            raise
        self._use_sample(sample, now)

    def _use_sample(self, sample: MuscleSample, now: float) -> None:
        self.sample, self.rejected = sample, None
        self.watchdog.take_sample(sample, now)
        # Messages that had waited during a pause show how the arm was before it.
        if self._awaited_samples and sample.delay <= PAUSE:
            self._awaited_samples -= 1
            if not self._awaited_samples:
                self.limiter.restart(sample, self.supervisor.is_running)

    def estimated(
        self, theta: Array, now: float, is_new: bool = True, time: float | None = None
    ) -> None:
        """Check the estimated posture θ [rad], (D,), and use it for control from now on.

        Args:
            theta: The posture.
            now: Time of reception by the steady clock [s].
            is_new: False for a repeated estimate, which is no new data for the watchdog.
            time: Time of the posture by the messages' clock [s]; None if this is the steady clock.

        Raises:
            MessageError: If the posture is implausible.
        """
        known = self.stream.body.offsets.known
        if not known:  # provisional offsets can lead to any estimate
            theta = np.clip(theta, self.robot.lower, self.robot.upper)
        try:
            check_posture(self.robot, theta, LIMITS.estimate_outside)
        except MessageError as error:
            self._estimate_problem.note(str(error), now)
            raise
        self._estimate_problem.note('', now)
        if is_new:
            self.watchdog.estimate.use(now)
            self.present_motion.step(theta, now if time is None else time)
        self.estimate = theta

    def use_body(self, body: BodyState) -> None:
        """Use a body state: its length offsets, isolated muscles and anomaly."""
        before = self.stream.body
        if body.offsets != before.offsets:
            self._use_offsets(body)
        self.stream.use_body(body)
        if body.isolated != before.isolated:
            self.setup.robot = self.robot.without(body.isolated)
            self.present_motion.forget()  # the estimate uses other muscles now
            self.target_state.unreachable_reason = ''
            if self.mae is not None:
                self.activities.follower.plan_anew()
        self._use_anomaly(body)

    def _use_anomaly(self, body: BodyState) -> None:
        """Stop the arm while an anomaly is present; resume after the verification of a suspect."""
        if body.has_anomaly:
            self.stop(ConditionKind.ANOMALY)
        self.supervisor.on_anomaly(body.anomaly)

    def _use_offsets(self, body: BodyState) -> None:
        before = self.stream.body.offsets
        self.present_motion.forget()
        self.limiter.shift(body.offsets.offset - before.offset)
        self.stopping.shift(body.offsets.offset - before.offset)
        if self.sample is not None:
            self.sample = self.sample.shifted(body.offsets.offset - before.offset)
        is_known = body.offsets.known
        if is_known != before.known or (body.offsets.offset != before.offset).any():
            self.activities.leave()
            self.supervisor.on_offsets(is_known)
        if not is_known and not body.offsets.revoked:
            # A length calibration begins or continues. The estimate is discarded, because it was
            # computed with other offsets.
            self.watchdog.estimate.expect_later(self.watchdog.steps.stepped_at, FIRST_ESTIMATE)
            self.estimate = None
        self.limiter.offsets_known = is_known

    def clock_jumped_back(self) -> None:
        """Adapt to a backward jump of the messages' clock.

        The comparison of this clock with the steady clock starts again, and the muscle states of
        earlier messages are discarded from the filters.
        """
        self.watchdog.steps.clock_jumped_back()
        self.stream.reset()
        self.present_motion.forget()

    # -- commands from users --------------------------------------------------------------------

    def target(self, joints: Mapping[str, tuple[float, float]]) -> None:
        """Set the targets of some joints; other joints keep their targets.

        If there is no target yet, other joints keep their estimated angles. Targets beyond the
        joint limits are clamped.

        Args:
            joints: Target angle [rad] and effort [N·m] of each of these joints, by name. The effort
                is a torque in addition to gravity compensation.

        Raises:
            MessageError: If the target is refused.
        """
        self._refuse_gravity_compensation()
        robot, state = self.robot, self.target_state
        kept = self.estimate if state.theta is None else state.theta
        if kept is None and len(joints) < robot.joint_count:
            raise MessageError(
                'no posture estimated yet', 'name all joints, or wait for an estimate'
            )
        before = zip(np.zeros(robot.joint_count) if kept is None else kept, state.effort)
        theta, effort = np.array([joints.get(*pair) for pair in zip(robot.joints, before)]).T
        goal = np.clip(theta, robot.lower, robot.upper)
        reason = ''
        if self.mae is not None and self.estimate is not None:
            nearest = self.planner.takes_nearest
            goal, reason = self.planner.reachable(self.mae, self.estimate, goal, nearest)
        clamped = tuple(n for n, a, b in zip(robot.joints, theta, goal) if a != b)
        self.target_state = Target(effort, goal, clamped, reason)
        if not (self.supervisor.is_running and self.settings.is_by_follower and self._is_ready):
            self._hold()  # the arm moves to the target as soon as it may move
            return
        try:
            self._approach(self.settings.target_duration)
        except MessageError:
            self.target_state = state
            raise
        except Exception as error:  # noqa: BLE001 (as in `_desired`)
            self._note_fault(error)

    def trajectory(self, points: TrajectoryPoints | None, delay: float = 0.0) -> None:
        """Follow a trajectory through points, or come to rest and hold if there are none.

        Args:
            points: The points; None to come to rest now.
            delay: Time until the trajectory starts [s]; negative if it started in the past.

        Raises:
            MessageError: If the trajectory is refused; nothing is changed then.
        """
        start, mae = self._ready(0.0 if points is None else max(delay, 0.0))
        if points is None:
            self._follow(self.planner.to_rest(start))
        else:
            lag = self.activities.follower.winches.lag
            trajectory = self.planner.through(mae, start, points, max(-delay, 0.0), lag)
            self._follow(trajectory, delay=max(delay, 0.0))

    def pose(self, pose: pin.SE3, whole: bool, now: float) -> None:
        """Move the end effector to a pose in the root link's frame.

        Args:
            pose: The pose.
            whole: True to reach position and orientation, False for the position alone.
            now: Present time [s].

        Raises:
            MessageError: If the pose is refused; nothing is changed then.
        """
        start, mae = self._ready()
        progress = self.activities.follower.progress
        if progress.is_moving and self.planner.is_under_way(pose, whole, progress.latest):
            self.planner.repeat_pose(now)
            return
        self._follow(*self.planner.to_pose(mae, start, pose, whole, now))

    def twist(self, twist: Array) -> None:
        """Move the end effector at a given velocity for `hand.TWIST_TIMEOUT` seconds.

        Args:
            twist: Linear [m/s] and angular [rad/s] velocity in the axes of the root link, (6,).

        Raises:
            MessageError: If the twist is refused; nothing is changed then.
        """
        start, mae = self._ready()
        self._follow(self.planner.by_twist(mae, start, twist))

    def explore_at_start(self) -> str:
        """Start the exploration if this is possible; return the reason if it is refused, else ''.

        A refused exploration is reported until it begins or a request replaces it.
        """
        reason = self.explore(True)
        self.supervisor.awaits_exploration = reason != ''
        return reason

    def explore(self, wanted: bool) -> str:
        """Start the exploration if `wanted`, else end it; return why this is refused, or ''."""
        condition = self.supervisor.condition
        if wanted and condition is not None:
            if self.supervisor.is_latched:
                return f'stopped: {condition.text}'
            return f'paused: {condition.text}: try again when the pause has ended'
        if wanted and self.settings.control_method.is_guided:
            return GUIDED
        if wanted and not (self.robot.tension_source.is_known or self.stream.body.offsets.known):
            return (
                'the length offsets are unknown, and exploration cannot determine them without '
                'tensions (tension_source: none); hold the arm still, set the parameter '
                'zero_posture of the estimator, and call estimator/zero'
            )
        if wanted and not self.stream.body.used.any():
            return f'all muscles are isolated; {RESTORE}'
        if wanted != self.supervisor.explores:
            self.target_state = Target(np.zeros(self.robot.joint_count))
            known = self.stream.body.offsets.known
            exploring = Activity.EXPLORING if known else Activity.CALIBRATING
            self._request(exploring if wanted else Activity.IDLE)
        elif not wanted:
            self.supervisor.awaits_exploration = False
        return ''

    def stop(self, cause: ConditionKind, detail: str = '') -> None:
        """Stop the arm for a cause, with an optional detail; the stop lasts until `reset`."""
        self.activities.leave()  # a reset before the next step must not continue a trajectory
        self.supervisor.on_event(cause.condition(detail))

    def reset(self, now: float) -> Condition | None:
        """End a stop and continue to the last target, unless a stop cause is present.

        Returns:
            The first stop cause that is present, or None if the stop has ended.
        """
        return self.supervisor.on_reset(self.stop_conditions(now))

    # -- time -----------------------------------------------------------------------------------

    def conditions(self, now: float) -> tuple[Condition, ...]:
        """Return everything that users should know: causes of the stop, and warnings."""
        return controller_status.conditions(self, now)

    def report(self, now: float) -> Report:
        """Return the status for /diagnostics."""
        return controller_status.report(self, now)

    def stop_conditions(self, now: float) -> list[Condition]:
        """Return the stop causes that are present, in the order of `ConditionKind`."""
        present = self.watchdog.conditions(now)
        if self.mae is None:
            present.append(ConditionKind.NO_CHECKPOINT.condition())
        if self.stream.body.has_anomaly:
            present.append(ConditionKind.ANOMALY.condition())
        if detail := self.stream.implausible(now):
            present.append(ConditionKind.IMPLAUSIBLE_MUSCLE_STATES.condition(detail))
        if detail := self._revoked_lengths:
            present.append(ConditionKind.LENGTH_OFFSETS_REVOKED.condition(detail))
        if detail := self._estimate_problem.lasting(now):
            present.append(ConditionKind.IMPLAUSIBLE_ESTIMATE.condition(detail))
        return sorted(present, key=lambda condition: ORDER[condition.identifier])

    @property
    def _revoked_lengths(self) -> str:
        """Whose length offsets the estimator has revoked, as a text; '' if it has revoked none."""
        muscles = self.stream.body.offsets.revoked
        if not muscles:
            return ''
        names = '' if len(muscles) == self.robot.muscle_count else self.robot.names(muscles)
        of_muscles = f' of {names}' if names else ''
        return f'the estimator has revoked the length offsets{of_muscles}'

    def step(self, now: float, time: float | None = None) -> Command | None:
        """Advance all parts to `now`, and return the command to publish; None to publish nothing.

        Args:
            now: Time of the steady clock [s].
            time: Time of the messages' clock [s]; None if this is the steady clock.
        """
        # The rate limit applies to the time since the last publication. The time since the last
        # step is longer, because it also contains the computation of the last command.
        steps = self.watchdog.steps
        computing = min(steps.pace, 1.0) * max(self.sent_at - steps.stepped_at, 0.0)
        time = now if time is None else time
        step = steps.step(now, time, not self.supervisor.is_running)
        if step.has_paused:  # the arm may have moved: restart the activity from the new posture
            self.activities.entered, self._awaited_samples = None, WINDOW
        present = self.stop_conditions(now)
        if self.limiter.command is not None or not self.supervisor.is_running:
            # Before the first command, causes do not stop the arm, because it does not move yet.
            self.supervisor.on_conditions(present, step.elapsed, self.stopping.is_releasing)
        fall = self.limiter.largest_change(TENSION, step.dt)
        self.watchdog.heat.lower(fall)
        dt, desired = max(step.dt - computing, 0.0), None
        if self.supervisor.is_running:
            self.stopping.leave()
            desired = None if present else self._desired(step.dt)
        if self.supervisor.is_running:  # the activity has not stopped the arm
            # Without a desired command, the last one is repeated, and has to keep the limits, too.
            limited = self._limited(desired or self.limiter.command, dt)
            if desired is not None and limited is None:
                self.stop(ConditionKind.COMMAND_NOT_FINITE)
        if not self.supervisor.is_running:
            limited = self._limited(self._stopped(present, step.dt), dt)
        held = self._held_posture
        self.holding.step(held, self.estimate, step.dt)
        self.resting_load.step(held, self.estimate, self._bone_tension, step.dt)
        if self._awaited_samples:
            return None  # the modules may have paid out; the last command would jerk the arm
        return limited or self.limiter.command

    @property
    def _held_posture(self) -> Array | None:
        """Posture [rad], (D,), at which the arm should rest now; None if no posture is demanded.

        The arm is not required to rest while it moves or is stopped, or while its target contains
        a torque in addition to gravity compensation.
        """
        activity, target = self.supervisor.activity, self.target_state
        control = self.activities.of(activity)
        is_holding = activity is Activity.HOLDING and self.supervisor.is_running
        has_arrived = is_holding and control is not None and control.has_arrived
        return target.theta if has_arrived and not target.effort.any() else None

    @property
    def _bone_tension(self) -> Array | None:
        """Bone-side tensions [N], (M,), 0 for isolated muscles; None if no sensor measures them.

        The friction of a drive at rest leaves the tension of a motor current undetermined.
        """
        source = self.robot.tension_source
        if self.sample is None or not source.is_known or source.is_current:
            return None
        return self.sample.bone_tension * self.sample.usable

    def _desired(self, dt: float) -> Command | None:
        """Return the command of the present activity, or None if there is none.

        If the activity raises an exception, the arm stops. There is one exception to this rule: if
        the muscles can hold too few postures to explore, or cannot move the arm to the target, the
        activity ends without a stop.
        """
        control = self.activities.of(self.supervisor.activity)
        known = self.stream.body.offsets.known
        may_move = known or control is self.activities.calibrating
        # Without an estimate, the arm waits for the next one, which a length calibration provides.
        if control is None or self.estimate is None or not may_move:
            self.activities.leave()
            return None
        try:
            return self._slack(self._step(control, self._inputs(dt)))
        except RobotDescriptionError as error:  # too few postures are holdable to explore
            reason = str(error)
            if isolated := self.robot.names(self.robot.isolated):
                reason = f'too few postures are holdable without {isolated}; {RESTORE}'
            self._give_up(reason)
        except MessageError as error:
            if error.reason == NOT_HOLDABLE:
                self._give_up(str(error))
            else:
                self._note_fault(error)
        except Exception as error:  # noqa: BLE001 (any exception has to stop the arm)
            self._note_fault(error)
        return None

    def _give_up(self, reason: str) -> None:
        """End the activity and forget the target, because the muscles cannot do what they should.

        The tensions stay as they are.
        """
        self._request(Activity.IDLE)
        self.target_state = Target(np.zeros(self.robot.joint_count), unreachable_reason=reason)

    def _note_fault(self, error: Exception) -> None:
        self.stop(ConditionKind.CONTROL_FAULT, f'{type(error).__name__}: {error}')

    def _step(self, control: ActivityControl, inputs: Inputs) -> Command | None:
        """Return the command of an activity; tell the supervisor when its motion has ended.

        If the follower has no trajectory, because a stop or another activity has discarded it, the
        arm first approaches the target.
        """
        follower = self.activities.follower
        is_discarded = control is follower and follower.progress.trajectory is None
        if is_discarded and self.target_state.theta is not None:
            self._approach(self.settings.first_duration)
        command = self.activities.step(control, inputs)
        if control.has_arrived:
            self.supervisor.on_arrival()
        return command

    def _inputs(self, dt: float) -> Inputs:
        # Without a stop cause, all inputs are available.
        assert self.mae is not None and self.sample is not None and self.estimate is not None
        sample = self.sample
        return Inputs(
            mae=self.mae,
            sample=sample,
            motor_tension=sample.motor_tension * sample.usable,
            bone_tension=sample.bone_tension * sample.usable,
            theta=self.estimate,
            length=self.limiter.last(LENGTH, sample).value,
            tension=self.limiter.last(TENSION, sample).value,
            limit=np.minimum(self.watchdog.heat.planned, self.robot.tension.limit),
            target=self.target_state.theta,
            effort=self.target_state.effort,
            dt=dt,
        )

    def _slack(self, command: Command | None) -> Command | None:
        """Replace the values of isolated muscles by values that keep their tendons slack."""
        if command is None or not self.robot.isolated:
            return command
        released = self.limiter.slack_length if command.kind == LENGTH else 0.0
        return Command(command.kind, np.where(self.robot.used, command.value, released))

    def _stopped(self, present: list[Condition], dt: float) -> Command | None:
        """Return the command of an arm that the causes `present` stop, after a step of dt [s]."""
        self.activities.leave()
        if self.sample is None:
            return None
        # After an auto-recoverable cause has cleared, the arm waits to resume. This time does not
        # count towards the hold time.
        waits = not self.supervisor.is_latched and not present
        causes = {condition.kind for condition in present}
        is_fresh = ConditionKind.STALE_MUSCLE_STATES not in causes
        # While estimates are missing, the estimator does not judge the suspect.
        is_judged = ConditionKind.STALE_ESTIMATE not in causes
        winds = self.supervisor.may_wind_suspect and is_judged
        suspect = self.stream.body.verified if winds else None
        at_once = self.supervisor.releases_at_once
        return self.stopping.step(self.sample, 0.0 if waits else dt, is_fresh, suspect, at_once)

    def _limited(self, desired: Command | None, dt: float) -> Command | None:
        if desired is None or self.sample is None:
            return None
        limit = self.watchdog.heat.momentary
        if not self.stream.body.offsets.known:
            limit = np.minimum(limit, gentle_limit(self.robot))
        is_winding = self.is_following and self.supervisor.is_running
        lead = self.activities.follower.winches.lead if is_winding else 0.0
        return self.limiter.limit(desired, self.sample, limit, dt, lead, self.rejected)

    # -- requests -------------------------------------------------------------------------------

    def _request(self, activity: Activity) -> None:
        if activity is not self.supervisor.activity:
            self.activities.leave()
        self.supervisor.on_request(activity)

    def _hold(self) -> None:
        """Move to the target with the present method, starting from the present tensions."""
        has_target = self.target_state.theta is not None
        self.activities.leave()
        self.supervisor.on_request(Activity.HOLDING if has_target else Activity.IDLE)

    def _approach(self, duration: float) -> None:
        """Start a trajectory of `duration` [s] to the target, along `Planner.to_posture`'s path."""
        state = self.target_state
        assert state.theta is not None
        start, mae = self._ready()
        lag = self.activities.follower.winches.lag
        trajectory, problem = self.planner.to_posture(mae, start, state.theta, duration, lag)
        if problem:
            state.theta = trajectory.end
            state.unreachable_reason = f'{problem}; the arm goes as far as it can'
        self._begin(trajectory)

    def _follow(
        self, trajectory: Trajectory, unreachable_reason: str = '', delay: float = 0.0
    ) -> None:
        """Follow a requested trajectory after `delay` [s]; its end becomes the target."""
        nothing = np.zeros(self.robot.joint_count)
        self.target_state = Target(nothing, trajectory.end, (), unreachable_reason)
        self._begin(trajectory, delay)

    def _begin(self, trajectory: Trajectory, delay: float = 0.0) -> None:
        follower = self.activities.follower
        if not self._is_on_trajectory:
            present = self._present
            if present.velocity.any():  # the arm first comes to rest
                delay = max(delay, STOPPING)
            if delay > 0.0:
                follower.follow(self.planner.to_rest(present))
        follower.follow(trajectory, delay)
        self.supervisor.on_request(Activity.MOVING)

    @property
    def _is_on_trajectory(self) -> bool:
        """Whether the arm is where a trajectory, which may have ended, demands it to be."""
        progress = self.activities.follower.progress
        return progress.trajectory is not None and not progress.has_fallen

    @property
    def _present(self) -> Setpoint:
        """The estimated posture, within the joint limits, and its velocity."""
        assert self.estimate is not None
        return self.present_motion.setpoint(self.estimate, self.robot)

    @property
    def is_following(self) -> bool:
        """Whether the follower has issued the last command, to move to a target or to hold it."""
        follower = self.activities.follower
        return self.activities.entered is follower and follower.progress.trajectory is not None

    @property
    def _is_ready(self) -> bool:
        known = self.stream.body.offsets.known
        has_network = self.estimate is not None and self.mae is not None
        return known and has_network and not self.stop_conditions(self.watchdog.steps.stepped_at)

    def _ready(self, delay: float = 0.0) -> tuple[Setpoint, Mae]:
        """Return the setpoint from which a trajectory starts `delay` [s] from now, and the network.

        Raises:
            MessageError: If no trajectory may start.
        """
        self._refuse_gravity_compensation()
        if self.estimate is None or self.mae is None:
            raise MessageError('no posture estimated yet', 'wait for an estimate and a checkpoint')
        present = self.stop_conditions(self.watchdog.steps.stepped_at)
        condition = self.supervisor.condition or next(iter(present), None)
        if condition is not None:
            raise MessageError('stopped', condition.text)
        if not self.stream.body.offsets.known:
            remedy = 'wait for the length calibration; if none is in progress, call estimator/zero'
            raise MessageError('length offsets are unknown', remedy)
        if self._is_on_trajectory:
            return self.activities.follower.progress.ahead(delay), self.mae
        return Setpoint.resting(self.planner.to_rest(self._present).end), self.mae

    def _refuse_gravity_compensation(self) -> None:
        if self.settings.control_method.is_guided:
            raise MessageError('method float', GUIDED)
