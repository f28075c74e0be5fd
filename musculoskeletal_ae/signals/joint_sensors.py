# SPDX-License-Identifier: Apache-2.0
"""Judges the joint sensors of a moving arm by its muscle lengths.

The geometric model states how every l changes with each joint. For N messages of a moving arm,

    l(t) − l̂(t) ≈ c + Σ_j a_j (l_j(t) − l̂(t)),    l̂: model at the median posture
                                                  l_j: the same with the measured θ_j of joint j

is fitted by least squares, with a constant c for each muscle and segment of the recording. Because
of c, the fit does not depend on length offsets. For a correct sensor a_j is about 1. If the sign of
θ_j is wrong, a_j is about −1. Leaving out one muscle at a time gives the standard error of a_j
(jackknife).

A sign cannot be judged from lengths if the joint hardly moves, or if the lengths of its muscles are
the same at θ and −θ. In the second case, a wrong sign is found only if both limits of the joint
have the same sign. Readings with the wrong sign are then beyond the limits.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.robot.joint_units import JointUnits
from musculoskeletal_ae.robot.robot import Robot

LEAST_MOTION = 0.05  # judge a joint only if the range of its θ is at least this [rad]
#: Judge the sign of a joint sensor only if its factor |a_j| (docstring of this module) is at least
#: this. On the emulated individuals 0–4 of two shipped arms and both emulator models, a_j of
#: joints that moved enough is between 0.4 and 1.9.
LEAST_SCALE = 0.3
BEYOND = 0.3  # treat readings as impossible if they exceed the joint limits by more than this [rad]
#: Assume another unit, order or sign of the joint angles (`_possible_faults`) if it reduces the
#: misfit of the muscle lengths to less than this fraction.
BETTER = 0.8
MOST_SAMPLES = 600  # judge sensors by at most this many messages, evenly distributed
LEAST_SAMPLES = 20  # judge no sensor by fewer messages than this
STUCK_TIME = 5.0  # examine a repeated reading only if it lasts for at least this time [s]
#: report a repeated reading as stuck if the lengths show that its joint moves by more than this
#: [rad]
STUCK_MOTION = 0.2
#: report a repeated reading as stuck if the lengths show a joint angle that differs from the
#: reading by more than this [rad]
STUCK_OFFSET = 0.5
#: assume that a joint has moved unnoticed only if its motion leaves at most this fraction of the
#: mean square of the length errors unexplained
STUCK_EXPLAINED = 0.5
#: kinds of faults: angles in degrees, a wrong sign, exchanged joints, a stuck reading
DEGREES, SIGN, ORDER, STUCK = 'degrees', 'joint sign', 'joint order', 'joint stuck'


class JointFault(NamedTuple):
    """A fault of one or several joint sensors."""

    kind: str  # DEGREES, SIGN, ORDER or STUCK
    joints: tuple[int, ...]  # indices of the joints
    begin: float = 0.0  # begin and end of a stuck reading [s]
    end: float = 0.0


def corrected(theta: Array, faults: Iterable[JointFault], units: JointUnits) -> Array:
    """Return the angles θ [rad], (N, D), that the sensors would measure without these faults."""
    theta = units.to_position(theta)  # the sensors publish positions
    for fault in faults:
        joints = list(fault.joints)
        if fault.kind == SIGN:
            theta[:, joints] *= -1.0
        elif fault.kind == ORDER:
            theta[:, joints] = theta[:, joints[::-1]]
        elif fault.kind == DEGREES:
            theta[:, joints] = np.radians(theta[:, joints])
    return units.to_theta(theta)


class Judgement(NamedTuple):
    """Faults of joint sensors, and the joints whose sign is certainly right."""

    faults: list[JointFault]
    right: tuple[int, ...]  # indices of the joints


def judge(
    robot: Robot,
    theta: Array,
    length: Array,
    tension: Array,
    used: Bools | None = None,
    segments: Ints | None = None,
) -> Judgement:
    """Judge unit, order and sign of the joint sensors of an arm that has moved.

    Args:
        robot: The geometric model.
        theta: Measured joint angles θ [rad], (N, D). Messages with NaN are not used.
        length: Muscle lengths l [m], (N, M).
        tension: Tensions T [N], (N, M).
        used: Muscles to judge by, (M,); None for all. Their lengths must have the right sign.
        segments: Number of the segment to which each message belongs, (N,); None for one segment.
            Short segments reduce the effect of drifting lengths.
    """
    rows = np.flatnonzero(np.isfinite(theta).all(axis=1))
    if len(rows) < LEAST_SAMPLES:
        return Judgement([], ())
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_SAMPLES)).astype(int)]
    tension = robot.actuation.known_tension(tension)
    used = np.ones(robot.muscle_count, dtype=bool) if used is None else used
    segments = np.zeros(len(theta), dtype=int) if segments is None else segments
    lengths = _Lengths(robot, length[rows], tension[rows], used, segments[rows])
    best: JointFault | None = None  # the fault that explains the lengths best; None for no fault
    signs = lengths.signs(theta[rows])
    least = BETTER * lengths.misfit(theta[rows] * signs.sign)
    for fault in _possible_faults(lengths, theta[rows]):
        true = corrected(theta[rows], [fault], robot.units)
        others = lengths.signs(true)
        if (misfit := lengths.misfit(true * others.sign)) < least:
            best, signs, least = fault, others, misfit
    faults = [] if best is None else [best]
    reversed_joints = set(np.flatnonzero(signs.sign < 0.0).tolist())
    if best is not None and best.kind == SIGN:
        reversed_joints ^= set(best.joints)
        faults = []
    if reversed_joints:
        faults.append(JointFault(SIGN, tuple(sorted(reversed_joints))))
    right = signs.is_known.copy()
    right[list(reversed_joints)] = False
    return Judgement(faults, tuple(np.flatnonzero(right).tolist()))


def sign_notes(robot: Robot, right: Sequence[int], remedy: str) -> list[str]:
    """Return sentences on the joint sensors whose sign is right, and on those not judged.

    Args:
        robot: The robot.
        right: Indices of the joints whose sign is right.
        remedy: A sentence on how to make the other joints move more; it ends the last note.
    """
    notes = []
    unknown = [name for j, name in enumerate(robot.joints) if j not in right]
    if right:
        names = ', '.join(robot.joints[j] for j in right)
        notes.append(f'these joint sensors have the right sign: {names}')
    if unknown:
        notes.append(
            'the sign of these joint sensors is not known, because the joints moved too little: '
            f'{", ".join(unknown)}. {remedy}'
        )
    return notes


def stuck_sensors(
    robot: Robot,
    time: Array,
    theta: Array,
    length: Array,
    tension: Array,
    used: Bools | None = None,
) -> list[JointFault]:
    """Return the joint sensors that repeat one reading although the lengths show another angle.

    A sensor is stuck if, during the repeated reading, the lengths show that its joint moves. It is
    also stuck if the lengths then show an angle that is far from the reading, in comparison with
    the rest of the recording.

    Args:
        robot: The geometric model.
        time: Times of the messages [s], (N,).
        theta: Measured joint angles θ [rad], (N, D).
        length: Muscle lengths l [m], (N, M).
        tension: Tensions T [N], (N, M).
        used: Muscles to judge by, (M,); None for all.
    """
    used = np.ones(robot.muscle_count, dtype=bool) if used is None else used
    tension = robot.actuation.known_tension(tension)
    faults = list[JointFault]()
    for j in range(robot.joint_count):
        for begin, end in _repeats(time, theta[:, j]):
            rows = np.linspace(begin, end, min(end - begin + 1, MOST_SAMPLES)).astype(int)
            rows = rows[np.isfinite(theta[rows]).all(axis=1)]
            if len(rows) < LEAST_SAMPLES:
                continue
            constant = np.flatnonzero(np.ptp(theta[rows], axis=0) == 0.0)
            jacobian = robot.routes.muscle_jacobian(theta[rows])[:, used][:, :, constant]
            error = (length[rows] - robot.muscle_lengths(theta[rows], tension[rows]))[:, used]
            motion = _hidden_motion(error - error.mean(axis=0), jacobian)[:, constant == j]
            away = np.zeros(1)
            if len(outside := _rows_outside(theta, begin, end)) >= LEAST_SAMPLES:
                usual = length[outside] - robot.muscle_lengths(theta[outside], tension[outside])
                error -= np.median(usual[:, used], axis=0)
                away = _hidden_motion(error, jacobian)[:, constant == j]
            is_moving = np.ptp(np.percentile(motion, [5, 95])) > STUCK_MOTION
            if is_moving or abs(np.median(away)) > STUCK_OFFSET:
                faults.append(JointFault(STUCK, (j,), float(time[begin]), float(time[end])))
    return faults


class _Signs(NamedTuple):
    """Signs that the measured angles should have according to the muscle lengths, (D,) each."""

    sign: Array  # factor by which θ must be multiplied, 1 or −1
    is_known: Bools  # whether the lengths show the sign


class _Lengths:
    """Muscle lengths of a moving arm, which show whether measured joint angles are right."""

    def __init__(
        self, robot: Robot, length: Array, tension: Array, used: Bools, segments: Ints
    ) -> None:
        self.robot, self._length, self._tension, self._used = robot, length, tension, used
        self._segments = [np.flatnonzero(segments == each) for each in np.unique(segments)]

    def _model(self, theta: Array) -> Array:
        """Return the lengths [m] that the model gives for the used muscles at θ (N, D)."""
        return self.robot.muscle_lengths(theta, self._tension)[:, self._used]

    def _centred(self, lengths: Array) -> Array:
        """Return lengths (N, M) after subtracting each muscle's mean in each segment."""
        centred = lengths.copy()
        for rows in self._segments:
            centred[rows] -= lengths[rows].mean(axis=0)
        return centred

    def misfit(self, theta: Array) -> float:
        """Return the root mean square of measured minus modelled lengths [m] at θ (N, D).

        The mean difference of each uninterrupted stretch of the recording is subtracted first. The
        result is ∞ if any θ is beyond a joint limit.
        """
        robot = self.robot
        beyond = np.maximum(theta - robot.upper, robot.lower - theta)
        if (beyond > BEYOND).any():
            return np.inf
        error = self._centred(self._length[:, self._used] - self._model(theta))
        return float(np.sqrt(np.square(error).mean()))

    def moved(self, theta: Array) -> Bools:
        """Return which joints have moved enough to be judged, (D,)."""
        is_enough: Bools = np.ptp(theta, axis=0) > LEAST_MOTION
        return is_enough

    def signs(self, theta: Array) -> _Signs:
        """Return the signs that θ (N, D) must have to agree with the muscle lengths."""
        sign, known = np.ones(theta.shape[1]), np.zeros(theta.shape[1], dtype=bool)
        for _ in range(theta.shape[1]):
            scale, error = self._scales(theta * sign)
            known = (np.abs(scale) > LEAST_SCALE) & (np.abs(scale) > error)
            wrong = known & (scale < 0.0)
            if not wrong.any():
                break
            # Change one sign only, then judge all joints again, because the wrong sign has put the
            # model into a wrong posture.
            sign[np.where(wrong, scale, 0.0).argmin()] *= -1.0
        return _Signs(sign, known & (scale > 0.0))

    def _scales(self, theta: Array) -> tuple[Array, Array]:
        """Return the factors a_j of the module docstring, and their standard errors, (D,) each.

        a_j is about 1 if the angle of joint j agrees with the muscle lengths, and about −1 if its
        sign is wrong. If it cannot be determined, it is 0 with the standard error ∞.
        """
        scale, deviation = np.zeros(theta.shape[1]), np.full(theta.shape[1], np.inf)
        moved = np.flatnonzero(self.moved(theta))
        muscles = int(self._used.sum())
        if not len(moved) or muscles <= len(moved):
            return scale, deviation
        still = np.tile(np.median(theta, axis=0), (len(theta), 1))
        base = self._model(still)
        changes = []
        for j in moved:
            posture = still.copy()
            posture[:, j] = theta[:, j]
            changes.append(self._centred(self._model(posture) - base))
        change = np.stack(changes, axis=-1)  # (N, M, joints)
        measured = self._centred(self._length[:, self._used] - base)
        # Each muscle adds one term to the normal equations. Subtracting this term leaves the muscle
        # out of the fit.
        products = np.einsum('nmj,nmk->mjk', change, change)
        rights = np.einsum('nmj,nm->mj', change, measured)
        scale[moved] = _solve(products.sum(axis=0), rights.sum(axis=0))
        without = np.array(
            [
                _solve(products.sum(axis=0) - products[m], rights.sum(axis=0) - rights[m])
                for m in range(muscles)
            ]
        )
        spread = np.square(without - without.mean(axis=0)).sum(axis=0)
        deviation[moved] = np.sqrt((muscles - 1) / muscles * spread)
        return scale, deviation


def _solve(products: Array, right: Array) -> Array:
    solution: Array = np.linalg.lstsq(products, right, rcond=None)[0].astype(float)
    return solution


def _possible_faults(lengths: _Lengths, theta: Array) -> list[JointFault]:
    """Return the faults of joint sensors that could explain the measured θ (N, D).

    The faults are wrong signs, degrees instead of radians, and two exchanged joints.
    """
    robot = lengths.robot
    turning = np.flatnonzero(~robot.units.slides).tolist()
    is_beyond = np.maximum(theta - robot.upper, robot.lower - theta).max(axis=0) > BEYOND
    far = np.flatnonzero(is_beyond).tolist()
    faults = list[JointFault]()
    if far:  # readings beyond the limits may be legal with the other sign, or as degrees
        faults.append(JointFault(SIGN, tuple(far)))
        # In degrees, an arm that moves has readings far beyond ±π.
        if np.abs(theta[:, turning]).max(initial=0.0) > np.pi:
            degrees = sorted({*far} & {*turning}), turning
            faults += [JointFault(DEGREES, tuple(joints)) for joints in degrees if joints]
    pairs = list(combinations(np.flatnonzero(lengths.moved(theta)).tolist(), 2))
    if pairs:  # state only the best exchange, because the caller's search for signs takes time
        exchanges = [JointFault(ORDER, pair) for pair in pairs]
        misfits = [lengths.misfit(corrected(theta, [fault], robot.units)) for fault in exchanges]
        faults.append(exchanges[int(np.argmin(misfits))])
    return faults


def _repeats(time: Array, values: Array) -> Iterator[tuple[int, int]]:
    """Yield the first and last index of each run of equal values of at least STUCK_TIME seconds."""
    edges = np.flatnonzero(values[1:] != values[:-1]) + 1
    begins = np.concatenate([[0], edges])
    ends = np.concatenate([edges, [len(values)]]) - 1
    for begin, end in zip(begins.tolist(), ends.tolist()):
        if end > begin and time[end] - time[begin] >= STUCK_TIME:
            yield begin, end


def _rows_outside(theta: Array, begin: int, end: int) -> Ints:
    """Return evenly distributed rows of θ (N, D) before `begin` and after `end`."""
    rows = np.flatnonzero(np.isfinite(theta).all(axis=1))
    rows = rows[(rows < begin) | (rows > end)]
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_SAMPLES)).astype(int)]


def _hidden_motion(error: Array, jacobian: Array) -> Array:
    """Return the motion of S joints [rad], (N, S), that best explains errors of lengths.

    The result is 0 if no motion explains enough of the errors.

    Args:
        error: Measured minus modelled lengths [m], (N, M), from which a constant for each muscle,
            such as the mean, has been subtracted.
        jacobian: G of these joints [m/rad], (N, M, S).
    """
    hidden: Array = np.einsum('nsm,nm->ns', np.linalg.pinv(jacobian), error)
    unexplained = error - np.einsum('nms,ns->nm', jacobian, hidden)
    if np.square(unexplained).sum() > STUCK_EXPLAINED * np.square(error).sum():
        return np.zeros_like(hidden)
    return hidden
