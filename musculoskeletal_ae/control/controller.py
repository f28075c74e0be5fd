# SPDX-License-Identifier: Apache-2.0
"""Control as a whole: targets in, safe commands out.

    target, pose, trajectory ─► planner ─► activity ─┐
                                 causes ─► supervisor ┤─► limiter ─► command
                                            safe stop ┘

The supervisor decides what the arm does (`supervisor`, `stops`), one object for each activity says
how (`follower`, `ramps`, `torque`, `exploration`, `calibrating`), and the limiter is the last thing
before publishing. This class connects them and holds no rules of its own.

An isolated muscle has no tension in any plan, and its module is told to hold it slack. A muscle
that is isolated while there is an anomaly is the suspect: the stopped arm winds it in a little, and
goes on when the anomaly is over.

`now` is a steady clock [s], `time` that of the messages.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.activities import ActivityControl, Inputs
from musculoskeletal_ae.control.calibrating import Calibrating, gentle_limit
from musculoskeletal_ae.control.command import LENGTH, TENSION, Command, Pull
from musculoskeletal_ae.control.exploration import Exploration, Exploring
from musculoskeletal_ae.control.follower import Follower
from musculoskeletal_ae.control.limiter import CommandLimiter
from musculoskeletal_ae.control.planner import Plan, Planner
from musculoskeletal_ae.control.ramps import LengthRamps, RampedTarget, length_methods
from musculoskeletal_ae.control.settings import BY_TENSION, Settings
from musculoskeletal_ae.control.stopping import SafeStop
from musculoskeletal_ae.control.stops import Action, Condition, StopCause
from musculoskeletal_ae.control.supervisor import Activity, Supervisor
from musculoskeletal_ae.control.torque import GravityCompensation, TorqueControl
from musculoskeletal_ae.control.trajectory import Points, Setpoint
from musculoskeletal_ae.control.watchdog import Watchdog
from musculoskeletal_ae.exceptions import MessageError, RobotDescriptionError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import BodyState
from musculoskeletal_ae.signals.limits import LIMITS, Persistence, check_posture
from musculoskeletal_ae.signals.muscle_stream import MuscleSample, MuscleStream

WINDOW = 3  # messages of the median against glitches
RESTORE = 'estimator/restore uses isolated muscles again'
AT_ONCE = 1.0  # [s] between an anomaly and the muscle that is isolated for it
APPROACHES = 3  # of a target by an arm that lacks a muscle and falls


@dataclass
class Target:
    """What was asked for last.

    Attributes:
        theta: Posture [rad], (D,); None while there is none.
        effort: Torque beyond holding the weight [N·m], (D,).
        clamped: Joints whose target lay beyond the limits.
        unreachable_reason: Why the arm goes elsewhere than was asked, or ''.
        approaches_left: How often an arm that falls on its way sets out again.
    """

    effort: Array
    theta: Array | None = None
    clamped: tuple[str, ...] = ()
    unreachable_reason: str = ''
    approaches_left: int = 0


class Activities:
    """One object for each activity, and which of them commands the arm."""

    def __init__(self, robot: Robot, settings: Settings, seed: int) -> None:
        self.ramps = LengthRamps(robot, settings)
        self.follower = Follower(robot, settings)
        self.ramped_target = RampedTarget(self.ramps, robot, settings)
        exploration = Exploration(robot, seed, settings.preset)
        self.exploring = Exploring(exploration, self.ramps)
        self.calibrating = Calibrating(robot, settings, seed)
        self.torque = TorqueControl(robot, settings)
        self.gravity_compensation = GravityCompensation(robot, settings)
        #: the one that has commanded last, unless it was interrupted since
        self.entered: ActivityControl | None = None

    def use(self, robot: Robot, settings: Settings) -> None:
        """Control this robot, whose isolated muscles pull nothing, by these settings."""
        for part in (
            self.ramps,
            self.follower,
            self.ramped_target,
            self.calibrating,
            self.torque,
            self.gravity_compensation,
        ):
            part.use(robot, settings)
        self.exploring.stream.use(robot, settings.preset)

    def of(self, activity: Activity, settings: Settings) -> ActivityControl | None:
        """Return the object that carries out an activity; None for none."""
        if activity in (Activity.HOLDING, Activity.MOVING):
            return self.follower if by_follower(settings) else self.ramped_target
        others: dict[Activity, ActivityControl] = {
            Activity.EXPLORING: self.exploring,
            Activity.CALIBRATING: self.calibrating,
            Activity.TORQUE: self.torque,
            Activity.GRAVITY_COMPENSATION: self.gravity_compensation,
        }
        return others.get(activity)

    def leave(self) -> None:
        """End what commands the arm: something else follows, or a stop."""
        if self.entered is not None:
            self.entered.leave()
        self.entered = None

    def step(self, control: ActivityControl, inputs: Inputs) -> Command | None:
        """Let one of them command the arm."""
        if control is not self.entered:
            if self.entered is not None:
                self.entered.leave()
            control.enter(inputs)
            self.entered = control
        return control.step(inputs)


class Suspicion:
    """Finds out which muscle the estimator suspects of the present anomaly.

    The estimator reports an anomaly and isolates the suspect in two messages, which may come in
    either order.
    """

    def __init__(self) -> None:
        self._isolated: tuple[int, float] | None = None  # the last muscle, and when [s]
        self._anomaly_at = math.inf

    def note_anomaly(self, now: float) -> None:
        """Take that an anomaly was detected."""
        self._anomaly_at = now

    def note_isolated(self, muscle: int, now: float) -> None:
        """Take that a muscle was isolated."""
        self._isolated = muscle, now

    def suspect(self, has_anomaly: bool, isolated: tuple[int, ...]) -> int | None:
        """Return the suspect, whichever of the two messages came first; None for none."""
        if not has_anomaly or self._isolated is None:
            return None
        muscle, at = self._isolated
        return muscle if muscle in isolated and at > self._anomaly_at - AT_ONCE else None


def by_follower(settings: Settings) -> bool:
    """Return whether targets are gone to by trajectories; by ramps of lengths otherwise."""
    return settings.method not in (*BY_TENSION, *length_methods(settings))


class Controller:
    """Connects everything between a target and a command."""

    def __init__(self, robot: Robot, settings: Settings | None = None, seed: int = 0) -> None:
        """Control `robot`; `seed` is the random seed of the exploration."""
        self.robot, self.settings = robot, settings or Settings()
        self.mae: Mae | None = None
        self.stream = MuscleStream(robot, window=WINDOW)
        self.sample: MuscleSample | None = None
        self.estimate: Array | None = None  # θ [rad], (D,)
        self.target_state = Target(np.zeros(robot.joint_count))
        self.supervisor = Supervisor()
        self.watchdog = Watchdog(robot, self.settings)
        self.planner = Planner(robot, self.settings)
        self.activities = Activities(robot, self.settings, seed)
        self.limiter = CommandLimiter(robot, self.settings)
        self.stopping = SafeStop(robot, self.settings, self.limiter)
        self.sent_at = 0.0  # when the last command went out; its user says so
        self._estimate_problem = Persistence()
        self._jumped_at = math.inf  # when lengths jumped [s]
        self._suspicion = Suspicion()
        if self.settings.method == 'float':
            self.supervisor.on_request(Activity.GRAVITY_COMPENSATION)

    # -- what comes in --------------------------------------------------------------------------

    def configure(self, settings: Settings) -> None:
        """Take new settings; another method or preset starts from how the muscles pull then.

        A MusculoskeletalError says that the joint stiffness does not fit the robot.
        """
        before, radian = self.settings, self.robot.kinematics.radian
        stiffness = settings.desired_stiffness(radian)
        self.settings = settings
        self._use_parts()
        is_other = (settings.method, settings.preset) != (before.method, before.preset)
        if settings.method == 'float':
            self._request(Activity.GRAVITY_COMPENSATION)
        elif is_other and not self.supervisor.explores:
            self._hold()
        if settings.method == 'stiffness' and stiffness != before.desired_stiffness(radian):
            self.activities.follower.plan_anew()

    def use(self, mae: Mae) -> None:
        """Take a checked network."""
        self.mae, self.watchdog.has_checkpoint = mae, True
        self.stream.use_friction(mae.friction)
        self.activities.follower.use_network(mae)
        if self.activities.entered is self.activities.ramped_target:
            self.activities.ramps.solve_again()

    def take(self, message: Any, now: float) -> None:
        """Take a message of muscle_states; a RejectionError says why it cannot be used."""
        self._use_sample(self.stream.take(message, now), now)

    def muscles(self, states: Array, now: float) -> None:
        """Take l as it was read [m], T [N] and temperature [°C], (3, M).

        A RejectionError says that no muscles of this arm can be so.
        """
        self._use_sample(self.stream.take_states(np.asarray(states), now), now)

    def _use_sample(self, sample: MuscleSample, now: float) -> None:
        self.sample = sample
        if sample.jumped:
            self._jumped_at = now
        self.watchdog.take_sample(sample, now)

    def estimated(self, theta: Array, now: float, is_new: bool = True) -> None:
        """Take estimated θ [rad] (D,); a MessageError says that no joints can be there.

        An estimate that is not `is_new`, such as one that is repeated, keeps its age.
        """
        known = self.stream.body.offsets.known
        if not known:  # a guess of the offsets may make any posture
            theta = np.clip(theta, self.robot.lower, self.robot.upper)
        try:
            check_posture(self.robot, theta, LIMITS.estimate_outside)
        except MessageError as error:
            self._estimate_problem.note(str(error), now)
            raise
        self._estimate_problem.note('', now)
        if is_new:
            self.watchdog.take_estimate(now)
        self.estimate = theta

    def use_body(self, body: BodyState) -> None:
        """Take which muscles are isolated, and the length offsets."""
        before = self.stream.body
        if body.offsets is not before.offsets:
            self._use_offsets(body)
        self.stream.use_body(body)
        if body.isolated == before.isolated:
            return
        self.robot = self.robot.without(body.isolated)
        self.target_state.unreachable_reason = ''
        self._use_parts()
        if self.mae is not None:
            self.activities.follower.plan_anew()
        if added := set(body.isolated) - set(before.isolated):
            self._suspicion.note_isolated(max(added), self.watchdog.age.stepped_at)
        self._note_suspect()

    def _use_offsets(self, body: BodyState) -> None:
        before = self.stream.body.offsets
        self.limiter.shift(body.offsets.offset - before.offset)
        if self.sample is not None:
            self.sample = self.sample.shifted(body.offsets.offset - before.offset)
        is_known = body.offsets.known
        if is_known != before.known or (body.offsets.offset != before.offset).any():
            self.activities.leave()
        self.limiter.offsets_known = is_known
        self.supervisor.on_offsets(is_known)

    def _use_parts(self) -> None:
        """Hand robot and settings to all parts: the only place where that happens."""
        for part in (self.watchdog, self.planner, self.activities, self.limiter, self.stopping):
            part.use(self.robot, self.settings)

    def anomaly(self, detected: bool) -> None:
        """Take anomaly_detected; once a suspect was verified, the arm goes on when it is over."""
        if detected and not self.watchdog.has_anomaly:
            self._suspicion.note_anomaly(self.watchdog.age.stepped_at)
        self.watchdog.has_anomaly = detected
        if detected:
            self.supervisor.on_event(StopCause.ANOMALY)
        else:
            self.supervisor.on_verified()
        self._note_suspect()

    def _note_suspect(self) -> None:
        isolated = self.stream.body.isolated
        suspect = self._suspicion.suspect(self.watchdog.has_anomaly, isolated)
        self.stopping.suspect = suspect
        if suspect is not None:
            self.supervisor.on_suspect(True)

    def clock_jumped_back(self) -> None:
        """Count the messages' time from here."""
        self.watchdog.age.clock_jumped_back()
        self.stream.reset()

    # -- what is asked --------------------------------------------------------------------------

    def target(self, joints: Mapping[str, tuple[float, float]]) -> None:
        """Take θ_target [rad] and effort [N·m] of some joints; the others keep theirs, if known."""
        self._refuse_gravity_compensation()
        robot, state = self.robot, self.target_state
        kept = self.estimate if state.theta is None else state.theta
        if kept is None and len(joints) < robot.joint_count:
            raise MessageError('no posture yet', 'give all joints, or wait for an estimate')
        before = zip(np.zeros(robot.joint_count) if kept is None else kept, state.effort)
        theta, effort = np.array([joints.get(*pair) for pair in zip(robot.joints, before)]).T
        goal = np.clip(theta, robot.lower, robot.upper)
        reason = ''
        if self.mae is not None and self.estimate is not None:
            nearest = self.planner.takes_nearest
            goal, reason = self.planner.reachable(self.mae, self.estimate, goal, nearest)
        clamped = tuple(n for n, a, b in zip(robot.joints, theta, goal) if a != b)
        self.target_state = Target(effort, goal, clamped, reason, APPROACHES)
        if not (self.supervisor.is_running and by_follower(self.settings) and self._is_ready):
            self._hold()  # it is gone to as soon as the arm may move
            return
        try:
            self._approach(self.settings.target_duration or self.settings.first_duration)
        except MessageError:
            self.target_state = state
            raise
        except Exception as error:  # noqa: BLE001 (as in `_desired`)
            self._note_fault(error)

    def trajectory(self, points: Points | None, delay: float = 0.0) -> None:
        """Follow points from `delay` [s] on, negative: since then; None: come to rest and hold.

        A MessageError says why not: nothing changes then.
        """
        start, mae = self._ready(max(delay, 0.0))
        if points is None:
            self._follow(self.planner.to_rest(start))
        else:
            plan = self.planner.through(mae, start, points, max(-delay, 0.0))
            self._follow(plan, max(delay, 0.0))

    def pose(self, pose: pin.SE3, whole: bool, now: float) -> None:
        """Bring the end effector to a pose in the root link's frame, or to its position only.

        A MessageError says why not: nothing changes then.
        """
        start, mae = self._ready()
        follower = self.activities.follower
        if follower.is_moving and self.planner.is_under_way(pose, whole, follower.latest):
            self.planner.repeat_pose(now)
            return
        self._follow(self.planner.to_pose(mae, start, pose, whole, now))

    def twist(self, twist: Array) -> None:
        """Move the end effector by a twist [m/s], [rad/s] (6,), axes of the root link, for a while.

        A MessageError says why not: nothing changes then.
        """
        start, mae = self._ready()
        self._follow(self.planner.by_twist(mae, start, twist))

    def explore(self, wanted: bool) -> str:
        """Explore, or end it and hold; return why not, or ''."""
        condition = self.supervisor.condition
        if wanted and condition is not None:
            return f'stopped: {condition}'
        if wanted and self.settings.method == 'float':
            return 'method float: a hand moves the arm; set another method first'
        if wanted and not self.stream.body.used.any():
            return f'all muscles are isolated; {RESTORE}'
        if wanted != self.supervisor.explores:
            self.target_state = Target(np.zeros(self.robot.joint_count))
            known = self.stream.body.offsets.known
            exploring = Activity.EXPLORING if known else Activity.CALIBRATING
            self._request(exploring if wanted else Activity.IDLE)
        elif not wanted:  # nor is it to explore after a stop
            self.supervisor.on_request(self.supervisor.activity)
        return ''

    def stop(self, cause: StopCause, detail: str = '') -> None:
        """Latch a safe stop."""
        self.supervisor.on_event(cause, detail)

    def reset(self, now: float) -> Condition | None:
        """End a stop and go on to the last target; return the cause that is present, if any."""
        return self.supervisor.on_reset(self.conditions(now))

    # -- time -----------------------------------------------------------------------------------

    def conditions(self, now: float) -> list[Condition]:
        """Return the causes to stop that are present, the most severe first."""
        present = self.watchdog.conditions(now)
        if why := self.stream.implausible(now):
            present.append(Condition(StopCause.IMPLAUSIBLE_MUSCLE_STATES, why))
        if why := self._revoked_lengths(now):
            present.append(Condition(StopCause.LENGTH_OFFSETS_REVOKED, why))
        if why := self._estimate_problem.lasting(now):
            present.append(Condition(StopCause.IMPLAUSIBLE_ESTIMATE, why))
        order = list(StopCause)
        return sorted(present, key=lambda condition: order.index(condition.cause))

    def _revoked_lengths(self, now: float) -> str:
        """Return why the lengths cannot be relied on, or ''.

        The estimator decides that. Only if it takes no notice of a jump, as one that was started
        meanwhile, does the controller itself.
        """
        stream = self.stream
        if stream.body.offsets.is_suspect:
            return 'the estimator has revoked their offsets'
        has_jumped = stream.displaced and not stream.has_displaced_unseen
        if has_jumped and stream.body.offsets.known and now - self._jumped_at > AT_ONCE:
            return f'they jumped: {self.robot.names(sorted(stream.displaced))}'
        return ''

    def step(self, now: float, time: float | None = None) -> Command | None:
        """Return the command of this moment, or None while nothing was ever commanded.

        `time` is the messages' [s], that of the steady clock if it is not given.
        """
        # What computing took is over when a command goes out: it may bring no change with it.
        computing = max(self.sent_at - self.watchdog.age.stepped_at, 0.0)
        time = now if time is None else time
        step = self.watchdog.age.step(now, time, not self.supervisor.is_running)
        if step.has_paused:  # the arm may be elsewhere by now: on from there
            self.activities.entered = None
        present = self.conditions(now)
        stale_estimate = any(c.cause is StopCause.STALE_ESTIMATE for c in present)
        if stale_estimate:  # an estimator that starts anew knows of no suspect
            self.supervisor.on_suspect(False)
        if self.limiter.command is not None or not self.supervisor.is_running:
            # Before the first command there is nothing to stop.
            self.supervisor.on_conditions(present, step.elapsed, self.stopping.is_releasing)
        fall = self.limiter.largest_change(TENSION, step.dt)
        self.watchdog.heat.lower(self.settings.temperature_limit, fall)
        dt = max(step.dt - computing, 0.0)
        if self.supervisor.is_running:
            self.stopping.leave()
            desired = None if present else self._desired(step.dt)
            limited = self._limited(desired, dt)
            if desired is not None and limited is None:
                self.supervisor.on_event(StopCause.COMMAND_NOT_FINITE)
        if not self.supervisor.is_running:
            limited = self._limited(self._stopped(present, dt), dt)
        return limited or self.limiter.command

    def _desired(self, dt: float) -> Command | None:
        """Return what the activity wants; any fault of it stops the arm."""
        control = self.activities.of(self.supervisor.activity, self.settings)
        known = self.stream.body.offsets.known
        if control is None or not (known or control is self.activities.calibrating):
            self.activities.leave()
            return None
        try:
            return self._slack(self._step(control, self._inputs(dt)))
        except RobotDescriptionError as error:  # too little is left to explore with
            self._request(Activity.IDLE)
            reason = str(error)
            if isolated := self.robot.names(self.robot.isolated):
                reason = f'what is left without {isolated} holds too few postures; {RESTORE}'
            self.target_state.unreachable_reason = reason
        except Exception as error:  # noqa: BLE001 (whatever it is, the arm must stop)
            self._note_fault(error)
        return None

    def _note_fault(self, error: Exception) -> None:
        self.supervisor.on_event(StopCause.CONTROL_FAULT, f'{type(error).__name__}: {error}')

    def _step(self, control: ActivityControl, inputs: Inputs) -> Command | None:
        activities, state = self.activities, self.target_state
        follower = activities.follower
        if control is follower and follower.trajectory is None and state.theta is not None:
            # After a stop or another method: on to the target, from where the arm is.
            self._approach(self.settings.first_duration)
        elif control is follower and follower.has_fallen and state.approaches_left:
            state.approaches_left -= 1
            follower.leave()
            self._approach(self.settings.target_duration or self.settings.first_duration)
        command = activities.step(control, inputs)
        if control is activities.gravity_compensation:
            # Where it is left is held by the method that comes next.
            inside = np.clip(inputs.theta, self.robot.lower, self.robot.upper)
            self.target_state = Target(np.zeros_like(inside), inside)
        if control is activities.exploring:
            state.theta = activities.exploring.theta
        if control is follower and not follower.is_moving:
            self.supervisor.on_arrival()
        return command

    def _inputs(self, dt: float) -> Inputs:
        # Without a present cause all of them are there.
        assert self.mae is not None and self.sample is not None and self.estimate is not None
        sample = self.sample
        pull = Pull(sample.motor_tension * sample.usable, sample.bone_tension * sample.usable)
        return Inputs(
            mae=self.mae,
            sample=sample,
            pull=pull,
            theta=self.estimate,
            length=self.limiter.last(LENGTH, sample).value,
            tension=self.limiter.last(TENSION, sample).value,
            limit=np.minimum(self.watchdog.heat.planned, self.robot.tension.limit),
            dt=dt,
        )

    def _slack(self, command: Command | None) -> Command | None:
        """Return a command that gives isolated muscles all the length, or no tension."""
        if command is None or not self.robot.isolated:
            return command
        released = self.limiter.slack_length if command.kind == LENGTH else 0.0
        return Command(command.kind, np.where(self.robot.used, command.value, released))

    def _stopped(self, present: list[Condition], dt: float) -> Command | None:
        """Return the command of a stopped arm."""
        if not self.stopping.is_entered:
            self.activities.leave()
            self.stopping.enter()
        if self.sample is None:
            return None
        # A paused arm whose data is back waits for a moment: neither hold nor release goes on.
        waits = not self.supervisor.is_latched and not present
        causes = {condition.cause for condition in present}
        is_fresh = StopCause.STALE_MUSCLE_STATES not in causes
        may_wind = self.supervisor.may_wind_suspect
        at_once = self.supervisor.action is Action.RELEASE_AT_ONCE
        return self.stopping.step(self.sample, 0.0 if waits else dt, is_fresh, may_wind, at_once)

    def _limited(self, desired: Command | None, dt: float) -> Command | None:
        if desired is None or self.sample is None:
            return None
        limit = self.watchdog.heat.momentary
        if not self.stream.body.offsets.known:
            limit = np.minimum(limit, gentle_limit(self.robot))
        return self.limiter.limit(desired, self.sample, limit, dt)

    # -- requests -------------------------------------------------------------------------------

    def _request(self, activity: Activity) -> None:
        if activity is not self.supervisor.activity:
            self.activities.leave()
        self.supervisor.on_request(activity)

    def _hold(self) -> None:
        """Go to the target by the method that is set now, from how the muscles pull."""
        state = self.target_state
        by_torque = self.settings.method == 'tension'
        holding = Activity.TORQUE if by_torque else Activity.HOLDING
        activity = Activity.IDLE if state.theta is None else holding
        self.activities.leave()
        if state.theta is not None:
            self.activities.torque.set_target(state.theta, state.effort)
            self.activities.ramped_target.set_target(state.theta, state.effort)
        self.supervisor.on_request(activity)

    def _approach(self, duration: float) -> None:
        """Set out to the target on a way that can be held."""
        state = self.target_state
        assert state.theta is not None
        start, mae = self._ready()
        plan = self.planner.to_posture(mae, start, state.theta, duration)
        self._begin(plan, 0.0, state.effort)

    def _follow(self, plan: Plan, delay: float = 0.0) -> None:
        """Follow a trajectory that was asked for."""
        nothing = np.zeros(self.robot.joint_count)
        end = plan.trajectory.end
        self.target_state = Target(nothing, end, (), plan.unreachable_reason)
        self._begin(plan, delay, nothing)

    def _begin(self, plan: Plan, delay: float, effort: Array) -> None:
        follower = self.activities.follower
        if follower.trajectory is None and delay > 0.0:
            start, _ = self._ready()
            follower.follow(self.planner.to_rest(start).trajectory)
        follower.follow(plan.trajectory, delay)
        follower.exert(effort)
        self.supervisor.on_request(Activity.MOVING)

    @property
    def is_following(self) -> bool:
        """Whether the follower commands the arm: it moves to a target, or holds one."""
        activity = self.supervisor.activity
        follower = self.activities.follower
        is_used = self.activities.of(activity, self.settings) is follower
        return is_used and follower.trajectory is not None

    @property
    def _is_ready(self) -> bool:
        known = self.stream.body.offsets.known
        return known and self.estimate is not None and self.mae is not None

    def _ready(self, delay: float = 0.0) -> tuple[Setpoint, Mae]:
        """Return where a trajectory starts in `delay` [s], and the network.

        A MessageError says why none may start.
        """
        self._refuse_gravity_compensation()
        if self.estimate is None or self.mae is None:
            raise MessageError('no posture yet', 'wait for an estimate and a checkpoint')
        present = self.conditions(self.watchdog.age.stepped_at)
        condition = self.supervisor.condition or next(iter(present), None)
        if condition is not None:
            raise MessageError('stopped', str(condition))
        if not self.stream.body.offsets.known:
            raise MessageError('length offsets are unknown', 'find them by estimator/zero')
        follower = self.activities.follower
        if follower.trajectory is not None:
            return follower.ahead(delay), self.mae
        inside = np.clip(self.estimate, self.robot.lower, self.robot.upper)
        return Setpoint.resting(inside), self.mae

    def _refuse_gravity_compensation(self) -> None:
        if self.settings.method == 'float':
            raise MessageError('floating', 'a hand moves the arm; set another method first')
