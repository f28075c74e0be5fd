# SPDX-License-Identifier: Apache-2.0
"""Checks that a candidate network agrees with joint sensors, or else with the network in use.

Three quantities are compared:

    θ         the joint angles that the network estimates on the recent messages
    lengths   the muscle lengths that the network computes at the same posture
    shape     the change of these lengths from posture to posture, on fixed random states

If joint sensors measured the postures, the sensors are the reference. The limit of the median error
of each joint or muscle is then ANGLE_WORSE times the error of the network in use, but at least
ANGLE_FLOOR or LENGTH_FLOOR. The shape is compared only if the candidate's mean error of length is
larger than that of the network in use.

Without joint sensors, the network in use is the reference. The limits of the median differences are
ANGLE_MOVED and LENGTH_MOVED, and that of the relative difference in shape is SHAPE_MOVED. If there
are too few messages, they are replaced by the fixed states with lengths that the network in use
computes. The names in capitals are constants of this file.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.estimation.network_validation.comparison import Comparison
from musculoskeletal_ae.estimation.network_validation.posture_check import PostureCheck
from musculoskeletal_ae.estimation.network_validation.recent_messages import LEAST, RecentMessages
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

# Limits relative to joint sensors. A good learned network differed from joint sensors by 0.29 rad
# although the network before it differed by 0.18 rad. Lengths of good learned networks differed by
# up to 0.03 m.
ANGLE_FLOOR = 0.35  # never reject a network for a smaller error of a joint angle than this [rad]
LENGTH_FLOOR = 0.06  # never reject a network for a smaller error of a length than this [m]
#: above these errors, reject a network whose error exceeds that of the network in use by this
#: factor
ANGLE_WORSE = 1.5
#: call a chosen network worse than the one in use only if its error exceeds this [rad]
ANGLE_CLEAR = 0.1
# Limits relative to the network in use. The first update of an initial network changed θ by up to
# 0.56 rad and lengths by up to 0.05 m; an update of a learned network changed θ by up to 0.31 rad.
#: while a learned network is in use, reject candidates whose θ differs from its θ by more than this
#: [rad]
ANGLE_MOVED = 0.45
#: while an initial network is in use, reject candidates whose θ differs from its θ by more than
#: this [rad]
ANGLE_MOVED_INITIAL = 0.8
#: reject a candidate if a length differs by more than this from that of the network in use [m]
LENGTH_MOVED = 0.07
# A minute of learning changed the shape of initial networks by 0.32 and of learned networks by
# 0.18. Multiplying all lengths by 1.5 changes it by 0.5.
#: while a learned network is in use, reject a candidate whose changes of length from posture to
#: posture differ by more than this share from those of the network in use
SHAPE_MOVED = 0.3
#: the same limit as SHAPE_MOVED, but while an initial network is in use
SHAPE_MOVED_INITIAL = 0.42

BY_SENSORS = 'from joint sensors'  # text for users if joint sensors are the reference
BY_NETWORK = 'from the network in use'  # text for users if the network in use is the reference


class AgreementCheck:
    """Compares candidates with joint sensors or with the network in use.

    Args:
        robot: The geometric model.
        postures: Fixed random states of the geometric model.
        messages: The recent messages.
        in_use: The network in use.
        isolated: Indices of the isolated muscles, which are ignored.
    """

    def __init__(
        self,
        robot: Robot,
        postures: PostureCheck,
        messages: RecentMessages,
        in_use: Mae,
        isolated: Iterable[int],
    ) -> None:
        self._robot, self._postures, self._messages = robot, postures, messages
        self._in_use, self._isolated = in_use, tuple(isolated)
        self._has_learned = in_use.covariance is not None

    def comparisons(self, mae: Mae) -> list[Comparison]:
        """Return comparisons of a candidate with joint sensors, or else with the network in use.

        There is one for each quantity: angles, lengths and, if needed, the change of lengths.
        """
        if not self._messages.are_enough:
            theta, tension = self._postures.theta, self._postures.tension
            length = self._in_use.lengths(theta, tension)
            return self._with_network(mae, mae.estimate(tension, length).theta, theta, tension)
        new, old, rows = self._estimates(mae)
        if len(rows) >= LEAST:
            return self._with_sensors(mae, new, old, rows)
        tension, _ = self._messages.readings(self._in_use)
        return self._with_network(mae, new, old, tension)

    def worse_angle(self, mae: Mae) -> str | None:
        """Return a text on the joint that a network estimates clearly worse than the one in use.

        Returns:
            The joint with both errors; '' if no error is above ANGLE_CLEAR and ANGLE_WORSE times
            that of the network in use. None if the joint sensors did not measure the postures.
        """
        new, old, rows = self._estimates(mae)
        if len(rows) < LEAST:
            return None
        measured = self._messages.theta[rows]
        error, in_use = (_median(theta[rows] - measured) for theta in (new, old))
        limit = np.fmax(ANGLE_CLEAR, ANGLE_WORSE * in_use)
        worst = self._angles(error, limit, BY_SENSORS).worst
        if worst is None:
            return ''
        unit = self._robot.units[worst]
        return (
            f'its estimate of {self._robot.joints[worst]} differs from the sensor by '
            f'{unit.position_text(error[worst])}, that of the network before by '
            f'{unit.position_text(in_use[worst])}'
        )

    def _estimates(self, mae: Mae) -> tuple[Array, Array, Ints]:
        """Return θ by a candidate and by the network in use [rad], (N, D), for recent messages.

        The indices of the messages in which all joints were measured come third.
        """
        new = mae.estimate(*self._messages.readings(mae)).theta
        old = self._in_use.estimate(*self._messages.readings(self._in_use)).theta
        return new, old, np.flatnonzero(np.isfinite(self._messages.theta).all(axis=1))

    def _with_network(self, mae: Mae, new: Array, old: Array, tension: Array) -> list[Comparison]:
        """Compare a candidate with the network in use.

        Args:
            mae: The candidate.
            new: Joint angles that the candidate estimates [rad], (N, D).
            old: Joint angles that the network in use estimates [rad], (N, D).
            tension: Bone-side tensions [N], (N, M).
        """
        angle = ANGLE_MOVED if self._has_learned else ANGLE_MOVED_INITIAL
        limit = np.full(self._robot.joint_count, angle)
        change = self._length_error(mae, old, tension, self._in_use.lengths(old, tension))
        length_limit = np.full(len(change), LENGTH_MOVED)
        return [
            self._angles(_median(new - old), limit, BY_NETWORK),
            self._lengths(change, length_limit, BY_NETWORK),
            self._shape(mae),
        ]

    def _with_sensors(self, mae: Mae, new: Array, old: Array, rows: Ints) -> list[Comparison]:
        """Compare a candidate and the network in use with joint sensors.

        Args:
            mae: The candidate.
            new: Joint angles that the candidate estimates [rad], (N, D).
            old: Joint angles that the network in use estimates [rad], (N, D).
            rows: Indices of the messages in which all joints were measured.
        """
        measured = self._messages.theta[rows]
        error, error_in_use = (_median(theta[rows] - measured) for theta in (new, old))
        least = np.full(self._robot.joint_count, ANGLE_FLOOR)
        length_error, length_error_in_use = (
            self._length_error(
                each, measured, *(part[rows] for part in self._messages.readings(each))
            )
            for each in (mae, self._in_use)
        )
        length_limit = np.fmax(LENGTH_FLOOR, ANGLE_WORSE * length_error_in_use)
        comparisons = [
            self._angles(error, np.fmax(least, ANGLE_WORSE * error_in_use), BY_SENSORS),
            self._lengths(length_error, length_limit, BY_SENSORS),
        ]
        if not length_error.mean() <= length_error_in_use.mean():
            comparisons.append(self._shape(mae))
        return comparisons

    def _angles(self, error: Array, limit: Array, source: str) -> Comparison:
        outside = self._robot.units.to_position
        return Comparison('θ', self._robot.joints, outside(error), outside(limit), source)

    def _lengths(self, error: Array, limit: Array, source: str) -> Comparison:
        return Comparison('l by ① at θ', self._robot.muscles, error, limit, source)

    def _shape(self, mae: Mae) -> Comparison:
        """Compare the network `mae` with the network in use by how lengths change with posture.

        Both networks compute the muscle lengths at the same fixed states.
        """
        theta, tension = self._postures.theta, self._postures.tension
        used = np.delete(np.arange(self._robot.muscle_count), self._isolated)
        new, old = (each.lengths(theta, tension)[:, used] for each in (mae, self._in_use))
        difference = np.linalg.norm((new - old).std(axis=0)) / np.linalg.norm(old.std(axis=0))
        limit = SHAPE_MOVED if self._has_learned else SHAPE_MOVED_INITIAL
        error = np.array([difference])
        return Comparison(
            'change of l by ①', ('all muscles',), error, np.array([limit]), BY_NETWORK
        )

    def _length_error(self, mae: Mae, theta: Array, tension: Array, length: Array) -> Array:
        """Return the median error of the lengths that a network computes at known postures.

        Args:
            mae: A network.
            theta: The postures [rad], (N, D).
            tension: Bone-side tensions [N], (N, M).
            length: Lengths with which those of the network are compared [m], (N, M).

        Returns:
            The error of each muscle's length [m], (M,); 0 for isolated muscles.
        """
        error = _median(mae.lengths(theta, tension) - length)
        error[list(self._isolated)] = 0.0
        return error


def _median(error: Array) -> Array:
    size: Array = np.median(np.abs(error), axis=0)
    return size
