# SPDX-License-Identifier: Apache-2.0
"""Muscles cut or switched off in turn, what the detector says of it, and how that is counted."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import mannwhitneyu

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.estimation.finding import observe
from musculoskeletal_ae.estimation.health import HealthMonitor
from musculoskeletal_ae.experiments.recording import (
    SAMPLE_TIME,
    Recording,
    columns,
    end_tensions,
    rows_between,
)
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.units import State
from musculoskeletal_ae.robot.robot import Robot

PAYLOAD = 3.6  # [kg], the printed dumbbell
GRASPING = 60.0  # [s] from grasp to release and from release to grasp
#: a muscle carries tension if it pulls this much more than T_bias, far beyond the sensor's noise
CARRYING = 10.0  # [N]
SLOT = 20.0  # [s] for each muscle: wait until it carries tension, cut, mend, recover
LATEST_CUT, CUT_TIME = 14.0, 3.0  # [s]
FALLEN = 0.1  # [s] after a cut, when no tension is left
RECOVERED = 2.0  # [s] after the mending, while the arm swings back
EARLIEST_CUT = 5.0  # [s] drawn uniformly up to it, so that cuts fall into motion and into rest


class GraspAndCut:
    """Script of the experiment (paper, §IV-B): grasp midway, then cut; here every muscle.

    A cut comes when the muscle carries tension; if it never does, it is cut all the same at the end
    of its wait, and `carried` says so. Muscles may be switched off instead: the wire is whole, and
    the module is commanded no tension.
    """

    def __init__(
        self, robot: Robot, duration: float, seed: int, switched_off: bool = False
    ) -> None:
        """Plan a motion of `duration` [s] and the cuts that follow it."""
        count, self._switched_off = robot.muscle_count, switched_off
        self.grasp, self._motion = 0.5 * duration, duration  # [s]
        self.duration = duration + SLOT * count  # of everything [s]
        # Messages of the motion without weight, and with it before the first cut.
        self.free, self.loaded = rows_between(0.0, self.grasp), rows_between(self.grasp, duration)
        # The second muscle first: it is the one that is deactivated in print.
        self.order = [*range(min(1, count - 1), count), *range(min(1, count - 1))]
        self.cut = np.full(count, np.nan)  # when each muscle was cut [s], (M,)
        self.carried: Bools = np.zeros(count, dtype=bool)  # whether it carried tension then, (M,)
        self._robot = robot
        self._wait = np.random.default_rng([seed, 0xC7]).uniform(0.0, EARLIEST_CUT, count)

    @property
    def counted(self) -> Ints:
        """Muscles that carried tension when they were cut; all if none did."""
        return np.flatnonzero(self.carried if self.carried.any() else ~self.carried)

    def while_cut(self, muscle: int) -> slice:
        """Return the messages while a muscle was cut and had no tension left."""
        cut = float(self.cut[muscle])
        return rows_between(cut + FALLEN, cut + CUT_TIME)

    def disturbed(self, count: int) -> Bools:
        """Return in which of so many messages a muscle is cut, or was until a moment ago."""
        disturbed = np.zeros(count, dtype=bool)
        for cut in self.cut.tolist():
            disturbed[rows_between(cut, cut + CUT_TIME + RECOVERED)] = True
        return disturbed

    def __call__(self, arm: Arm, time: float) -> Bools | None:
        """Grasp, cut or mend, if it is time to; see `recording.Script`."""
        if abs(time - self.grasp) < 0.5 * SAMPLE_TIME:
            arm.set_payload(PAYLOAD)
        now = time + 1e-9
        place = int((now - self._motion) // SLOT)
        if not 0 <= place < len(self.order):
            return None
        muscle, elapsed = self.order[place], now - self._motion - SLOT * place
        if np.isnan(self.cut[muscle]):
            carries = arm.tension[muscle] > self._robot.tension.bias[muscle] + CARRYING
            if elapsed >= LATEST_CUT or (carries and elapsed >= self._wait[muscle]):
                self.cut[muscle], self.carried[muscle] = time, carries
                if not self._switched_off:
                    arm.set_ruptured([self._robot.muscles[muscle]])
        elif abs(now - self.cut[muscle] - CUT_TIME) < 0.5 * SAMPLE_TIME:
            arm.set_ruptured([])
        if self._switched_off and self.cut[muscle] <= now < self.cut[muscle] + CUT_TIME:
            return np.arange(len(self.cut)) == muscle
        return None


def grasp_and_release(arm: Arm, time: float) -> None:
    """Grasp and release every minute; see `recording.Script`."""
    turn, since = divmod(round(time / SAMPLE_TIME), round(GRASPING / SAMPLE_TIME))
    if since == 0:
        arm.set_payload(PAYLOAD if turn % 2 else 0.0)


class Watched(NamedTuple):
    """The detector's answers to N messages."""

    theta: Array  # estimated [rad], (N, D)
    anomaly: Array  # A, scaled units, (N,)
    distance: Array  # d, in healthy standard deviations, (N,)
    suspect: Ints  # the most suspect muscle, (N,)
    alarm: Bools  # whether the message completes a detection, (N,)


def watch(robot: Robot, mae: Mae, recording: Recording) -> Watched:
    """Run estimator and detector over a recording as the node does; nothing is latched."""
    health, rows = HealthMonitor(robot, mae.preset), []
    health.use(mae)
    bone_tensions = end_tensions(mae, recording)
    restored = mae.estimate(bone_tensions, recording.length)
    messages = zip(recording.length, recording.tension, bone_tensions, strict=True)
    for n, (length, tension, bone_tension) in enumerate(messages):
        demand = robot.demanded(length, recording.command[n])
        state = State(*(part[n] for part in restored))
        message = observe(mae, length, tension, bone_tension, SAMPLE_TIME, demand, state)
        finding = health.step(message)
        reading = health.residual.reading
        assert reading is not None
        suspect = reading.suspect if finding is None else finding.muscle
        row = message.estimate.anomaly, reading.distance, suspect, finding is not None
        rows.append(row)
    return Watched(restored.theta, *columns(rows))


def detection(
    robot: Robot, plan: GraspAndCut, seen: Watched, well: Watched, mae: Mae
) -> dict[str, Any]:
    """Return how soon and how rightly cuts were noticed, and how many alarms were false.

    `seen` is the recording with the cuts and `well` the healthy one, as the network's detector sees
    them. A cut that was not noticed counts with the time it lasted.
    """
    delay = np.full(len(plan.cut), CUT_TIME)
    named, noticed = np.zeros((2, len(plan.cut)), dtype=bool)
    begun, false = begins(seen.alarm), begins(seen.alarm & ~plan.disturbed(len(seen.alarm)))
    for muscle, cut in enumerate(plan.cut.tolist()):
        rows = rows_between(cut, cut + CUT_TIME)
        noticed[muscle] = begun[rows].any()
        if noticed[muscle]:
            at = int(begun[rows].argmax())
            delay[muscle] = SAMPLE_TIME * (at + 1)
            named[muscle] = seen.suspect[rows][at] == muscle
    statistics, counted = mae.anomaly, plan.counted
    name = HealthMonitor(robot, mae.preset).residual.threshold_name
    by_muscle = {'carried': plan.carried, 'detected': noticed, 'detection_s': delay, 'named': named}
    return {
        'threshold': float(statistics.thresholds.get(name, 0.0)) if statistics else 0.0,
        'calibrated': bool(statistics and statistics.calibrated),
        'detection_s': float(delay[counted].mean()),
        'detection_worst_s': float(delay[counted].max()),
        'detected_share': float(noticed[counted].mean()),
        'named_share': float(named[counted].mean()),
        'counted_cuts': len(counted),
        'cuts': {
            name: {key: values[m].item() for key, values in by_muscle.items()}
            for m, name in enumerate(robot.muscles)
        },
        'false_alarms': int(begins(well.alarm).sum()),
        'false_alarms_beside_cuts': int(false.sum()),
        'healthy_s': SAMPLE_TIME * len(well.alarm),
    }


def anomaly_levels(
    plan: GraspAndCut, watched: Mapping[str, Watched], well: Mapping[str, Watched], fault: str
) -> dict[str, Any]:
    """Return A and d: the largest of the healthy messages, the smallest level of a cut.

    The level of a cut is the median over the messages between cut and mending; `fault` is what keys
    call it.
    """
    numbers: dict[str, Any] = {}
    for when, prefix in (('before', '_before'), ('after', '')):
        for name, letter in (('anomaly', 'a'), ('distance', 'd')):
            seen, healthy = getattr(watched[when], name), getattr(well[when], name)
            calm = np.concatenate([seen[plan.free], seen[plan.loaded], healthy])
            cuts = [seen[plan.while_cut(m)] for m in range(len(plan.cut))]
            levels = [float(np.median(cut)) for cut in cuts]
            faulty = np.concatenate([cuts[m] for m in plan.counted])
            values = {
                'healthy_max': float(calm.max()),
                'healthy_median': float(np.median(calm)),
                f'{fault}_min': min(levels[m] for m in plan.counted),
                fault: levels,
                f'{fault}_auroc': auroc(calm, faulty),
            }
            numbers |= {f'{letter}{prefix}_{key}': value for key, value in values.items()}
    return numbers


def begins(alarm: Bools) -> Bools:
    """Return which messages begin an alarm, as an operator has to reset it; none that goes on."""
    return alarm & ~np.append(False, alarm[:-1])


def auroc(healthy: Array, faulty: Array) -> float:
    """Return the chance that a faulty message scores above a healthy one (ties count half)."""
    pairs = len(healthy) * len(faulty)
    return float(mannwhitneyu(faulty, healthy).statistic / pairs) if pairs else 0.5
