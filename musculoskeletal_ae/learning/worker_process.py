# SPDX-License-Identifier: Apache-2.0
"""The node's side of the training process: hand over a job, ask later, never wait."""

from __future__ import annotations

import queue
import socket
import subprocess
import sys
import tempfile
import threading
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.update import Job

ENDING = 2.0  # [s] that the process has to end by itself


class Start(NamedTuple):
    """What a worker is told first.

    Attributes:
        robot: Directory of the robot.
        checkpoint: The network to go on from.
        preset: How to learn.
        seed: Of everything random.
        file: Where to keep the network; None for nowhere.
    """

    robot: Path
    checkpoint: bytes
    preset: str
    seed: int
    file: Path | None


class Answer(NamedTuple):
    """What came of a job: `Update` in a form that crosses processes.

    Beside it: why the network could not be saved, or '', and the time that the update took [s].
    """

    checkpoint: bytes
    version: int
    loss: float
    error: float
    noise: Array
    changed: tuple[tuple[int, int], ...]
    doubtful: tuple[int, ...]
    calibrated: bool
    unsaved: str
    seconds: float


class WorkerProcess:
    """One training process and the thread that talks to it.

    Attributes:
        busy: Whether a job is under way.
        dead: Why the process can do no more, or ''.
        least_samples: From how many samples on it learns; None until it is up.
    """

    def __init__(self, start: Start) -> None:
        """Start the process."""
        # A file, because nobody reads a pipe while the process lives.
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  (closed by close)
        ours, theirs = socket.socketpair()
        with theirs:
            # Its own module, on the interpreter that runs this.
            self._process = subprocess.Popen(  # noqa: S603
                [sys.executable, '-m', 'musculoskeletal_ae.learning.worker', str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stderr=self._errors,
            )
        self._connection = Connection(ours.detach())
        self.busy = False
        self.dead = ''
        self.least_samples: int | None = None
        self._jobs: queue.SimpleQueue[Job | Start | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[Answer | int | Exception] = queue.SimpleQueue()
        self._jobs.put(start)
        self._thread = threading.Thread(target=self._talk, daemon=True)
        self._thread.start()

    @property
    def pid(self) -> int:
        """Id of the process."""
        return self._process.pid

    def submit(self, job: Job) -> None:
        """Hand over a job; only when not busy."""
        self.busy = True
        self._jobs.put(job)

    def poll(self) -> Answer | None:
        """Return the answer to the job, if it has come."""
        try:
            answer = self._answers.get_nowait()
        except queue.Empty:
            return None
        if isinstance(answer, int):
            self.least_samples = answer
            return None
        self.busy = False
        if isinstance(answer, Exception):
            self.dead = f'{type(answer).__name__} {answer}'.strip()
            if isinstance(answer, EOFError | OSError):
                self.dead = self._last_words() or self.dead
            else:
                self.kill()  # it lives, but what it says cannot be taken
            return None
        return answer

    def _last_words(self) -> str:
        try:
            self._process.wait(ENDING)
        except subprocess.TimeoutExpired:
            return ''
        self._errors.seek(0)
        lines = self._errors.read().decode(errors='replace').strip().splitlines()
        return f'status {self._process.returncode} {lines[-1] if lines else ""}'

    def kill(self) -> None:
        """End the process by force."""
        with suppress(OSError):
            self._process.kill()

    def close(self) -> None:
        """End the process; within `ENDING` by itself, else by force."""
        self._jobs.put(None)
        with suppress(OSError):
            self._process.terminate()
        try:
            self._process.wait(ENDING)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._thread.join(ENDING)
        self._errors.close()

    def _talk(self) -> None:
        with self._connection as connection:
            while (job := self._jobs.get()) is not None:
                try:
                    connection.send(job)
                    self._answers.put(connection.recv())
                # Whatever it is, as a torn pickle or no memory: it would be waited for else.
                except Exception as error:  # noqa: BLE001
                    self._answers.put(error)
                    return
