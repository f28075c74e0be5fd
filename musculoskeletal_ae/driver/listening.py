# SPDX-License-Identifier: Apache-2.0
"""What the messages of a driver say about it while nothing is commanded.

Rows and units show in what values are possible at all. Where θ is known (joint sensors, or a stated
posture), l must be what the geometric model says there, up to what bodies differ from their models:
its sign, unit, zero and place in the array show, best while the arm is moved by hand.
"""

from __future__ import annotations

import math
from collections import Counter
from itertools import permutations

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.bags.check import misplaced_muscles
from musculoskeletal_ae.bags.streams import Pairs
from musculoskeletal_ae.driver.verdict import Verdict
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.validity import QUANTITIES, read_array, read_posture

RATE_TOLERANCE = 0.2
LONGEST_GAP = 0.2  # [s], the controller's `max_age`
MOST_REPEATED = 0.2  # share of messages that say what the one before said, to the last digit
TEMPERATURES = -20.0, 130.0  # [°C]
# How far the lengths of healthy arms are from the model's, as these see it, individuals 0–9 of both
# shipped arms (`python -m bench driver_margins`): offset at most 42 mm, changes by 0.31 to 1.55 of
# the model's, where another muscle fits 2.5 times better off by no more than 8.5 mm.
ZERO_TOLERANCE = 0.045  # [m]
SLOPES = 0.2, 2.2
MISPLACED = 0.012  # [m]
MOVED = 0.04  # [m] of l from which its slope can be told
MOST_SAMPLES = 400
UNITS = {1000.0: 'mm', 100.0: 'cm'}


class Listening:
    """Collects messages of a driver and judges them. Times are of one steady clock [s]."""

    def __init__(self, robot: Robot, rate: float, posture: Array | None = None) -> None:
        """Expect messages at a rate [Hz]; the arm is held at a posture [rad] (D,), if stated."""
        self._robot, self._rate = robot, rate
        self._theta, self._stated = posture, posture is not None
        self._times: list[float] = []
        self._states: list[Array] = []  # (3, M)
        self._postures: list[Array] = []  # θ at each, NaN where it is not known, (D,)
        self._rejected: Counter[str] = Counter()
        self._examples: dict[str, str] = {}
        postures = robot.random_postures(500, np.random.default_rng(0))
        slack = np.zeros((500, robot.muscle_count))
        spans = [robot.muscle_lengths(postures, slack + pull) for pull in (0.0, robot.tension.max)]
        self._low, self._high = np.min(spans, axis=(0, 1)), np.max(spans, axis=(0, 1))

    @property
    def count(self) -> int:
        """How many messages of muscle_states came, whatever they said."""
        return len(self._times)

    def muscles(self, message: object, now: float) -> Array | None:
        """Take a message of muscle_states; return what it says (3, M), if it can be read."""
        self._times.append(now)
        try:
            states = read_array(message, len(QUANTITIES), self._robot.muscle_count)
        except MessageError as error:
            self._reject('muscle_states', error)
            return None
        theta = np.full(self._robot.joint_count, math.nan) if self._theta is None else self._theta
        self._states.append(states)
        self._postures.append(theta)
        return states

    def joints(self, message: object) -> None:
        """Take a message of joint_states."""
        try:
            theta = read_posture(message, self._robot.joints)
        except MessageError as error:
            self._reject('joint_states', error)
        else:
            if not self._stated:
                self._theta = theta

    def _reject(self, topic: str, error: MessageError) -> None:
        self._rejected[f'{topic}: {error.reason}'] += 1
        self._examples[f'{topic}: {error.reason}'] = str(error)

    def verdict(self) -> Verdict:
        """Judge what came."""
        verdict = Verdict(self._robot)
        for reason, count in self._rejected.items():
            topic, _, why = reason.partition(': ')
            told = f'{topic}: {count} messages refused, {self._examples[reason]}'
            check = 'rate' if why in ('not finite', 'empty') else 'order'
            verdict.failed(check, (), told, _REMEDIES.get(why, 'doc/your_robot.md, the contract'))
        if not self.count:
            verdict.failed(
                'rate', (), 'no muscle_states came', 'publish them; see namespace and ROS_DOMAIN_ID'
            )
        else:
            self._judge_rate(verdict)
        if self._states:
            states = np.array(self._states)
            if self._judge_rows(verdict, np.median(states, axis=0)):
                self._judge_lengths(verdict, states)
        return verdict

    def _judge_rate(self, verdict: Verdict) -> None:
        gaps = np.diff(self._times)
        rate = len(gaps) / gaps.sum() if gaps.sum() > 0.0 else 0.0
        seen = f'muscle_states came at {rate:.0f} Hz'
        if abs(rate / self._rate - 1.0) > RATE_TOLERANCE:
            how = f'publish at {self._rate:g} Hz, or say the rate: --rate here, `rate` of the nodes'
            verdict.failed('rate', (), seen, how)
        elif gaps.max(initial=0.0) > LONGEST_GAP:
            how = 'read and publish in a loop of its own; nothing in it may wait'
            verdict.failed('rate', (), f'{seen}, but nothing for {gaps.max():.2f} s', how)
        if len(self._states) > 10:
            # The rate at which messages come is not the rate at which modules are read.
            states = np.array(self._states)[:, :2]  # a temperature may stand
            same = states[1:] == states[:-1]
            repeated = same.all(axis=(1, 2)).mean()
            stuck: Bools = same.all(axis=(0, 1))
            if repeated > MOST_REPEATED:
                how = 'publish each reading once, when it has been read'
                told = f'{100 * repeated:.0f} % of the messages repeat the one before'
                verdict.failed('rate', (), told, how)
            elif stuck.any():
                who = tuple(np.flatnonzero(stuck).tolist())
                how = 'is this module read at all?'
                verdict.failed('rate', who, 'the same reading in every message', how)
        verdict.passed('rate')

    def _plausible(self, states: Array) -> Bools:
        length, tension, temperature = states
        most = self._robot.tension.max
        slack = 0.02 * most
        return np.array(
            [
                (length >= self._low - 0.1) & (length <= self._high + 0.1),
                (tension >= -slack) & (tension <= 1.1 * most),
                np.isnan(temperature)
                | (temperature > TEMPERATURES[0]) & (temperature < TEMPERATURES[1]),
            ]
        )

    def _judge_rows(self, verdict: Verdict, states: Array) -> bool:
        """Judge rows and units by what values are possible; say whether they are."""
        plausible = self._plausible(states)
        if plausible.all():
            verdict.passed('unit')
            if np.isnan(states[2]).any():
                verdict.notes.append('no temperatures (NaN): nothing protects the motors from heat')
            return True
        rows = list(QUANTITIES)
        kelvin = self._plausible(states - np.array([[0.0], [0.0], [273.15]]))
        if kelvin.all():
            verdict.failed('unit', (), 'temperatures look like K', 'publish °C')
            return False
        by_muscle = states.reshape(-1, 3).T  # as if muscle by muscle, read as row by row
        if self._plausible(by_muscle).all():
            told = 'the values of each muscle stand together'
            verdict.failed('order', (), told, f'publish 3 rows: {", ".join(rows)}')
            return False
        for order in permutations(range(3)):
            if order != (0, 1, 2) and self._plausible(states[list(order)]).all():
                told = ', '.join(rows[order.index(i)] for i in range(3))
                verdict.failed(
                    'order', (), f'the rows look like {told}', f'publish {", ".join(rows)}'
                )
                return False
        length, tension, temperature = states
        for factor, unit in UNITS.items():
            if (
                not plausible[0].all()
                and self._plausible(states / np.array([[factor], [1.0], [1.0]]))[0].all()
            ):
                verdict.failed('unit', (), f'lengths look like {unit}', 'publish m')
                plausible[0] = True
        for row, value, (low, high), unit, change in (
            (0, length, (self._low, self._high), 'm', 'is it m, and zero at θ = 0?'),
            (1, tension, (0.0, self._robot.tension.max), 'N', 'is it N, and does pull count as +?'),
            (2, temperature, TEMPERATURES, '°C', 'is it °C? NaN where there is none'),
        ):
            for m in np.flatnonzero(~plausible[row]).tolist():
                least, most = (np.broadcast_to(end, value.shape)[m] for end in (low, high))
                told = f'{rows[row]} {value[m]:.4g} {unit}, possible {least:.3g} to {most:.3g}'
                verdict.failed('unit', (m,), told, change)
        return False

    def _judge_lengths(self, verdict: Verdict, states: Array) -> None:
        robot, theta = self._robot, np.array(self._postures)
        known = np.isfinite(theta).all(axis=1)
        if not known.any():
            verdict.notes.append(
                'sign, zero and order of l are not judged without θ: publish joint_states, or hold '
                'the arm still and state --posture'
            )
            return
        chosen = np.flatnonzero(known)
        chosen = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), MOST_SAMPLES)).astype(int)]
        theta, (length, tension) = theta[chosen], np.moveaxis(states[chosen, :2], 1, 0)
        beyond = np.maximum(theta - robot.upper, robot.lower - theta).max(axis=0)
        if beyond.max() > 0.3:
            j = int(beyond.argmax())
            told = f'joint {robot.joints[j]} reads {theta[0, j]:.3g} rad, {beyond[j]:.2g} beyond'
            verdict.failed(
                'unit', (), f'{told} its limits', 'is it rad, with the zero of the URDF?'
            )
            return
        model = robot.muscle_lengths(theta, tension)
        moved = np.ptp(model, axis=0) > MOVED
        if not moved.any():
            verdict.notes.append('sign and order show better while the arm is moved by hand')
        if moved.any():
            pairs = Pairs(np.array(self._times)[chosen], theta, length, tension)
            others = dict(misplaced_muscles(pairs, robot))
        else:
            others = _exchanged(robot, length, model)
        for m, name in enumerate(robot.muscles):
            other = others.get(name, '')
            if moved.any() and not (moved[m] and (length - model)[:, m].std() > MISPLACED):
                other = ''
            if other:  # or is it this one, with the wrong sign?
                like = length[:, m] - model[:, robot.muscles.index(other)]
                if _spread(length[:, m] + model[:, m], moved[m]) < _spread(like, moved[m]):
                    other = ''
            self._judge_length(verdict, m, length[:, m], model[:, m], other)

    def _judge_length(
        self, verdict: Verdict, m: int, length: Array, model: Array, other: str
    ) -> None:
        """Judge l of one muscle beside what the model says, (N,), and whom it behaves like."""
        off = float(np.median(length - model))
        slope = math.nan
        if np.ptp(model) > MOVED:
            slope = float(np.cov(length, model)[0, 1] / model.var(ddof=1))
            told = f'l changes by {slope:.2f} of what the routes say'
        elif abs(off) > ZERO_TOLERANCE and abs(np.median(length + model)) < 0.3 * abs(off):
            slope, told = -1.0, f'l is {np.median(length):+.3f} m, the routes say {model[0]:+.3f}'
        if other:
            told = f'it behaves like {other}'
            verdict.failed('order', (m,), told, 'publish muscles in the order of muscles.yaml')
            return
        if -SLOPES[1] < slope < -SLOPES[0]:  # (a slope that is not known is NaN)
            verdict.failed('sign', (m,), told, 'l must fall when the motor winds in')
            return
        if slope == slope and not SLOPES[0] < slope < SLOPES[1]:
            how = 'check the radius of the spool, the counts of its encoder, and the route'
            verdict.failed('unit', (m,), told, how)
            return
        for check in ('order', 'sign') if slope == slope else ():
            verdict.passed(check, m)
        if abs(off) > ZERO_TOLERANCE:
            told = f'l is {1e3 * off:+.0f} mm from what the routes say at this posture and tension'
            how = 'l must be 0 at θ = 0 without tension: subtract this, or call estimator/zero'
            verdict.failed('zero', (m,), told, how)
        else:
            verdict.passed('zero', m)


def _spread(error: Array, moved: bool) -> float:
    return float(error.std() if moved else abs(np.median(error)))


def _exchanged(robot: Robot, length: Array, model: Array) -> dict[str, str]:
    """Return muscles of a resting arm whose l fit where they are exchanged, and not as they are."""
    at, routes = np.median(length, axis=0), np.median(model, axis=0)
    off = np.abs(at[:, None] - routes)
    swapped = np.maximum(off, off.T)
    return {
        robot.muscles[i]: robot.muscles[j]
        for i in range(len(at))
        for j in [int(swapped[i].argmin())]
        if min(off[i, i], off[j, j]) > ZERO_TOLERANCE and swapped[i, j] < 0.4 * off[i, i]
    }


_REMEDIES = {
    'not finite': 'publish no NaN or infinity (but for temperatures that are not measured: NaN)',
    'missing joint': 'name the joints as muscles.yaml does; those are all wanted',
    'wrong length': 'publish 3×M values: row length, row tension, row temperature',
    'wrong layout': "layout.dim is ('quantity', 3, 3M), ('muscle', M, M), or empty",
}
