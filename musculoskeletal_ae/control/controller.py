# SPDX-License-Identifier: Apache-2.0
"""Control as a whole: targets in, safe commands out, and why the arm must not move.

    target ─→ posture (lengths) or torque (tensions) ─→ safety ─→ command

A stop latches on missing or old sensor data, an anomaly, an unfit checkpoint, a fault of control's
own, or on request (doc/interface.md, stop and resume). `reset` clears it once no cause is left;
then the last target is resumed by a ramp from where the arm is. Exploration is not resumed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control import safety
from musculoskeletal_ae.control.exploration import Exploration
from musculoskeletal_ae.control.posture import PostureControl
from musculoskeletal_ae.control.safety import LENGTH, TENSION, Command, Muscles, SafetyFilter
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.control.torque import TorqueControl
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.robot import Robot

LONGEST_STEP = 0.1  # [s]; after a pause control goes on instead of catching up
NOTABLE = 0.05  # [N·m] of missing torque


class Controller:
    """Steps everything between a target and a command. Times are of one steady clock [s]."""

    def __init__(self, robot: Robot, settings: Settings | None = None, seed: int = 0) -> None:
        """Control `robot`; `seed` is the random seed of the exploration."""
        self._robot, self.settings = robot, settings or Settings()
        self.posture = PostureControl(robot, self.settings)
        self.torque = TorqueControl(robot, self.settings)
        self.safety = SafetyFilter(robot, self.settings)
        #: tension limit of each muscle, lowered by heat [N], (M,)
        self.limit: Array = np.full(robot.muscle_count, robot.tension.max)
        self.clamped: tuple[str, ...] = ()  # joints whose target lay beyond the limits
        self._mae: Mae | None = None
        # One stream for the life of the controller: after a pause it brings new postures.
        self._exploration = Exploration(robot, seed)
        self._muscles: Muscles | None = None
        self._estimate: Array | None = None
        self._muscles_at = self._estimate_at = self.stepped_at = -math.inf
        self._anomaly = False
        # Whether the next command starts a method anew, from how the muscles pull then.
        self._starts = True

    # -- what comes in --------------------------------------------------------------------------

    def configure(self, settings: Settings) -> None:
        """Take new settings; another method starts from how the muscles pull at that moment.

        Raises:
            MusculoskeletalError: If the joint stiffness does not fit the robot.
        """
        before, joints = self.settings, self._robot.joint_count
        stiffness = settings.desired_stiffness(joints)
        self.settings = settings
        self.posture.settings = self.torque.settings = self.safety.settings = settings
        if settings.method != before.method and not self.posture.exploring:
            self._starts = True
        elif settings.method == 'stiffness' and stiffness != before.desired_stiffness(joints):
            self.posture.start()

    def use(self, mae: Mae) -> None:
        """Take a checked network."""
        self._mae = mae
        self.posture.use(mae)

    def muscles(self, muscles: Muscles, now: float) -> None:
        """Take muscle_states."""
        self._muscles, self._muscles_at = muscles, now
        self.safety.muscles(muscles)
        highest = self.settings.temperature_limit
        self.limit = safety.thermal_limit(self._robot, muscles.temperature, highest)

    def estimated(self, theta: Array, now: float) -> None:
        """Take estimated_joint_states [rad], shape (D,)."""
        self._estimate, self._estimate_at = theta, now

    def anomaly(self, detected: bool) -> None:
        """Take anomaly_detected."""
        self._anomaly = detected
        if detected:
            self.stop('anomaly_detected')

    def target(self, joints: Mapping[str, tuple[float, float]]) -> None:
        """Take θ_target [rad] and effort [N·m] of some joints; the others keep theirs.

        Raises:
            MessageError: If it leaves joints out of whose posture nothing is known yet.
        """
        robot = self._robot
        kept = self.posture.theta if self.posture.theta is not None else self._estimate
        if kept is None and len(joints) < robot.joint_count:
            raise MessageError('no posture yet', 'give all joints, or wait for an estimate')
        before = zip(np.zeros(robot.joint_count) if kept is None else kept, self.posture.effort)
        theta, effort = np.array([joints.get(*pair) for pair in zip(robot.joints, before)]).T
        inside = np.clip(theta, robot.lower, robot.upper)
        self.clamped = tuple(n for n, a, b in zip(robot.joints, theta, inside) if a != b)
        self._starts |= self.posture.exploring
        self.posture.set_target(inside, effort)

    # -- what is asked --------------------------------------------------------------------------

    def explore(self, wanted: bool) -> str:
        """Explore, or end it and hold; return why not, or ''."""
        if wanted and self.safety.cause:
            return f'stopped: {self.safety.cause}'
        if wanted != self.posture.exploring:
            self.posture.explore(iter(self._exploration) if wanted else None)
            self.posture.theta = None
            self._starts = True
        return ''

    def stop(self, cause: str) -> None:
        """Latch a safe stop."""
        self.explore(False)
        self.safety.stop(cause)

    def reset(self, now: float) -> str:
        """Clear a stop and go on to the last target; return why not, or ''."""
        cause = self.present_cause(now)
        if not cause and self.safety.cause:
            self.safety.cause = ''
            self._starts = True
        return cause

    def present_cause(self, now: float) -> str:
        """Return why the arm must not move now, or ''."""
        if self._mae is None:
            return 'no checkpoint'
        if self._anomaly:
            return 'anomaly_detected; call estimator/reset when it is mended'
        for what, arrival in (
            ('muscle_states', self._muscles_at),
            ('estimated_joint_states', self._estimate_at),
        ):
            if now - arrival > self.settings.max_age:
                return f'{what} older than {self.settings.max_age:g} s'
        return ''

    def report(self, now: float) -> Report:
        """Say what control is doing and what is in its way."""
        chosen, posture, robot = self.settings, self.posture, self._robot
        solution, missing = posture.solution, np.zeros(0)
        values, warnings = {'method': chosen.method, 'preset': chosen.preset}, []
        if self.clamped:
            values['target clamped at'] = ', '.join(self.clamped)
            warnings.append('target clamped to the joint limits')
        if solution is not None:
            missing = solution.missing_torque
        if solution is not None and solution.stiffness is not None:
            expected, *reachable = solution.stiffness
            desired = chosen.desired_stiffness(robot.joint_count)
            for row in zip(robot.joints, desired, expected.diagonal(), *reachable):
                name, wanted, planned, low, high = row
                text = f'{planned:.2f} N·m/rad, reachable {low:.2f} to {high:.2f}'
                if wanted > 0.0 and not low <= wanted <= high:
                    text += f', desired {wanted:.2f} clamped'
                values[f'joint stiffness {name}'] = text
        if posture.effort.any() and chosen.method in ('geometric', 'first', 'second'):
            warnings.append(f'method {chosen.method} exerts no effort')
        if self._in_tension:
            missing = self.torque.missing_torque
        if np.abs(missing).max(initial=0.0) > NOTABLE:
            lacks = (f'{name} {torque:.2f} N·m' for name, torque in zip(robot.joints, missing))
            values['missing torque'] = ', '.join(lacks)
            warnings.append('the target needs more torque than the muscles have')
        hot = {n: t for n, t in zip(robot.muscles, self.limit) if t < robot.tension.max}
        if hot:
            values['tension limited by heat'] = ', '.join(f'{n} {t:.0f} N' for n, t in hot.items())
            warnings.append(f'hot: {", ".join(hot)}')
        doing = 'no target' if posture.theta is None else 'holding'
        doing = 'exploring' if posture.exploring else doing
        if self.safety.cause:
            return Report('error', f'stopped: {self.safety.cause}', values)
        if waiting := self.present_cause(now):
            return Report('warn', f'waiting: {waiting}', values)
        if warnings:
            return Report('warn', '; '.join(warnings), {**values, 'doing': doing})
        return Report('ok', doing, values)

    # -- time -----------------------------------------------------------------------------------

    @property
    def _in_tension(self) -> bool:
        return self.settings.method == 'tension' and not self.posture.exploring

    def step(self, now: float) -> Command | None:
        """Return the command of this moment, or None while nothing was ever commanded."""
        since = now - self.stepped_at if self.stepped_at > -math.inf else 0.0
        dt = min(max(since, 0.0), LONGEST_STEP)
        self.stepped_at = now
        cause = self.present_cause(now)
        # Before the first command there is nothing to stop.
        if cause and self.safety.command is not None:
            self.stop(cause)
        desired = None
        if not cause and not self.safety.cause:
            try:
                desired = self._command(dt)
            except Exception as error:  # noqa: BLE001 (any fault of control's own stops the arm)
                self.stop(f'fault of control: {type(error).__name__}: {error}')
        fresh = now - self._muscles_at <= self.settings.max_age
        return self.safety.step(desired, self.limit, dt, fresh)

    def _command(self, dt: float) -> Command | None:
        mae, muscles, estimate = self._mae, self._muscles, self._estimate
        # No present cause: all are there.
        assert mae is not None and muscles is not None and estimate is not None
        posture, in_tension = self.posture, self._in_tension
        if self._starts:
            self._starts = False
            # Go on from the last command, or from how the muscles pull at this moment.
            kind, command = TENSION if in_tension else LENGTH, self.safety.command
            if command is None or command.kind != kind:
                command = safety.unchanging(self._robot, kind, muscles)
            (self.torque if in_tension else posture).start_from(command.value)
        planned = np.minimum(self.limit, self._robot.tension.limit)
        if not in_tension:
            length = posture.step(muscles.tension, estimate, planned, dt)
            return None if length is None else Command(LENGTH, length)
        if posture.theta is None:
            return None
        target, effort = posture.theta, posture.effort
        return Command(TENSION, self.torque.step(mae, estimate, target, effort, planned, dt))
