# SPDX-License-Identifier: Apache-2.0
"""Preset `paper`: the procedure as printed (section "Online Learning").

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

from musculoskeletal_ae.learning.update import (
    Job,
    Update,
    history,
    newest_error,
    with_statistics,
)
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import from_mae, to_mae
from musculoskeletal_ae.mae.optimiser import Optimiser
from musculoskeletal_ae.mae.training import loss, one_thread
from musculoskeletal_ae.mae.units import scale_vector
from musculoskeletal_ae.presets import PAPER
from musculoskeletal_ae.robot.robot import Robot

BATCHES = 10  # C_batch
EPOCHS = 10  # C_epoch
THRESHOLD = 20  # C_thre
DATA = 10  # C_data


class PaperUpdater:
    """Learns as printed, on samples in their own units, by Adam of the initial training."""

    least_samples = THRESHOLD + 1

    def __init__(self, robot: Robot, mae: Mae, seed: int = 0) -> None:
        """Go on from a network."""
        self._robot, self._origin, self._mae = robot, mae, mae
        self._network = from_mae(mae)
        self._settings = PAPER.training
        self._optimiser = Optimiser(self._network, self._settings.step_size, muon=False)
        self._rng = np.random.default_rng([seed, 0x9A])
        self._steps = 0

    def update(self, job: Job) -> Update:
        """Learn one newest sample among stored ones; `job.steps` is the paper's own here."""
        robot, seen = self._robot, job.seen
        error = newest_error(self._mae, seen)
        values = np.concatenate([seen.theta, seen.tension, seen.length], axis=1)
        values = values * scale_vector(robot.joint_count, robot.muscle_count)
        # The print knows no changed muscle: a sample that says nothing about one is none.
        values = values[seen.known.all(axis=1)]
        enough = len(values) >= self.least_samples
        mask = torch.arange(3).repeat_interleave(DATA + 2)
        batches = []
        for _ in range(BATCHES if enough else 0):
            stored = self._rng.choice(len(values) - 1, DATA, replace=False)
            rows = np.vstack([values[-1], np.zeros(values.shape[1]), values[stored]])
            batches.append(torch.as_tensor(np.tile(rows, (3, 1)), dtype=torch.float32))
        losses = []
        with one_thread():
            for batch in EPOCHS * batches:
                value = loss(self._network, batch, mask, self._settings)
                value.backward()
                self._optimiser.step(1.0)
                losses.append(value.item())
        self._steps += len(losses)
        mae = to_mae(
            self._network,
            robot.joints,
            robot.muscles,
            self._origin.preset,
            history(self._origin, len(seen), 'paper', self._steps),
            job.version,
        )
        self._mae = with_statistics(mae, self._mae, job)
        return Update(
            self._mae, float(np.mean(losses[-BATCHES:])) if enough else np.nan, error, np.empty(0)
        )
