# SPDX-License-Identifier: Apache-2.0
"""Runs updates, either in the calling process or in a separate training process.

Experiments and learning from recordings use the calling process, and the node uses a separate one.
The caller submits a job and polls for its update. The module `body_updater` computes the update. It
imports torch and is therefore imported only in processes that train.
"""

from __future__ import annotations

import faulthandler
import math
import multiprocessing
import os
import queue
import threading
import time
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import TYPE_CHECKING

from musculoskeletal_ae.learning.scheduler import Job, Update
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.presets.registry import preset_named
from musculoskeletal_ae.process_signals import interrupts_blocked
from musculoskeletal_ae.robot.robot import Robot

if TYPE_CHECKING:
    from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
    from musculoskeletal_ae.learning.updater import Updater


class Trainer:
    """Runs each update in the calling process, at once when its job is submitted."""

    def __init__(self, robot: Robot, preset: str, seed: int = 0) -> None:
        """Create a trainer for the preset of this name; `begin` sets the network.

        `seed` is the random seed of all updates.
        """
        self.robot, self.preset, self.seed = robot, preset_named(preset), seed
        self.trouble = ''  # why no updates are made at present, for users; '' if they are
        self._updater: Updater | None = None
        self._update: Update | None = None

    def begin(self, mae: Mae) -> None:
        """Begin to train the network `mae`, and discard any earlier job."""
        self._updater = self.preset.make_updater(self.robot, mae, self.seed)
        self._update = None

    @property
    def ready(self) -> bool:
        """Whether a job may be submitted."""
        return self._updater is not None and self._update is None

    @property
    def body(self) -> CalibratedBody | None:
        """The most recently fitted body, or None if none is known in this process."""
        return None if self._updater is None else self._updater.body

    def submit(self, job: Job) -> None:
        """Submit a job: run it at once; `poll` then returns its update."""
        assert self._updater is not None
        self._update = self._updater.update(job)

    def poll(self) -> Update | None:
        """Return the update if it is complete, else None."""
        update, self._update = self._update, None
        return update

    def values(self) -> dict[str, str]:
        """Return values for /diagnostics by name; this class has none."""
        return {}

    def close(self) -> None:
        """Discard the updater and its job."""
        self._updater = self._update = None


# -- separate training process --------------------------------------------------------------------

NICENESS = 5  # run the training process with a niceness higher than the node's by this
#: Wait this long before restarting a lost training process [s]. A process that dies in each start,
#: for example because memory is short, then takes little time from the other nodes.
PAUSE = 5.0
#: restart a training process, as hung, if an answer takes longer than this [s]; imports take
#: minutes on a slow disk
PATIENCE = 300.0
LONGEST_ENDING = 2.0  # wait at most this long for a killed training process to end [s]


class TrainerProcess(Trainer):
    """Runs updates in a separate process, which is restarted if it dies or hangs.

    A thread communicates with the process, so that `submit` and `poll` do not wait for answers.
    Ending a process can take twice LONGEST_ENDING. A restarted process repeats the job that was
    lost.
    """

    def __init__(self, robot: Robot, preset: str, seed: int = 0) -> None:
        super().__init__(robot, preset, seed)
        self.restarts = 0  # number of training processes that were lost and restarted
        self._mae: Mae | None = None
        self._job: Job | None = None
        self._process: SpawnProcess | None = None
        #: without a process, start one at this time; with a job, expect its answer until then [s]
        self._due = math.inf

    def begin(self, mae: Mae) -> None:
        """Begin with a network in a new process, which replaces the present one."""
        self.close()
        self._mae = mae
        self._start()

    def _start(self) -> None:
        assert self._mae is not None
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[Update | str] = queue.SimpleQueue()
        context = multiprocessing.get_context('spawn')
        arguments = self.robot.description.directory, self.preset.name, self.seed
        try:
            ours, theirs = context.Pipe()
            process = context.Process(target=serve, args=(theirs, *arguments), daemon=True)
            with theirs, interrupts_blocked():
                process.start()
        except OSError as error:
            self._schedule_restart(f'cannot be started ({error})')
            return
        self._process, self._due = process, math.inf
        talk = ours, process, self._mae, self.robot, self._jobs, self._answers
        self._thread = threading.Thread(target=_talk, args=talk, daemon=True)
        self._thread.start()
        if self._job is not None:
            self.submit(self._job)

    @property
    def pid(self) -> int | None:
        """Process id; None while there is no process."""
        return None if self._process is None else self._process.pid

    @property
    def ready(self) -> bool:
        """Whether the training process has started and waits for a job."""
        return self._process is not None and self._job is None

    def submit(self, job: Job) -> None:
        """Submit a job to the training process; `poll` returns its update later."""
        self._job, self._due = job, time.monotonic() + PATIENCE
        self._jobs.put(job)

    def poll(self) -> Update | None:
        """Return the update if it has arrived, else None; restart a lost process after a pause."""
        now = time.monotonic()
        if self._process is None:
            if now >= self._due:
                self._start()
            return None
        if self._job is None:
            return None
        try:
            answer = self._answers.get_nowait()
        except queue.Empty:
            if now > self._due:
                self._schedule_restart('did not answer in time')
            return None
        if isinstance(answer, str):
            self._schedule_restart(f'died ({answer})')
            return None
        self.trouble, self._mae, self._job = '', answer.mae, None
        return answer

    def _schedule_restart(self, problem: str) -> None:
        self._end()
        self.restarts += 1
        self.trouble = f'the training process {problem}; restarting it'
        self._due = time.monotonic() + PAUSE

    def _end(self) -> None:
        # The process may be killed at once, because this object can repeat the job and keeps the
        # last network.
        if self._process is not None:
            self._process.kill()
            self._process.join(LONGEST_ENDING)
            self._jobs.put(None)
            self._thread.join(LONGEST_ENDING)
            self._process = None

    def values(self) -> dict[str, str]:
        """Return the number of restarts and the process id for /diagnostics."""
        values = {'training process restarts': str(self.restarts)}
        return values if self.pid is None else {**values, 'training process': str(self.pid)}

    def close(self) -> None:
        """End the process and discard the job."""
        self._end()
        self._job, self._due = None, math.inf


def _talk(
    connection: Connection,
    process: SpawnProcess,
    mae: Mae,
    robot: Robot,
    jobs: queue.SimpleQueue[Job | None],
    answers: queue.SimpleQueue[Update | str],
) -> None:
    """Send network and jobs to a process, and put its updates or an error text into `answers`."""
    with connection:
        try:
            connection.send(checkpoint.to_bytes(mae))
            while (job := jobs.get()) is not None:
                connection.send(job)
                data, *others = connection.recv()
                answers.put(Update(checkpoint.from_bytes(data, robot), *others))
        except (EOFError, OSError):
            process.join(LONGEST_ENDING)
            answers.put(f'status {process.exitcode}')
        # Report every error, such as a truncated pickle or a lack of memory; otherwise the node
        # would wait until the deadline.
        except Exception as error:  # noqa: BLE001
            answers.put(f'{type(error).__name__}: {error}')


def serve(connection: Connection, directory: Path, preset: str, seed: int) -> None:
    """Run the training process until the node closes its end of the connection or dies."""
    faulthandler.enable()
    os.nice(NICENESS)
    import torch

    torch.set_num_threads(1)
    robot = Robot.load(directory)
    trainer = Trainer(robot, preset, seed)
    try:
        trainer.begin(checkpoint.from_bytes(connection.recv(), robot))
        while True:
            trainer.submit(connection.recv())
            update = trainer.poll()
            assert update is not None
            # Send the network as a checkpoint, which the receiver validates.
            connection.send((checkpoint.to_bytes(update.mae), *update[1:]))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass
