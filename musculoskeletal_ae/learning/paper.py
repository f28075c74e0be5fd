# SPDX-License-Identifier: Apache-2.0
"""An update of preset `paper`: the procedure as printed (section "Online Learning").

    batch = {newest, (0, 0, 0), C_data random stored ones} × {①, ②, ③},   3 (C_data + 2) entries

from C_thre samples on, with C_thre = 20, C_data = 10, number of batches 10 and epochs 10.

"The number of batches C_batch = 10" can be read as ten such batches, each with its own random
samples, gone through ten times: 100 steps of 36 entries. Or as mini-batches of ten within one
batch of 36: 4 × 10 steps. The first is chosen: the text calls the 36 entries "a batch", so their
number counts such batches; and with the second an update would see only ten stored samples.
"""

from __future__ import annotations

import numpy as np
import torch

from musculoskeletal_ae.learning.training import Job, Update
from musculoskeletal_ae.learning.update import Updater
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import from_mae
from musculoskeletal_ae.mae.optimiser import Optimiser
from musculoskeletal_ae.mae.training import loss, one_thread
from musculoskeletal_ae.mae.units import scale_vector
from musculoskeletal_ae.presets import PAPER
from musculoskeletal_ae.robot.robot import Robot

BATCHES = 10  # C_batch
EPOCHS = 10  # C_epoch
DATA = 10  # C_data


class PaperUpdater(Updater):
    """Learns as printed, on samples in their own units, by Adam of the initial training."""

    def __init__(self, robot: Robot, mae: Mae, seed: int = 0) -> None:
        """Go on from a network."""
        super().__init__(robot, mae)
        self._network = from_mae(mae)
        self._optimiser = Optimiser(self._network, PAPER.training.step_size, muon=False)
        self._rng = np.random.default_rng([seed, 0x9A])
        self._steps = 0

    def update(self, job: Job) -> Update:
        """Learn one newest sample among stored ones; `job.steps` is the paper's own here."""
        robot, seen, error = self._robot, job.seen, self._newest_error(job.seen)
        values = np.concatenate([seen.theta, seen.tension, seen.length], axis=1)
        values = values * scale_vector(robot.joint_count, robot.muscle_count)
        # The print knows no changed muscle: a sample that says nothing about one is none.
        values = values[seen.known.all(axis=1)]
        batches = []
        for _ in range(BATCHES if len(values) >= PAPER.least_samples else 0):
            stored = self._rng.choice(len(values) - 1, DATA, replace=False)
            rows = np.vstack([values[-1], np.zeros(values.shape[1]), values[stored]])
            batches.append(torch.as_tensor(np.tile(rows, (3, 1)), dtype=torch.float32))
        mask = torch.arange(3).repeat_interleave(DATA + 2)
        losses = []
        with one_thread():
            for batch in EPOCHS * batches:
                value = loss(self._network, batch, mask, PAPER.training)
                value.backward()
                self._optimiser.step(1.0)
                losses.append(value.item())
        self._steps += len(losses)
        mae = self._published(self._network, 'paper', self._steps, job)
        last = float(np.mean(losses[-BATCHES:])) if losses else np.nan
        return Update(mae, last, error, np.empty(0))
