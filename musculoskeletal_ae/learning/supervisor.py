# SPDX-License-Identifier: Apache-2.0
"""Keeps a training process running: one job at a time, and started again if it dies or hangs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from musculoskeletal_ae.learning.update import Job
from musculoskeletal_ae.learning.worker_process import Answer, Start, WorkerProcess

#: until a training process that died is started again [s], doubled each time up to the longest
FIRST_PAUSE, LONGEST_PAUSE = 1.0, 60.0
#: until a process that does not come up is taken to hang [s]: the first import on a slow disk takes
#: minutes
PATIENCE_AT_START = 300.0
#: the same of one that does not answer, and what each step of training adds; it takes a hundredth
PATIENCE, PATIENCE_PER_STEP = 60.0, 0.1


class Supervisor:
    """The node's side of training; no call waits for the process.

    Attributes:
        restarts: How often the process died.
        trouble: Why it died, until it has answered again; or ''.
    """

    def __init__(self, begin_with: Callable[[], Start]) -> None:
        """Start nothing yet.

        Args:
            begin_with: Returns what a new process is told first.
        """
        self._begin_with = begin_with
        self._worker: WorkerProcess | None = None
        self._pause = FIRST_PAUSE
        self._restart_at: float | None = None
        self._deadline = math.inf
        self.restarts = 0
        self.trouble = ''

    def start(self) -> None:
        """Start a process, in the place of the one before; later, if that cannot be done now."""
        self.stop()
        self._deadline = time.monotonic() + PATIENCE_AT_START
        try:
            self._worker = WorkerProcess(self._begin_with())
        except OSError as error:
            self._failed(f'the training process cannot be started ({error})')

    def stop(self) -> None:
        """End the process, if there is one."""
        self._restart_at = None
        if self._worker is not None:
            self._worker.close()
            self._worker = None

    def submit(self, job: Job) -> None:
        """Hand over a job; only when `can_take` says so."""
        assert self._worker is not None
        self._deadline = time.monotonic() + PATIENCE + PATIENCE_PER_STEP * job.steps
        self._worker.submit(job)

    def poll(self) -> Answer | None:
        """Return the answer to the job, if it has come; start a process that died again."""
        now = time.monotonic()
        if self._worker is None:
            if self._restart_at is not None and now >= self._restart_at:
                self.start()
            return None
        answer = self._worker.poll()
        if self._worker.dead:
            why = self._worker.dead
            self.stop()
            self._failed(f'the training process died ({why})')
        elif answer is not None:
            self.trouble, self._pause = '', FIRST_PAUSE
        elif now > self._deadline and (self.busy or self._worker.least_samples is None):
            self._worker.kill()
            self.stop()
            self._failed('the training process did not answer in time')
        return answer

    def _failed(self, why: str) -> None:
        self.restarts += 1
        self.trouble = f'{why}; starting it again'
        self._restart_at = time.monotonic() + self._pause
        self._pause = min(2.0 * self._pause, LONGEST_PAUSE)

    @property
    def busy(self) -> bool:
        """Whether a job is under way."""
        return self._worker is not None and self._worker.busy

    def can_take(self, samples: int) -> bool:
        """Return whether it is up, idle, and so many samples are enough to learn from."""
        worker = self._worker
        if worker is None or worker.busy or worker.least_samples is None:
            return False
        return samples >= worker.least_samples

    @property
    def pid(self) -> int | None:
        """Id of the process; None while there is none."""
        return None if self._worker is None else self._worker.pid
