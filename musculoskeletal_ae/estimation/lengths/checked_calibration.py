# SPDX-License-Identifier: Apache-2.0
"""A length calibration from its start until its offsets count as known.

`LengthCalibration` rejects offsets that do not explain the lengths and tensions. If an arm stands
still, some offsets explain its readings even if it does not stand in the stated posture. They then
count as known only if the joint sensors, where there are any, measure the stated posture.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.lengths.length_calibration import (
    LengthCalibration,
    stated_theta,
)
from musculoskeletal_ae.estimation.lengths.length_trust import Evidence
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.remedy import Step
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import LengthOffsets
from musculoskeletal_ae.signals.muscle_stream import MuscleSample
from musculoskeletal_ae.signals.wiring import WiringJudgement

SHIFTED = 0.02  # use an estimated offset if it differs by more than this from the one in use [m]
#: Reject a stated posture if a joint sensor differs by more than this [rad]. A larger difference is
#: due to a wrong posture or a faulty sensor.
STATED_ERROR = 0.2
#: compare the stated posture with the median of this number of measured postures, at least and at
#: most
LEAST, MOST = 10, 100


class CheckedCalibration:
    """Runs a length calibration, and decides when its offsets are used and count as known.

    Attributes:
        posture: The stated posture, as the constructor gets it.
    """

    def __init__(self, robot: Robot, mae: Mae | None, posture: tuple[float, ...] = ()) -> None:
        """Start a calibration.

        Args:
            robot: The nominal body.
            mae: The network; its isolated muscles are ignored.
            posture: Positions of the joints at which the arm stands [rad or m], (D,); () if it
                moves gently.

        Raises:
            MusculoskeletalError: If there is no network, if the posture is not valid, or if no
                posture is stated for a robot whose tensions are unknown.
        """
        if mae is None:
            raise MusculoskeletalError(
                'a length calibration requires a checkpoint; set the parameter `checkpoint`, or '
                'start the learner'
            )
        self.posture, self._stated = posture, stated_theta(robot, posture)
        if not posture and not robot.tension_source.is_known:
            raise MusculoskeletalError(
                'without tensions (tension_source: none), lengths can be calibrated only in a '
                'known posture; hold the arm still and set the parameter zero_posture'
            )
        self._robot = robot
        self._calibration = LengthCalibration(robot, mae, self._stated)
        self._used: Array | None = None  # offsets in use [m], (M,); None before the first estimate
        #: θ measured last while the arm stands [rad], (D,) each
        self._measured: deque[Array] = deque(maxlen=MOST)
        self._problem = ''  # why the stated posture is not that of the arm

    @property
    def is_standing(self) -> bool:
        """Whether the arm stands in a stated posture."""
        return self._calibration.is_standing

    @property
    def offsets(self) -> LengthOffsets | None:
        """The newest estimate of the offsets; None before the first.

        While the arm stands in a stated posture, nothing is estimated until the calibration has
        found the offsets and the joint sensors agree with the posture.
        """
        is_too_early = self.is_standing and not self._calibration.is_done
        return None if is_too_early or self._problem else self._calibration.offsets

    @property
    def progress(self) -> str:
        """Progress of the calibration and any problem, as a text for users."""
        return '; '.join(filter(None, (self._calibration.progress, self._problem)))

    @property
    def problem(self) -> str:
        """Why the calibration does not end although it has enough data, or ''."""
        return self._calibration.problem or self._problem

    @property
    def wiring(self) -> WiringJudgement | None:
        """What the newest fit tells about order and signs of the columns; None before the first."""
        return self._calibration.wiring

    @property
    def remedy(self) -> tuple[Step, ...]:
        """What a user must do before the lengths can be calibrated; () if the wiring is right."""
        return self._calibration.remedy

    @property
    def overtime(self) -> float:
        """Time for which the arm has moved or stood longer than required [s]."""
        return self._calibration.time - self._calibration.enough

    def step(self, sample: MuscleSample, dt: float, theta: Array | None) -> Evidence | None:
        """Continue the calibration with the readings of one message.

        Args:
            sample: The readings.
            dt: Time since the previous message [s].
            theta: Measured joint angles [rad], (D,), or None if they were not measured.

        Returns:
            CALIBRATING if `offsets` are to be used from now on, CALIBRATED if they also count as
            known, which ends the calibration, or None.
        """
        if self._problem:
            return None
        if self.is_standing and theta is not None:
            self._measured.append(theta)
        self._calibration.step(sample.motor_tension, sample.length_read, dt, theta)
        offsets = self.offsets
        if offsets is None:
            return None
        if self._calibration.is_done:
            self._problem = self._posture_problem()
            return None if self._problem else Evidence.CALIBRATED
        # Use the first estimate, and any other only after a substantial change.
        if self._used is None or np.abs(offsets.offset - self._used).max() > SHIFTED:
            self._used = offsets.offset
            return Evidence.CALIBRATING
        return None

    def _posture_problem(self) -> str:
        """Return why the arm does not stand in the stated posture, as a text for users, or ''."""
        if self._stated is None or len(self._measured) < LEAST:
            return ''
        measured = np.median(self._measured, axis=0)
        difference = np.abs(measured - self._stated)
        j = int(difference.argmax())
        if difference[j] <= STATED_ERROR:
            return ''
        text = self._robot.units[j].position_text
        return (
            f'zero_posture states {text(self._stated[j])} for {self._robot.joints[j]}, but '
            f'its sensor measures {text(measured[j])} (legal: a difference of at most '
            f'{text(STATED_ERROR, "g")}); correct zero_posture or the sensor, and call '
            'estimator/zero again'
        )
