# SPDX-License-Identifier: Apache-2.0
"""Drops or corrects samples that were taken under wrong length offsets or with false joint sensors.

`OffsetHistory` tracks the length offsets of samples.

A finding may revoke the offsets, because lengths have jumped or disagree with the joint sensors.
The finding comes some time after the fault. Therefore the samples of the last seconds are held
back until the next length calibration:

    same offsets         the finding was false, so the samples are used again
    other offsets        the samples are dropped, because it is unknown which of them are wrong

Offsets may also have been wrong from the start, for example after a bad calibration. This is
certain if a new calibration gives different offsets although no length has jumped and no message
was missed: the muscle modules cannot have lost their position then. Samples taken under the wrong
offsets are corrected.

`JointHistory` removes the angles of joint sensors from samples while the estimator does not use the
sensors. The estimator doubts a sensor some time after its fault, and publishes when the doubt
begins (`signals/joint_trust_message.py`). Samples of the doubtful time then lose the angle of this
joint. They keep tensions, lengths and the other angles. What happens next depends on the estimator:

    trusted again        the sensor was false in the meantime, so these angles stay unknown
    confirmed by user    the doubt was wrong, so the samples get their angles back
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.signals.joint_trust_message import JointTrust, SensorTrust
from musculoskeletal_ae.signals.limits import LIMITS

#: conclude that length offsets have changed only if two calibrations differ by more than this [m]
CALIBRATION_SPREAD = 0.008
#: hold back samples taken up to this long before length offsets were revoked [s], because the
#: offsets may already have been wrong
HELD_TIME = 5.0
#: Correct samples for a changed offset only if the change exceeds this [m]: such a jump would have
#: been detected, so the offset was wrong from the start.
DETECTED_JUMP = LIMITS.step + LIMITS.speed * LIMITS.longest_step


class OffsetHistory:
    """Drops or corrects the samples of one store when its length offsets change.

    Attributes:
        dropped: Number of samples dropped because their length offsets were revoked.
        corrected: Number of samples whose lengths were corrected for offsets wrong from the start.
    """

    def __init__(self, samples: SampleStore, offset: Array) -> None:
        """Start with the present offsets [m], (M,).

        If the learner was restarted while it held back samples, start with the offsets under which
        those samples were taken instead.
        """
        self._samples = samples
        self._offset = samples.held_offset if samples.held else offset
        #: number of the first sample that was taken under the present offsets
        self._first = samples.accepted + 1
        self._is_revoked = bool(samples.held)
        self._is_continuous = True  # whether no jump or gap has occurred since `_first`
        self.dropped = self.corrected = 0

    def interrupt(self) -> None:
        """Record a jump or gap, after which the muscle modules may have lost their position."""
        self._is_continuous = False

    def revoke(self, now: float) -> None:
        """Hold back recent samples, because a finding at `now` [s] has revoked the offsets."""
        if not self._is_revoked:
            self._samples.hold(now - HELD_TIME, now, self._offset)
        self._is_revoked = True

    def use(self, offset: Array) -> None:
        """Use known offsets [m] (M,) from now on.

        If they equal the previous offsets, samples that were held back are used again. Otherwise
        these samples are dropped. If the previous offsets were wrong from the start, all samples
        that were taken under them are corrected.
        """
        change = self._offset - offset
        size = float(np.nanmax(np.abs(change)))  # NaN for a muscle that was added at a restart
        if size <= CALIBRATION_SPREAD:
            self._samples.put_back_held()
        else:
            self.dropped += self._samples.drop_held()
            if self._is_continuous and not self._is_revoked and size > DETECTED_JUMP:
                self.corrected += self._samples.lengthen(change, self._first)
            else:
                self._first = self._samples.accepted + 1
        if size > CALIBRATION_SPREAD or self._is_revoked:
            self._is_continuous = True
        self._offset, self._is_revoked = offset, False


class JointHistory:
    """Removes angles from the samples of one store, and puts them back."""

    def __init__(self, samples: SampleStore, joint_count: int) -> None:
        """Start with sensors that are all trusted."""
        self._samples = samples
        self._trust = JointTrust.full(joint_count)
        #: angles that were removed [rad], by number of the sample, for each unused joint
        self._removed: dict[int, dict[int, float]] = {}

    def use(self, trust: JointTrust) -> tuple[int, ...]:
        """Use another trust: remove or put back angles; return the newly unused joints."""
        before, self._trust = self._trust, trust
        new = tuple(j for j in trust.unused if before.is_used[j])
        for j in new:
            self._removed[j] = self._samples.remove_angles(j, trust.since[j])
        for j in [j for j in self._removed if trust.is_used[j]]:
            removed = self._removed.pop(j)
            if trust.trust[j] is SensorTrust.CONFIRMED and before.trust[j] is SensorTrust.DOUBTED:
                self._samples.set_angles(j, removed)
        return new
