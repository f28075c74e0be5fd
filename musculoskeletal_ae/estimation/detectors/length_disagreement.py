# SPDX-License-Identifier: Apache-2.0
"""Detects muscle lengths that contradict the joint sensors.

    g = l − l_net(θ, T_end)
    Δ = g − g_usual

l are the measured muscle lengths. l_net are the lengths that the network computes from the joint
angles θ of the joint sensors and the bone-side tensions T_end. g is the median over the last
second, and g_usual the median of g in healthy messages.

If all joints are measured, g is the error of every muscle's length. On a healthy arm it is small
and changes little with the posture. When the length offset of a module jumps or drifts, g changes
by as much as the offset.

A joint sensor with an offset δθ changes g as well, but like a change of posture: Δ = −G δθ, where G
is the muscle Jacobian ∂l/∂θ. Because muscles outnumber joints, arbitrary errors of lengths rarely
have this form. If some δθ explains most of Δ, and more of it than a wrong length of one muscle, the
joint sensors are false: nothing is reported here, and `joint_sensor_trust.py` decides. Otherwise,
the lengths are reported. If only one length disagrees with θ, only its muscle is reported.

A healthy tendon that is shorter than l_net is stretched and has tension. If a tendon is shorter but
has no tension, it is ruptured. Its muscle is reported, provided that the lengths of all other
muscles agree with θ. This is how a rupture is detected while no commands arrive.
"""

from collections import deque
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.finding import Detector, Finding, Observation
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_stream import MuscleSample
from musculoskeletal_ae.signals.reading_limits import slack_tension

SPACING = 0.1  # compare measured and computed lengths at this interval [s]
COUNT = 10  # take the median of this many comparisons, so that single outliers do not matter
#: report lengths once their differences have exceeded the limits for this long [s]
LASTING = 1.0


class Largest(NamedTuple):
    """Largest tolerated differences between measured lengths and those that a network computes.

    A number applies to all muscles; an array has a value for each muscle, (M,).
    """

    single: Array | float  # largest difference of a single muscle [m]
    all: Array | float  # largest root mean square of the differences of all muscles in use [m]

    def excess(self, change: Array, used: Bools) -> float:
        """Return the ratio of length differences to these limits; legal: at most 1.

        Args:
            change: Difference of each length [m], (M,).
            used: The muscles in use, (M,).
        """
        size = float(np.sqrt(np.square((change / self.all)[used]).mean())) if used.any() else 0.0
        return max(float(np.abs(change / self.single).max()), size)

    def text(self, change: Array, used: Bools, muscle: int) -> str:
        """Return the difference of a muscle and that of all muscles, with limits, for users.

        Args:
            change: Difference of each length [m], (M,).
            used: The muscles in use, (M,).
            muscle: Index of the muscle.
        """
        single, together = (np.broadcast_to(limit, change.shape) for limit in self)
        size = float(np.sqrt(np.square(change[used]).mean()))
        return (
            f'{1e3 * change[muscle]:.0f} mm (limit {1e3 * single[muscle]:.0f} mm); root mean '
            f'square over all muscles: {1e3 * size:.0f} mm (limit {1e3 * together.min():.0f} mm)'
        )


# Largest values on healthy exploring Musashi arms. Half of the arms were of emulator model
# `foreign`, and some had a load of 3.6 kg and were pushed. The first value of each pair is the one
# of a single muscle, and the second is the root mean square over all muscles:
#
#     initial networks                     Δ 0.036 m, 0.019 m     g 0.051 m, 0.029 m
#     after 20 to 60 s of learning         Δ 0.032 m, 0.013 m
#     networks with a calibrated detector  Δ 0.013 m, 0.006 m     g 0.013 m, 0.006 m
#
# The limits for calibrated networks detect an error of 0.05 m of a single muscle in every posture.
#: with a network whose detector is not calibrated, tolerate this change Δ of the difference between
#: measured and computed lengths
CHANGE_YOUNG = Largest(0.06, 0.028)
#: with such a network, tolerate this difference g between measured and computed lengths while the
#: usual difference is not known
GAP_YOUNG = Largest(0.08, 0.045)
#: with a network whose detector is calibrated, tolerate this change Δ, and this difference g while
#: the usual difference is not known
LEARNED = Largest(0.035, 0.016)
#: Store a healthy message at this interval [s]. The stored messages show the usual difference
#: between measured and computed lengths.
HEALTHY_SPACING = 1.0
HEALTHY_COUNT = 60  # keep at most this many healthy messages; they span a minute
ENOUGH = 5  # treat the usual difference as unknown with fewer healthy messages than this
#: treat a message as healthy if no change Δ exceeds this multiple of its limit; the value is low,
#: so that the usual difference does not follow a drift
HEALTHY_EXCESS = 0.5
#: blame the joint sensors only if an error of their angles leaves at most this share of the changes
#: Δ unexplained
UNEXPLAINED = 0.5


class LengthDisagreement(Detector):
    """Reports muscle lengths that contradict the joint sensors."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._mae: Mae | None = None
        self._used: Bools = np.ones(robot.muscle_count, dtype=bool)
        #: measured minus computed length of each muscle [m], (M,), as the median over the last
        #: second; 0 for isolated muscles; None without measurements of all joints
        self._gap: Array | None = None
        #: θ, T_end and l of healthy messages, from which g_usual of any network follows; l is NaN
        #: for muscles that were isolated
        self._healthy: deque[tuple[Array, Array, Array]] = deque(maxlen=HEALTHY_COUNT)
        self._usual: Array = np.zeros(robot.muscle_count)  # g_usual [m], (M,); 0 if unknown
        #: for which muscles the usual difference g_usual is known, (M,)
        self._has_usual: Bools = np.zeros(robot.muscle_count, dtype=bool)
        self._healthy_time = 0.0  # time since a message was last added to `_healthy` [s]
        self.reset()

    def use(self, mae: Mae) -> None:
        """Use another network to compute lengths; its isolated muscles are ignored."""
        self._mae = mae
        self._used = ~np.isin(np.arange(self._robot.muscle_count), mae.isolated)
        self.reset()
        self._compute_usual()

    def reset(self) -> None:
        """Reset the detector: discard messages of the last second, keep healthy messages."""
        self._recent: deque[Array] = deque(maxlen=COUNT)
        self._since, self._beyond = 0.0, 0.0
        self._gap = None

    def forget(self) -> None:
        """Forget all messages, also the healthy ones, because the length offsets have changed."""
        self.reset()
        self._healthy.clear()
        self._compute_usual()

    def _compute_usual(self) -> None:
        """Compute g_usual of each muscle from the messages in which it was in use."""
        self._usual = np.zeros(self._robot.muscle_count)
        self._has_usual = np.zeros(self._robot.muscle_count, dtype=bool)
        if len(self._healthy) < ENOUGH or self._mae is None:
            return
        theta, tension, length = map(np.array, zip(*self._healthy))
        gap = length - self._mae.lengths(theta, tension)
        self._has_usual = self._used & (np.count_nonzero(np.isfinite(gap), axis=0) >= ENOUGH)
        self._usual[self._has_usual] = np.nanmedian(gap[:, self._has_usual], axis=0)

    def step(self, observation: Observation) -> Finding | None:
        """Report lengths if they have contradicted the joint sensors for more than 1 s.

        The result is None if there is nothing to report.
        """
        self._since += observation.dt
        if self._since < SPACING - 1e-9 or self._mae is None:
            return None
        if observation.measured is None:  # compare as soon as there is a fresh reading again
            if self._since > (COUNT + 1) * SPACING:  # earlier values are out of date
                self._recent.clear()
                self._gap, self._beyond = None, 0.0
            return None
        dt, self._since = self._since, 0.0
        sample, theta = observation.sample, observation.measured
        self._recent.append(sample.length - self._mae.lengths(theta, sample.bone_tension))
        if len(self._recent) < COUNT:
            return None
        self._gap = np.median(np.array(self._recent), axis=0) * self._used
        excess = self._excess(self._gap)
        self._beyond = self._beyond + dt if excess > 1.0 else 0.0
        if not observation.lengths_known:
            return None
        known = self._used & self._has_usual
        if excess <= 1.0 and self._excess(self._gap * known) <= HEALTHY_EXCESS:
            self._note_healthy(theta, sample, dt)
        return self._finding(observation) if self._beyond > LASTING else None

    def _note_healthy(self, theta: Array, sample: MuscleSample, dt: float) -> None:
        self._healthy_time += dt
        if self._healthy_time >= HEALTHY_SPACING - 1e-9:
            self._healthy_time = 0.0
            length = np.where(self._used, sample.length, np.nan)
            self._healthy.append((theta, np.nan_to_num(sample.bone_tension), length))
            self._compute_usual()

    def _change(self, gap: Array) -> tuple[Array, Largest]:
        """Return the change of each length difference since the arm was healthy, with its limits.

        For a muscle without enough healthy messages, such as one that was isolated for a minute,
        the healthy difference is assumed to be 0, and the limits are GAP_YOUNG or LEARNED.

        Args:
            gap: Measured minus computed lengths [m], (M,).

        Returns:
            The change of each difference [m], (M,), and the limits of these changes.
        """
        assert self._mae is not None
        is_learned = self._mae.is_calibrated
        limits = (LEARNED, LEARNED) if is_learned else (CHANGE_YOUNG, GAP_YOUNG)
        single, together = (np.where(self._has_usual, *pair) for pair in zip(*limits, strict=True))
        return gap - self._usual, Largest(single, together)

    def _excess(self, gap: Array) -> float:
        change, largest = self._change(gap)
        return largest.excess(change, self._used)

    def _finding(self, observation: Observation) -> Finding | None:
        assert self._mae is not None
        assert self._gap is not None
        assert observation.measured is not None
        change, largest = self._change(self._gap)
        muscle = int(np.abs(change).argmax())
        if self._is_ruptured(muscle, observation.sample, change, largest):
            short = f'{-1e3 * change[muscle]:.0f} mm shorter than expected in the measured posture'
            return Finding(
                muscle, ConditionKind.SLACK_TENDON, f'it has no tension, although it is {short}'
            )
        tension = observation.sample.bone_tension
        jacobian = self._mae.muscle_jacobian(observation.measured, tension)
        jacobian = jacobian * self._used[:, None]
        shift = np.linalg.lstsq(jacobian, -change, rcond=None)[0]
        unexplained = change + jacobian @ shift
        evidence = (
            'length differs from the length expected in the measured posture by '
            f'{largest.text(change, self._used, muscle)}'
        )
        by_muscle = np.delete(change, muscle)  # what remains unexplained if this length is wrong
        limit = min(UNEXPLAINED * np.linalg.norm(change), np.linalg.norm(by_muscle))
        if np.linalg.norm(unexplained) <= limit:
            return None  # joint sensors are false; `joint_sensor_trust.py` judges them
        is_alone = self._others_agree(muscle, change, largest)
        kind = ConditionKind.LENGTH_DISAGREES if is_alone else ConditionKind.LENGTHS_DISAGREE
        return Finding(muscle, kind, f'its {evidence}')

    def _others_agree(self, muscle: int, change: Array, largest: Largest) -> bool:
        """Return whether the lengths of all muscles but one agree with the measured posture."""
        is_other = np.arange(len(change)) != muscle
        return largest.excess(change * is_other, self._used & is_other) <= 1.0

    def _is_ruptured(
        self, muscle: int, sample: MuscleSample, change: Array, largest: Largest
    ) -> bool:
        """Return whether a tendon is ruptured: it alone is too short, and has no tension.

        Args:
            muscle: Index of the muscle whose length differs most.
            sample: The readings.
            change: Change of each length difference since the arm was healthy [m], (M,).
            largest: The limits of these differences.
        """
        lowest = slack_tension(self._robot.tension.bias[muscle])
        is_slack = sample.motor_tension[muscle] < lowest
        others_agree = self._others_agree(muscle, change, largest)
        return bool(is_slack and change[muscle] < 0.0 and others_agree)
