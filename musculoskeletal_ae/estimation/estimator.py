# SPDX-License-Identifier: Apache-2.0
"""Joint angles from muscle length and tension, message by message; is the body still healthy.

    (T_end, l) ─② of the MAE→ θ, T, l ─→ detector ─→ anomaly, latched until `reset`
    while zeros are sought: no judgement, but `zeroing` finds them and the estimate follows
    θ, T, l ─→ what pushes the arm from outside (`touch`)
    pose of the marker ─inverse kinematics from the estimate→ θ as a camera sees it

T_end is T without what friction along the wires adds or takes (`friction`).

What was detected first names the suspect for as long as the latch holds. With `on_anomaly:
isolate` the suspect is isolated at once and verified (`verification`), also one whose length has
jumped: if it is broken it stays isolated, else it is used again, and either way the anomaly is
over. The robot in here is the estimator's own: its isolated muscles are those of which it knows.

A module whose thermal constants drift (`heat`) is an anomaly too. It latches where the winding is
hot; a cool arm is not stopped for it, but the suspect is named all the same, until `reset` takes
the module as it is.
"""

import copy
import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.anomaly import AnomalyDetector, Verdict
from musculoskeletal_ae.estimation.contact import Contact, ContactEstimator
from musculoskeletal_ae.estimation.length_calibration import LengthCalibration
from musculoskeletal_ae.estimation.verification import Outcome, Verification
from musculoskeletal_ae.estimation.verification import Verdict as VerificationVerdict
from musculoskeletal_ae.exceptions import MessageError, MusculoskeletalError
from musculoskeletal_ae.friction import FrictionDirection
from musculoskeletal_ae.heat import Heat
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.units import State
from musculoskeletal_ae.plausibility import SLACK
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.inverse_kinematics import inverse_kinematics
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import LengthOffsets

# Commands older than this no longer say what the modules do.
COMMAND_AGE = 0.5  # [s]
# A pause in the messages counts as at most this much of a muscle's time without tension.
LONGEST_PERIOD = 0.1  # [s]
# Without a message for this long there is nothing to estimate from.
SILENCE = 1.0  # [s]
# A marker that the arm cannot reach to within these is another one, or its calibration is off.
MARKER_DISTANCE, MARKER_ANGLE = 0.05, 0.3  # [m], [rad]
JOINTS_AGE = 0.05  # [s] that joint angles belong to a message
SHIFTED = 0.02  # [m] by which a guess of a zero may be off before it is told anew
# A sensor that says exactly the same for so long, while the others say that the muscle moves by so
# much, is dead or frozen, however little that disturbs the estimate.
STILL_TIME, MOVED = 1.0, 0.006  # [s], [m]
# Whose sensor says no number for so long is isolated: nothing is estimated while it does.
SILENT = 0.15  # [s]
# So many suspects that turn out healthy within so many seconds, and the arm stays stopped.
ACQUITTALS, WITHIN = 2, 60.0
# A winding below this may warm as it likes: the arm is not stopped for it.
COOL = 60.0  # [°C]
PAST_STOP = 0.01  # share of a joint's range


class Estimate(NamedTuple):
    """What one message gives."""

    state: State  # (θ, T, l) as the network restores them
    anomaly: float  # A, scaled units
    detected: bool  # whether this message completes a detection that was not there before
    contact: Contact | None = None  # None while the zeros of l are unknown


class Estimator:
    """Steps network and detector. `time` is the messages' clock [s], `now` a steady one [s]."""

    def __init__(self, robot: Robot, preset: str = 'default') -> None:
        """Wait for a network; the preset says what decides that there is an anomaly."""
        self.robot = self._robot = robot = copy.copy(robot)
        self.mae: Mae | None = None  # the network in use, without the isolated muscles
        self._whole: Mae | None = None  # the same as it came
        self._verification: Verification | None = None
        self._acquitted: list[float] = []  # when [s]
        self._command: Array | None = None  # l_target [m], (M,)
        self._read: Array | None = None  # l and T of the last message, and for how long so far [s]
        self._same: Array = np.zeros((2, robot.muscle_count))
        self._moved: tuple[Mae, float, float] | None = None  # without it: its l at least, at most
        #: the one muscle without numbers; since when, and when last [s]
        self._silent: tuple[int | None, float, float] = None, 0.0, 0.0
        self.verified = ''  # the last suspect, and what it was
        self.detector = AnomalyDetector(robot, preset=preset)
        self.heat = Heat(robot)
        self._direction, self._external = FrictionDirection(), ContactEstimator(robot)
        self._contact: Contact | None = None
        self._contacts = 0
        self.cause = self._suspect = ''  # why an anomaly is latched, and the muscle
        self._theta: Array = 0.5 * (robot.lower + robot.upper)
        self._verdict: Verdict | None = None
        self.zeros = LengthOffsets.none(
            robot.muscle_count
        )  # of the length sensors, as all nodes are told
        self._zeroing: LengthCalibration | None = None
        self._joints: tuple[float, Array | None] = -math.inf, None
        self._time = math.inf  # of the last message; none yet
        self._stepped_at = self._commanded_at = -math.inf

    def use(self, mae: Mae) -> None:
        """Take a network and the healthy statistics it brings."""
        less = mae.without(self._robot.isolated)
        self.detector.use(less)
        self._external.use(less)
        self._whole, self.mae = mae, less
        if self._zeroing is not None:  # what it found with another one is off by their difference
            self._zeroing = LengthCalibration(self._robot, less, self._zeroing.posture)

    def isolate(self, muscles: Iterable[int]) -> None:
        """Go on without these muscles, places in T and l, and with all others.

        A suspect among the others is verified no longer; what was detected stays. Zeros that are
        being found are looked for anew.
        """
        before = self._robot.isolated
        self._robot.isolate(muscles)
        suspect = self._verification
        if suspect is not None and self._robot.used[suspect.muscle]:
            self._verification = None
        if self._whole is not None and self._robot.isolated != before:
            self.use(self._whole)
        self.detector.reset()

    def commanded(
        self, now: float, length: Array | None = None, tension: Array | None = None
    ) -> None:
        """Note the target lengths [m] or tensions [N] (M,) sent to the modules."""
        self.detector.commanded(length, tension)
        self._command, self._commanded_at = length, now

    def joints(self, theta: Array, now: float) -> None:
        """Take measured θ [rad] (D,): only zeroing uses it, where there is any."""
        self._joints = now, theta

    def check_posture(self, posture: tuple[float, ...]) -> None:
        """Raise a MusculoskeletalError unless an arm can stand in θ [rad] (D,); () is legal."""
        lower, upper, theta = self._robot.lower, self._robot.upper, np.array(posture)
        # A joint that rests on its stop is read a little beyond it.
        past = PAST_STOP * (upper - lower)
        inside = theta.shape == lower.shape
        inside = inside and bool(((theta >= lower - past) & (theta <= upper + past)).all())
        if posture and not inside:
            limits = zip(self._robot.units, lower, upper, strict=True)
            legal = (f'{low:.2f} to {high:.2f} {unit.theta}' for unit, low, high in limits)
            raise MusculoskeletalError(f'{list(posture)}; legal: none, or {", ".join(legal)}')

    def zero(self, posture: tuple[float, ...] = ()) -> None:
        """Begin to find the zeros of the length sensors; the arm stands in `posture` [rad] (D,).

        Without one they are found while the arm moves gently. A MusculoskeletalError says that
        there is no network, or no such posture.
        """
        if self.mae is None:
            raise MusculoskeletalError('no checkpoint, and zeros are found with a network')
        self.check_posture(posture)
        robot = self._robot
        self._zeroing = LengthCalibration(robot, self.mae, np.array(posture) if posture else None)
        self.zeros = LengthOffsets.unknown(robot.muscle_count)
        self.detector.judges, self._verdict = False, None
        self._external.reset()
        self._contact = None
        self.reset()

    def step(
        self, tension: Array, length: Array, time: float, now: float,
        temperature: Array | None = None,
    ) -> Estimate | None:  # fmt: skip
        """Return the estimate from measured T [N], read l [m] and temperatures [°C], (M,) each.

        None without a network, or while nothing is known of the zeros of l.
        """
        since, self._time, self._silent = max(time - self._time, 0.0), time, (None, 0.0, 0.0)
        if temperature is not None:
            self.heat.step(tension, np.where(self._robot.used, temperature, np.nan), since)
        if self.mae is None:
            return None
        dt = min(since, LONGEST_PERIOD)
        if since > SILENCE:
            self._forget_motion()
        self._stepped_at = now
        if now - self._commanded_at > COMMAND_AGE:
            self.detector.commanded()
            self._command = None
        guess: LengthOffsets | None = self.zeros
        if self._zeroing is not None:
            guess = self._zero_on(self._zeroing, tension, length, dt, now)
        if guess is None:
            return None
        end = self._direction.end_tension(self.mae.friction, tension, length)
        state = self.mae.estimate(end, length - guess.offset)
        self._theta, length = state.theta, length - self.zeros.offset  # as commands are told
        if self._verification is not None:
            self._verify(self._verification, state.theta, tension, end, length, dt, now)
        verdict = self._verdict = self.detector.step(state, end, tension, length, dt)
        still = self._stands_still(self.mae, tension, end, length, dt)
        if still is not None and not verdict.cause:
            why = 'a sensor stands still while the arm moves'
            verdict = verdict._replace(suspect=still, cause=why)
        for m, how in self.heat.changed.items():
            if self.heat.core[m] > COOL and not verdict.cause:
                verdict = verdict._replace(suspect=m, cause=f'its module {how}')
        detected = bool(verdict.cause) and not self.cause
        if detected:
            self._suspect = self._robot.muscles[verdict.suspect]
            self.cause = f'{self._suspect}: {verdict.cause}'
            self._begin_verification(verdict.suspect, now)
        before, self._contact = self._contact, None
        if self.zeros.known:
            self._contact = touch = self._external.step(state.theta, end * self._robot.used, since)
            self._contacts += touch.is_contact and not (before is not None and before.is_contact)
        return Estimate(state, verdict.anomaly, detected, self._contact)

    def _stands_still(
        self, mae: Mae, tension: Array, end: Array, length: Array, dt: float
    ) -> int | None:
        """Return the muscle of a sensor that says the same though the others say that it moves."""
        robot, read, before = self._robot, np.array([length, tension]), self._read
        self._read = read
        self._same = (self._same + dt) * (read == before)
        if self._same.max() < STILL_TIME or not self.detector.calibrated:
            self._moved = None
            return None
        # One without tension has another rule; one that is paid out may keep T_bias to the bit.
        bias = robot.tension.bias
        judged = robot.used & (tension > SLACK * bias)
        since = judged * np.maximum(
            self._same[0], self._same[1] * (np.abs(tension - bias) > SLACK * bias)
        )
        muscle = int(since.argmax())
        if since[muscle] < STILL_TIME or not self.detector.judges:
            self._moved = None
            return None
        less, low, high = self._moved or (mae, np.inf, -np.inf)
        isolated = tuple(sorted((*robot.isolated, muscle)))
        if less.isolated != isolated:
            less, low, high = mae.without(isolated), np.inf, -np.inf
        theta = less.estimate(end, length).theta
        likely = float(less.lengths(theta, np.minimum(end, robot.tension.limit))[muscle])
        self._moved = less, min(low, likely), max(high, likely)
        return muscle if self._moved[2] - self._moved[1] > MOVED else None

    def jumped(self, muscle: int, now: float) -> None:
        """Take that the length of a muscle, and of no other, jumped and stayed there."""
        verifies = self.detector.settings.on_anomaly == 'isolate' and self.detector.judges
        if verifies and not self.cause and self._robot.used[muscle]:
            self._suspect = self._robot.muscles[muscle]
            self.cause = f'{self._suspect}: its length jumped'
            self._begin_verification(muscle, now)

    def unread(self, states: Array, now: float) -> bool:
        """Take muscle_states (3, M) with what is not finite; return whether a muscle was isolated.

        Where all of that is one muscle's, its sensor is broken: there is nothing to verify.
        """
        broken = ~np.isfinite(states[:2]).all(axis=0) & self._robot.used
        muscle = int(broken.argmax()) if broken.sum() == 1 else None
        before, since, last = self._silent
        if muscle != before or now - last > SILENT:
            since = now
        self._silent = muscle, since, now
        if muscle is None or now - since < SILENT or self.detector.settings.on_anomaly == 'stop':
            return False
        assert muscle is not None
        self.verified = (
            f'{self._robot.muscles[muscle]}: {VerificationVerdict(Outcome.VALUES_MISSING)}'
        )
        self.isolate((*self._robot.isolated, muscle))
        return True

    def _begin_verification(self, suspect: int, now: float) -> None:
        robot = self._robot
        recent = [at for at in self._acquitted if now - at < WITHIN]
        if self.detector.settings.on_anomaly == 'stop' or len(recent) >= ACQUITTALS:
            return
        constants = robot.tension.bias[suspect], robot.stiffness[suspect]
        self._verification = Verification(suspect, *map(float, constants))
        self.isolate((*robot.isolated, suspect))

    def _verify(
        self, suspect: Verification, theta: Array, tension: Array, end: Array, length: Array,
        dt: float, now: float,
    ) -> None:  # fmt: skip
        assert self.mae is not None
        m = suspect.muscle
        command = None if self._command is None else float(self._command[m])
        pulls = np.clip(end, 0.0, self._robot.description.tension.limit)
        likely = self.mae.lengths(theta, pulls)
        found = suspect.step(float(tension[m]), float(length[m]), command, float(likely[m]), dt)
        if found is None:
            return
        self.verified = f'{self._robot.muscles[m]}: {found}'
        if found.outcome is Outcome.HEALTHY:
            self._acquitted.append(now)
        else:
            self._verification = None
        self.heat.accept(m)
        self._clear()

    def _zero_on(
        self, zeroing: LengthCalibration, tension: Array, length: Array, dt: float, now: float
    ) -> LengthOffsets | None:
        came, theta = self._joints
        zeroing.step(tension, length, dt, theta if now - came < JOINTS_AGE else None)
        guess = zeroing.offsets
        if zeroing.is_standing and not zeroing.is_done:
            return None  # nobody shall move
        # A guess is told anew only when it is another one: whoever follows it goes on from there.
        if guess is not None and (
            guess.known
            or self._verdict is None
            or np.abs(guess.offset - self.zeros.offset).max() > SHIFTED
        ):
            self.zeros = guess
        if zeroing.is_done:
            self._zeroing, self.detector.judges = None, True
            self.detector.reset()
        return guess

    def see(self, pose: pin.SE3) -> Array:
        """Return θ [rad] (D,) that brings the end effector to a pose in the root link's frame.

        NaN of joints that do not move it.
        """
        posture = inverse_kinematics(self._robot, pose, self._theta)
        if posture.distance > MARKER_DISTANCE or posture.angle > MARKER_ANGLE:
            raise MessageError(
                'out of reach', f'{posture.distance:.3f} m and {posture.angle:.2f} rad are left'
            )
        return posture.seen

    def reset(self) -> None:
        """Clear the anomaly."""
        self.heat.accept(*self.heat.changed)
        self._clear()

    def _clear(self) -> None:
        self.cause = self._suspect = ''
        suspect, self._verification = self._verification, None
        if suspect is not None:  # whoever resets it says that it is sound
            self.isolate(m for m in self._robot.isolated if m != suspect.muscle)
        self.detector.reset()

    def clock_jumped_back(self) -> None:
        """Start the detector's counts anew; what was detected stays."""
        self._time = math.inf
        self.detector.reset()
        self._forget_motion()

    def _forget_motion(self) -> None:
        self._direction.reset()
        self._external.reset()

    def report(self, now: float) -> Report:
        """Say what is estimated, and how the body is."""
        if self.mae is None:
            return Report('warn', 'waiting for a checkpoint', {})
        values = {
            'checkpoint version': str(self.mae.version),
            'anomaly calibrated': str(self.detector.calibrated),
        }
        if self.mae.covariance is not None:
            spread = np.sqrt(np.diag(self.mae.covariance))
            values['joint uncertainty'] = self._robot.told(spread, 3)
        if isolated := self._robot.names(self._robot.isolated):
            values['isolated muscles'] = isolated
        values['verification'] = 'none' if self._verification is None else 'running'
        if self.verified:
            values['last verified'] = self.verified
        drifting = {self._robot.muscles[m]: how for m, how in self.heat.changed.items()}
        if self._verdict is not None:
            named = next(iter(drifting), self._robot.muscles[self._verdict.suspect])
            values |= {
                'A': f'{self._verdict.anomaly:.4f}',
                'd': f'{self._verdict.distance:.1f}',
                'suspect muscle': self._suspect or named,
            }
            if self.detector.calibrated:
                letter = 'd' if self.detector.whitened else 'A'
                assert self._read is not None
                limit = self.detector.limit(self._theta, self._read[1])
                values[f'{letter} limit'] = f'{limit:.3g}'
        if (touch := self._contact) is not None:
            force = f'{np.linalg.norm(touch.force()):.0f} N at the hand'
            known = force if touch.is_contact else 'none'
            values['contact'] = known if self._external.is_calibrated else 'not calibrated'
            values['contacts'] = str(self._contacts)
        if self.zeros.offset.any():
            zeros = zip(self._robot.muscles, 1e3 * self.zeros.offset, 1e3 * self.zeros.deviation)
            values['length zeros'] = ', '.join(f'{n} {o:.1f} ± {d:.1f} mm' for n, o, d in zeros)
        far = self.detector.unfamiliar(self._theta) if self.detector.calibrated else 0.0
        values['posture'] = f'unfamiliar ({far:.1f})' if far > 1.0 else 'familiar'
        if self.cause:
            doing = '; verifying it' if self._verification is not None else ''
            return Report('error', f'anomaly detected: {self.cause}{doing}', values)
        if now - self._stepped_at > SILENCE:
            return Report('warn', 'no muscle_states', values)
        if self._zeroing is not None:
            return Report('warn', f'finding the length zeros: {self._zeroing.progress}', values)
        calibrated = '' if self.detector.calibrated else ', uncalibrated'
        if drifting:
            told = (f'{name}: its module {how}' for name, how in drifting.items())
            return Report('warn', f'anomaly of a cool muscle: {"; ".join(told)}', values)
        if isolated:
            return Report('warn', f'estimating{calibrated} without {isolated}', values)
        return Report('ok', f'estimating{calibrated}', values)
