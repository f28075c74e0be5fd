# SPDX-License-Identifier: Apache-2.0
"""Exchanges muscles, or reverses a sign, in a live driver, and follows the advice of the estimator.

python -m bench wiring [--robot …] [--seeds 0,1,2,3,4] [--folder DIR]

An individual that has learned for two minutes explores. Its driver then restarts after half a
second with two muscles exchanged, in readings and commands, or with the length and the command of
one muscle reversed. The bench calls the services that the estimator advises, until it names a wrong
wiring, or reports nothing more. For comparison, a healthy driver restarts without length offsets.
The bench prints one line for each case:

- `named`: the muscles were named, and no others; `undetermined`: others were named, too;
  `refused`: offsets were refused without naming the muscles; `other`: another fault was reported;
  `unnoticed`: nothing was reported within a minute; `FALSE`: offsets were accepted,
- the error of the estimate and the anomaly score A before the restart and at the end.

A healthy driver must be calibrated: `accepted`, or else `REFUSED`.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.learned_arm import add_folder, initial, learned_arm
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.emulator.faults import ArmReadings
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.emulator.reality import FOREIGN, KIN, make_arm
from musculoskeletal_ae.estimation.estimator import Estimator, Output
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME
from musculoskeletal_ae.experiments.workers import workers
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.remedy_steps import Step
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_states import MuscleReadings
from musculoskeletal_ae.signals.muscle_stream import RejectionError
from musculoskeletal_ae.signals.wiring import Wiring

MINUTES = 2.0  # let an individual learn from an exploration of this duration first [min]
BEFORE = 10.0  # let the arm explore for this time before the driver restarts [s]
RESTART = 0.5  # let the driver publish no messages for this time while it restarts [s]
LONGEST = 180.0  # follow the advice of the estimator for at most this time [s]
NOTHING = 60.0  # stop when nothing is reported, but not before this time [s]
AFTER = 10.0  # let the arm explore for this time after the advice was followed [s]
REFUSING = 15.0  # let a calibration go on for at most this time after it has enough data [s]
OFFSET = 0.1  # let a driver that loses its offsets restart with offsets of up to this length [m]


class Driver:
    """A driver whose column j shows muscle order[j], with a sign and an offset of its length."""

    def __init__(self, arm: Arm) -> None:
        self.arm, self.wiring = arm, Wiring.straight(arm.robot.muscle_count)
        self.offset = np.zeros(arm.robot.muscle_count)

    def sense(self) -> ArmReadings:
        """Return the readings as the driver publishes them."""
        read, into = self.arm.sense(), list(self.wiring.order)
        muscles = MuscleReadings.of_rows(read.muscles.rows[:, into])
        muscles.length = np.array(self.wiring.sign) * muscles.length + self.offset
        return read._replace(muscles=muscles)

    def command(self, target: Array) -> None:
        """Pass target lengths [m] on to the muscles, (M,)."""
        self.arm.command_length(self.wiring.signed(target - self.offset))


class Loop:
    """An emulated arm behind a driver, estimator and controller, connected as in their nodes."""

    def __init__(self, robot: Robot, mae: Mae, arm: Arm, seed: int, has_sensors: bool) -> None:
        self.driver, self.time, self._has_sensors = Driver(arm), 0.0, has_sensors
        self.estimator, self.controller = Estimator(robot), Controller(robot, seed=seed)
        self.estimator.use(mae)
        self.controller.use(mae)
        self._offsets = self.estimator.body.offsets

    def step(self) -> Output | None:
        """Simulate one message; return the results of the estimator."""
        self.time += SAMPLE_TIME
        now, read, output = self.time, self.driver.sense(), None
        estimator, controller = self.estimator, self.controller
        if self._has_sensors:
            estimator.joints(read.theta, now)
        message = read.muscles
        with suppress(RejectionError):
            output = estimator.take(message, now, now)
        if estimator.body is not controller.stream.body:
            self._offsets = estimator.body.offsets
            controller.use_body(estimator.body)
        with suppress(RejectionError):
            controller.take(message, now)
        if output is not None:
            controller.estimated(output.state.theta, now)
        if (command := controller.step(now)) is not None:
            self.driver.command(command.value + self._offsets.offset)
            estimator.commanded(now, length=command.value)
        self.driver.arm.step(SAMPLE_TIME)
        return output

    def explore(self, duration: float) -> tuple[float, float]:
        """Explore, with resets of the controller; return the mean error [rad] and the mean A."""
        errors, anomalies = [np.nan], [np.nan]
        for n in range(round(duration / SAMPLE_TIME)):
            supervisor = self.controller.supervisor
            if n % 50 == 0 and self.estimator.suspects.finding is None:
                if not supervisor.is_running:
                    self.controller.reset(self.time)
                if supervisor.is_running and not supervisor.explores:
                    self.controller.explore(True)
            if (output := self.step()) is not None:
                errors.append(float(np.linalg.norm(output.state.theta - self.driver.arm.theta)))
                anomalies.append(output.anomaly)
        return float(np.nanmean(errors)), float(np.nanmean(anomalies))

    def follow_advice(self) -> set[int] | None:
        """Follow the advice of the estimator, until it names a wrong wiring or reports nothing.

        Returns:
            The columns that were named; the empty set if a calibration has failed for another
            reason; None if the estimator reports nothing, after a calibration or without one.
        """
        end, estimator = self.time + LONGEST, self.estimator
        while self.time < end:
            self.explore(2.0)
            finding, calibration = estimator.suspects.finding, estimator.calibration
            if finding is not None:
                if finding.kind is ConditionKind.MUSCLES_EXCHANGED:
                    return _named(estimator, finding.evidence)
                with suppress(MusculoskeletalError):
                    if Step.CALIBRATE_LENGTHS in estimator.remedy:
                        estimator.calibrate_lengths()
                    else:
                        estimator.reset()
            elif calibration is not None:
                if calibration.remedy:
                    return _named(estimator, calibration.problem)
                if calibration.problem and calibration.time - calibration.enough > REFUSING:
                    return set()
            elif self.time > end - LONGEST + NOTHING:
                return None
        return set() if estimator.calibration is not None else None


def _named(estimator: Estimator, text: str) -> set[int]:
    return {m for m, name in enumerate(estimator.robot.muscles) if name in text}


class Case(NamedTuple):
    """One restart of a driver, and what differs after it."""

    what: str  # change in the driver: 'exchange', 'sign', or 'healthy' for none
    wiring: Wiring
    has_sensors: bool


def cases(robot: Robot, seed: int) -> Iterator[Case]:
    """Yield the cases of one individual: adjacent and random muscles."""
    count, rng = robot.muscle_count, np.random.default_rng([seed, 0x0D])
    straight = Wiring.straight(count)
    first = int(rng.integers(count - 1))
    distant = rng.choice(count, 2, replace=False).tolist()
    for has_sensors in (True, False):
        yield Case('healthy', straight, has_sensors)
        yield Case('exchange', straight.exchanged(first, first + 1), has_sensors)
        yield Case('exchange', straight.exchanged(*distant), has_sensors)
        yield Case('sign', straight.reversed(int(rng.integers(count))), has_sensors)


def run(robot: Robot, mae: Mae, arm: Arm, seed: int, case: Case) -> dict[str, Any]:
    """Run one case; return its outcome, and errors and anomaly scores before and after it."""
    loop = Loop(robot, mae, arm, seed, case.has_sensors)
    rng = np.random.default_rng([seed, *case.wiring.faulty])
    loop.explore(rng.uniform(BEFORE, 2.0 * BEFORE))
    before = loop.explore(BEFORE)
    loop.driver.wiring = case.wiring
    if case.what == 'healthy':
        loop.driver.offset = rng.uniform(-OFFSET, OFFSET, robot.muscle_count)
    arm.step(RESTART)
    loop.time += RESTART
    offsets = loop.estimator.body.offsets
    named = loop.follow_advice()
    is_new = loop.estimator.body.offsets.known and loop.estimator.body.offsets is not offsets
    if case.what == 'healthy':
        outcome = 'accepted' if is_new else 'REFUSED'
    elif named is None:
        outcome = 'other' if loop.estimator.cause else 'unnoticed'
        if is_new:
            outcome = 'FALSE'
    else:
        wrong = set(case.wiring.faulty)
        outcome = 'undetermined' if named >= wrong else 'refused'
        if named == wrong:
            outcome = 'named'
    after = loop.explore(AFTER)
    calibration = loop.estimator.calibration
    said = loop.estimator.cause or ('' if calibration is None else calibration.problem)
    return {'outcome': outcome, 'before': before, 'after': after, 'said': said}


def measure(robot: Robot, folder: Path, seed: int, reality: str) -> list[tuple[str, str]]:
    """Try all cases on one individual; return a line of text and the outcome of each."""
    results, mae = [], learned_arm(robot, seed, folder, MINUTES, reality).mae
    for case in cases(robot, seed):
        got = run(robot, mae, make_arm(robot, seed, reality), seed, case)
        how = 'sensors' if case.has_sensors else 'none'
        muscles = robot.names(case.wiring.faulty) or '-'
        (error, anomaly), (last_error, last_anomaly) = got['before'], got['after']
        text = (
            f'{seed} {reality:7s} {how:7s} {case.what:8s} {muscles}: {got["outcome"]}; '
            f'{error:.3f} → {last_error:.3f} rad, A {anomaly:.3f} → {last_anomaly:.3f}; '
            f'{got["said"]}'
        )
        results.append((text, f'{case.what}, {how}: {got["outcome"]}'))
    return results


def main(argv: list[str]) -> int:
    """Print the outcomes; return the exit status, 0 unless false offsets were accepted, else 1."""
    parser = Parser('wiring', 'Exchanges muscles, or reverses a sign, in a live driver.')
    parser.add_robot()
    parser.add_seeds((0, 1, 2, 3, 4))
    add_folder(parser, Path('bench_wiring'))
    parser.add_workers()
    args = parser.parse_args(argv)
    robot, outcomes = Robot.load(args.robot), Counter[str]()
    folder = args.folder.resolve()
    initial(robot, folder)
    calls = [(robot, folder, seed, reality) for seed in args.seeds for reality in (KIN, FOREIGN)]
    with workers(args.jobs, args.scheduler) as processes:
        for results in processes.in_order(measure, calls):
            for text, outcome in results:
                print(text, flush=True)
                outcomes[outcome] += 1
    for text, count in sorted(outcomes.items()):
        print(f'{count:4d} × {text}')
    return int(any('FALSE' in text or 'REFUSED' in text for text in outcomes))
