# SPDX-License-Identifier: Apache-2.0
"""Length calibration: determines the offset of every length sensor after power-on.

The arm moves gently, with or without measured joint angles, or it stands in a stated posture.
`length_moments.py` collects the readings, and `length_fit.py` fits the offsets to them. This file
decides when to fit and whether the result is reliable.

While the arm moves, known offsets stay as they are: after one winch has slipped, only its offset is
fitted. If the readings contradict the known offsets, the caller starts again without them
(`contradicts_known`). In a stated posture, all offsets are determined.

Offsets cannot correct readings in a wrong order, or lengths with a wrong sign. Such readings would
often lead to plausible but false offsets. Before offsets of a moving arm are accepted, the wiring
is therefore judged (`signals/wiring.py`), and a wrong wiring is refused with the names of the
muscles. A standing arm does not show the wiring.

If an arm stands still, some offsets explain its readings even if it does not stand in the stated
posture. On an arm with joint sensors, the offsets are therefore accepted only if the sensors
measure that posture.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.lengths.length_fit import FARTHEST, Fit, LengthFit
from musculoskeletal_ae.estimation.lengths.length_moments import MomentCollector, Moments
from musculoskeletal_ae.estimation.lengths.length_trust import Evidence
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.remedy_steps import Step, sentence
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import MOST_OFFSET, UNKNOWN, LengthOffsets, Trust
from musculoskeletal_ae.signals.wiring import WiringJudgement, judge

ENOUGH_WITH_ANGLES = 20.0  # with joint sensors, require gentle motion for this long [s]
ENOUGH = 38.0  # without joint sensors, require gentle motion for this long [s]
STANDING = 1.0  # require the arm to stand still in a posture stated by the user for this long [s]
#: begin the first fit after this time [s]; fit a standing arm anew each time it has passed again
FIRST_FIT = 0.5
FIT_INTERVAL = 2.0  # begin later fits of a moving arm at this interval [s]
#: Do one piece of a fit, which takes 1 to 2 ms, for every PIECE_TIME [s] since the last message.
#: Do at least one piece and at most MOST_PIECES at each message. A fit therefore takes equally long
#: with messages at 50 to 200 Hz.
PIECE_TIME = 0.005
MOST_PIECES = 4  # do at most this many pieces of a fit at one message, so that none is delayed
#: reject a fit if the median residual of a length is larger than this [m]; correct offsets leave
#: 0.0003 m
LARGEST_RESIDUAL = 0.02
#: Drop all known offsets if the median error of a known length is larger than this [m]. With right
#: offsets, it is below 7 mm for most muscles of emulator model `foreign`. If it is larger, only the
#: advantage of the known offsets is lost.
CONTRADICTION = 0.01
#: reject a fit with a larger cost per residual than this: correct offsets cost 0.2 to 0.5, offsets
#: of a wrong posture 1.1, and pure noise 0.95
LARGEST_COST = 0.75
#: advise these steps if the order or the sign of the readings is wrong
CORRECT_DRIVER = Step.CORRECT_WIRING, Step.CALIBRATE_LENGTHS
#: advise this if a calibration in gentle motion fails; a network that has not learned the arm may
#: not be accurate enough for it
OTHER_WAY = (
    'provide joint sensors; or set zero_posture, hold the arm there, and call estimator/zero'
)
#: treat this many successive moments (means over 0.25 s) as one independent measurement, when the
#: standard deviation of an offset is computed
CORRELATED = 10.0
#: during the calibration, use a newer estimate of the offsets only if an offset differs by more
#: than this from the one in use [m]
SHIFTED = 0.02
#: Reject a stated posture if a joint sensor differs by more than this [rad]. A larger difference is
#: due to a wrong posture or a faulty sensor.
STATED_ERROR = 0.2
#: compare the stated posture with the median of at least LEAST and at most MOST measured postures
LEAST, MOST = 10, 100
BEYOND_STOP = 0.01  # let a stated joint angle exceed a limit by this share of the joint's range
#: multiply a median absolute deviation by this to get the standard deviation
MAD_TO_DEVIATION = 1.48


class LengthCalibration:
    """Collects readings and fits the offsets, with a small amount of work at every message.

    Attributes:
        posture: Positions of the joints at which the arm stands, as the user has stated them [rad
            or m], (D,); () if the arm moves gently.
        muscles: Indices of the muscles whose offsets are calibrated; all others are known.
        contradicts_known: Whether the readings contradict the known offsets.
        wiring: Whether muscles are exchanged or lengths have a wrong sign, according to the newest
            fit; None before the wiring has been judged.
    """

    def __init__(
        self,
        robot: Robot,
        mae: Mae | None,
        posture: tuple[float, ...] = (),
        known: Array | None = None,
        reason: str = '',
    ) -> None:
        """Start a calibration.

        Args:
            robot: The nominal body.
            mae: The network; its isolated muscles are ignored.
            posture: Positions of the joints at which the arm stands still [rad or m], (D,); () if
                it moves gently during the calibration.
            known: Offsets that are known [m], (M,), NaN for those that are to be calibrated; None
                if all are.
            reason: Why an earlier calibration begins again, as a text for users; '' if it does not.

        Raises:
            MusculoskeletalError: If there is no network, if the posture is not valid, or if no
                posture is stated for a robot whose tensions are unknown.
        """
        if mae is None:
            raise MusculoskeletalError(
                'a length calibration requires a checkpoint; set the parameter `checkpoint`, or '
                'start the learner'
            )
        self.posture, self._stated = posture, stated_theta(robot, posture)
        if not posture and not robot.tension_source.is_known:
            raise MusculoskeletalError(
                'without tensions (tension_source: none), lengths can be calibrated only in a '
                'known posture; hold the arm still and set the parameter zero_posture'
            )
        self._robot, self._mae, self._reason = robot, mae, reason
        self._known = np.full(robot.muscle_count, np.nan) if known is None else known
        self.muscles: tuple[int, ...] = tuple(np.flatnonzero(np.isnan(self._known)).tolist())
        self.contradicts_known = False
        self._fit = LengthFit(robot, mae, self._known)
        self._collector = MomentCollector(self._fit.used, robot.joint_count, self._stated)
        self._since = 0.0  # time since the last fit began [s]
        self._work: Generator[None, None, None] | None = None  # the running fit
        self._best: Fit | None = None
        self._has_angles = False  # whether joint angles are measured most of the time
        self._problem = ''  # why the last fit is not reliable, or the stated posture is wrong
        self._estimate: LengthOffsets | None = None  # newest estimate, which may be unreliable
        self._used: Array | None = None  # offsets in use [m], (M,); None before the first estimate
        #: θ measured last while the arm stands [rad], (D,) each
        self._measured: deque[Array] = deque(maxlen=MOST)
        self.wiring: WiringJudgement | None = None

    @property
    def is_standing(self) -> bool:
        """Whether the arm stands in a stated posture."""
        return self._stated is not None

    @property
    def is_done(self) -> bool:
        """Whether the offsets are known, which ends the calibration."""
        return self._estimate is not None and self._estimate.known and not self._problem

    @property
    def offsets(self) -> LengthOffsets | None:
        """The newest estimate of the offsets; None before the first.

        While the arm stands in a stated posture, there is no estimate until the offsets are known.
        """
        return None if self.is_standing and not self.is_done else self._estimate

    @property
    def time(self) -> float:
        """Duration of gentle motion, or of standing, so far [s]."""
        return self._collector.time

    @property
    def enough(self) -> float:
        """Duration of gentle motion, or of standing, that is enough [s]."""
        if self.is_standing:
            return STANDING
        return ENOUGH_WITH_ANGLES if self._has_angles else ENOUGH

    @property
    def progress(self) -> str:
        """Progress of the calibration and any problem, as a text for users."""
        how = 'of standing still' if self.is_standing else 'of gentle motion'
        again = f' (begun again: {self._reason})' if self._reason else ''
        progress = f'{self.time:.0f} of {self.enough:.0f} s {how}{again}'
        return f'{progress}; {self.problem}' if self.problem else progress

    @property
    def problem(self) -> str:
        """Why the calibration does not end although it has enough data, for users; '' otherwise."""
        if self._collector.has_moved_away:
            return 'the arm moved away; hold it still and call estimator/zero again'
        return self._problem

    @property
    def remedy(self) -> tuple[Step, ...]:
        """Steps by which a user corrects the driver before a calibration; () if none are needed."""
        return CORRECT_DRIVER if self.wiring is not None and self.wiring.is_faulty else ()

    def step(
        self, tension: Array, length: Array, dt: float, theta: Array | None = None
    ) -> Evidence | None:
        """Continue the calibration by the readings of one message.

        Args:
            tension: Tensions [N], (M,).
            length: Muscle lengths as read, with their unknown offsets [m], (M,).
            dt: Time since the previous message [s].
            theta: Measured joint angles [rad], (D,), or None without joint sensors.

        Returns:
            CALIBRATING if `offsets` are to be used from now on; CALIBRATED if they are also known,
            which ends the calibration; None if nothing changes.
        """
        has_failed = self.is_standing and (self._problem or self._collector.has_moved_away)
        if has_failed:
            return None
        if not self.is_done:
            if self.is_standing and theta is not None:
                self._measured.append(theta)
            self._continue(tension, length, dt, theta)
        if self.is_done and (problem := self._posture_problem()):
            self._problem = problem
        if (offsets := self.offsets) is None:
            return None
        if self.is_done:
            return Evidence.CALIBRATED
        # Use the first estimate, and a later estimate only after a substantial change.
        if self._used is None or np.abs(offsets.offset - self._used).max() > SHIFTED:
            self._used = offsets.offset
            return Evidence.CALIBRATING
        return None

    def _posture_problem(self) -> str:
        """Return for users why the arm does not stand in the stated posture; '' if it does."""
        if self._stated is None or len(self._measured) < LEAST:
            return ''
        measured = np.median(self._measured, axis=0)
        difference = np.abs(measured - self._stated)
        j = int(difference.argmax())
        if difference[j] <= STATED_ERROR:
            return ''
        text = self._robot.units[j].position_text
        return (
            f'zero_posture states {text(self._stated[j])} for {self._robot.joints[j]}, but '
            f'its sensor measures {text(measured[j])} (legal: a difference of at most '
            f'{text(STATED_ERROR, "g")}); correct zero_posture or the sensor, and call '
            'estimator/zero again'
        )

    def _continue(self, tension: Array, length: Array, dt: float, theta: Array | None) -> None:
        """Record the readings of a message, and continue or begin a fit if one is due."""
        self._collector.step(tension, length, dt, theta)
        self._since += dt
        if self._work is not None:
            for _ in range(min(max(1, round(dt / PIECE_TIME)), MOST_PIECES)):
                if next(self._work, self) is self:
                    self._work = None
                    break
        elif self._since >= self._pause and len(self._collector):
            self._since = 0.0
            self._begin_fit(self._collector.moments())

    @property
    def _pause(self) -> float:
        return FIRST_FIT if self._best is None or self.is_standing else FIT_INTERVAL

    def _begin_fit(self, moments: Moments) -> None:
        measured = np.flatnonzero(~np.isnan(moments.theta).any(axis=1))
        self._has_angles = 2 * len(measured) > len(moments.theta)
        if self._has_angles:
            moments = moments.rows(measured)
            is_enough = self.time >= self.enough
            if is_enough and not self.is_standing:
                readings = moments.theta, moments.read, moments.tension
                self.wiring = judge(self._mae.lengths, *readings, used=self._fit.used)
            self._judge(self._fit.known_angles(moments), moments, is_enough)
        else:
            self._work = self._fit_unknown_angles(moments)

    def _fit_unknown_angles(self, moments: Moments) -> Generator[None, None, None]:
        """Fit the offsets, and judge the wiring once there is enough motion.

        The generator yields after each short piece of work.
        """
        is_enough = self.time >= self.enough
        fit = yield from self._fit.unknown_angles(moments, self._best)
        if is_enough:
            self.wiring = yield from self._fit.wiring(fit, moments)
        self._judge(fit, moments, is_enough)

    def _judge(self, fit: Fit, moments: Moments, is_enough: bool) -> None:
        """Judge whether a fit is reliable, and make it the newest estimate of the offsets.

        `is_enough` says whether there was enough motion for reliable offsets when the fit began.
        """
        muscle_count, used = self._robot.muscle_count, self._fit.used
        expected = self._mae.lengths(fit.theta, moments.tension)
        # An isolated muscle still receives commands and needs an offset, however uncertain.
        of_isolated = np.median(moments.read - expected, axis=0)
        of_isolated = np.clip(of_isolated, -FARTHEST, FARTHEST)
        offset = np.where(used, fit.constants[:muscle_count], of_isolated)
        offset = self._fit.with_known(offset)
        self._problem = self._impossible_offset(offset)
        if self._problem:  # no node would use such an offset, not even provisionally
            self._estimate = None
            return
        error = used * (moments.length - offset - expected)
        residual = np.median(np.abs(error), axis=0)
        self._best = fit
        deviation, trust = np.full(muscle_count, UNKNOWN), Trust.UNKNOWN
        if is_enough:
            self._problem = self._problem_of(fit, residual)
            self.contradicts_known = self._contradicts_known(error)
            if not self._problem:
                independent = max(1.0, len(fit.theta) / CORRELATED)
                deviation = MAD_TO_DEVIATION * residual / np.sqrt(independent)
                deviation[~used] = LARGEST_RESIDUAL
                trust = Trust.KNOWN
        self._estimate = LengthOffsets.of(offset, deviation, trust)

    def _impossible_offset(self, offset: Array) -> str:
        """Return for users which offset is too large to be used, or '' if none is."""
        muscle = int(np.abs(offset).argmax())
        if abs(offset[muscle]) <= MOST_OFFSET:
            return ''
        return (
            f'the length of {self._robot.muscles[muscle]} has an offset of {offset[muscle]:.1f} m; '
            f'legal: within ±{MOST_OFFSET:g} m; let the driver count from a zero near the arm, and '
            'call estimator/zero again'
        )

    def _contradicts_known(self, error: Array) -> bool:
        """Return whether the fit is bad, or a known offset is off.

        If measured joint angles show that the wiring is wrong, the known offsets are not blamed.
        Without them, the wiring is judged by the fit, so wrong known offsets would mislead it.

        Args:
            error: Measured lengths minus those of the fit [m], (K, M).
        """
        is_known = ~np.isnan(self._known)
        if not is_known.any() or (self.remedy and self._has_angles):
            return False
        off = np.abs(np.median(error[:, is_known], axis=0)) > CONTRADICTION
        return bool(self._problem) or bool(off.any())

    def _problem_of(self, fit: Fit, residual: Array) -> str:
        """Return why a fit is not reliable, as a text for users, or '' if it is reliable.

        Args:
            fit: The fit to judge.
            residual: Median residual of each length [m], (M,).
        """
        if self.wiring is not None and self.remedy:
            return f'{self.wiring.text(self._robot.muscles)}: {sentence(self.remedy)}'
        if residual.max() > LARGEST_RESIDUAL:
            name = self._robot.muscles[int(residual.argmax())]
            limit = 1e3 * LARGEST_RESIDUAL
            return (
                f'the length of {name} differs from the fit by {1e3 * residual.max():.1f} mm; '
                f'legal: at most {limit:g} mm; check this muscle, or {OTHER_WAY}'
            )
        cost = self._fit.cost_per_residual(fit)
        # At a high cost, the fit may have found wrong postures that are similar to the true ones.
        if not cost <= LARGEST_COST:
            problem = 'no offsets explain the lengths and tensions'
            excess = f'the cost of the fit is {cost:.2f}; legal: at most {LARGEST_COST:g}'
            return f'{problem}: {excess}; {OTHER_WAY}'
        return ''


def stated_theta(robot: Robot, posture: tuple[float, ...]) -> Array | None:
    """Check the posture that a user has stated for a length calibration, and return its θ.

    Args:
        robot: The nominal body.
        posture: Positions of the joints [rad or m], (D,); () means no posture and is legal.

    Returns:
        θ [rad], (D,); None without a posture.

    Raises:
        MusculoskeletalError: If the posture does not have one value for each joint, or is outside
            the joint limits; the text names the legal ranges.
    """
    if not posture:
        return None
    units = robot.units
    theta = units.to_theta(np.array(posture)) if len(posture) == len(units) else np.zeros(0)
    # The measured angle of a joint at its stop may slightly exceed the limit.
    beyond = BEYOND_STOP * (robot.upper - robot.lower)
    low, high = robot.lower - beyond, robot.upper + beyond
    if theta.shape == low.shape and ((theta >= low) & (theta <= high)).all():
        return theta
    limits = zip(units, robot.lower, robot.upper)
    legal = ', '.join(unit.range_text(low, high, '.6g') for unit, low, high in limits)
    raise MusculoskeletalError(f'zero_posture is {list(posture)}; legal: an empty list, or {legal}')
