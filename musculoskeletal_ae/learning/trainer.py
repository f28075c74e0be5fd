# SPDX-License-Identifier: Apache-2.0
"""Where updates are made: here (experiments, recordings) or in a process of their own (the node).

A job goes in, an update comes out, and the caller looks now and then whether it has. What an update
does is in `update`, which imports torch and is itself imported only where something trains.
"""

from __future__ import annotations

import faulthandler
import math
import multiprocessing
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.learning.calibration import Healthy
from musculoskeletal_ae.learning.samples import Observations
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.presets.registry import preset_named
from musculoskeletal_ae.robot.robot import Robot

if TYPE_CHECKING:
    from musculoskeletal_ae.learning.body import CalibratedBody
    from musculoskeletal_ae.learning.updater import Updater


class Job(NamedTuple):
    """What an update may use."""

    observed: Observations  # the samples, the oldest first
    healthy: Healthy  # what was seen of the healthy arm
    statistics_hold: bool  # the statistics so far are of the arm as it is: no muscle has changed
    steps: int  # of training
    isolated: tuple[int, ...] = ()  # muscles that the messages say nothing about


class Update(NamedTuple):
    """What came of it."""

    mae: Mae  # the network
    loss: float  # of the training
    noise: Array = np.empty(0)  # σ of each length that the body does not explain [m], (M,) or none
    # The muscle, if any, whose newest samples contradict all older ones, with how many they are.
    changed: tuple[tuple[int, int], ...] = ()
    contradicted: tuple[int, ...] = ()  # muscles that they contradict together: θ is wrong there
    error: float = 0.0  # mean ‖θ_est − θ‖₂ over the newest samples before they were learned [rad]
    seconds: float = 0.0  # how long it took
    device: str = 'cpu'  # where it was trained


class Trainer:
    """Makes an update at once, where it is submitted; one job at a time."""

    def __init__(self, robot: Robot, preset: str, seed: int = 0) -> None:
        """Learn as `preset` says; `seed` draws what is random."""
        self.robot, self.preset, self.seed = robot, preset_named(preset), seed
        self.trouble = ''  # why there is no update
        self._updater: Updater | None = None
        self._update: Update | None = None

    def begin(self, mae: Mae) -> None:
        """Go on from a network; what was submitted before is forgotten."""
        self._updater = self.preset.make_updater(self.robot, mae, self.seed)
        self._update = None

    @property
    def ready(self) -> bool:
        """Whether a job may be submitted."""
        return self._updater is not None and self._update is None

    @property
    def body(self) -> CalibratedBody | None:
        """The calibrated body as it was fitted last; None where none is, or it is elsewhere."""
        return None if self._updater is None else self._updater.body

    def submit(self, job: Job) -> None:
        """Take a job."""
        assert self._updater is not None
        self._update = self._updater.update(job)

    def poll(self) -> Update | None:
        """Return what came of the job, if that is known by now."""
        update, self._update = self._update, None
        return update

    def values(self) -> dict[str, str]:
        """Return what people want to know, for /diagnostics."""
        return {}

    def close(self) -> None:
        """End it."""
        self._updater = self._update = None


# -- a process of its own -------------------------------------------------------------------------

NICENESS = 5  # beside that of the node
#: until a training process that was lost is started again [s], doubled each time up to the longest
FIRST_PAUSE, LONGEST_PAUSE = 1.0, 60.0
#: until a process that has not answered is taken to hang [s], and what each step of training adds;
#: the first answer waits for imports, which take minutes on a slow disk
PATIENCE_AT_FIRST, PATIENCE, PATIENCE_PER_STEP = 300.0, 60.0, 0.1
ENDING = 2.0  # [s] that the operating system has to end a process


class TrainerProcess(Trainer):
    """Makes updates in another process, and in the next one if that dies or hangs.

    No call waits for the process: a thread does. A job that was lost with one is given to the next.
    """

    def __init__(self, robot: Robot, preset: str, seed: int = 0, device: str = 'cpu') -> None:
        """Learn on one of `parameters.DEVICES`, or on the CPU where there is no such."""
        super().__init__(robot, preset, seed)
        self._device = device
        self.restarts = 0  # how often a process was lost
        self._mae: Mae | None = None
        self._job: Job | None = None
        self._process: SpawnProcess | None = None
        self._pause = FIRST_PAUSE
        self._restart_at = self._deadline = math.inf

    def begin(self, mae: Mae) -> None:
        """Start a process with a network, in the place of the one before."""
        self.close()
        self._mae = mae
        self._start()

    def _start(self) -> None:
        assert self._mae is not None
        self._patience = PATIENCE_AT_FIRST
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[Update | str] = queue.SimpleQueue()
        context = multiprocessing.get_context('spawn')
        arguments = self.robot.description.directory, self.preset.name, self.seed, self._device
        try:
            ours, theirs = context.Pipe()
            process = context.Process(target=serve, args=(theirs, *arguments), daemon=True)
            with theirs, _interrupts_blocked():
                process.start()
        except OSError as error:
            self._lost(f'cannot be started ({error})')
            return
        self._process, self._restart_at = process, math.inf
        talk = ours, process, self._mae, self.robot, self._jobs, self._answers
        self._thread = threading.Thread(target=_talk, args=talk, daemon=True)
        self._thread.start()
        if self._job is not None:
            self.submit(self._job)

    @property
    def pid(self) -> int | None:
        """Id of the process; None while there is none."""
        return None if self._process is None else self._process.pid

    @property
    def ready(self) -> bool:
        """Whether there is a process, and it is idle."""
        return self._process is not None and self._job is None

    def submit(self, job: Job) -> None:
        """Hand over a job."""
        self._job = job
        self._deadline = time.monotonic() + self._patience + PATIENCE_PER_STEP * job.steps
        self._jobs.put(job)

    def poll(self) -> Update | None:
        """Return the update, if it has come; start a process that was lost again."""
        now = time.monotonic()
        if now >= self._restart_at:
            self._start()
        if self._process is None or self._job is None:
            return None
        try:
            answer = self._answers.get_nowait()
        except queue.Empty:
            if now > self._deadline:
                self._lost('did not answer in time')
            return None
        if isinstance(answer, str):
            self._lost(f'died ({answer})')
            return None
        self.trouble, self._pause, self._patience = '', FIRST_PAUSE, PATIENCE
        self._mae, self._job = answer.mae, None
        return answer

    def _lost(self, why: str) -> None:
        self._end()
        self.restarts += 1
        self.trouble = f'the training process {why}; starting it again'
        self._restart_at = time.monotonic() + self._pause
        self._pause = min(2.0 * self._pause, LONGEST_PAUSE)

    def _end(self) -> None:
        # By force, whatever it is doing: it keeps nothing that is not known here.
        if self._process is not None:
            self._process.kill()
            self._process.join(ENDING)
            self._jobs.put(None)
            self._thread.join(ENDING)
            self._process = None

    def values(self) -> dict[str, str]:
        """Return restarts and process id."""
        values = {'training process restarts': str(self.restarts)}
        return values if self.pid is None else {**values, 'training process': str(self.pid)}

    def close(self) -> None:
        """End the process, and forget the job."""
        self._end()
        self._job, self._restart_at = None, math.inf


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Let a child be born deaf to Ctrl-C, which goes to the whole group; the node ends it."""
    # It is started with the first child, and unblocks the signal afterwards.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _talk(
    connection: Connection,
    process: SpawnProcess,
    mae: Mae,
    robot: Robot,
    jobs: queue.SimpleQueue[Job | None],
    answers: queue.SimpleQueue[Update | str],
) -> None:
    """Give a process its network and its jobs; answer with updates, or with why there are none."""
    with connection:
        try:
            connection.send(checkpoint.to_bytes(mae))
            while (job := jobs.get()) is not None:
                connection.send(job)
                data, *others = connection.recv()
                answers.put(Update(checkpoint.from_bytes(data, robot), *others))
        except (EOFError, OSError):
            process.join(ENDING)
            answers.put(f'status {process.exitcode}')
        # Whatever it is, as a torn pickle or no memory: it would be waited for else.
        except Exception as error:  # noqa: BLE001
            answers.put(f'{type(error).__name__}: {error}')


def serve(connection: Connection, directory: Path, preset: str, seed: int, device: str) -> None:
    """Be the training process: answer until the other end closes, however the node ended."""
    faulthandler.enable()
    os.nice(NICENESS)
    import torch

    from musculoskeletal_ae.mae.training import train_on

    torch.set_num_threads(1)
    try:
        train_on(device)
    except MusculoskeletalError as error:
        print(f'{error}; learning on the CPU', file=sys.stderr, flush=True)
    robot = Robot.load(directory)
    trainer = Trainer(robot, preset, seed)
    try:
        trainer.begin(checkpoint.from_bytes(connection.recv(), robot))
        while True:
            trainer.submit(connection.recv())
            update = trainer.poll()
            assert update is not None
            # A checkpoint, so that it is checked where it arrives.
            connection.send((checkpoint.to_bytes(update.mae), *update[1:]))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass
