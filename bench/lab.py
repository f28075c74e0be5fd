# SPDX-License-Identifier: Apache-2.0
"""A laboratory in one process: an emulated arm, its driver and all nodes, in lock-step.

    arm ─► sensors ─► Wire ─► Process ─► estimator ─► controller ─► Wire ─► arm
                                     └─► learner ─► networks, which the estimator accepts or rejects

Time is simulated, and the cores exchange messages as their nodes do: muscle states best-effort with
a queue of QUEUE messages, everything else reliably. The wire between the driver and the nodes
distorts readings and commands, for mishaps of sensors, cables and drivers.

The computer may be busy: the driver and each node then wait for the processor. The wait before a
run is WAIT on average; about once in STALL_EVERY seconds, STALL is added. Both times are multiplied
by the number of other processes per core. Messages that arrive during a wait stay in the queue.
After the wait, the process receives the oldest message and the last QUEUE messages; those in
between are lost. A late message may therefore be followed by one that was sent much later. The arm
and its muscle modules do not wait.
"""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.learned_arm import STEPS, Seldom
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.estimation.lengths.length_trust import Evidence
from musculoskeletal_ae.exceptions import CheckpointError, MessageError
from musculoskeletal_ae.experiments.recording import EXPLORATION_STREAM, SAMPLE_TIME
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.state_directory import StateStore
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.messages.arrival import Arrival
from musculoskeletal_ae.signals.body_state import BodyState
from musculoskeletal_ae.signals.muscle_states import MuscleReadings

CORES = 2  # simulate a computer with this many cores
#: let a process wait for the processor for this mean time, for each process per core [s]
WAIT = 0.0008
STALL_EVERY = 10.0  # stall a process at this mean interval [s]
STALL = 0.015  # let a stall take this mean time, for each process per core [s]
HANDLING = 0.0005  # let a node handle a message in this time [s]
QUEUE = 10  # let at most this many messages wait in a subscription; drop older ones
#: set the publisher's clock ahead of the steady clock by this time [s]; no node may depend on it
AHEAD = 1.7e9
RESTARTING = 2.0  # let a node take this time to start again [s]
ESTIMATOR, CONTROLLER, LEARNER = 'estimator', 'controller', 'learner'


class Message(NamedTuple):
    """A message, and the time on the steady clock at which it was sent [s]."""

    sent_at: float
    content: Any


class Process:
    """A simulated process of a busy computer.

    It waits for the processor before it reads messages.
    """

    def __init__(self, load: float, seed: list[int]) -> None:
        """Share the computer with `load` other processes, on average.

        `seed` determines how long the process waits for the processor.
        """
        self._per_core, self._rng = load / CORES, np.random.default_rng(seed)
        self._runs_at = 0.0  # time at which the process runs next [s]
        self._subscribed_at = 0.0  # time from which it receives messages [s]
        self._waiting: list[Message] = []
        self._arrival = Arrival()
        self.lost = 0  # number of lost messages
        self.longest_delay = 0.0  # longest delay of a message [s]

    def send(self, message: Message) -> None:
        """Send a message to the process, which reads it when it runs next."""
        if message.sent_at >= self._subscribed_at:
            self._waiting.append(message)

    def suspend(self, until: float) -> None:
        """Suspend the process until a time [s], as a signal does."""
        self._runs_at = until

    def restart(self, at: float) -> None:
        """Restart the process; its successor runs and gets messages from the time `at` [s] on."""
        self._runs_at = self._subscribed_at = at
        self._arrival = Arrival()
        self._waiting.clear()

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
            sent = round(1e9 * (message.sent_at + AHEAD))
            self._arrival.receive(now, sent, self._arrival.number + 1)
            self.longest_delay = max(self.longest_delay, self._arrival.delay)
            received.append((now, self._arrival.delay, message.content))
            now += HANDLING
        return received


class Packet(NamedTuple):
    """The readings that the driver publishes in one period."""

    muscles: MuscleReadings
    theta: Array | None  # joint angles [rad], (D,), with NaN for missing ones; None: no message


#: maps the time [s] and a packet to the packets that are sent instead
ReadingFault = Callable[[float, Packet], list[Packet]]
#: maps the time [s] and a length command [m] (M,) to the command that arrives; None if none does
CommandFault = Callable[[float, Array], Array | None]


class Wire:
    """The wire between the arm and the nodes: sensors, cables and the driver.

    Faults are applied to readings in the order of `reading_faults`, and to commands in the order of
    `command_faults`.
    """

    def __init__(self) -> None:
        """Start with a healthy wire, which changes nothing."""
        self.reading_faults: list[ReadingFault] = []
        self.command_faults: list[CommandFault] = []

    def clear(self) -> None:
        """Clear all faults, so that readings and commands pass unchanged."""
        self.reading_faults.clear()
        self.command_faults.clear()

    def readings(self, now: float, packet: Packet) -> list[Packet]:
        """Return the packets that the driver publishes at `now` [s] instead of a healthy one."""
        packets = [packet]
        for fault in self.reading_faults:
            packets = [sent for each in packets for sent in fault(now, each)]
        return packets

    def command(self, now: float, value: Array) -> Array | None:
        """Return the length command [m] (M,) that reaches the modules; None if it is lost.

        `value` is the command that the controller has sent.
        """
        command: Array | None = value
        for fault in self.command_faults:
            command = None if command is None else fault(now, command)
        return command


class Lab:
    """An arm with driver, estimator, controller and learner on one computer.

    Attributes:
        arm: The emulated arm.
        wire: The wire between arm and nodes.
        estimator: The core of the estimator.
        controller: The core of the controller.
        learner: The core of the learner.
        now: The steady clock [s].
        clock_shift: The ROS clock minus the steady clock [s].
        before_step: Functions that are called before each step, with this laboratory as argument.
    """

    def __init__(self, arm: Arm, initial: Mae, seed: int, load: float = 0.0) -> None:
        """Connect an arm at rest to the nodes.

        `seed` selects the exploration and the waits, and `load` is the number of other processes.
        """
        self.arm, self.now, self.clock_shift = arm, 0.0, 0.0
        self.wire = Wire()
        self.before_step: list[Callable[[Lab], object]] = []
        self.driver, self._estimating, self.controlling, self._learning = (
            Process(load, [seed, n]) for n in range(4)
        )
        robot = arm.robot
        self.estimator = Estimator(robot)
        self.controller = Controller(robot, seed=EXPLORATION_STREAM + seed)
        self.learner = Learner(robot, initial, seed=seed, steps=STEPS, trainer=Seldom)
        self._connect_networks()
        self.rejected_networks: list[str] = []  # reasons for which the estimator rejected networks
        self._candidate: Mae | None = None  # newest network that the learner published
        #: reliable messages that wait for the controller until it runs
        self._to_controller: list[Callable[[], object]] = []
        self._to_learner: list[Callable[[], object]] = []
        self._estimates: list[Array] = []
        self._command: Array | None = None  # length command for the driver [m], (M,)
        self._published_body: BodyState | None = self.estimator.body
        self._published_trust = self.estimator.joint_trust

    # -- time -----------------------------------------------------------------------------------

    @property
    def clock(self) -> float:
        """The ROS clock [s], which the learner and the time stamps of messages use."""
        return self.now + self.clock_shift

    def run(self, seconds: float) -> None:
        """Run the laboratory for a time [s]."""
        for _ in range(round(seconds / SAMPLE_TIME)):
            self.step()

    def step(self) -> None:
        """Simulate the arm, the driver and the nodes for one sample period."""
        now = self.now
        for each in self.before_step:
            each(self)
        if self.learner.mae is not self._candidate and self._runs_estimator:
            self._candidate = self.learner.mae
            self._decide()
        if (at := self.driver.runs(now)) is not None:
            self._drive(at)
        if (at := self._estimating.runs(now)) is not None:
            self._estimate(at)
        if (at := self.controlling.runs(now)) is not None:
            self._control(at)
        if (at := self._learning.runs(now)) is not None:
            self._learn(at)
        self.arm.step(SAMPLE_TIME)
        self.now = now + SAMPLE_TIME

    @property
    def _runs_estimator(self) -> bool:
        return self._published_body is not None

    def _drive(self, now: float) -> None:
        if self._command is not None:
            value = self.wire.command(now, self._command)
            if value is not None:
                self.arm.command_length(value)
            self._command = None
        read = self.arm.sense()
        for packet in self.wire.readings(now, Packet(read.muscles, read.theta)):
            content = packet.muscles, packet.theta
            for process in (self._estimating, self.controlling, self._learning):
                process.send(Message(now, content))

    # -- nodes ----------------------------------------------------------------------------------

    def _estimate(self, now: float) -> None:
        core = self.estimator
        for received, delay, (muscles, theta) in self._estimating.receive(now):
            if theta is not None and np.isfinite(theta).any():
                core.joints(theta, received)
            try:
                output = core.take(muscles, received + self.clock_shift, received, delay)
            except MessageError:  # the nodes count and drop bad messages
                self.publish()
                continue
            if output is not None:
                self._estimates.append(output.state.theta)
            self.publish()

    def publish(self) -> None:
        """Publish to the other nodes what has changed in the estimator's latched topics."""
        core = self.estimator
        if (trust := core.joint_trust) is not self._published_trust:
            self._published_trust = trust
            self._to_learner.append(lambda: self.learner.use_joint_trust(trust))
        if core.body is not self._published_body:
            body = self._published_body = core.body
            self._to_controller.append(lambda: self.controller.use_body(body))
            self._to_learner.append(lambda: self.learner.use_body(body))

    def _connect_networks(self) -> None:
        """Let controller and learner hear the estimator's decisions on networks."""
        self.estimator.networks.accepted = self._accepted
        self.estimator.networks.rejected = self._rejected

    def choose_network(self, mae: Mae) -> bool:
        """Let a user choose a network for the estimator; return whether it is accepted."""
        try:
            self.estimator.networks.choose(mae, self.now)
        except CheckpointError:
            return False
        return True

    def _decide(self) -> None:
        """Let the estimator decide on the learner's candidate."""
        if self._candidate is not None:
            with suppress(CheckpointError):  # `_rejected` is called
                deque(self.estimator.networks.propose(self._candidate, lambda: self.now), maxlen=0)

    def _rejected(self, mae: Mae, reason: str) -> None:
        self.rejected_networks.append(reason)
        self._to_learner.append(lambda: self.learner.note_rejected(mae.version, reason))

    def _accepted(self, mae: Mae) -> None:
        self.controller.use(mae)
        self._to_learner.append(lambda: self.learner.note_accepted(mae))
        # The lengths could not be calibrated without a network.
        if Evidence.NOT_CALIBRATED in self.estimator.trust.evidence:
            self.estimator.calibrate_lengths()

    def _control(self, now: float) -> None:
        core = self.controller
        for tell in self._to_controller:
            tell()
        self._to_controller.clear()
        # Without an estimate for 1.5 periods, the timer of the node steps the controller.
        if now - core.watchdog.steps.stepped_at > 1.5 * SAMPLE_TIME:
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

    def _command_by(self, core: Controller, now: float) -> None:
        command = core.step(now, now + self.clock_shift)
        if command is not None:
            core.sent_at = now
            offset = core.stream.body.offsets.offset
            self._command = command.value + offset
            length = self._command - self.estimator.body.offsets.offset
            self.estimator.commanded(now, length=length)

    def _learn(self, now: float) -> None:
        core = self.learner
        for tell in self._to_learner:
            tell()
        self._to_learner.clear()
        for received, delay, (muscles, theta) in self._learning.receive(now):
            if theta is not None:
                core.joints(received + self.clock_shift, theta)
            with suppress(MessageError):  # the nodes count and drop bad messages
                core.take(muscles, received + self.clock_shift, delay)
        core.poll(now + self.clock_shift)

    # -- mishaps of nodes and clocks ------------------------------------------------------------

    def suspend(self, node: str, seconds: float) -> None:
        """Suspend a node for a time [s], as a signal or a swapping computer does."""
        self._process_of(node).suspend(self.now + seconds)

    def restart(self, node: str) -> None:
        """Restart a node: kill it and start it again, which takes RESTARTING seconds.

        The controller then finds the stop that its predecessor has left behind. The learner keeps
        its samples and its network, which are on disk.
        """
        robot = self.arm.robot
        self._process_of(node).restart(self.now + RESTARTING)
        if node == ESTIMATOR:
            left = self.estimator.body  # a real estimator saves its state
            self.estimator = Estimator(robot, first_generation=left.generation + 1)
            self.estimator.isolate(left.isolated)
            self._connect_networks()
            self._candidate, self._published_body = None, None
            self._published_trust = self.estimator.joint_trust
            self._estimates.clear()
            self.before_step.append(self._start_estimator(self.now + RESTARTING))
        elif node == CONTROLLER:
            former = self.controller
            core = self.controller = Controller(robot, seed=round(1e3 * self.now))
            supervisor = former.supervisor
            found = supervisor.condition if supervisor.is_latched else None
            core.stop(ConditionKind.RESTARTED if found is None else found.kind)
            if former.mae is not None:
                core.use(former.mae)
            core.use_body(self.estimator.body)
        else:
            before = self.learner
            with tempfile.TemporaryDirectory() as name:
                state = StateStore(Path(name), robot)
                state.save(before.samples, before.checkpoint)
                state.close()
                learner = Learner(robot, seed=0, steps=STEPS, trainer=Seldom, directory=Path(name))
                learner.keeper.close()
            learner.use_body(self.controller.stream.body)
            self.learner = learner

    def _start_estimator(self, at: float) -> Callable[[Lab], None]:
        """Return a function that lets the new estimator publish from the time `at` [s] on."""

        def start(lab: Lab) -> None:
            if lab.now >= at and start in lab.before_step:
                lab.before_step = [each for each in lab.before_step if each is not start]
                lab._candidate = lab.learner.mae
                lab._decide()
                lab.publish()

        return start

    def _process_of(self, node: str) -> Process:
        return {
            'driver': self.driver,
            ESTIMATOR: self._estimating,
            CONTROLLER: self.controlling,
            LEARNER: self._learning,
        }[node]

    def jump_clock(self, seconds: float) -> None:
        """Let the ROS clock jump by a time [s], to which the nodes react as `Shell` does."""
        self.clock_shift += seconds
        if seconds < 0.0:
            self.estimator.clock_jumped_back()
            self.controller.clock_jumped_back()
            self.learner.reset()
