# SPDX-License-Identifier: Apache-2.0
"""The process in which a learner's node lets its network be trained.

python -m musculoskeletal_ae.learning.worker FILE_DESCRIPTOR     (started by `WorkerProcess` only)

It is told a robot and a network, then jobs one at a time, and answers each with a checkpoint. It
ends when the node's end of the connection closes, however the node ended.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from musculoskeletal_ae.learning.worker_process import Answer, Start

NICENESS = 5


def serve(connection: Connection) -> None:
    """Answer until the other end closes."""
    # The heavy imports belong into this process, not into the node that imports this module.
    import torch

    from musculoskeletal_ae.learning.online import make_updater
    from musculoskeletal_ae.mae import checkpoint
    from musculoskeletal_ae.robot.robot import Robot

    torch.set_num_threads(1)
    node = os.getppid()
    updater: Any = None
    file: Path | None = None
    while True:
        message = connection.recv()
        if isinstance(message, Start):
            robot, file = Robot.load(message.robot), message.file
            mae = checkpoint.from_bytes(message.checkpoint, robot)
            updater = make_updater(robot, mae, message.preset, message.seed)
            connection.send(updater.least_samples)
            continue
        begun = time.perf_counter()
        update = updater.update(message)
        # A node that was killed may have a successor, which keeps its own.
        unsaved = ''
        if file is not None and os.getppid() == node:
            try:
                checkpoint.save(update.mae, file)
            except OSError as error:
                unsaved = str(error)
        anomaly = update.mae.anomaly
        connection.send(
            Answer(
                checkpoint.to_bytes(update.mae),
                update.mae.version,
                update.loss,
                update.error,
                update.noise,
                update.changed,
                update.doubtful,
                anomaly is not None and anomaly.calibrated,
                unsaved,
                time.perf_counter() - begun,
            )
        )


def main() -> None:
    """Serve the connection whose file descriptor is the only argument."""
    # Ctrl-C goes to the whole group; the node ends this process by closing the connection.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICENESS)
    with Connection(int(sys.argv[1])) as connection:
        try:
            serve(connection)
        except (EOFError, BrokenPipeError, ConnectionResetError):
            pass


if __name__ == '__main__':
    main()
