# SPDX-License-Identifier: Apache-2.0
"""Checkpoint validation: a candidate network has to explain the arm before it takes over.

It is checked beside the network in use:

    postures   Through ①, on a fixed set of postures of the geometric model: what it restores of
               (θ, T, l), and of G. Through ② and ③, the same with the lengths of ①. The root mean
               square error of each joint or muscle is divided by the spread of the true values.
               This ratio is at most LIMITS. The lengths of a real arm differ from those of the
               model by centimetres, but ② and ③ have to agree with ①.
    messages   On the last seconds of healthy messages of this node: the error of T and l through
               ②, and of l through ① at the θ of ②. The median of each muscle is at most
               WORSE times that of the network in use, or FLOOR. The first network is not checked.
    agreement  On the same messages, θ, and the lengths of ① at the posture. Where joint sensors
               measured it, the median error of each joint and muscle is at most ANGLE_WORSE times
               that of the network in use, or ANGLE_FLOOR and LENGTH_FLOOR. Elsewhere the median
               distance from the network in use is at most ANGLE_MOVED and LENGTH_MOVED. With too
               few messages, the lengths of the network in use on the fixed postures stand in. On
               those, the lengths of ① change from posture to posture as those of the network in
               use do, but for a share of SHAPE_MOVED, unless they are closer to what joint sensors
               measure.
    detector   A calibrated detector finds nothing on those messages, and would find a muscle that
               is ruptured. A network without a calibrated detector does not switch that of the
               network in use off: it takes over with that detector, widened until it is silent on
               those messages (`with_detector`). A user who has declared the body healthy within
               the last ten minutes may relearn a repaired muscle, and the network stays as it is.

A network that a user chooses by hand need not agree with the one in use on the posture.

A network that always answers the same reaches a share of 1. Where the muscles determine a joint
only poorly, as where several postures have the same lengths, its error may be UNDETERMINED times
that of the best affine map of (T, l), if that is more; its mean error may not. LIMITS, WORSE, FLOOR
and LEAST_CUT leave a margin to the largest values of healthy networks: initial and learned ones of
both presets, on both shipped robots and both emulator models (`python -m bench gate` prints them,
beside those of attacks).

After an anomaly, the newest network that has been in use for PROOF seconds without one comes back.
"""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.detectors.residual_distance import DISTANCE
from musculoskeletal_ae.exceptions import GateError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import residuals
from musculoskeletal_ae.mae.units import Mask
from musculoskeletal_ae.robot.jumps import jump_warning
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.friction import FrictionDirection, end_tension

POSTURES = 64
SPAN, SPACING = 10.0, 0.1  # [s] of messages, and between those that are kept
LEAST = 20  # messages that are enough to judge by
PROOF = 10.0  # [s]
MOST_USED = 20  # networks that are kept to go back to
LONGEST_PERIOD = 0.5  # [s] without messages in which a tendon may have slid anywhere
DECLARED = 600.0  # [s] after a repair in which a network without a detector is taken as it is
NOTICED = 2.0  # [s] before an anomaly is noticed in which messages were already wrong

#: largest share left unexplained of the fixed postures
LIMITS = {
    'θ by ①': 0.6,
    'T by ①': 1.35,  # two muscles exchanged show √2
    'l by ①': 1.7,
    'θ by ②': 1.3,  # of a joint that the muscles do not determine, 1
    'T by ②': 1.35,
    'l by ②': 0.6,
    'θ by ③': 0.7,
    'T by ③': 13.0,
    'l by ③': 0.6,
    'G by ①': 1.6,
    'mean θ by ①': 0.6,
    'mean θ by ③': 0.7,
}
#: lengths [m] and moment arms [m] that spread less are not to be explained better than larger ones
LEAST_SPREAD, LEAST_ARM = 0.04, 0.01
UNDETERMINED = 1.2
AFFINE = 1000  # postures that the affine map is fitted to; its error is that on as many others
WORSE = 2.0
FLOOR = {'T by ②': 40.0, 'l by ②': 0.06, 'l by ① at θ of ②': 0.06}  # [N], [m], [m]
# Learned networks that were published were off by 0.29 rad of joint sensors, after others that were
# off by 0.18 rad, and their lengths by 0.03 m. A geometric network that learns moves by
# 0.56 rad at its first update, and its lengths by 0.05 m; a learned one moves by 0.31 rad.
ANGLE_FLOOR, LENGTH_FLOOR, ANGLE_WORSE = 0.35, 0.06, 1.5  # [rad], [m], where sensors measured
ANGLE_MOVED, ANGLE_MOVED_INITIAL = 0.45, 0.8  # [rad], from a learned network, and from another
LENGTH_MOVED = 0.07  # [m], from the network in use
BY_POSTURE, SHAPE = 'l by ① at θ', 'change of l by ①'
# Learning changed how lengths depend on the posture by 0.32 in a minute, and a learned network by
# 0.18; all lengths × 1.5 change it by 0.5.
SHAPE_MOVED, SHAPE_MOVED_INITIAL = 0.3, 0.42
WIDENED = 3.5  # the threshold of a detector that was taken over, over d of messages
LEAST_CUT = 0.1  # d of messages with a muscle cut over the threshold, the clearest muscle


class Comparison(NamedTuple):
    """A candidate beside what counts: of each joint [rad], each muscle [m], or a share of all."""

    name: str
    error: Array
    limit: Array
    source: str


class CheckpointValidator:
    """Accepts or rejects candidates. Times `now` are of one steady clock [s].

    Attributes:
        isolated: Muscles whose messages do not count (positions in T and l).
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._postures = theta, pull, _ = self._states(POSTURES)
        slope = robot.series_elastic.length_slope(pull)[..., None]
        self._jacobian = robot.routes.muscle_jacobian(theta) * (1.0 - slope)
        #: when it came, T, l, which way tendons slid, and θ that was measured (NaN if it was not)
        self._messages: deque[tuple[float, Array, Array, Array, Array]] = deque()
        self._direction, self._time = FrictionDirection(), math.inf
        self._used: list[tuple[float, Mae]] = []  # since when which network was in use
        self._anomaly = False
        self._declared_at = -math.inf
        self.isolated: tuple[int, ...] = ()

    def _states(self, count: int) -> tuple[Array, Array, Array]:
        """Return θ, T and l of random states of the geometric model."""
        robot, rng = self._robot, np.random.default_rng(0)
        theta = robot.random_postures(count, rng)
        share = rng.uniform(size=(count, robot.muscle_count))
        pull = robot.tension.bias + share * (robot.tension.limit - robot.tension.bias)
        return theta, pull, robot.muscle_lengths(theta, pull)

    @cached_property
    def _undetermined(self) -> Array:
        """The share of each joint's angle that may be left, by what muscles determine of it."""
        theta, *told = self._states(2 * AFFINE)
        given = np.hstack([np.ones((2 * AFFINE, 1)), *(part / part.std() for part in told)])
        affine = np.linalg.lstsq(given[:AFFINE], theta[:AFFINE], rcond=None)[0]
        left: Array = _size((given @ affine - theta)[AFFINE:]) / theta.std(axis=0)
        return UNDETERMINED * left

    @cached_property
    def _likely(self) -> str:
        """Why the robot description may be the reason and not the network, or ''."""
        told = jump_warning(self._robot)
        return f' ({told})' if told else ''

    @property
    def mae(self) -> Mae | None:
        """The network in use."""
        return self._used[-1][1] if self._used else None

    def message(
        self, tension: Array, length: Array, now: float, theta: Array | None = None
    ) -> None:
        """Note one of the node's own messages, T [N] and l [m] (M,), and θ (D,) if measured."""
        since, self._time = now - self._time, now
        if not 0.0 <= since < LONGEST_PERIOD:
            self._direction.reset()
        direction = self._direction.step(length)
        if self._anomaly or (self._messages and 0.0 <= now - self._messages[-1][0] < SPACING):
            return
        if theta is None:
            theta = np.full(self._robot.joint_count, np.nan)
        self._messages.append((now, tension, length, direction, theta))
        while now - self._messages[0][0] > SPAN:
            self._messages.popleft()

    def start(self) -> None:
        """Begin anew, without a network."""
        self._used.clear()
        self.forget()

    def forget(self) -> None:
        """Forget the messages, as when the length offsets change."""
        self._messages.clear()
        self._direction.reset()

    def check(self, mae: Mae, is_chosen: bool = False) -> None:
        """Check a network; `is_chosen` by a user, it may disagree with the one in use on θ.

        Raises:
            GateError: If it does not explain the arm.
        """
        try:
            deque(self.trial(mae, is_chosen), maxlen=0)
        except GateError as error:
            raise GateError(f'{error}{self._likely}') from error

    def trial(self, mae: Mae, is_chosen: bool = False) -> Iterator[None]:
        """Check as `check` in steps of some milliseconds, between which a node may go on."""
        found, pieces = list[str](), self._faults(mae, is_chosen)
        while True:
            with np.errstate(all='ignore'):
                fault = next(pieces, None)
            if fault is None:
                break
            found += [fault] if fault else []
            yield
        if found:
            raise GateError('; '.join(found))

    def declare_healthy(self, now: float) -> None:
        """Note that a user declares the body healthy as it is, as after a repair."""
        self._declared_at = now

    def take(self, mae: Mae, now: float) -> None:
        """Note that a network took over."""
        self._used.append((now, mae))
        while len(self._used) > 1 and now - self._used[1][0] >= PROOF:
            del self._used[0]
        if len(self._used) > MOST_USED:  # the first is proven
            del self._used[1]

    def anomaly(self, detected: bool, now: float) -> Mae | None:
        """Note whether an anomaly is detected; return the network that is to come back, if any."""
        if detected == self._anomaly:
            return None
        self._anomaly = detected
        if not detected:
            self._messages.clear()  # a repaired arm may differ
            return None
        while self._messages and now - self._messages[-1][0] < NOTICED:
            self._messages.pop()
        in_use = self.mae
        while len(self._used) > 1 and now - self._used[-1][0] < PROOF:
            del self._used[-1]
        return self.mae if self.mae is not in_use else None

    # -- what is measured -----------------------------------------------------------------------

    def posture_errors(self, mae: Mae) -> Iterator[tuple[str, Array] | None]:
        """Yield shares left unexplained of the fixed postures, of each joint or muscle.

        None after a piece of work that is not all of a share.
        """
        theta, pull, length = self._postures
        own = mae.lengths(theta, pull)
        for mask, sign in zip(Mask, '①②③', strict=True):
            restored = mae.decode(mae.encode(mask, theta, pull, own))
            truth = theta, pull, length if sign == '①' else own
            for name, value, true in zip('θTl', restored, truth, strict=True):
                spread = np.maximum(true.std(axis=0), LEAST_SPREAD if name == 'l' else 1e-9)
                yield f'{name} by {sign}', _size(value - true) / spread
                if name == 'θ' and sign != '②':
                    yield f'mean θ by {sign}', np.abs((value - true).mean(axis=0)) / spread
        off = np.empty_like(self._jacobian)
        for some in np.array_split(np.arange(POSTURES), 4):
            off[some] = mae.muscle_jacobian(theta[some], pull[some]) - self._jacobian[some]
            yield None
        by_muscle = (
            part.swapaxes(1, 2).reshape(-1, off.shape[1]) for part in (off, self._jacobian)
        )
        error, size = map(_size, by_muscle)
        yield 'G by ①', error / np.maximum(size, LEAST_ARM)

    def _with_friction_of(self, mae: Mae) -> tuple[Array, Array]:
        """Return T_end [N] and l [m] of the messages (N, M), by a network's friction."""
        _, tension, length, direction, _ = map(np.array, zip(*self._messages))
        return end_tension(mae.friction, tension, direction), length

    def message_errors(self, mae: Mae) -> dict[str, Array]:
        """Return what is left of T [N] and l [m] of the messages, of each muscle; {} if too few."""
        if len(self._messages) < LEAST:
            return {}
        tension, length = self._with_friction_of(mae)
        restored = mae.estimate(tension, length)
        used = np.delete(np.arange(self._robot.muscle_count), self.isolated)
        parts = (
            restored.tension - tension,
            restored.length - length,
            mae.lengths(restored.theta, tension) - length,
        )
        left = {name: np.zeros(self._robot.muscle_count) for name in FLOOR}
        for row, part in zip(left.values(), parts):
            row[used] = np.median(np.abs(part[:, used]), axis=0)
        return left

    def agreement(self, mae: Mae) -> list[Comparison]:
        """Compare θ, and the lengths of ① at a posture, with those that count; see above.

        Nothing where no network is in use.
        """
        if self.mae is None:
            return []
        before, radian = self.mae.without(self.isolated), self._robot.kinematics.radian
        if len(self._messages) < LEAST:
            theta, tension, _ = self._postures
            length = before.lengths(theta, tension)
            new = mae.estimate(tension, length).theta
        else:
            new = mae.estimate(*self._with_friction_of(mae)).theta
            tension, length = self._with_friction_of(before)
            theta = before.estimate(tension, length).theta
            measured = np.array([row[-1] for row in self._messages])
            known = np.isfinite(measured).all(axis=1)
            if np.count_nonzero(known) >= LEAST:
                estimates = new[known], theta[known]
                return self._by_sensors(mae, before, measured[known], estimates)
        has_learned = before.covariance is not None
        most = (ANGLE_MOVED if has_learned else ANGLE_MOVED_INITIAL) * radian
        change = self._off(mae, theta, tension, before.lengths(theta, tension))
        source = 'the network in use'
        return [
            Comparison('θ', _median(new - theta), most, source),
            Comparison(BY_POSTURE, change, np.full(len(change), LENGTH_MOVED), source),
            self._shape(mae, before),
        ]

    def _by_sensors(
        self, mae: Mae, before: Mae, measured: Array, estimates: tuple[Array, Array]
    ) -> list[Comparison]:
        """Compare with measured θ (N, D); the estimates are of the candidate and of the other."""
        is_known = np.array([np.isfinite(row[-1]).all() for row in self._messages])
        error, earlier = (_median(theta - measured) for theta in estimates)
        least = ANGLE_FLOOR * self._robot.kinematics.radian
        off = list[Array]()
        for each in (mae, before):
            tension, length = (part[is_known] for part in self._with_friction_of(each))
            off.append(self._off(each, measured, tension, length))
        limit = np.fmax(LENGTH_FLOOR, ANGLE_WORSE * off[1])
        source = 'joint sensors'
        compared = [
            Comparison('θ', error, np.fmax(least, ANGLE_WORSE * earlier), source),
            Comparison(BY_POSTURE, off[0], limit, source),
        ]
        return compared if off[0].mean() <= off[1].mean() else [*compared, self._shape(mae, before)]

    def _shape(self, mae: Mae, before: Mae) -> Comparison:
        """Compare how the lengths of all muscles change over the fixed postures."""
        theta, tension, _ = self._postures
        used = np.delete(np.arange(self._robot.muscle_count), self.isolated)
        new, old = (each.lengths(theta, tension)[:, used] for each in (mae, before))
        share = np.linalg.norm((new - old).std(axis=0)) / np.linalg.norm(old.std(axis=0))
        has_learned = before.covariance is not None
        most = SHAPE_MOVED if has_learned else SHAPE_MOVED_INITIAL
        return Comparison(SHAPE, np.array([share]), np.array([most]), 'the network in use')

    def _off(self, mae: Mae, theta: Array, tension: Array, length: Array) -> Array:
        """Return by how much the lengths of ① are off [m], the median of each muscle in use."""
        off = _median(mae.lengths(theta, tension) - length)
        off[list(self.isolated)] = 0.0
        return off

    def with_detector(self, mae: Mae, now: float) -> Mae:
        """Return a network that takes over, with a calibrated detector if there is one in use.

        The threshold is that of the detector in use, or more if the messages need it. Soon after
        a user has declared the body healthy, a muscle may be another one, and the network stays as
        it is.
        """
        statistics = None if self.mae is None else self.mae.anomaly
        has_own = mae.anomaly is not None and mae.anomaly.calibrated
        if has_own or statistics is None or not statistics.calibrated:
            return mae
        if 0.0 <= now - self._declared_at < DECLARED:
            return mae
        if self._messages:
            used = mae.without(self.isolated)
            tension, length = self._with_friction_of(used)
            error = residuals(used.estimate(tension, length), tension, length, used.isolated)
            highest = float(statistics.without(self.isolated).distances(error).max())
            threshold = statistics.thresholds.get(DISTANCE, math.inf)
            widened = {DISTANCE: max(threshold, WIDENED * highest)}
            statistics = replace(statistics, thresholds={**statistics.thresholds, **widened})
        return replace(mae, anomaly=statistics)

    def detector(self, mae: Mae) -> Iterator[float]:
        """Yield d over its threshold, the median: of the messages, then with each muscle cut.

        Nothing where there is no calibrated detector.
        """
        statistics = mae.anomaly
        if statistics is None or not statistics.calibrated or len(self._messages) < LEAST:
            return
        threshold = statistics.thresholds.get(DISTANCE, np.inf)
        tension, length = self._with_friction_of(mae)

        def distance(tension: Array, length: Array) -> float:
            state = mae.estimate(tension, length)
            error = residuals(state, tension, length, mae.isolated)
            return float(np.median(statistics.distances(error) / threshold))

        yield distance(tension, length)
        # As many messages as say something suffice, times every muscle.
        some = np.linspace(0, len(length) - 1, LEAST).astype(int)
        for uncut in np.delete(1.0 - np.eye(self._robot.muscle_count), self.isolated, axis=0):
            yield distance(tension[some] * uncut, length[some])

    def _faults(self, mae: Mae, is_chosen: bool) -> Iterator[str]:
        """Yield what is wrong, and '' after each piece of work."""
        joints, muscles = self._robot.joints, self._robot.muscles
        mae = mae.without(self.isolated)
        for item in self.posture_errors(mae):
            yield ''
            if item is None:
                continue
            name, share = item
            limit = np.full(len(share), LIMITS[name])
            if name[0] == 'θ' and not share.max() <= LIMITS[name]:
                limit = np.maximum(limit, self._undetermined)
            over = share / limit
            if not over.max() <= 1.0:
                worst = int(over.argmax())
                who = (joints if 'θ' in name else muscles)[worst]
                of = 'on the geometric model' if name.endswith('①') else 'of the lengths of ①'
                told = f'{share[worst]:.2g} unexplained {of}'
                yield f'{name}, {who}: {told}, limit {limit[worst]:.3g}'
        # It is unknown how well a first network has to explain a body that differs from its model.
        left = {} if self.mae is None else self.message_errors(mae)
        before = {} if self.mae is None else self.message_errors(self.mae.without(self.isolated))
        yield ''
        for name, error in left.items():
            limit = np.fmax(FLOOR[name], WORSE * before[name])
            over = error / limit
            if not over.max() <= 1.0:
                worst = int(over.argmax())
                told = f'{error[worst]:.3g} left of own messages, limit {limit[worst]:.3g}'
                yield f'{name}, {muscles[worst]}: {told}'
        for name, error, limit, source in [] if is_chosen else self.agreement(mae):
            over = error / limit
            if not over.max() <= 1.0:
                worst = int(over.argmax())
                who = {'θ': joints, BY_POSTURE: muscles, SHAPE: ('all muscles',)}[name][worst]
                yield (
                    f'{name}, {who}: {error[worst]:.2g} away from {source}, limit '
                    f'{limit[worst]:.3g}'
                )
        yield ''
        distances = list[float]()
        for distance in self.detector(mae):
            distances.append(distance)
            yield ''
        if not distances:
            return
        healthy, cut = distances[0], max(distances[1:], default=np.inf)
        if healthy > 1.0:
            yield f'detector: d {healthy:.2g} of its threshold on own messages, limit 1'
        if cut < LEAST_CUT:
            yield f'detector: d {cut:.2g} of its threshold with a muscle cut, least {LEAST_CUT:g}'


def _median(error: Array) -> Array:
    size: Array = np.median(np.abs(error), axis=0)
    return size


def _size(error: Array) -> Array:
    size: Array = np.sqrt(np.square(error).mean(axis=0))
    return size
