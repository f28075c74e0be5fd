# SPDX-License-Identifier: Apache-2.0
"""Checks calibrated length offsets against the joint sensors, before they count as known.

A calibration rejects offsets that do not explain the lengths and tensions. It cannot notice that
the arm did not stand in the stated posture. Joint sensors can: `JointDisagreement` compares them
with the lengths by the same limits by which it would revoke the offsets later. Without joint
sensors, the offsets of a calibration count as known at once.
"""

MEASURED = 1.0  # count joints as measured up to this time after the last measured angles [s]
LONGEST = 3.0  # report a problem if the joint sensors have not agreed after this time [s]
DISAGREES = (
    'the calibrated lengths disagree with the joint sensors; check the joint sensors and '
    'zero_posture, then call estimator/zero again'
)


class CalibrationCheck:
    """Decides whether the offsets that a calibration has found may count as known.

    Attributes:
        has_begun: Whether the calibration has found offsets.
        problem: Why they do not count as known yet, as a text for users, or ''.
    """

    def __init__(self) -> None:
        self.has_begun, self.problem = False, ''
        self._time = 0.0  # time since the calibration has found offsets [s]

    def step(self, dt: float, unmeasured_time: float, agrees: bool) -> bool:
        """Return whether the offsets may count as known.

        Args:
            dt: Time since the previous message [s].
            unmeasured_time: Time since joint angles were last measured [s]; infinite without joint
                sensors.
            agrees: Whether the lengths agree with the joint sensors.
        """
        self._time += dt
        is_measured = unmeasured_time < MEASURED
        self.problem = DISAGREES if is_measured and self._time > LONGEST else ''
        return agrees or not is_measured
