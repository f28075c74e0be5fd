# SPDX-License-Identifier: Apache-2.0
"""Counts false stops of healthy arms, on an idle computer or on a busy one.

    python -m bench false_stops [--robot …] [--seeds 5,…,14] [--hours 1] [--load 8] [--quick]

New individuals explore and learn for an hour of simulated time each. The cores of estimator,
controller and learner run in one process. They exchange messages as their nodes do, best-effort and
with a queue of QUEUE messages.

With --load, the computer is busy: the driver and each node wait for the processor. The wait before
a run is WAIT on average; about once in STALL_EVERY seconds, STALL is added. Both times are
multiplied by the number of other processes per core. Messages that arrive during a wait stay in the
queue. After the wait, the process receives the oldest message and the last QUEUE messages; those in
between are lost. A late message may therefore be followed by one that was sent much later. The arm
and its muscle modules do not wait.

These times are as long as those measured on two cores at a load of 20. There, a process that
computed for a few milliseconds 100 times a second took 13 ms on average, and 46 ms in 1 % of all
cases. Ten times in 150 s it did not run for 0.12 to 0.41 s.

The bench prints the false findings, doubted joint sensors and stops, the pauses (stops that end by
themselves, for example after 0.2 s without messages), the number of messages that the controller
lost, and the longest delay of a message. An individual's hour ends with its first finding, doubt or
stop. The exit status is 1 if there was one.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from bench.learned_arm import STEPS, Seldom
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.emulator.reality import KIN, make_arm
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.estimation.status import joint_trust_text
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.experiments.recording import EXPLORATION_STREAM, SAMPLE_TIME
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import Parser, number, positive
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.message_delay import MessageDelay
from musculoskeletal_ae.signals.motor_interface import MuscleReading

CORES = 2  # number of cores of the simulated computer
WAIT = 0.0008  # mean time until a process gets the processor, for each process per core [s]
STALL_EVERY = 10.0  # mean time between two stalls of a process [s]
STALL = 0.015  # mean duration of a stall, for each process per core [s]
HANDLING = 0.0005  # time in which a node handles a message [s]
QUEUE = 10  # largest number of messages that wait in a subscription; older ones are dropped
#: time by which the publisher's clock is ahead of the steady clock [s]; no node may depend on it
AHEAD = 1.7e9


class Message(NamedTuple):
    """A message, and the time on the steady clock at which it was sent [s]."""

    sent_at: float
    content: Any


class Process:
    """A simulated process of a busy computer.

    It waits for the processor before it reads messages.
    """

    def __init__(self, load: float, seed: list[int]) -> None:
        """Share the computer with `load` other processes, on average."""
        self._per_core, self._rng = load / CORES, np.random.default_rng(seed)
        self._runs_at = 0.0  # time at which the process runs next [s]
        self._waiting: list[Message] = []
        self._delays = MessageDelay()
        self.lost = 0  # number of lost messages
        self.longest_delay = 0.0  # longest delay of a message [s]

    def send(self, message: Message) -> None:
        """Put a message into the queue of the process, which reads it when it runs next."""
        self._waiting.append(message)

    def runs(self, now: float) -> float | None:
        """Return when the process runs [s] in the sample period from `now`; None if it does not."""
        if self._runs_at >= now + SAMPLE_TIME:
            return None
        runs_at = max(now, self._runs_at)
        wait = WAIT * self._rng.exponential()
        if self._rng.random() < SAMPLE_TIME / STALL_EVERY:
            wait += STALL * self._rng.exponential()
        self._runs_at = now + SAMPLE_TIME + self._per_core * wait
        return runs_at

    def receive(self, now: float) -> list[tuple[float, float, Any]]:
        """Return the messages that the process receives when it runs at the time `now` [s].

        Each entry is the time of reception [s], the delay since sending [s] and the content.
        """
        waiting, self._waiting = self._waiting, []
        kept = waiting[:1] + waiting[1:][-QUEUE:]
        self.lost += len(waiting) - len(kept)
        received = []
        for message in kept:
            delay = self._delays.step(now, round(1e9 * (message.sent_at + AHEAD)))
            self.longest_delay = max(self.longest_delay, delay)
            received.append((now, delay, message.content))
            now += HANDLING
        return received


class Result(NamedTuple):
    """Results of one healthy arm: a false finding or stop, pauses, lost and late messages."""

    seconds: float  # simulated time [s]
    problem: str  # the false finding or stop that ended it, or ''
    pauses: int  # how often the arm paused
    lost: int  # number of muscle_states that the controller lost
    delay: float  # longest delay of muscle_states at the controller [s]
    samples: int  # number of samples that the learner took

    def line(self, seed: int) -> str:
        """Return a line of the table."""
        return (
            f'{seed:>5} {self.seconds:>8.0f} {self.pauses:>7} {self.lost:>8} '
            f'{1000.0 * self.delay:>9.0f} {self.samples:>7}  {self.problem}'
        )


HEAD = (
    f'{"seed":>5} {"time [s]":>8} {"pauses":>7} {"lost":>8} {"late [ms]":>9} {"samples":>7}  '
    'false finding or stop'
)


class BusyLoop:
    """An exploring arm with driver, estimator, controller and learner on one computer."""

    def __init__(self, arm: Arm, initial: Mae, seed: int, load: float = 0.0) -> None:
        """Connect an arm at rest to the nodes; `load` is the number of other processes."""
        robot, self.arm, self.now = arm.robot, arm, 0.0
        self.estimator, self.controller = (
            Estimator(robot),
            Controller(robot, seed=EXPLORATION_STREAM + seed),
        )
        self.learner = Learner(robot, initial, seed=seed, steps=STEPS, trainer=Seldom)
        self.driver, self.estimating, self.controlling, self.learning = (
            Process(load, [seed, n]) for n in range(4)
        )
        self.pauses = 0
        self._mae: Mae | None = None
        #: messages of the estimator to the controller, which are reliable
        self._reliable: list[Callable[[], None]] = []
        self._estimates: list[Array] = []
        self._command: Array | None = None  # length command for the driver [m], (M,)
        self._body = self.estimator.body

    @property
    def problem(self) -> str:
        """The false finding or stop as a text, or '' if there was none."""
        supervisor = self.controller.supervisor
        if self.estimator.cause:
            return f'finding: {self.estimator.cause}'
        if self.estimator.joint_trust.doubted:
            return joint_trust_text(self.estimator.robot, self.estimator.joint_trust)
        return f'stop: {supervisor.condition}' if supervisor.is_latched else ''

    def run(self, seconds: float) -> Result:
        """Run for a time [s], or until the first false finding or stop."""
        for _ in range(round(seconds / SAMPLE_TIME)):
            if self.problem:
                break
            self.step()
        muscles = self.controlling
        return Result(
            self.now, self.problem, self.pauses, muscles.lost, muscles.longest_delay,
            len(self.learner.samples),
        )  # fmt: skip

    def step(self) -> None:
        """Simulate the arm, the driver and the nodes for one sample period."""
        now = self.now
        if self.learner.mae is not self._mae:
            self._mae = self.learner.mae
            self.estimator.use(self._mae)
            self.controller.use(self._mae)
        if (at := self.driver.runs(now)) is not None:
            if self._command is not None:
                self.arm.command_length(self._command)
            read = self.arm.sense()
            states = np.array([read.length, read.tension, read.temperature])
            message = Message(at, (MuscleReading(states.ravel()), read.theta))
            for process in (self.estimating, self.controlling, self.learning):
                process.send(message)
        if (at := self.estimating.runs(now)) is not None:
            self._estimate(at)
        if (at := self.controlling.runs(now)) is not None:
            self._control(at)
        if (at := self.learning.runs(now)) is not None:
            for received, delay, (muscles, theta) in self.learning.receive(at):
                self.learner.joints(received, theta)
                self.learner.take(muscles, received, delay)
            self.learner.poll(at)
        self.arm.step(SAMPLE_TIME)
        self.now = now + SAMPLE_TIME

    def _estimate(self, now: float) -> None:
        core = self.estimator
        for received, delay, (muscles, theta) in self.estimating.receive(now):
            core.joints(theta, received)
            try:
                output = core.take(muscles, received, received, delay)
            except MessageError:  # the nodes count and drop bad messages
                continue
            if core.body is not self._body:
                self._body = core.body
                self._reliable.append(partial(self.controller.use_body, core.body))
            if output is not None:
                self._estimates.append(output.state.theta)

    def _control(self, now: float) -> None:
        core = self.controller
        for use in self._reliable:
            use()
        self._reliable.clear()
        was_running = core.supervisor.is_running
        # Without an estimate for 1.5 periods, the timer of the node steps the controller.
        if now - core.watchdog.age.stepped_at > 1.5 * SAMPLE_TIME:
            self._command_by(core, now)
        estimates, self._estimates = self._estimates[-QUEUE:], []
        for message, theta in zip_longest(self.controlling.receive(now), estimates):
            with suppress(MessageError):  # the nodes count and drop bad messages
                if message is not None:
                    now, delay, (muscles, _) = message
                    core.take(muscles, now, delay)
            with suppress(MessageError):
                if theta is not None:
                    core.estimated(theta, now)
                    self._command_by(core, now)
        self.pauses += was_running and not core.supervisor.is_running
        if core.supervisor.is_running and not core.supervisor.explores:
            core.explore(True)

    def _command_by(self, core: Controller, now: float) -> None:
        command = core.step(now)
        if command is not None:
            core.sent_at = now
            self._command = command.value
            self.estimator.commanded(now, length=command.value)


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
    parser.add_argument('--initial', type=Path, help='initial checkpoint (default: train one)')
    parser.add_quick('a minute of each arm')
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    robot = Robot.load(options.robot)
    if options.initial is None:
        initial = initial_mae(robot).mae
    else:
        initial = checkpoint.load(options.initial, robot)
    seconds = 60.0 if options.quick else 3600.0 * options.hours
    print(HEAD)
    problems = 0
    for seed in options.seeds:
        arm = make_arm(robot, seed, options.reality)
        result = BusyLoop(arm, initial, seed, options.load).run(seconds)
        problems += bool(result.problem)
        print(result.line(seed), flush=True)
    print(f'{problems} false findings and stops')
    return int(problems > 0)
