# SPDX-License-Identifier: Apache-2.0
"""Detects a sensor whose reading stays exactly the same while its muscle moves.

The readings of a working sensor contain noise. Therefore a constant reading is a fault even if it
hardly disturbs the estimate. The other muscles show whether the muscle moves.
"""

from dataclasses import dataclass

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.finding import Detector, Finding, Observation
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.reading_limits import slack_tension

FROZEN_TIME = 1.0  # suspect a sensor whose reading has stayed the same for this long [s]
#: report a constant tension near T_bias only if this sensor usually has noise there: more than the
#: share NOISY of at least ENOUGH messages near T_bias differed from the message before
NOISY, ENOUGH = 0.9, 1000
#: report a constant reading once the other muscles show that this muscle's length must have changed
#: by more than this [m]
MOVED = 0.006


@dataclass
class _Observed:
    """A muscle with a constant reading, and its lengths that the other muscles have shown so far.

    Attributes:
        mae: The network without this muscle.
        shortest: Its shortest predicted length [m].
        longest: Its longest predicted length [m].
    """

    mae: Mae
    shortest: float = np.inf
    longest: float = -np.inf


class FrozenSensor(Detector):
    """Reports a muscle whose length or tension reading is constant although the muscle moves.

    The lengths of the other muscles show whether it moves. If several muscles have constant
    readings, as sound sensors without noise have at a standing winch, each message examines the
    next of them, so that no message takes longer to check.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._mae: Mae | None = None
        self._last: Array | None = None  # last readings of length and tension, (2, M)
        #: time for which the readings of length and tension have not changed [s]
        self._unchanged_time: Array = np.zeros((2, robot.muscle_count))
        #: for each tension reading, the numbers of messages near T_bias in which it stayed the
        #: same, in which it changed, and in which it has stayed the same since the last change,
        #: (3, M)
        self._near_bias: Array = np.zeros((3, robot.muscle_count))
        self._observed: dict[int, _Observed] = {}  # muscles with constant readings, by index
        self._examined = -1  # index of the muscle that was examined last

    def use(self, mae: Mae) -> None:
        """Use another network to predict lengths; its isolated muscles are ignored."""
        self._mae = mae
        self._observed = {}

    def reset(self) -> None:
        """Reset the detector: measure anew how long readings have been constant."""
        self._last = None
        self._unchanged_time[:] = 0.0
        self._observed = {}

    def step(self, observation: Observation) -> Finding | None:
        """Report a muscle whose reading is constant although the muscle moves.

        The result is None if there is no such muscle.
        """
        sample, robot = observation.sample, self._robot
        tension, mae = sample.motor_tension, self._mae
        readings = np.array([sample.length_read, tension])
        is_same = readings == self._last if self._last is not None else np.zeros_like(readings)
        if not robot.tension_source.is_known:  # an unknown tension does not count as frozen
            is_same[1] = 0.0
        slack = slack_tension(robot.tension.bias)
        is_near_bias = (np.abs(tension - robot.tension.bias) <= slack) & sample.usable
        # Messages with the present value are counted only when the reading changes again. Otherwise
        # a frozen sensor would look like one that never had noise.
        same, changed, now = self._near_bias
        has_changed = is_same[1] == 0.0
        same, changed = same + now * has_changed, changed + (has_changed & is_near_bias)
        self._near_bias = np.array([same, changed, (now + is_near_bias) * ~has_changed])
        self._last = readings
        self._unchanged_time = (self._unchanged_time + observation.dt) * is_same
        if self._unchanged_time.max() < FROZEN_TIME or mae is None or not mae.is_calibrated:
            self._observed = {}
            return None
        # Slack tendons are left to `slack_tendon.py`. A constant tension of T_bias is no fault of a
        # simple module that always reports exactly T_bias.
        by_length, by_tension = self._unchanged_time
        has_noise = (same + changed >= ENOUGH) & (changed > NOISY * (same + changed))
        time = np.maximum(by_length, by_tension * (~is_near_bias | has_noise))
        time = time * (sample.usable & (tension > slack))
        constant = np.flatnonzero(time >= FROZEN_TIME).tolist() if observation.lengths_known else []
        self._observed = {m: each for m, each in self._observed.items() if m in constant}
        if not constant:
            return None
        muscle = next((m for m in constant if m > self._examined), constant[0])
        self._examined = muscle
        if muscle not in self._observed:
            self._observed[muscle] = _Observed(mae.without((*mae.isolated, muscle)))
        observed = self._observed[muscle]
        theta = observed.mae.estimate(sample.bone_tension, sample.length).theta
        pull = np.minimum(sample.bone_tension, robot.tension.limit) * sample.usable
        predicted = float(observed.mae.lengths(theta, pull)[muscle])
        observed.shortest = min(predicted, observed.shortest)
        observed.longest = max(predicted, observed.longest)
        if observed.longest - observed.shortest <= MOVED:
            return None
        quantity = 'length' if by_length[muscle] >= FROZEN_TIME else 'tension'
        evidence = f'its {quantity} reading stays exactly the same while the arm moves'
        return Finding(muscle, ConditionKind.SENSOR_FROZEN, evidence)
