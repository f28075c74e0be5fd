# SPDX-License-Identifier: Apache-2.0
"""Checks whether a muscle that was isolated or suspected may be restored.

A muscle must not be restored while one of these problems is present:

    the length has just jumped      its new level is not accepted yet
    a reading is NaN                the sensor is faulty (`MuscleSample.missing`)
    T < SLACK_SHARE · T_ref         the tendon is slack although the command demands tension T_ref
    |l − l'| > limit                the length does not fit the posture

l' is the length that the network computes at the posture that joint sensors measure or, without
them, at the posture that the other muscles indicate. A length may be wrong because the tendon is
still ruptured, because the winch is still moving, or because the module has another length offset
since the repair. A tendon that is slack because no tension is demanded may be longer than l'; the
controller winds it in.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_stream import MuscleSample
from musculoskeletal_ae.signals.reading_limits import LIMITS, slack_tension

#: Refuse to use a repaired muscle if its length l differs from the predicted length l' by more than
#: this [m]: the first limit is for networks with a calibrated detector, the second for all others.
#: Healthy lengths differ by at most 0.013 and 0.051 m (`detectors/length_disagreement.py`).
LARGEST_LEARNED, LARGEST_YOUNG = 0.02, 0.08


class RepairCheck(NamedTuple):
    """Checks, from the readings of one message, whether repaired muscles may be restored."""

    robot: Robot  # the nominal body with all muscles
    mae: Mae  # the network with all muscles
    sample: MuscleSample  # the readings
    isolated: Iterable[int]  # indices of the muscles that do not indicate the posture
    theta: Array | None  # θ from joint sensors [rad], (D,), or None without them
    demand: Array | None  # tensions that were demanded at the readings [N], (M,); None if unknown
    jumping: Collection[int]  # indices of the muscles whose lengths have just jumped
    #: largest legal difference |l − l'| of a length from the predicted one [m]; infinite while the
    #: length offsets are unknown
    limit: float

    def problem(self, muscle: int) -> str:
        """Return why a muscle must not be used yet, as a text for users; '' if it may be used."""
        return self.defect(muscle) or self._length_problem(muscle)

    def defect(self, muscle: int) -> str:
        """Return a problem that is not a wrong length, as a text for users; '' if there is none."""
        robot, sample, demand = self.robot, self.sample, self.demand
        name, tension = robot.muscles[muscle], float(sample.motor_tension[muscle])
        if muscle in self.jumping:
            return f'the length of {name} has just jumped; wait for {LIMITS.settled:g} s'
        if muscle in sample.missing:
            return f'{name}: a sensor reports NaN instead of a number; repair it'
        bias = float(robot.tension.bias[muscle])
        demanded = 0.0 if demand is None else float(demand[muscle])
        if demanded >= bias and tension < slack_tension(demanded):
            return f'{name} has no tension although the command demands tension; repair it'
        return ''

    def _length_problem(self, muscle: int) -> str:
        name, limit, error = self.robot.muscles[muscle], self.limit, self._length_error(muscle)
        may_be_slack = self._is_slack(muscle) and error > 0.0
        if abs(error) <= limit or may_be_slack:
            return ''
        others = 'other muscles' if self.theta is None else 'joint sensors'
        reference = f'the {others} indicate'
        direction = 'longer' if error > 0.0 else 'shorter'
        return (
            f'the length of {name} is {1e3 * abs(error):.0f} mm {direction} than {reference} '
            f'(limit {1e3 * limit:.0f} mm); wait until its winch has come to rest, or call '
            'estimator/zero if the length stays wrong'
        )

    def is_taut_with_wrong_length(self, muscle: int) -> bool:
        """Return whether a muscle is not slack, but its length does not fit the posture.

        Its tendon is then not ruptured. Unless its winch is still moving, the length has an offset.
        """
        is_doubtful = muscle in self.jumping or muscle in self.sample.missing
        is_settled = not is_doubtful and not self._is_slack(muscle)
        return is_settled and abs(self._length_error(muscle)) > self.limit

    def _is_slack(self, muscle: int) -> bool:
        lowest = slack_tension(self.robot.tension.bias[muscle])
        return bool(self.sample.motor_tension[muscle] < lowest)

    def _length_error(self, muscle: int) -> float:
        """Return the length error l − l' of a muscle [m]: measured minus predicted length.

        l' is predicted at the posture that joint sensors or, without them, the other muscles show.
        """
        theta, sample = self.theta, self.sample
        if theta is None:
            others = self.mae.without({*self.isolated, muscle})
            theta = others.estimate(sample.bone_tension, sample.length).theta
        pull = np.nan_to_num(sample.bone_tension).clip(0.0, self.robot.tension.limit)
        return float(sample.length[muscle] - self.mae.lengths(theta, pull)[muscle])
