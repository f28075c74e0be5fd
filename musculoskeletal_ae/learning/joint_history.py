# SPDX-License-Identifier: Apache-2.0
"""Removes the angles of joint sensors from samples while the estimator does not use the sensors.

The estimator doubts a sensor some time after its fault, and publishes when the doubt begins
(`signals/joint_trust.py`). Samples of the doubtful time then lose the angle of this joint. They
keep tensions, lengths and the other angles. What happens next depends on the estimator:

    trusted again        the sensor was false in the meantime, so these angles stay unknown
    confirmed by user    the doubt was wrong, so the samples get their angles back
"""

from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.signals.joint_trust import JointTrust, SensorTrust


class JointHistory:
    """Removes angles from the samples of one store, and puts them back.

    Attributes:
        given_up: Number of angles that were removed from samples and have not been put back.
    """

    def __init__(self, samples: SampleStore, joint_count: int) -> None:
        """Start with sensors that are all trusted."""
        self._samples = samples
        self._trust = JointTrust.full(joint_count)
        #: angles that were removed [rad], by number of the sample, for each unused joint
        self._removed: dict[int, dict[int, float]] = {}
        self.given_up = 0

    def use(self, trust: JointTrust) -> tuple[int, ...]:
        """Use another trust: remove or put back angles; return the newly unused joints."""
        before, self._trust = self._trust, trust
        new = tuple(j for j in trust.unused if before.is_used[j])
        for j in new:
            self._removed[j] = self._samples.remove_angles(j, trust.since[j])
            self.given_up += len(self._removed[j])
        for j in [j for j in self._removed if trust.is_used[j]]:
            removed = self._removed.pop(j)
            if trust.trust[j] is SensorTrust.CONFIRMED and before.trust[j] is SensorTrust.DOUBTED:
                self.given_up -= self._samples.set_angles(j, removed)
        return new
