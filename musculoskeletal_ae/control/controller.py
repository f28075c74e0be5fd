# SPDX-License-Identifier: Apache-2.0
"""Control as a whole: targets in, safe commands out.

    target     ─→ posture (lengths) or torque (tensions) ─┐
    trajectory ─→ motion (lengths) ───────────────────────┴─→ safety ─→ command

An isolated muscle has no tension in any plan, and its module is told to hold it slack. The robot in
here is the controller's own: its isolated muscles are those of which it was told. A muscle that is
isolated while there is an anomaly is the suspect: the stopped arm winds it in a little, and goes on
when the anomaly is over.

A stop latches on what `watch` finds, an unfit checkpoint, a fault of control's own, or on request
(doc/interface.md, stop and resume). `reset` clears it once no cause is left; then the last target,
which may be a trajectory's end, is resumed by a ramp from where the arm is. Exploration is not
resumed. Data that is late, but back before the stop pays out, is no reason to latch: after RESUME
of it the arm goes on by itself, exploring or not.

`now` is a steady clock [s], `time` that of the messages.
"""

import copy
import math
from collections.abc import Iterable, Mapping
from contextlib import suppress

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control import reach
from musculoskeletal_ae.control.exploration import Exploration, GentleMotion, gentle_limit
from musculoskeletal_ae.control.hand import Hand
from musculoskeletal_ae.control.methods import FloatControl, TorqueControl, msc_compensation
from musculoskeletal_ae.control.motion import MotionControl, slowness
from musculoskeletal_ae.control.posture import PostureControl, Pull
from musculoskeletal_ae.control.safety import LENGTH, TENSION, Command, Muscles, SafetyFilter
from musculoskeletal_ae.control.settings import BY_TENSION, Settings
from musculoskeletal_ae.control.trajectory import Points, Setpoint, Trajectory
from musculoskeletal_ae.control.watch import Watch
from musculoskeletal_ae.exceptions import MessageError, RobotDescriptionError
from musculoskeletal_ae.friction import FrictionDirection
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.presets import PRESETS
from musculoskeletal_ae.robot.robot import Robot

RESTORE = 'estimator/restore uses isolated muscles again'
RESUME = 0.2  # [s] of fresh data after which a stop that may pass ends
#: of the way from tension.limit to tension.max that may be demanded; `watch` stops at a half
FED_BACK = 1.0 / 3.0
EASED = 0.9  # of tension.limit, demanded at most of a muscle that has been above it for long
AT_ONCE = 1.0  # [s] between an anomaly and the muscle that is isolated for it
#: causes of a stop that may be a broken muscle's doing
BY_MUSCLE = ('anomaly', 'muscle_states', 'estimate')
APPROACHES = 3  # of a target by an arm that lacks a muscle and falls
SAME = 1e-6  # poses that differ by less are one
ROUNDING = 1e-6  # [rad] by which a point may lie beyond a joint limit


class Controller:
    """Steps everything between a target and a command."""

    def __init__(self, robot: Robot, settings: Settings | None = None, seed: int = 0) -> None:
        """Control `robot`; `seed` is the random seed of the exploration."""
        self.robot, self.settings = copy.copy(robot), settings or Settings()
        robot = self.robot
        self.posture = PostureControl(robot, self.settings)
        self.torque = TorqueControl(robot, self.settings)
        self.motion = MotionControl(robot, self.settings)
        self.follows = False  # a trajectory, or holds where one ended
        #: the last pose, whether its orientation counts, and the way to it
        self._posed: tuple[pin.SE3, bool, Trajectory | None] = pin.SE3.Identity(), True, None
        self._approaches = 0  # of a target that are left, if the arm falls
        self._hand = Hand(robot)
        self.short = ''  # what the last target was out of reach by
        self.floating = FloatControl(robot, self.settings)
        self.safety = SafetyFilter(robot, self.settings)
        self.watch = Watch(robot, self.settings)
        self.clamped: tuple[str, ...] = ()  # joints whose target lay beyond the limits
        self.mae: Mae | None = None
        # One stream for the life of the controller: after a pause it brings new postures.
        self._exploration = Exploration(robot, seed, PRESETS[self.settings.preset].to_limits)
        self.gentle = GentleMotion(robot, seed)
        self.estimate: Array | None = None
        self._direction = FrictionDirection()
        self._pull = Pull(robot.tension.bias, robot.tension.bias)
        self.sent_at = 0.0  # when the last command went out; its user says so
        self._fresh = 0.0  # [s] of data since it was late
        # whether it explored when it was stopped; whether a suspect is verified; whether the arm is
        # to go on by itself, and may
        self._explored = self._verifies = self._resumes = self._may_resume = False
        self._isolated_at, self._anomaly_at = (-1, -math.inf), math.inf
        # Whether the next command starts a method anew, from how the muscles pull then.
        self._starts = True

    # -- what comes in --------------------------------------------------------------------------

    def configure(self, settings: Settings) -> None:
        """Take new settings; another method or preset starts from how the muscles pull then.

        A MusculoskeletalError says that the joint stiffness does not fit the robot.
        """
        before, radian = self.settings, self.robot.kinematics.radian
        stiffness = settings.desired_stiffness(radian)
        self.settings = settings
        self.posture.settings = self.torque.settings = self.safety.settings = settings
        self.motion.settings = self.floating.settings = self.watch.settings = settings
        if settings.method == 'float':
            self.explore(False)
        another = (settings.method, settings.preset) != (before.method, before.preset)
        self._exploration.to_limits = PRESETS[settings.preset].to_limits
        if another and not self.posture.exploring:
            self._starts, self.follows = True, False
        elif settings.method == 'stiffness' and stiffness != before.desired_stiffness(radian):
            (self.motion.plan_anew if self.follows else self.posture.start)()

    def use(self, mae: Mae) -> None:
        """Take a checked network."""
        self.mae, self.watch.checkpoint = mae, True
        self.posture.use(mae)
        self.motion.use(mae)

    def muscles(self, muscles: Muscles, now: float) -> None:
        """Take muscle_states; a MessageError says that no muscles of this arm can be so."""
        self.watch.muscles(muscles, self.safety.zeroed, now)
        length, tension, _ = self.safety.muscles(muscles)
        self.watch.pulled(tension, now)
        friction = 0.0 if self.mae is None else self.mae.friction
        self._pull = Pull(tension, self._direction.end_tension(friction, tension, length))

    def estimated(self, theta: Array, now: float) -> None:
        """Take estimated θ [rad] (D,); a MessageError says that no joints can be there."""
        if not self.safety.zeroed:
            theta = np.clip(theta, self.robot.lower, self.robot.upper)
        self.watch.estimated(theta, now)
        self.estimate = theta

    def zeros(self, known: bool, less: Array) -> None:
        """Take whether zeros are known, and how much less [m] (M,) lengths are from now on."""
        self.safety.shift(less)
        self.watch.forget()
        self._direction.reset()
        if known != self.safety.zeroed or less.any():
            self._starts, self.follows = True, False
        self.safety.zeroed = known
        self.gentle.start()

    def anomaly(self, detected: bool) -> None:
        """Take anomaly_detected; once a suspect was verified, the arm goes on when it is over."""
        if detected and not self.watch.anomaly:
            self._anomaly_at = self.watch.stepped_at
        self._resumes |= self._verifies and not detected
        self._verifies, self.watch.anomaly = self._verifies and detected, detected
        if detected:
            self.stop('anomaly_detected')
        self._note_suspect()

    def isolate(self, muscles: Iterable[int]) -> None:
        """Go on without these muscles, places in T and l, and with all others."""
        muscles, before = set(muscles), set(self.robot.isolated)
        self.robot.isolate(muscles)
        if muscles != before:
            self.short = ''
        if added := muscles - before:
            self._isolated_at = max(added), self.watch.stepped_at
        if self.mae is not None:
            self.use(self.mae)
        self._note_suspect()

    def _note_suspect(self) -> None:
        muscle, at = self._isolated_at  # whichever was told first
        here = self.watch.anomaly and at > self._anomaly_at - AT_ONCE
        here = here and muscle in self.robot.isolated
        self.safety.suspect = muscle if here else None
        self._verifies |= here

    def target(self, joints: Mapping[str, tuple[float, float]]) -> None:
        """Take θ_target [rad] and effort [N·m] of some joints; the others keep theirs, if known."""
        self._refuse_floating()
        robot = self.robot
        kept = self.posture.theta if self.posture.theta is not None else self.estimate
        if kept is None and len(joints) < robot.joint_count:
            raise MessageError('no posture yet', 'give all joints, or wait for an estimate')
        before = zip(np.zeros(robot.joint_count) if kept is None else kept, self.posture.effort)
        theta, effort = np.array([joints.get(*pair) for pair in zip(robot.joints, before)]).T
        inside = np.clip(theta, robot.lower, robot.upper)
        inside, self.short = self._within_reach(inside, self._nearest)
        self.clamped = tuple(n for n, a, b in zip(robot.joints, theta, inside) if a != b)
        chosen = self.settings
        solved = chosen.method == 'proposed' and PRESETS[chosen.preset].equilibrium
        if solved and chosen.target_duration > 0.0 and not self.safety.cause:
            with suppress(MessageError):  # not ready: then by a ramp, once it is
                self._approach(inside, effort, APPROACHES)
                return
        self._starts |= self.posture.exploring or self.follows
        self.follows = self._explored = False
        self.posture.set_target(inside, effort)

    def _approach(self, theta: Array, effort: Array, left: int) -> None:
        kept, (start, mae) = (self.clamped, self.short), self._ready()
        way = reach.way(self.robot, mae, start.theta, theta)
        planned = Trajectory.to(start, way, self.settings.target_duration)
        self._follow(*self._within_limits(mae, planned), effort=effort)
        (self.clamped, self.short), self._approaches = kept, left

    def trajectory(self, points: Points | None, delay: float = 0.0) -> None:
        """Follow points from `delay` [s] on, negative: since then; None: come to rest and hold.

        A MessageError says why not: nothing changes then.
        """
        robot = self.robot
        if points is not None:
            low, high = robot.lower[points.joints], robot.upper[points.joints]
            beyond = (points.position < low - ROUNDING) | (points.position > high + ROUNDING)
            if beyond.any():
                k, j = np.argwhere(beyond)[0]
                told = f'{robot.joints[points.joints[j]]} {points.position[k, j]:.3f}'
                unit = robot.units[points.joints[j]].theta
                limits = f'legal: {low[j]:.3f} to {high[j]:.3f} {unit}'
                raise MessageError('beyond the joint limits', f'{told}, {limits}')
        start, mae = self._ready(max(delay, 0.0))
        if points is None:
            self._follow(Trajectory.stopping(start, robot))
        else:
            planned = Trajectory.through(start, points, max(-delay, 0.0))
            slower = self._slowed(mae, planned)
            self._within_reach(planned.end, nearest=False)
            self._follow(planned, slower, max(delay, 0.0))

    def pose(self, pose: pin.SE3, whole: bool, now: float) -> None:
        """Bring the end effector to a pose in the root link's frame, or to its position only.

        A MessageError says why not: nothing changes then.
        """
        (start, mae), chosen = self._ready(), self.settings
        if self._goes_to(pose, whole):
            self._hand.again(now)
            return
        theta, short = self._hand.posture(mae, pose, whole, start.theta, self._nearest)
        planned = self._hand.towards(start, theta, chosen.hand_speed, now)
        self._follow(*self._within_limits(mae, planned))
        self._posed = pose, whole, self.motion.latest
        self.short = short and f'{short}; nearest approached'

    def _goes_to(self, pose: pin.SE3, whole: bool) -> bool:
        """Whether the hand is on its way to a pose already."""
        before, whole_before, way = self._posed
        going = self.motion.moving and self.motion.latest is way and whole == whole_before
        return going and bool(before.isApprox(pose, SAME))

    def twist(self, twist: Array) -> None:
        """Move the end effector by a twist [m/s], [rad/s] (6,), axes of the root link, for a while.

        A MessageError says why not: nothing changes then.
        """
        start, mae = self._ready()
        self._follow(*self._within_limits(mae, self._hand.moved(mae, start, twist)))

    def _slowed(self, mae: Mae, planned: Trajectory) -> float:
        """Return how many times longer a way has to take.

        A MessageError says that it then leaves the joint limits: one that is slowed and starts in
        motion is another way.
        """
        slower = slowness(self.robot, mae, planned, self.settings)
        planned.scaled(slower).check(self.robot)
        return slower

    def _within_limits(self, mae: Mae, planned: Trajectory) -> tuple[Trajectory, float]:
        """Return a way within the joint limits, and how many times longer it has to take.

        A MessageError says that there is none.
        """
        try:
            return planned, self._slowed(mae, planned)
        except MessageError:
            planned = planned.after_rest(self.robot)
            return planned, self._slowed(mae, planned)

    def _within_reach(self, theta: Array, nearest: bool) -> tuple[Array, str]:
        """Return where to go for θ [rad] (D,) without the isolated muscles, and what θ lacks.

        A MessageError says that they are needed, unless the `nearest` posture is wished.
        """
        if self.robot.used.all() or self.mae is None or self.estimate is None:
            return theta, ''
        held, short = reach.nearest_held(self.robot, self.mae, self.estimate, theta)
        if not short:
            return theta, ''
        short = f'{short} without {self._left_out}; nearest posture held: {self.robot.told(held)}'
        if not nearest:
            raise MessageError('out of reach', short)
        return held, f'{short}; nearest approached'

    @property
    def _nearest(self) -> bool:
        return self.settings.unreachable == 'nearest'

    @property
    def _left_out(self) -> str:
        return self.robot.names(self.robot.isolated)

    def _refuse_floating(self) -> None:
        if self.settings.method == 'float':
            raise MessageError('floating', 'a hand moves the arm; set another method first')

    def _ready(self, delay: float = 0.0) -> tuple[Setpoint, Mae]:
        """Return where a trajectory starts in `delay` [s], and the network.

        A MessageError says why none may start.
        """
        self._refuse_floating()
        if self.estimate is None or self.mae is None:
            raise MessageError('no posture yet', 'wait for an estimate and a checkpoint')
        if cause := self.safety.cause or self.watch.present_cause(self.watch.stepped_at):
            raise MessageError('stopped', cause)
        if not self.safety.zeroed:
            raise MessageError('length zeros are unknown', 'find them by estimator/zero')
        if self.follows and not self._starts:
            return self.motion.ahead(delay), self.mae
        inside = np.clip(self.estimate, self.robot.lower, self.robot.upper)
        return Setpoint.resting(inside), self.mae

    def _follow(
        self,
        planned: Trajectory,
        slower: float | None = None,
        delay: float = 0.0,
        effort: Array | None = None,
    ) -> None:
        if not self.follows or self._starts:
            self._explore(False)
            self.motion.start()
            if delay > 0.0:
                self.motion.follow(Trajectory.stopping(self._ready()[0], self.robot))
        self.follows, self._starts, self.clamped, self.short = True, False, (), ''
        self._approaches = 0
        try:
            self.motion.follow(planned, delay, slower)
            self.motion.exert(np.zeros(self.robot.joint_count) if effort is None else effort)
        except Exception as error:  # noqa: BLE001 (as in `step`)
            self.stop(f'fault of control: {type(error).__name__}: {error}')
        self.posture.theta, self.posture.effort = planned.end, self.motion.effort

    # -- what is asked --------------------------------------------------------------------------

    def explore(self, wanted: bool) -> str:
        """Explore, or end it and hold; return why not, or ''."""
        if wanted and self.safety.cause:
            return f'stopped: {self.safety.cause}'
        if wanted and self.settings.method == 'float':
            return 'method float: a hand moves the arm; set another method first'
        if wanted and len(self.robot.isolated) == self.robot.muscle_count:
            return f'all muscles are isolated; {RESTORE}'
        self._explored = False
        self._explore(wanted)
        return ''

    def _explore(self, wanted: bool) -> None:
        if wanted != self.posture.exploring:
            self.short, self.clamped = '', ()
            self.posture.explore(iter(self._exploration) if wanted else None)
            self.posture.theta = None
            self._starts, self.follows = True, False

    def stop(self, cause: str) -> None:
        """Latch a safe stop."""
        if not self.safety.cause or self.safety.passing:
            self._may_resume, self._explored = True, False
        self._may_resume &= cause.startswith(BY_MUSCLE)
        self._explored |= self.posture.exploring
        self._explore(False)
        self.safety.stop(cause)

    def clock_jumped_back(self) -> None:
        """Count the messages' time from here."""
        self.watch.clock_jumped_back()
        self._direction.reset()

    def reset(self, now: float) -> str:
        """Clear a stop and go on to the last target; return why not, or ''."""
        cause = self.watch.present_cause(now)
        if not cause and self.safety.cause:
            self.safety.cause, self.safety.passing = '', False
            self._starts = True
        return cause

    # -- time -----------------------------------------------------------------------------------

    @property
    def by_tension(self) -> TorqueControl | None:
        """What commands tensions now; None where lengths are commanded."""
        if self.settings.method not in BY_TENSION or self.posture.exploring:
            return None
        return self.floating if self.settings.method == 'float' else self.torque

    def step(self, now: float, time: float | None = None) -> Command | None:
        """Return the command of this moment, or None while nothing was ever commanded.

        `time` is the messages' [s], that of the steady clock if it is not given.
        """
        # What computing took is over when a command goes out: it may bring no change with it.
        computing = max(self.sent_at - self.watch.stepped_at, 0.0)
        stopped = bool(self.safety.cause)
        dt, awake, paused = self.watch.step(now, now if time is None else time, stopped)
        self._starts |= paused
        late, cause = self.watch.late(now), self.watch.present_cause(now)
        # An estimator that starts anew knows of no suspect, and says that there is no anomaly.
        self._verifies &= not late.startswith('estimated')
        # Before the first command there is nothing to stop.
        self.follows &= not (cause or self.safety.cause)
        if cause and self.safety.command is not None:
            if cause == late:
                self._may_resume &= bool(self.safety.cause)
                self.safety.stop(cause, passing=True)
            else:
                self.stop(cause)
        self._fresh = 0.0 if cause else self._fresh + awake
        if self.safety.passing and self._fresh > RESUME:
            self.safety.cause, self.safety.passing, self._starts = '', False, True
        self.watch.limit_by_heat(self.safety.most_change(TENSION, dt))
        if self._resumes and (not self._may_resume or not self.reset(now)):
            self._resumes = False
            if self._may_resume and self._explored:
                self.explore(True)
            cause = self.watch.present_cause(now)
        desired = None
        if not cause and not self.safety.cause:
            try:
                desired = self._slack(self._command(dt))
            except RobotDescriptionError as error:  # too little is left to explore with
                self._explore(False)
                self.short = str(error)
                if without := self._left_out:
                    self.short = f'what is left without {without} holds too few postures; {RESTORE}'
            except Exception as error:  # noqa: BLE001 (any fault of control's own stops the arm)
                self.stop(f'fault of control: {type(error).__name__}: {error}')
        waits = self.safety.passing and not cause  # until RESUME: neither hold nor release goes on
        fresh = not late.startswith('muscle')
        limit = self.watch.most
        if not self.safety.zeroed:
            limit = np.minimum(limit, gentle_limit(self.robot))
        passed = 0.0 if waits else max(dt - computing, 0.0)
        command = self.safety.step(desired, limit, passed, fresh)
        if self.safety.cause and not self.safety.passing:
            self._explore(False)
        return command

    def _slack(self, command: Command | None) -> Command | None:
        """Return a command that gives isolated muscles all the length, or no tension."""
        if command is None or not self.robot.isolated:
            return command
        nothing = self.safety.longest if command.kind == LENGTH else 0.0
        return Command(command.kind, np.where(self.robot.used, command.value, nothing))

    def _bounded(self, length: Array, muscles: Muscles) -> Command:
        """Return lengths that demand no tension for which `watch` would stop the arm.

        Plans of `proposed` stay within tension.limit; feedback, an arm that does not come along,
        `second` and preset `paper` demand more. Stiffness is as was asked for, whatever pushes the
        arm.
        """
        if self.settings.method != 'stiffness' or self.posture.exploring:
            limits, strained = self.robot.tension, self.watch.strained
            most = limits.limit + FED_BACK * (limits.max - limits.limit)
            if np.count_nonzero(strained):
                most = np.where(strained, EASED * limits.limit, most)
            length = np.maximum(length, muscles.length + msc_compensation(self.robot, most))
        return Command(LENGTH, length)

    def _command(self, dt: float) -> Command | None:
        mae, muscles, estimate = self.mae, self.safety.now, self.estimate
        # No present cause: all are there.
        assert mae is not None and muscles is not None and estimate is not None
        posture, by_tension = self.posture, self.by_tension
        if not self.safety.zeroed:
            if not posture.exploring:
                return None
            now = muscles.tension, muscles.length, estimate, self.safety.last(LENGTH).value
            return Command(LENGTH, self.gentle.step(mae, *now, dt))
        planned = np.minimum(self.watch.limit, self.robot.tension.limit)
        if self._starts and self.follows:  # after a pause: on from where it was
            self._starts = False
            self.motion.start()
        again = self._approaches and self.settings.target_duration > 0.0
        if self.follows and again and self.motion.fallen:
            assert posture.theta is not None  # what is followed has led there
            self._starts = True
            self._approach(posture.theta, posture.effort, self._approaches - 1)
        if self._starts:
            self._starts = False
            kind = TENSION if by_tension else LENGTH
            (by_tension or posture).start_from(self.safety.last(kind).value)
        if self.follows:
            sent = self.safety.last(LENGTH).value
            length = self.motion.step(muscles.length, self._pull, estimate, sent, planned, dt)
            return self._bounded(length, muscles)
        if by_tension is None:
            goal = posture.step(self._pull, estimate, planned, dt)
            return None if goal is None else self._bounded(goal, muscles)
        if self.settings.method == 'float':
            nothing = np.zeros_like(estimate)
            tension = self.floating.step(mae, estimate, estimate, nothing, planned, dt)
            # Where it is left is held by the method that comes next.
            inside = np.clip(estimate, self.robot.lower, self.robot.upper)
            posture.theta, posture.effort = inside, nothing
            return Command(TENSION, tension)
        if posture.theta is None:
            return None
        target, effort = posture.theta, posture.effort
        return Command(TENSION, self.torque.step(mae, estimate, target, effort, planned, dt))
