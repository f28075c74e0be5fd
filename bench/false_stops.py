# SPDX-License-Identifier: Apache-2.0
"""Counts false stops and contacts of healthy arms, on an idle computer or on a busy one.

    python -m bench false_stops [--robot …] [--seeds 5,…,14] [--hours 1] [--load 8] [--quick]
    python -m bench false_stops --pushes 10 [--reality foreign]

New individuals explore and learn for an hour of simulated time each, in the laboratory of
`bench/lab.py`: the cores of estimator, controller and learner run in one process and exchange
messages as their nodes do.

With --load, the computer is busy: the driver and each node wait for the processor, and messages are
lost or come late. The times of `bench/lab.py` are as long as those measured on two cores at a load
of 20. There, a process that computed for a few milliseconds 100 times a second took 13 ms on
average, and 46 ms in 1 % of all cases. Ten times in 150 s it did not run for 0.12 to 0.41 s.

The bench prints the false findings, doubted joint sensors and stops, the pauses (stops that end by
themselves, for example after 0.2 s without messages), the number of messages that the controller
lost, and the longest delay of a message. It also prints the number of false contacts, and the
largest evidence d for contact after the first MINUTE of detection; contact is reported above 10
(`estimation/contact.py`). An individual's hour ends with its first finding, doubt or stop. The exit
status is 1 if there was any.

With --pushes N, the arm then continues to explore with the network that it has learned, and a
torque acts on one joint at a time for at most a second. The torques are multiples of σ, the
residual torque of the joint on the healthy moving arm. Each acts N times on each joint. A second
table has σ, and for each torque the share of the pushes that are noticed within 0.1 s and within a
second, and the median delay. Joints near a stop are not pushed.
"""

from typing import NamedTuple

import numpy as np

from bench.lab import CORES, SAMPLE_TIME, Lab
from bench.learned_arm import add_initial, initial_network
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.emulator.reality import KIN, make_arm
from musculoskeletal_ae.estimation.contact import AT_STOP
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments.contact import APART, CONTACT_STREAM, MOVED, SOON, ContactLoop
from musculoskeletal_ae.experiments.workers import workers
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import rare_peak
from musculoskeletal_ae.options import Parser, number, positive, whole
from musculoskeletal_ae.robot.robot import Robot

MINUTE = 60.0  # ignore the evidence for contact during this time after the first network [s]
FACTORS = 5.0, 10.0, 15.0, 20.0, 40.0  # push joints with these multiples of σ
#: leave a push out if the wrench on the hand would exert more than this share of its torque at
#: other joints
INEXACT = 0.05


class Result(NamedTuple):
    """Results of one healthy arm: a false finding or stop, pauses, lost and late messages."""

    seconds: float  # simulated time [s]
    problem: str  # the false finding or stop that ended the exploration, or ''
    pauses: int  # how often the arm paused
    lost: int  # number of muscle_states that the controller lost
    delay: float  # longest delay of muscle_states at the controller [s]
    samples: int  # number of samples that the learner accepted
    contacts: int  # number of false contacts
    evidence: float  # largest d, the evidence for contact

    def line(self, seed: int) -> str:
        """Return the results of the individual `seed` as a line of the table."""
        return (
            f'{seed:>5} {self.seconds:>8.0f} {self.pauses:>7} {self.lost:>8} '
            f'{1000.0 * self.delay:>9.0f} {self.samples:>7} {self.contacts:>8} '
            f'{self.evidence:>6.1f}  {self.problem}'
        )


HEAD = (
    f'{"seed":>5} {"time [s]":>8} {"pauses":>7} {"lost":>8} {"late [ms]":>9} {"samples":>7} '
    f'{"contacts":>8} {"d":>6}  '
    'false finding or stop'
)


class BusyLoop(Lab):
    """A laboratory with an arm that explores all the time, and counts its pauses."""

    def __init__(self, arm: Arm, initial: Mae, seed: int, load: float = 0.0) -> None:
        """Connect an arm at rest to the nodes.

        `seed` selects the exploration, and `load` is the number of other processes.
        """
        super().__init__(arm, initial, seed, load)
        self.pauses = 0
        #: largest evidence for contact after the first MINUTE in which contact was detected
        self.evidence = 0.0

    @property
    def problem(self) -> str:
        """The false finding or stop as a text, or '' if there was none."""
        supervisor = self.controller.supervisor
        if self.estimator.cause:
            return f'finding: {self.estimator.cause}'
        if doubted := self.estimator.joint_trust.doubted:
            names = ', '.join(self.estimator.robot.joints[j] for j in doubted)
            return f'doubted joint sensors: {names}'
        condition = supervisor.condition
        return f'stop: {condition.text}' if supervisor.is_latched and condition else ''

    def watch(self, seconds: float) -> Result:
        """Explore for a time [s], or until the first false finding or stop."""
        calibrated = 0.0  # time for which contact has been detected [s]
        for _ in range(round(seconds / SAMPLE_TIME)):
            if self.problem:
                break
            if (output := self.estimator.output) is not None and output.contact is not None:
                distance = output.contact.distance
                calibrated += SAMPLE_TIME if np.isfinite(distance) else 0.0
                if calibrated > MINUTE and distance > self.evidence:
                    self.evidence = distance
            was_running = self.controller.supervisor.is_running
            self.step()
            supervisor = self.controller.supervisor
            self.pauses += was_running and not supervisor.is_running
            if supervisor.is_running and not supervisor.explores:
                self.controller.explore(True)
        muscles = self.controlling
        return Result(
            self.now, self.problem, self.pauses, muscles.lost, muscles.longest_delay,
            len(self.learner.samples), self.estimator.contact.count, self.evidence,
        )  # fmt: skip


class Pushes(NamedTuple):
    """Delays until contact was noticed while a torque acted on one joint of an exploring arm.

    Attributes:
        spread: Residual torque σ of each joint on the healthy moving arm [N·m], (D,).
        delays: Delays until contact was reported [s], ∞ if it was not, (D, F, N): N pushes with
            each of the F multiples of σ. NaN for pushes that were left out.
    """

    spread: Array
    delays: Array

    def lines(self, robot: Robot) -> list[str]:
        """Return the lines of the table: its head, and a line for each joint."""
        lines = [
            f'      {"joint":<16}{"σ":>6}   torque [N·m]: % in {SOON} s, % in {MOVED} s, median'
        ]
        for joint, spread, delays in zip(robot.joints, self.spread, self.delays, strict=True):
            cells = []
            for factor, each in zip(FACTORS, delays, strict=True):
                made = each[np.isfinite(each) | np.isinf(each)]
                soon, late = (100.0 * np.mean(made <= within + 1e-9) for within in (SOON, MOVED))
                median = np.median(made) if len(made) else np.nan
                cells.append(f'{factor * spread:5.2f}: {soon:3.0f} {late:3.0f} {median:5.2f}')
            lines.append(f'      {joint:<16}{spread:>6.3f}   ' + ' | '.join(cells))
        return lines


def push(lab: BusyLoop, seed: int, count: int) -> Pushes:
    """Push each joint of a healthy exploring arm `count` times with each of several torques.

    Raises:
        MusculoskeletalError: If the arm has not moved long enough to calibrate contact detection.
    """
    arm, mae, rng = lab.arm, lab.estimator.mae, np.random.default_rng([seed, CONTACT_STREAM])
    if mae is None or mae.touch is None or np.isinf(rare_peak(mae.touch.peaks)):
        raise MusculoskeletalError(
            f'contact detection is not calibrated after {lab.now:.0f} s; choose more --hours'
        )
    loop = ContactLoop(arm, mae, Settings(first_duration=2.0), CONTACT_STREAM + seed)
    loop.contacts_during(APART, exploring=True)
    delays = np.full((arm.robot.joint_count, len(FACTORS), count), np.nan)
    for joint, k, n in np.ndindex(delays.shape):
        torque = (-1.0) ** n * FACTORS[k] * mae.touch.spread[joint]
        delays[joint, k, n] = _delay(loop, joint, torque, rng)
    return Pushes(mae.touch.spread, delays)


def _delay(loop: ContactLoop, joint: int, torque: float, rng: np.random.Generator) -> float:
    """Exert a torque [N·m] at a joint until contact is reported; return the delay [s]."""
    robot = loop.arm.robot
    while True:
        *_, before = loop.contacts_during(rng.uniform(0.5, 1.0) * APART, exploring=True)
        theta = loop.arm.theta[joint]
        is_free = robot.lower[joint] + AT_STOP < theta < robot.upper[joint] - AT_STOP
        if is_free and not before.is_contact:
            break
    try:
        for n in range(round(MOVED / SAMPLE_TIME) + 1):
            # This wrench on the hand exerts no torque at the other joints.
            jacobian = robot.kinematics.end_effector_jacobian(loop.arm.theta)
            torques = torque * np.eye(robot.joint_count)[joint]
            wrench = np.linalg.lstsq(jacobian.T, torques)[0]
            if np.abs(jacobian.T @ wrench - torques).max() > INEXACT * abs(torque):
                return float('nan')
            loop.arm.set_wrench(wrench)
            # The message with n = 0 was read before the push, so n is the delay in messages.
            if loop.contact(exploring=True).is_contact:
                return n * SAMPLE_TIME
        return float('inf')
    finally:
        loop.push(np.zeros(3))


def watch(
    robot: Robot, reality: str, seed: int, initial: Mae, load: float, seconds: float, pushes: int
) -> tuple[Result, Pushes | None]:
    """Let an emulated arm explore for `seconds` [s], push it, and return the results.

    `reality` and `seed` select the arm; `load` is the number of processes that compete with it.
    """
    lab = BusyLoop(make_arm(robot, seed, reality), initial, seed, load)
    result = lab.watch(seconds)
    return result, push(lab, seed, pushes) if pushes else None


def main(argv: list[str]) -> int:
    """Print the table; exit status 1 if a healthy arm stopped."""
    parser = Parser('false_stops', (__doc__ or '').partition('\n')[0])
    parser.add_robot()
    parser.add_seeds(tuple(range(5, 15)))
    parser.add_argument(
        '--hours', type=positive, default=1.0, help='simulated time of each arm [h]'
    )
    parser.add_argument(
        '--load',
        type=number(0.0, 100.0),
        default=0.0,
        help=f'load of the simulated computer, which has {CORES} cores',
    )
    parser.add_argument(
        '--reality', default=KIN, help='emulator model: kin, foreign or an MJCF file'
    )
    parser.add_argument(
        '--pushes',
        type=whole(0, 1000),
        default=0,
        help='afterwards, push each joint this many times with each of several torques',
    )
    add_initial(parser)
    parser.add_quick('a minute of each arm')
    parser.add_workers()
    options = parser.parse_args(argv)
    robot = Robot.load(options.robot)
    initial = initial_network(robot, options.initial)
    seconds = 60.0 if options.quick else 3600.0 * options.hours
    print(HEAD)
    problems = 0
    calls = [
        (robot, options.reality, seed, initial, options.load, seconds, options.pushes)
        for seed in options.seeds
    ]
    with workers(options.jobs, options.scheduler) as processes:
        results = processes.in_order(watch, calls)
        for seed, (result, pushes) in zip(options.seeds, results, strict=True):
            problems += bool(result.problem)
            print(result.line(seed), flush=True)
            if pushes is not None:
                print('\n'.join(pushes.lines(robot)), flush=True)
    print(f'{problems} false findings and stops')
    return int(problems > 0)
