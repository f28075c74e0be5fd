# SPDX-License-Identifier: Apache-2.0
"""Rupture or switch off each muscle in turn, run the detector, and count its alarms."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.estimation.estimate import estimate
from musculoskeletal_ae.estimation.finding import Observation
from musculoskeletal_ae.estimation.health import HealthMonitor
from musculoskeletal_ae.experiments.recording import (
    SAMPLE_TIME,
    Recording,
    columns,
    rows_between,
)
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.units import State
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.friction import directions
from musculoskeletal_ae.signals.muscle_states import MuscleReadings
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

PAYLOAD = 3.6  # let the arm grasp this mass, that of the paper's dumbbell (§IV-B) [kg]
GRASPING = 60.0  # grasp or release the payload at this interval [s]
#: a muscle carries tension if T exceeds T_bias by this much [N], far beyond the sensor's noise
CARRYING = 10.0
#: give each muscle this time to wait until it carries tension, rupture, be repaired and recover [s]
SLOT = 20.0
LATEST_RUPTURE = 14.0  # rupture a muscle no later than this after the beginning of its slot [s]
RUPTURE_TIME = 3.0  # repair a muscle this long after its rupture [s]
SLACKENING = 0.1  # expect a ruptured muscle to be slack this long after its rupture [s]
RECOVERY = 2.0  # let the arm swing back for this time after a repair [s]
#: wait for a random time of up to this before a rupture [s], so that muscles rupture both in motion
#: and at rest
LONGEST_WAIT = 5.0


class GraspAndRupture:
    """Script of a recording (paper, §IV-B): grasp a payload, then rupture muscles one by one.

    The arm grasps the payload in the middle of the motion and holds it from then on. After the
    motion, each muscle has a period of SLOT [s]. In this period, it ruptures as soon as it carries
    tension after a random wait, but no later than LATEST_RUPTURE [s]. `carried` states whether it
    carried tension when it ruptured. After another RUPTURE_TIME [s], it is repaired. With
    `switched_off`, the tendons stay intact, and the muscle modules are commanded zero tension for
    RUPTURE_TIME instead.

    Attributes:
        order: The muscles that rupture, in the order of their ruptures.
    """

    def __init__(
        self,
        robot: Robot,
        duration: float,
        seed: int,
        switched_off: bool = False,
        most: int | None = None,
        slot: float = SLOT,
    ) -> None:
        """Plan a motion, and the ruptures after it.

        Args:
            robot: The robot whose muscles rupture.
            duration: Duration of the motion [s].
            seed: Random seed of the waits before the ruptures.
            switched_off: Whether muscles are switched off instead of ruptured.
            most: Largest number of muscles to rupture; None for all of them.
            slot: Time for each muscle [s]; it shortens the longest wait for the rupture.
        """
        count, self._switched_off = robot.muscle_count, switched_off
        # time of the grasp, and duration of the motion [s]
        self.grasp, self._motion = 0.5 * duration, duration
        # Rows of the motion without the payload, and with the payload before the first rupture.
        self.free, self.loaded = rows_between(0.0, self.grasp), rows_between(self.grasp, duration)
        # Start with the second muscle, which the paper deactivates.
        self.order = [*range(min(1, count - 1), count), *range(min(1, count - 1))][:most]
        # time for each muscle, and latest rupture within it [s]
        self._slot, self._latest = slot, slot - (SLOT - LATEST_RUPTURE)
        self.duration = duration + slot * len(self.order)  # duration of the whole script [s]
        #: time of each muscle's rupture [s], (M,); NaN for muscles that do not rupture
        self.rupture = np.full(count, np.nan)
        #: whether each muscle carried tension when it ruptured, (M,)
        self.carried: Bools = np.zeros(count, dtype=bool)
        self._robot = robot
        self._wait = np.random.default_rng([seed, 0xC7]).uniform(0.0, LONGEST_WAIT, count)

    @property
    def muscles(self) -> list[int]:
        """The muscles that rupture, in the order of the robot."""
        return sorted(self.order)

    @property
    def counted(self) -> list[int]:
        """The `muscles` that carried tension when they ruptured; all of them if none did."""
        return [m for m in self.muscles if self.carried[m]] or self.muscles

    def while_ruptured(self, muscle: int) -> slice:
        """Return the slice of messages in which a muscle was ruptured and had lost its tension."""
        start = float(self.rupture[muscle])
        return rows_between(start + SLACKENING, start + RUPTURE_TIME)

    def disturbed(self, count: int) -> Bools:
        """Return a mask (count,) of messages during a rupture, or shortly after its repair."""
        disturbed = np.zeros(count, dtype=bool)
        for start in self.rupture[self.order].tolist():
            disturbed[rows_between(start, start + RUPTURE_TIME + RECOVERY)] = True
        return disturbed

    def __call__(self, arm: Arm, time: float) -> Bools | None:
        """Grasp the payload, and rupture or repair a muscle, when this is due at `time` [s].

        Returns:
            A mask (M,) of the muscles that are switched off, or None if none is; see
            `recording.Script`.
        """
        if abs(time - self.grasp) < 0.5 * SAMPLE_TIME:
            arm.set_payload(PAYLOAD)
        now = time + 1e-9
        place = int((now - self._motion) // self._slot)
        if not 0 <= place < len(self.order):
            return None
        muscle, elapsed = self.order[place], now - self._motion - self._slot * place
        if np.isnan(self.rupture[muscle]):
            carries = arm.tension[muscle] > self._robot.tension.bias[muscle] + CARRYING
            if elapsed >= self._latest or (carries and elapsed >= self._wait[muscle]):
                self.rupture[muscle], self.carried[muscle] = time, carries
                if not self._switched_off:
                    arm.set_faults([f'rupture:{self._robot.muscles[muscle]}'])
        elif abs(now - self.rupture[muscle] - RUPTURE_TIME) < 0.5 * SAMPLE_TIME:
            arm.set_faults([])
        start = self.rupture[muscle]
        if self._switched_off and start <= now < start + RUPTURE_TIME:
            return np.arange(len(self.rupture)) == muscle
        return None


def grasp_and_release(arm: Arm, time: float) -> None:
    """Let an arm grasp or release a payload, in turn, if a minute begins at `time` [s]."""
    turn, since = divmod(round(time / SAMPLE_TIME), round(GRASPING / SAMPLE_TIME))
    if since == 0:
        arm.set_payload(PAYLOAD if turn % 2 else 0.0)


class DetectorOutput(NamedTuple):
    """Outputs of estimator and detector for each of N messages."""

    theta: Array  # estimated joint angles θ [rad], (N, D)
    anomaly: Array  # anomaly A [scaled units], (N,)
    distance: Array  # distance d [healthy standard deviations], (N,)
    suspect: Ints  # index of the most suspect muscle, (N,)
    alarm: Bools  # whether the message completes a detection, (N,)


def observe(
    mae: Mae,
    length: Array,
    motor_tension: Array,
    bone_tension: Array,
    dt: float,
    demand: Array | None = None,
    state: State | None = None,
    command: Array | None = None,
) -> Observation:
    """Return the observation of recorded readings, whose temperatures are unknown.

    Args:
        mae: The network; its isolated muscles are ignored.
        length: Muscle lengths, with the length offsets removed [m], (M,).
        motor_tension: Motor-side tensions [N], (M,).
        bone_tension: Bone-side tensions [N], (M,).
        dt: Time since the previous message [s].
        demand: Tensions demanded of the modules [N], (M,), or None if they are unknown.
        state: The state that the network reconstructs from the readings; None to compute it here.
        command: Target lengths of the modules [m], (M,), or None without a length command.
    """
    unknown, usable = np.full(len(length), np.nan), np.ones(len(length), dtype=bool)
    usable[list(mae.isolated)] = False
    sample = MuscleSample(
        time=math.nan,
        length=length,
        length_read=length,
        tension_read=motor_tension,
        motor_tension=motor_tension,
        bone_tension=bone_tension,
        sliding=unknown,
        temperature=unknown,
        usable=usable,
        newest=MuscleReadings(length=length, tension=motor_tension),
    )
    estimated = estimate(mae, bone_tension, length, state)
    return Observation(sample, estimated, demand, dt, command=command)


def run_detector(
    robot: Robot, mae: Mae, recording: Recording, sliding: Array | None = None
) -> DetectorOutput:
    """Run estimator and detector on a recording; return their outputs for each message.

    Both run as in the estimator node, but they continue after an alarm.

    Args:
        robot: The robot that was recorded.
        mae: The network that the detector uses.
        recording: The recording of N messages.
        sliding: Sliding directions of the tendons, (N, M), if they are already known. They are the
            same for all networks.
    """
    health, rows = HealthMonitor(robot, mae.preset), []
    health.use(mae)
    sliding = directions(recording.length) if sliding is None else sliding
    bone_tensions = mae.transmission.end(recording.tension, sliding)
    restored = mae.estimate(bone_tensions, recording.length)
    tensions = mae.transmission.motor(recording.tension, sliding)
    messages = zip(recording.length, tensions, bone_tensions, strict=True)
    for n, (length, tension, bone_tension) in enumerate(messages):
        command = recording.command[n]
        demand = robot.actuation.demanded(length, command)
        state = State(*(part[n] for part in restored))
        message = observe(mae, length, tension, bone_tension, SAMPLE_TIME, demand, state, command)
        finding = health.step(message)
        reading = health.residual.reading
        assert reading is not None
        suspect = reading.suspect if finding is None else finding.muscle
        row = message.estimate.anomaly, reading.distance, suspect, finding is not None
        rows.append(row)
    return DetectorOutput(restored.theta, *columns(rows))


def detection(
    robot: Robot, plan: GraspAndRupture, faulty: DetectorOutput, healthy: DetectorOutput, mae: Mae
) -> dict[str, Any]:
    """Return the detection delays, the share of correctly named muscles, and the false alarms.

    The delay of a rupture that was not detected is its whole duration, RUPTURE_TIME [s].

    Args:
        robot: The robot, whose muscles have ruptured one by one.
        plan: The script that ruptured the muscles.
        faulty: Outputs of the detector for the recording with the ruptures.
        healthy: Outputs of the detector for a healthy recording.
        mae: The network of the detector.
    """
    delay = np.full(len(plan.rupture), RUPTURE_TIME)
    named, detected = np.zeros((2, len(plan.rupture)), dtype=bool)
    starts = alarm_starts(faulty.alarm)
    false = alarm_starts(faulty.alarm & ~plan.disturbed(len(faulty.alarm)))
    for muscle in plan.muscles:
        rupture = float(plan.rupture[muscle])
        rows = rows_between(rupture, rupture + RUPTURE_TIME)
        detected[muscle] = starts[rows].any()
        if detected[muscle]:
            at = int(starts[rows].argmax())
            delay[muscle] = SAMPLE_TIME * (at + 1)
            named[muscle] = faulty.suspect[rows][at] == muscle
    statistics, counted = mae.anomaly, plan.counted
    name = HealthMonitor(robot, mae.preset).residual.threshold_name
    by_muscle = {
        'carried': plan.carried,
        'detected': detected,
        'detection_s': delay,
        'named': named,
    }
    return {
        'threshold': float(statistics.thresholds.get(name, 0.0)) if statistics else 0.0,
        'calibrated': bool(statistics and statistics.calibrated),
        'detection_s': float(delay[counted].mean()),
        'detection_worst_s': float(delay[counted].max()),
        'detected_share': float(detected[counted].mean()),
        'named_share': float(named[counted].mean()),
        'counted_cuts': len(counted),
        'cuts': {
            robot.muscles[m]: {key: values[m].item() for key, values in by_muscle.items()}
            for m in plan.muscles
        },
        'false_alarms': int(alarm_starts(healthy.alarm).sum()),
        'false_alarms_beside_cuts': int(false.sum()),
        'healthy_s': SAMPLE_TIME * len(healthy.alarm),
    }


def anomaly_levels(
    plan: GraspAndRupture,
    faulty_outputs: Mapping[str, DetectorOutput],
    healthy_outputs: Mapping[str, DetectorOutput],
    fault: str,
) -> dict[str, Any]:
    """Return measures of the anomaly A and the distance d for healthy and for ruptured muscles.

    All measures exist before and after learning. They are the largest and the median value of
    healthy messages, the level of each rupture, the smallest level of the muscles in
    `plan.counted`, and the AUROC (`auroc`). The level of a rupture is the median of A or d over the
    messages of `GraspAndRupture.while_ruptured`. The levels have the order of `plan.muscles`.

    Args:
        plan: The script that ruptured the muscles.
        faulty_outputs: Outputs for its recording, by the networks 'before' and 'after' learning.
        healthy_outputs: Outputs for a healthy recording, by the same networks.
        fault: Name of the fault in the keys of the result.
    """
    numbers: dict[str, Any] = {}
    for when, prefix in (('before', '_before'), ('after', '')):
        for name, letter in (('anomaly', 'a'), ('distance', 'd')):
            values = getattr(faulty_outputs[when], name)
            before_faults = values[plan.free], values[plan.loaded]
            healthy = np.concatenate([*before_faults, getattr(healthy_outputs[when], name)])
            ruptures = {m: values[plan.while_ruptured(m)] for m in plan.muscles}
            levels = {m: float(np.median(rupture)) for m, rupture in ruptures.items()}
            faulty = np.concatenate([ruptures[m] for m in plan.counted])
            results = {
                'healthy_max': float(healthy.max()),
                'healthy_median': float(np.median(healthy)),
                f'{fault}_min': min(levels[m] for m in plan.counted),
                fault: list(levels.values()),
                f'{fault}_auroc': auroc(healthy, faulty),
            }
            numbers |= {f'{letter}{prefix}_{key}': value for key, value in results.items()}
    return numbers


def alarm_starts(alarm: Bools) -> Bools:
    """Return a mask of the messages at which an alarm starts; continued alarms do not count."""
    return alarm & ~np.append(False, alarm[:-1])


def auroc(healthy: Array, faulty: Array) -> float:
    """Return the probability that a faulty message scores above a healthy one.

    Equal scores count half. The result is 0.5 if either array is empty.
    """
    from scipy.stats import mannwhitneyu  # import only if needed: it takes 0.7 s

    pairs = len(healthy) * len(faulty)
    return float(mannwhitneyu(faulty, healthy).statistic / pairs) if pairs else 0.5
