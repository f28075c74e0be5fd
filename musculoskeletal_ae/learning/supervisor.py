# SPDX-License-Identifier: Apache-2.0
"""Keeps a training process running: one job at a time, and started again if it dies."""

from __future__ import annotations

import time
from collections.abc import Callable

from musculoskeletal_ae.learning.update import Job
from musculoskeletal_ae.learning.worker_process import Answer, Start, WorkerProcess

#: until a training process that died is started again [s], doubled each time up to the longest
FIRST_PAUSE, LONGEST_PAUSE = 1.0, 60.0


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
        self.restarts = 0
        self.trouble = ''

    def start(self) -> None:
        """Start a process, in the place of the one before."""
        self.stop()
        self._worker = WorkerProcess(self._begin_with())

    def stop(self) -> None:
        """End the process, if there is one."""
        self._restart_at = None
        if self._worker is not None:
            self._worker.close()
            self._worker = None

    def submit(self, job: Job) -> None:
        """Hand over a job; only when `can_take` says so."""
        assert self._worker is not None
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
            self.restarts += 1
            self.trouble = f'the training process died ({self._worker.dead}); starting it again'
            self.stop()
            self._restart_at = now + self._pause
            self._pause = min(2.0 * self._pause, LONGEST_PAUSE)
        elif answer is not None:
            self.trouble, self._pause = '', FIRST_PAUSE
        return answer

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
