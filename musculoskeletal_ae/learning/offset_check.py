# SPDX-License-Identifier: Apache-2.0
"""Length offsets are believed only if the arm's own messages agree with them.

    e = |l − o − ①(θ, T_end)|,   median over COUNT messages, of each muscle

θ is measured, or else restored by ②. New offsets o have to leave no more than WORSE times what the
offsets before left with the same network, or FLOOR if that is more. Whoever published them, an
estimator that was misled or a stranger, nothing is learned with offsets that do not agree.
"""

import math
from collections import deque

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.signals.body_state import LengthOffsets
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

SPACING, COUNT = 0.1, 20  # [s] between messages that are compared, and how many
WORSE = 2.0
#: [m] that is left by healthy networks: those that have learned this arm, and those that have not
FLOOR, FLOOR_UNLEARNED = 0.04, 0.1
SAME = 0.008  # [m] by which offsets of two calibrations of the same arm differ


class OffsetCheck:
    """Decides whether length offsets are believed.

    Attributes:
        is_believed: Whether they are. They are not while too few messages have come.
        problem: Why they are not believed, or ''.
    """

    def __init__(self, offsets: LengthOffsets) -> None:
        """Believe the first offsets: nothing else is known of the arm."""
        self._offsets = self._believed = offsets
        self._since = math.inf
        #: θ (NaN where it was not measured), T_end and l, with the offsets before and with these
        self._before: deque[tuple[Array, Array, Array]] = deque(maxlen=COUNT)
        self._now: deque[tuple[Array, Array, Array]] = deque(maxlen=COUNT)
        self.is_believed, self.problem = True, ''

    def use(self, offsets: LengthOffsets) -> None:
        """Go by other offsets, which may be unknown."""
        self._offsets = offsets
        self._now.clear()
        self.problem = ''
        change = np.abs(offsets.offset - self._believed.offset).max()
        self.is_believed = offsets.known and self._believed.known and bool(change <= SAME)
        if not offsets.known:  # what comes after it is another calibration
            self._believed = LengthOffsets(self._believed.offset, offsets.deviation)

    def forget(self) -> None:
        """Forget the messages, as after a backward jump of the clock."""
        self._now.clear()

    def step(self, mae: Mae | None, message: MuscleSample, theta: Array | None, dt: float) -> None:
        """Take a message, `dt` [s] after the one before, and θ [rad] (D,) where it was measured."""
        self._since += dt
        if self._since < SPACING - 1e-9 or mae is None or not self._offsets.known:
            return
        self._since = 0.0
        unknown = np.full(len(mae.joints), np.nan)
        row = (unknown if theta is None else theta, message.bone_tension, message.length)
        if self.is_believed:
            self._before.append(row)
            return
        self._now.append(row)
        if len(self._now) == COUNT:
            self._judge(mae)

    def _judge(self, mae: Mae) -> None:
        left = _left(mae, self._now)
        limit = np.full_like(left, FLOOR if mae.covariance is not None else FLOOR_UNLEARNED)
        if len(self._before) == COUNT:
            limit = np.maximum(FLOOR, WORSE * _left(mae, self._before))
        over = left / limit
        if over.max() > 1.0:
            m = int(over.argmax())
            self.problem = (
                f'the length zeros do not agree with the messages: {mae.muscles[m]} is off by '
                f'{1e3 * left[m]:.0f} mm, limit {1e3 * limit[m]:.0f} mm; call estimator/zero'
            )
            return
        self._believed, self.is_believed, self.problem = self._offsets, True, ''
        self._before = self._now.copy()


def _left(mae: Mae, rows: deque[tuple[Array, Array, Array]]) -> Array:
    """Return what is left of every length [m], (M,); 0 of isolated muscles."""
    theta, tension, length = map(np.array, zip(*rows, strict=True))
    is_measured = np.isfinite(theta).all(axis=1)
    if 2 * np.count_nonzero(is_measured) > len(rows):
        theta, tension, length = theta[is_measured], tension[is_measured], length[is_measured]
    else:
        theta = mae.estimate(tension, length).theta
    left: Array = np.median(np.abs(length - mae.lengths(theta, tension)), axis=0)
    left[list(mae.isolated)] = 0.0
    return left
