# SPDX-License-Identifier: Apache-2.0
"""Check the messages of a driver while nothing is commanded.

The checks concern the rate, repeated readings, and the range of possible values. If θ is known,
they also compare l with the geometric model (doc/explanation/control_and_safety.md, Judging a
driver).
"""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import permutations

import numpy as np
from scipy.optimize import linear_sum_assignment

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.awake_clock import AwakeClock
from musculoskeletal_ae.driver.pace import Pace
from musculoskeletal_ae.driver.verdict import PROBLEMS, Verdict
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.messages.message_reading import (
    joints_not_finite,
    read_posture,
)
from musculoskeletal_ae.report import distinct
from musculoskeletal_ae.robot import model_errors
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals import joint_sensors, wiring
from musculoskeletal_ae.signals.joint_sensors import JointFault
from musculoskeletal_ae.signals.joint_series import judge_series
from musculoskeletal_ae.signals.motor_interface import MotorInterface
from musculoskeletal_ae.signals.muscle_states import (
    QUANTITIES,
    MuscleReadings,
    Presence,
    Quantity,
    possible_readings,
    read_muscle_states,
)
from musculoskeletal_ae.signals.reading_limits import length_range
from musculoskeletal_ae.signals.wiring import Wiring, WiringJudgement

#: report a fault if more than this share of the messages repeats the previous message exactly
MOST_REPEATED = 0.2
#: treat sensors with at most this many different values as free of noise: repeated readings of an
#: arm at rest are then no fault
QUIET = 3
TEMPERATURES = -20.0, 130.0  # treat temperatures outside this range as impossible [°C]
#: let l exceed its range by this distance, with and without length calibration [m]
BEYOND = 0.1, 1.0
BEYOND_JOINT = 0.3  # report a fault if θ exceeds the joint limits by more than this [rad]
#: compare BEYOND_JOINT with this quantile of the excess of θ over its limits, because a single
#: reading may be an outlier
BEYOND_SHARE = 0.95
#: report a fault if |T − T_bias| exceeds the smaller of these while nothing is commanded, [N] and
#: relative to T_bias; they cover errors of the sensor and of its zero
RESTING_TENSION, RESTING_SHARE = 15.0, 0.5
PULLS = 0.3, 3.0  # reinterpret units or rows only if T / T_bias at rest is then in this range
#: reinterpret units or rows only if temperatures at rest are then in this range [°C]
USUAL = 10.0, 60.0
#: conclude that T is in another unit if all tensions, converted from that unit to N, differ from
#: T_bias by less than this fraction
UNIT_TOLERANCE = 0.3
#: units in which a driver may publish tensions by mistake, each in newtons
TENSION_UNITS = {'kgf': 9.80665, 'lbf': 4.44822, 'kN': 1000.0}
#: doubt the unit if a module without commands reports a higher temperature than this [°C]; modules
#: above 13 °C exceed this value if their temperature is published in °F
HOTTEST_AT_REST = 55.0
# Lengths of healthy arms differ from the model. For the emulated individuals 0–9 of arm26 and
# musashi_left_arm (notes/removed_benches.md), lengths change by 0.31 to 1.55 times the model's
# changes, and `model_errors.LARGEST` bounds the difference.
#: report a fault if the change of l, divided by the modelled change, is outside this range
SLOPES = 0.2, 2.2
#: count a column of an arm at rest as misplaced only if another muscle fits better by this factor
BETTER_AT_REST = 2.5
MOVED = 0.04  # check sign and scale of l only if it has varied by more than this [m]
#: judge signs and order of the joint sensors only if a joint has moved by more than this [rad]
MOVED_JOINT = 0.2
MOST_SAMPLES = 400  # compare at most this many messages with the model, to save time
#: units in which values may have been published by mistake, in SI units or °C
UNITS = {
    'length': {'mm': 1e-3, 'cm': 1e-2},
    'tension': {'mN': 1e-3, 'cN': 1e-2},  # of motor currents: mA and cA
    'temperature': {'m°C': 1e-3, 'c°C': 1e-2, 'tenths of °C': 0.1},
}


MOTOR_NOTE = (
    'l and T are computed from positions and efforts; to correct their unit, sign, zero or order, '
    'change spool_radius, direction, zero, joint, tension_per_effort and effort_zero in motors.yaml'
)


class Listening:
    """Collects messages of a driver and checks them. All times come from one steady clock [s]."""

    def __init__(
        self,
        robot: Robot,
        rate: float,
        posture: Sequence[float] | None = None,
        zeroed: bool = True,
        motors: MotorInterface | None = None,
        clock: AwakeClock | None = None,
    ) -> None:
        """Prepare to check the messages of a driver.

        Args:
            robot: The geometric model.
            rate: Expected rate of muscle_states [Hz].
            posture: Positions of the joints [rad or m], (D,), in which the arm is held, or None to
                use joint_states.
            zeroed: Whether the lengths are calibrated; if not, each may have any constant offset.
            motors: How the motors of a ros2_control robot are connected, or None for muscle_states.
            clock: Shows the pauses of this process; None for a process without pauses.
        """
        self._robot, self._zeroed = robot, zeroed
        self._pace = Pace(rate, clock or AwakeClock())
        self._motors = motors or MotorInterface(None)
        self._stated = posture is not None
        self._theta = np.full(robot.joint_count, math.nan)
        if posture is not None:
            self._theta = robot.units.to_theta(np.array(posture))
        self._not_finite: Counter[str] = Counter()  # positions that are not finite, by joint
        #: readings of each message of muscle_states, and how many messages of joint_states arrived
        #: before it
        self._read: list[tuple[MuscleReadings, int]] = []
        #: for each message of joint_states: time [s] of the muscle message before it, and θ (D,)
        self._angles_read: list[tuple[float, Array]] = []
        self._now = 0.0  # time of the newest message of the muscles [s]
        #: errors of the rejected messages, by topic and reason
        self._rejected: dict[tuple[str, str], list[MessageError]] = {}
        #: lowest and highest possible readings
        self._low, self._high = possible_readings(robot)
        (low, high), beyond = length_range(robot), BEYOND[not zeroed]
        self._low.length, self._high.length = low - beyond, high + beyond
        self._low.temperature, self._high.temperature = TEMPERATURES
        # T computed from currents may be wrong by drive friction and an unknown scale.
        if not robot.tension_source.is_current:
            self._low.tension = -0.02 * robot.tension.max

    @property
    def count(self) -> int:
        """Number of messages of muscle_states, or of the motors, valid or not."""
        return self._pace.count

    @property
    def measured(self) -> Array:
        """The newest angles of the joint sensors [rad], (D,); NaN where they are unknown."""
        return np.full_like(self._theta, math.nan) if self._stated else self._theta

    def muscles(self, message: object, now: float, sent: float = math.nan, number: int = 0) -> None:
        """Record a message of muscle_states, or of the motors.

        Args:
            message: The message, which is not checked yet.
            now: Time of reception [s].
            sent: Source time by the driver's clock [s]; NaN if unknown.
            number: Sequence number; 0 if unknown.
        """
        self._pace.message(now, sent, number)
        self._now = now
        topic = 'motors' if self._motors.is_ros2_control else 'muscle_states'
        with self._rejecting(topic):
            reading = self._motors.reading(message)
            self._read.append((read_muscle_states(reading, self._robot), len(self._angles_read)))

    def joints(self, message: object) -> None:
        """Record a message of joint_states, whose angles are then compared with the lengths."""
        with self._rejecting('joint_states'):
            self._not_finite.update(joints_not_finite(message, self._robot.joints))
            theta = read_posture(message, self._robot.units, some=True)
            if not self._stated:  # joints may come in several messages
                self._theta = np.where(np.isnan(theta), self._theta, theta)
                self._angles_read.append((self._now, theta))

    @contextmanager
    def _rejecting(self, topic: str) -> Iterator[None]:
        try:
            yield
        except MessageError as error:
            self._rejected.setdefault((topic, error.reason), []).append(error)

    def verdict(self, now: float) -> Verdict:
        """Check the messages received until `now` [s]; return the results."""
        verdict = Verdict(self._robot)
        has_angles = not self._stated and not np.isnan(self._theta).all()
        for (topic, reason), errors in self._rejected.items():
            detail = f'{topic}: {len(errors)} messages rejected, {errors[-1]}'
            # The driver may publish other joints, such as those of a hand, in other messages.
            if reason == 'missing joint' and has_angles:
                verdict.notes.append(detail)
            else:
                what = f'{topic}: {reason}'
                verdict.failed(what if what in PROBLEMS else f'{topic}: refused', detail=detail)
        for name, count in self._not_finite.items():
            verdict.failed('joint not finite', name=name, count=count)
        if not self.count:
            verdict.failed('silent', topic=self._motors.state_topic)
            return verdict
        read = MuscleReadings.stack(each for each, _ in self._read)
        theta = self._angles_at_readings(verdict)
        self._pace.judge(verdict, now)
        if self._motors.is_ros2_control:
            verdict.notes.append(MOTOR_NOTE)
        self._judge_repetition(verdict, read)
        usual = MuscleReadings.of_rows(np.median(read.rows, axis=0)) if self._read else None
        if usual is not None and self._judge_values(verdict, usual):
            self._judge_rest(verdict, usual)
            known = np.flatnonzero(np.isfinite(theta).all(axis=1))
            if len(known):
                few = np.linspace(0, len(known) - 1, min(len(known), MOST_SAMPLES)).astype(int)
                some = read.at(known[few])
                tension = self._robot.actuation.known_tension(some.tension)
                self._judge_lengths_and_joints(verdict, theta[known[few]], some.length, tension)
            else:
                lacking = np.isnan(theta).all(axis=0)
                unknown = ', '.join(np.array(self._robot.joints)[lacking])
                reason = (
                    f'the angles of {unknown} are unknown'
                    if unknown
                    else 'the angles of all joints were never known at the same time'
                )
                verdict.advise(
                    ('order', 'sign', 'zero') if self._zeroed else ('order', 'sign'),
                    f'{reason}; publish joint_states of all joints, or hold the arm still and use '
                    '--posture of check_driver',
                )
        return verdict

    def _angles_at_readings(self, verdict: Verdict) -> Array:
        """Return θ [rad] at each message of the muscles, (N, D), with NaN where it is unknown.

        False angles are left out, and the verdict reports them.

        Args:
            verdict: Receives the results.
        """
        unknown = np.full((1, self._robot.joint_count), math.nan)
        if self._stated or not self._angles_read:
            return np.repeat(self._theta[None], len(self._read), axis=0)
        time, theta = map(np.array, zip(*self._angles_read))
        judged = judge_series(self._robot, time, theta)
        if judged.is_fault:
            verdict.failed('false joint angles', detail=judged.text, remedy=judged.remedy)
        elif judged.text:
            verdict.notes.append(judged.advice)
        # Row 0 stands for the time before the first message. Each angle holds until the next one.
        known = np.concatenate([unknown, judged.theta])
        rows = np.where(np.isfinite(known), np.arange(len(known))[:, None], 0)
        newest = np.maximum.accumulate(rows, axis=0)
        angles = np.take_along_axis(known, newest, axis=0)
        at: Array = angles[[count for _, count in self._read]].reshape(-1, unknown.shape[1])
        return at

    def _judge_repetition(self, verdict: Verdict, read: MuscleReadings) -> None:
        if len(self._read) > 10:
            # A driver may publish more often than it reads the modules. Temperatures are not
            # compared, because they may stay the same.
            values = read.length
            if self._robot.tension_source.is_known:
                values = np.hstack([values, read.tension])
            same: Bools = values[1:] == values[:-1]
            is_stuck = same.all(axis=0).reshape(-1, self._robot.muscle_count).all(axis=0)
            if same.all(axis=1).mean() > MOST_REPEATED:
                columns = values.T
                if 1 < max(len(np.unique(column)) for column in columns) <= QUIET:
                    verdict.notes.append(
                        'the readings hardly change; move the arm to check whether each message '
                        'is new'
                    )
                else:
                    verdict.failed('repeated', share=100.0 * same.all(axis=1).mean())
            elif is_stuck.any():
                verdict.failed('stuck', *np.flatnonzero(is_stuck).tolist())

    def _judge_values(self, verdict: Verdict, usual: MuscleReadings) -> bool:
        """Judge by the ranges of possible values whether rows, units and signs are right.

        Return False if they are wrong; the fault is then in the verdict.

        Args:
            verdict: Receives the results.
            usual: Medians of the published readings.
        """
        fault, units = '', list[str]()  # the first possible fault, and the units that explain it
        for what, texts, meant in _interpretations(usual):
            if fault and what != fault:
                break
            possible = self._possible(meant)
            # Without a command, T must be close to T_bias in the right interpretation.
            pulls = np.median(meant.tension / self._robot.tension.bias)
            warm = meant.temperature[~np.isnan(meant.temperature)]
            is_usual = PULLS[0] < pulls < PULLS[1] and (
                not len(warm) or USUAL[0] < np.median(warm) < USUAL[1]
            )
            if 'unit' in texts:
                # All muscles share a unit, so a single impossible value has another cause.
                wrong = np.count_nonzero(~self._possible(usual).all(axis=0))
                is_usual = is_usual and wrong > min(1, self._robot.muscle_count - 1)
            if possible.all() and (not what or is_usual):
                if 'unit' in texts:
                    fault = what
                    units.append(texts['unit'])
                    continue
                if what:
                    verdict.failed(self._of_source(what), **texts)
                    return False
                verdict.passed('unit')
                if np.isnan(usual.temperature).any():
                    verdict.notes.append(
                        'temperatures are not measured (NaN), so nothing protects the motors from '
                        'heat'
                    )
                return True
        if fault:
            unit = ' or '.join(units)
            if self._robot.tension_source.is_current:
                unit = unit.replace('N', 'A')
            verdict.failed(self._of_source(fault), unit=unit)
            return False
        for quantity, is_possible in zip(QUANTITIES, possible, strict=True):
            for m in np.flatnonzero(~is_possible).tolist():
                published = (quantity.of(each)[m] for each in (usual, self._low, self._high))
                value, low, high = distinct(*published)
                if quantity.presence is Presence.REQUIRED:
                    what = self._of_source(quantity.name)
                    verdict.failed(what, m, value=f'{value}, possible {low} to {high},')
                else:
                    texts = {'value': value, 'low': low, 'high': high, 'unit': quantity.unit}
                    verdict.failed('impossible value', m, quantity=quantity.name, **texts)
        return False

    def _possible(self, readings: MuscleReadings) -> Bools:
        """Return which readings are possible at rest, (Q, M)."""
        return np.array([self._possible_values(each, readings) for each in QUANTITIES])

    def _possible_values(self, quantity: Quantity, readings: MuscleReadings) -> Bools:
        """Return which readings of a quantity are possible at rest, (M,)."""
        values, source = quantity.of(readings), self._robot.tension_source
        possible: Bools = (values >= quantity.of(self._low)) & (values <= quantity.of(self._high))
        if quantity is MuscleReadings.tension:
            # Friction can make single currents negative, but not all of them by so much.
            pushes = values < -PULLS[0] * self._robot.tension.bias
            all_push = source.is_current and bool(pushes.all())
            return (possible & (not all_push)) | (not source.is_known)
        if quantity.presence is not Presence.REQUIRED:
            possible |= np.isnan(values)
        return possible

    def _of_source(self, fault: str) -> str:
        """Return the name of a fault for the quantity that the driver reports.

        If the driver reports currents, 'current' replaces 'tension' in the name.
        """
        if not self._robot.tension_source.is_current:
            return fault
        return fault.replace('tension', 'current')

    def _judge_rest(self, verdict: Verdict, usual: MuscleReadings) -> None:
        """Judge the tensions and temperatures of modules that have received no command.

        Args:
            verdict: Receives the results.
            usual: Medians of the published readings.
        """
        bias = self._robot.tension.bias
        # With position-controlled modules, T depends on the posture, so it is not compared.
        bias = self._robot.actuation.choose(bias, np.full_like(bias, np.nan))
        for unit, newtons in TENSION_UNITS.items():
            if (np.abs(newtons * usual.tension / bias - 1.0) < UNIT_TOLERANCE).all():
                verdict.failed('tension unit', unit=unit)
                return
        tolerated = np.minimum(RESTING_TENSION, RESTING_SHARE * bias)
        for m in np.flatnonzero(np.abs(usual.tension - bias) > tolerated).tolist():
            verdict.failed('resting tension', m, got=usual.tension[m], bias=bias[m])
        hottest = np.nanmax(usual.temperature, initial=-math.inf)
        if hottest > HOTTEST_AT_REST:
            verdict.notes.append(
                f'a module at rest reports {hottest:.0f} °C; check that the driver publishes °C, '
                'not °F'
            )

    def _judge_lengths_and_joints(
        self, verdict: Verdict, theta: Array, length: Array, tension: Array
    ) -> None:
        """Judge lengths and joint sensors by the model, and find which of them have faults.

        If several lengths have faults, and faults of the joint sensors explain all of them, only
        the latter are reported.

        Args:
            verdict: Receives the results.
            theta: Joint angles θ [rad], (N, D).
            length: Muscle lengths l [m], (N, M).
            tension: Tensions T [N], (N, M).
        """
        lengths, sensors = Verdict(self._robot), joint_sensors.Judgement([], ())
        self._judge_lengths(lengths, theta, length, tension)
        if not self._stated:
            sensors = joint_sensors.judge(self._robot, theta, length, tension)
        # At rest, too many signs and orders of joints could explain the lengths.
        has_moved = not self._stated and bool((np.ptp(theta, axis=0) > MOVED_JOINT).any())
        faults = [
            each for each in sensors.faults if has_moved or each.kind == joint_sensors.DEGREES
        ]
        # Without zeros, lengths of wrong sign look like angles of wrong sign.
        are_turned = not self._zeroed and any(each.kind == 'all signs' for each in lengths.faults)
        # The fault of a single length has another cause than the joint sensors.
        wrong = {name for fault in lengths.faults for name in fault.subjects}
        is_suspect = len(wrong) > 1 or not wrong.issubset(self._robot.muscles)
        if faults and is_suspect and not are_turned:
            others = Verdict(self._robot)
            meant = joint_sensors.corrected(theta, faults, self._robot.units)
            self._judge_lengths(others, meant, length, tension)
            if not others.faults:
                self._report_sensors(verdict, faults, lengths)
                return
        if has_moved and not lengths.faults:
            verdict.notes += joint_sensors.sign_notes(
                self._robot, sensors.right, 'Move the arm by hand through its whole range'
            )
        verdict.add(lengths)

    def _report_sensors(
        self, verdict: Verdict, faults: Sequence[JointFault], lengths: Verdict
    ) -> None:
        """Report the faults of joint sensors that explain all faults of lengths.

        Args:
            verdict: Receives the results.
            faults: The faults of the joint sensors.
            lengths: The faults that the lengths seem to have.
        """
        robot = self._robot
        # On a symmetric arm, the reversed sign of one joint sensor looks like several exchanged
        # muscles. One fault is more likely than several.
        look_exchanged = len(lengths.faults) > 2
        look_exchanged &= all(fault.kind == 'place' for fault in lengths.faults)
        muscles = ', '.join(name for each in lengths.faults for name in each.subjects)
        for fault in faults:
            names = ', '.join(robot.joints[j] for j in fault.joints)
            if fault.kind == joint_sensors.SIGN and look_exchanged:
                verdict.failed('joint sign or order', names=names, muscles=muscles)
            else:
                verdict.failed(fault.kind, names=names)

    def _are_turned(self, length: Array, model: Array, moved: Bools) -> bool:
        """Return whether the driver publishes the lengths of all muscles with the wrong sign.

        If the arm was moved, this is the case if all lengths that should have changed have changed
        in the opposite direction. At rest, it is the case if all lengths fit the model with the
        opposite sign, and several do not fit as they are.

        Args:
            length: Published l [m], (N, M).
            model: Lengths of the geometric model [m], (N, M).
            moved: Which muscles should have changed their lengths noticeably, (M,).
        """
        if moved.any():
            slopes = [np.polyfit(model[:, m], length[:, m], 1)[0] for m in np.flatnonzero(moved)]
            return len(slopes) > 1 and all(SLOPES[0] < -slope < SLOPES[1] for slope in slopes)
        turned, literal = (np.abs(np.median(length + sign * model, axis=0)) for sign in (1, -1))
        misfits = int((literal > model_errors.LARGEST).sum())
        return self._zeroed and bool((turned <= model_errors.LARGEST).all()) and misfits > 1

    def _judge_lengths(self, verdict: Verdict, theta: Array, length: Array, tension: Array) -> None:
        """Judge the lengths by the geometric model, and report their faults.

        Args:
            verdict: Receives the results.
            theta: Joint angles θ [rad], (N, D).
            length: Muscle lengths l [m], (N, M).
            tension: Tensions T [N], (N, M).
        """
        robot = self._robot
        # Judge the message that few others exceed, not a single extreme.
        excess = np.maximum(theta - robot.upper, robot.lower - theta)
        judged = np.argsort(excess, axis=0)[int(BEYOND_SHARE * (len(theta) - 1))]
        beyond = np.take_along_axis(excess, judged[None], axis=0)[0]
        j = int(beyond.argmax())
        if beyond[j] > BEYOND_JOINT:
            at, off = robot.units.to_position(np.array([theta[judged[j], j], beyond[j]]), j)
            values = {'theta': at, 'beyond': off, 'unit': robot.units[j].position}
            verdict.failed('joint', name=robot.joints[j], **values)
            return
        model = robot.muscle_lengths(theta, tension)
        # Position-controlled modules hold their lengths even if a hand moves the joints, so l never
        # counts as moved.
        least = robot.actuation.choose(MOVED, math.inf)
        moved: Bools = np.ptp(model, axis=0) > least

        straight = Wiring.straight(robot.muscle_count)
        judgement, doubt = WiringJudgement(straight, (straight,), (), 0.0), ''
        if moved.any():
            # On a moved arm, length offsets do not affect the comparison.
            readings = robot.muscle_lengths, theta, length, tension
            judgement = wiring.judge(*readings)
            fit, reversed_fit = np.sqrt(wiring.square_misfits(*readings, signs=True))
            own, inverse = fit.diagonal(), reversed_fit.diagonal()
        else:
            # On an arm at rest, the offset is the only information.
            offsets = np.median(length[:, :, None] - model[:, None], axis=0)
            fit, own = np.abs(offsets), np.abs(offsets.diagonal())
            inverse = np.abs(np.median(length + model, axis=0))
            better = robot.actuation.choose('moving the arm by hand', '`check_driver --move`')
            doubt = (
                f'; judged at rest, which is not reliable: {better} checks sign and order better'
            )
            fit = np.maximum(fit, fit.T)  # at rest, only pairwise exchanges can be recognised
        rows, best = linear_sum_assignment(fit)
        # Antagonists mirror each other. If all signs are wrong, exchanged antagonists fit as well,
        # but are less likely.
        compared = moved if moved.any() else np.full(len(own), self._zeroed)
        all_turned = inverse[compared].sum() < fit[rows, best][compared].sum()
        if all_turned and self._are_turned(length, model, moved):
            verdict.failed('all signs', *range(len(own)), doubt=doubt)
            return
        by_hand = 'move the arm by hand while check_driver listens, without --move'
        if self._stated:
            by_hand = f'publish joint_states of all joints, and {by_hand}'
        of_positions = 'use --move, with a --tension at which the joints move'
        verdict.advise(('order', 'sign'), robot.actuation.choose(by_hand, of_positions))
        order = judgement.wiring.order if moved.any() else best.tolist()
        for m, other in enumerate(order):
            off = float(np.median((length - model)[:, m]))
            follows = other == m or all_turned
            if not moved.any():
                follows |= inverse[m] < fit[m, other] or own[m] <= BETTER_AT_REST * fit[m, other]
                # If two muscles are exchanged, both misfit; if only one misfits, its zero is wrong.
                follows |= not self._zeroed or min(own[m], own[other]) <= model_errors.LARGEST
            if not follows:
                verdict.failed('place', m, other=robot.muscles[other], doubt=doubt)
                continue
            if moved[m]:
                slope = np.cov(length[:, m], model[:, m])[0, 1] / model[:, m].var(ddof=1)
                detail = f'l changes by {slope:.2f} times the change that the route predicts'
                if not SLOPES[0] < slope < SLOPES[1]:
                    inverted = SLOPES[0] < -slope < SLOPES[1]
                    verdict.failed('sign' if inverted else 'slope', m, detail=detail)
                    continue
                if m in judgement.right:
                    verdict.passed('order', m)
                verdict.passed('sign', m)
            if not self._zeroed:
                continue
            if abs(off) <= model_errors.LARGEST:
                verdict.passed('zero', m)
            elif not moved.any() and inverse[m] < 0.3 * abs(off):
                measured = f'l is {np.median(length[:, m]):+.3f} m'
                predicted = f'the route predicts {model[0, m]:+.3f} m'
                verdict.failed('sign', m, detail=f'{measured}, {predicted}{doubt}')
            else:
                # Unless a hand changes the length, a wrong sign or order looks like a wrong zero.
                is_movable = robot.actuation.choose(not self._stated, False)
                what = 'zero at rest' if is_movable and not moved[m] else 'zero'
                verdict.failed(what, m, off=1e3 * off)


def _interpretations(
    published: MuscleReadings,
) -> Iterator[tuple[str, dict[str, str], MuscleReadings]]:
    """Yield interpretations of a message's values, from the literal one to the least likely.

    Each interpretation is a tuple: the name of the driver fault that would explain it ('' for
    none), the values for the texts about this fault, and the readings that the driver should have
    published. The last interpretation is the literal one again: if none gives possible values, they
    are reported as they were published.

    Args:
        published: The published values.
    """
    yield '', {}, published
    celsius = published.temperature - 273.15
    yield 'temperature unit', {'unit': 'K'}, published.replace(temperature=celsius)
    # Only the rows that each message has can be in another order.
    expected = [each for each in QUANTITIES if each.presence is not Presence.OPTIONAL]
    rows = [each.of(published) for each in expected]
    by_muscle = np.reshape(rows, (-1, len(rows))).T
    names = [each.name for each in expected]
    yield 'by muscle', {}, published.replace(**dict(zip(names, by_muscle)))
    for order in permutations(names):
        meant = published.replace(**dict(zip(order, rows)))
        yield 'rows', {'rows': ', '.join(order)}, meant
    for what, units in UNITS.items():
        for unit, factor in units.items():
            scaled = published.replace(**{what: factor * getattr(published, what)})
            yield f'{what} unit', {'unit': unit}, scaled
    yield 'tension sign', {}, published.replace(tension=-published.tension)
    yield '', {}, published
