# SPDX-License-Identifier: Apache-2.0
"""Detect that lengths and joint sensors no longer tell the same posture.

    g = l − ①(θ, T_end),   θ by joint sensors; g is the median of SPAN seconds
    Δ = g − what g usually is

Where all joints are measured, g says of every single muscle by how much its length is off. On a
healthy arm g is small, and changes little from posture to posture. Lengths of modules that lost
their count change it by as much as they are off, whether they jump or drift.

A joint sensor that is off changes g as well, but only as another posture would: Δ = −G δθ. Muscles
outnumber joints, and lengths that are off by chance are no other posture. Therefore whoever is
outvoted is not believed: if a δθ explains most of Δ, the lengths agree with each other and with the
network, and the joint sensor with the largest δθ is named. If not, the lengths are wrong.
"""

from collections import deque
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.estimation.finding import Detector, Finding, Kind, Observation
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

SPACING, COUNT = 0.1, 10  # [s] between values of g, and values that its median spans
LASTING = 1.0  # [s] for which Δ has to be too large


class Largest(NamedTuple):
    """What is too large of Δ, or of g itself while it is unknown what is usual."""

    single: float  # of one muscle [m]
    all: float  # root mean square over the muscles in use [m]

    def excess(self, change: Array, used: Bools) -> float:
        """Return by what share a change [m] (M,) is beyond that."""
        size = float(np.sqrt(np.square(change[used]).mean())) if used.any() else 0.0
        return max(float(np.abs(change).max()) / self.single, size / self.all)


# Healthy arms of Musashi, half of them `foreign`, exploring, some with 3.6 kg and pushed: networks
# of the geometric model changed by 0.036 m and 0.019 m from posture to posture, and were 0.051 m
# and 0.029 m off; those that had learned for 20 to 60 s changed by 0.032 m and 0.013 m.
CHANGE_YOUNG, GAP_YOUNG = Largest(0.06, 0.028), Largest(0.08, 0.045)
# By networks that have learned the arm for long enough to calibrate the detector of the residual:
# both were 0.013 m and 0.006 m at most. One muscle that is 0.05 m off is found in every posture.
CHANGE_LEARNED, GAP_LEARNED = Largest(0.035, 0.016), Largest(0.035, 0.016)
#: [s] between healthy messages that tell what g usually is, and how many are kept and are enough
HEALTHY_SPACING, HEALTHY_COUNT, ENOUGH = 1.0, 60, 5
CLEARLY = 0.5  # of what is too large, up to which a message is healthy: what drifts is not usual
EXPLAINED = 0.5  # share of Δ that a wrong joint sensor leaves unexplained at most


class JointDisagreement(Detector):
    """Compares the lengths with those of the measured posture.

    Attributes:
        gap: g [m], (M,); None without measurements.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._mae: Mae | None = None
        self._used: Bools = np.ones(robot.muscle_count, dtype=bool)
        self.gap: Array | None = None
        #: θ, T_end and l of healthy messages, which tell what g usually is with any network
        self._healthy: deque[tuple[Array, Array, Array]] = deque(maxlen=HEALTHY_COUNT)
        self._usual: Array | None = None
        self._healthy_time = 0.0  # [s] since the last of them
        self.reset()

    def use(self, mae: Mae) -> None:
        """Use this network, without the muscles that are isolated in it."""
        self._mae = mae
        self._used = ~np.isin(np.arange(self._robot.muscle_count), mae.isolated)
        self.reset()
        self._find_usual()

    def reset(self) -> None:
        """Forget the last messages. What is usual stays: nobody declares wrong lengths healthy."""
        self._recent: deque[Array] = deque(maxlen=COUNT)
        self._since, self._unmeasured, self._beyond = 0.0, 0.0, 0.0
        self.gap = None

    def forget(self) -> None:
        """Forget what is usual, too: lengths are measured from other offsets."""
        self.reset()
        self._healthy.clear()
        self._usual = None

    def _find_usual(self) -> None:
        if len(self._healthy) < ENOUGH or self._mae is None:
            return
        theta, tension, length = map(np.array, zip(*self._healthy))
        self._usual = np.median(length - self._mae.lengths(theta, tension), axis=0) * self._used

    @property
    def agrees(self) -> bool:
        """Whether the lengths are those of the measured posture; no without measurements."""
        return self.gap is not None and self._excess(self.gap) <= 1.0

    def step(self, observation: Observation) -> Finding | None:
        """Take a message."""
        self._since += observation.dt
        if self._since < SPACING - 1e-9 or self._mae is None:
            return None
        dt, self._since = self._since, 0.0
        if observation.measured is None:
            self._unmeasured += dt
            if self._unmeasured > COUNT * SPACING:  # of another posture by now
                self._recent.clear()
                self.gap, self._beyond = None, 0.0
            return None
        self._unmeasured = 0.0
        sample, theta = observation.sample, observation.measured
        self._recent.append(sample.length - self._mae.lengths(theta, sample.bone_tension))
        if len(self._recent) < COUNT:
            return None
        self.gap = np.median(np.array(self._recent), axis=0) * self._used
        excess = self._excess(self.gap)
        self._beyond = self._beyond + dt if excess > 1.0 else 0.0
        if not observation.lengths_known:
            return None
        if excess <= (1.0 if self._usual is None else CLEARLY):
            self._note_healthy(theta, sample, dt)
        return self._finding(observation) if self._beyond > LASTING else None

    def _note_healthy(self, theta: Array, sample: MuscleSample, dt: float) -> None:
        self._healthy_time += dt
        if self._healthy_time >= HEALTHY_SPACING - 1e-9:
            self._healthy_time = 0.0
            self._healthy.append((theta, sample.bone_tension, sample.length))
            self._find_usual()

    def _change(self, gap: Array) -> tuple[Array, Largest]:
        """Return Δ [m] (M,), and how large it may be."""
        assert self._mae is not None
        statistics = self._mae.anomaly
        has_learned = statistics is not None and statistics.calibrated
        if self._usual is None:
            return gap, GAP_LEARNED if has_learned else GAP_YOUNG
        return gap - self._usual, CHANGE_LEARNED if has_learned else CHANGE_YOUNG

    def _excess(self, gap: Array) -> float:
        change, largest = self._change(gap)
        return largest.excess(change, self._used)

    def _finding(self, observation: Observation) -> Finding:
        assert self._mae is not None
        assert self.gap is not None
        assert observation.measured is not None
        change, largest = self._change(self.gap)
        muscle = int(np.abs(change).argmax())
        tension = observation.sample.bone_tension
        jacobian = self._mae.muscle_jacobian(observation.measured, tension)
        jacobian = jacobian * self._used[:, None]
        shift = np.linalg.lstsq(jacobian, -change)[0]
        left = change + jacobian @ shift
        size = float(np.sqrt(np.square(change[self._used]).mean()))
        figures = (
            f'{1e3 * change[muscle]:.0f} mm, limit {1e3 * largest.single:.0f} mm, and all by '
            f'{1e3 * size:.0f} mm, limit {1e3 * largest.all:.0f} mm'
        )
        if np.linalg.norm(left) <= EXPLAINED * np.linalg.norm(change):
            radian = self._robot.kinematics.radian
            j = int(np.abs(shift / radian).argmax())
            evidence = (
                f'its length is off from that of the measured posture by {figures}, as if joint '
                f'sensor {self._robot.joints[j]} read {shift[j]:.2f} {self._robot.units[j].theta} '
                'too much'
            )
            return Finding(muscle, Kind.JOINT_SENSORS_DISAGREE, evidence)
        evidence = f'its length is off from that of the measured posture by {figures}'
        return Finding(muscle, Kind.LENGTHS_DISAGREE, evidence)
