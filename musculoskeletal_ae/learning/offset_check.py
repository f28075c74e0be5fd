# SPDX-License-Identifier: Apache-2.0
"""Checks new length offsets against the arm's own messages.

    e = |l − o − ①(θ, T_end)|,   median over COUNT messages, for each muscle

l − o is the measured length with the new offsets o. ①(θ, T_end) is the length that the network
predicts for the measured θ, or for θ estimated from T_end and l − o if it was not measured. New
offsets are accepted if e is at most LARGEST_RATIO times the error with the previous offsets and the
same network, or at most LEARNED_ERROR. With fewer than COUNT messages under the previous offsets,
the limit of e is LEARNED_ERROR for a network that has learned an arm, and UNLEARNED_ERROR for any
other network.

Offsets within CALIBRATION_SPREAD of the accepted ones are accepted without a comparison, unless the
offsets were unknown in between. Learning pauses while the published offsets disagree with the
messages, whichever node published them.
"""

import math
from collections import deque

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.signals.body_state import LengthOffsets
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

SPACING = 0.1  # time between compared messages [s]
COUNT = 20  # number of compared messages
LARGEST_RATIO = 2.0  # largest accepted error, relative to the error with the previous offsets
LEARNED_ERROR = 0.04  # largest accepted error if the network has learned an arm [m]
UNLEARNED_ERROR = 0.1  # largest accepted error if the network has not learned an arm [m]
#: largest difference between two correct calibrations of the same arm [m]
CALIBRATION_SPREAD = 0.008


class OffsetCheck:
    """Decides whether length offsets are plausible.

    Attributes:
        is_believed: Whether the offsets are accepted.
        problem: Why they are rejected, or ''.
    """

    def __init__(self, offsets: LengthOffsets) -> None:
        """Accept the first offsets, because there is nothing to compare them with."""
        self._offsets = self._believed = offsets
        self._since = math.inf
        #: θ (NaN if it was not measured), T_end and l of recent messages with the previous offsets
        self._before: deque[tuple[Array, Array, Array]] = deque(maxlen=COUNT)
        #: the same quantities with the new offsets
        self._now: deque[tuple[Array, Array, Array]] = deque(maxlen=COUNT)
        self.is_believed, self.problem = True, ''

    def use(self, offsets: LengthOffsets) -> None:
        """Check these offsets from now on; unknown offsets are allowed, but never accepted."""
        self._offsets = offsets
        self._now.clear()
        self.problem = ''
        change = np.abs(offsets.offset - self._believed.offset).max()
        is_same = bool(change <= CALIBRATION_SPREAD)
        self.is_believed = offsets.known and self._believed.known and is_same
        if not offsets.known:  # the next calibration is checked even if it gives the same offsets
            self._believed = LengthOffsets(self._believed.offset, offsets.deviation)

    def forget(self) -> None:
        """Discard the messages, for example after a backward jump of the clock."""
        self._now.clear()

    def step(self, mae: Mae | None, message: MuscleSample, theta: Array | None, dt: float) -> None:
        """Record a message. After COUNT messages, new offsets are accepted or rejected.

        Args:
            mae: The network in use; None before the first.
            message: The message.
            theta: Measured θ [rad], (D,), or None.
            dt: Time since the previous message [s].
        """
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
        error = _length_error(mae, self._now)
        accepted = LEARNED_ERROR if mae.covariance is not None else UNLEARNED_ERROR
        limit = np.full_like(error, accepted)
        if len(self._before) == COUNT:
            limit = np.maximum(LEARNED_ERROR, LARGEST_RATIO * _length_error(mae, self._before))
        excess = error / limit
        if excess.max() > 1.0:
            m = int(excess.argmax())
            self.problem = (
                f'the length offsets disagree with the messages: the length of {mae.muscles[m]} is '
                f'off by {1e3 * error[m]:.0f} mm; legal: at most {1e3 * limit[m]:.0f} mm; call '
                'estimator/zero'
            )
            return
        self._believed, self.is_believed, self.problem = self._offsets, True, ''
        self._before = self._now.copy()


def _length_error(mae: Mae, rows: deque[tuple[Array, Array, Array]]) -> Array:
    """Return the median length error e of each muscle [m], (M,); 0 for isolated muscles."""
    theta, tension, length = map(np.array, zip(*rows, strict=True))
    is_measured = np.isfinite(theta).all(axis=1)
    if 2 * np.count_nonzero(is_measured) > len(rows):
        theta, tension, length = theta[is_measured], tension[is_measured], length[is_measured]
    else:
        theta = mae.estimate(tension, length).theta
    error: Array = np.median(np.abs(length - mae.lengths(theta, tension)), axis=0)
    error[list(mae.isolated)] = 0.0
    return error
