# SPDX-License-Identifier: Apache-2.0
"""A length calibration from its start until its offsets count as known.

`LengthCalibration` rejects offsets that do not explain the lengths and tensions. It cannot notice
that the arm does not stand in the stated posture. Joint sensors can: `JointDisagreement` compares
them with the lengths, by the same limits by which it would revoke the offsets later. The offsets
that the calibration has found therefore count as known only when the joint sensors agree. Without
joint sensors, they count as known at once.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.length_calibration import (
    LengthCalibration,
    check_stated_posture,
)
from musculoskeletal_ae.estimation.length_trust import Evidence
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import LengthOffsets
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

SHIFTED = 0.02  # use an estimated offset if it differs by more than this from the one in use [m]
MEASURED = 1.0  # count joints as measured up to this time after the last measured angles [s]
#: wait for this time before the joint sensors are compared with the offsets [s], because
#: `JointDisagreement` uses the median of the lengths over the last second
SETTLED = 1.2
PATIENCE = 4.0  # report a problem if the joint sensors have not agreed after this time [s]
DISAGREES = (
    'the calibrated lengths disagree with the joint sensors; check the joint sensors and '
    'zero_posture, then call estimator/zero again'
)


class CheckedCalibration:
    """Runs a length calibration, and decides when its offsets are used and count as known.

    Attributes:
        posture: The stated posture of the arm [rad], (D,), or () if it moves gently.
    """

    def __init__(self, robot: Robot, mae: Mae | None, posture: tuple[float, ...] = ()) -> None:
        """Start a calibration.

        Args:
            robot: The nominal body.
            mae: The network; its isolated muscles are ignored.
            posture: θ in which the arm stands [rad], (D,); () if it moves gently.

        Raises:
            MusculoskeletalError: If there is no network, if the posture is not valid, or if no
                posture is stated for a robot whose tensions are unknown.
        """
        if mae is None:
            raise MusculoskeletalError(
                'a length calibration requires a checkpoint; set the parameter `checkpoint`, or '
                'start the learner'
            )
        check_stated_posture(robot, posture)
        if not posture and not robot.tension_source.is_known:
            raise MusculoskeletalError(
                'without tensions (tension_source: none), lengths can be calibrated only in a '
                'known posture; hold the arm still and set the parameter zero_posture'
            )
        self.posture = posture
        stated = np.array(posture) if posture else None
        self._calibration = LengthCalibration(robot, mae, stated)
        self._used: Array | None = None  # offsets in use [m], (M,); None before the first estimate
        self._found_time = 0.0  # time since the calibration has found offsets [s]
        self._problem = ''  # why these do not count as known

    @property
    def is_standing(self) -> bool:
        """Whether the arm stands in a stated posture."""
        return self._calibration.is_standing

    @property
    def offsets(self) -> LengthOffsets | None:
        """The newest estimate of the offsets; None before the first.

        While the arm stands in a stated posture, nothing is estimated until the calibration has
        found the offsets.
        """
        is_too_early = self.is_standing and not self._calibration.is_done
        return None if is_too_early else self._calibration.offsets

    @property
    def progress(self) -> str:
        """Progress of the calibration and any problem, as a text for users."""
        return '; '.join(filter(None, (self._calibration.progress, self._problem)))

    @property
    def problem(self) -> str:
        """Why the calibration does not end although it has enough data, or ''."""
        return self._calibration.problem or self._problem

    def step(
        self,
        sample: MuscleSample,
        dt: float,
        theta: Array | None,
        unmeasured_time: float,
        agrees: bool,
    ) -> Evidence | None:
        """Continue the calibration by one message.

        Args:
            sample: The readings.
            dt: Time since the previous message [s].
            theta: Measured joint angles [rad], (D,), or None if they were not measured.
            unmeasured_time: Time since joint angles were last measured [s]; infinite without joint
                sensors.
            agrees: Whether the lengths agree with the joint sensors.

        Returns:
            CALIBRATING if `offsets` are to be used from now on, CALIBRATED if they also count as
            known, which ends the calibration, or None.
        """
        self._calibration.step(sample.model_tension, sample.length_read, dt, theta)
        offsets = self.offsets
        if offsets is None:
            return None
        used, is_found = self._used, self._calibration.is_done
        has_just_been_found = is_found and self._found_time == 0.0
        if is_found:
            self._found_time += dt
            is_measured = unmeasured_time < MEASURED
            if not is_measured or (agrees and self._found_time > SETTLED):
                return Evidence.CALIBRATED
            self._problem = DISAGREES if self._found_time > PATIENCE else ''
        # Use the first and the last estimate, and any other only after a substantial change.
        has_shifted = used is None or np.abs(offsets.offset - used).max() > SHIFTED
        if has_shifted or has_just_been_found:
            self._used = offsets.offset
            return Evidence.CALIBRATING
        return None
