# SPDX-License-Identifier: Apache-2.0
"""Online learning (§III-C).

    batch = {newest, (0, 0, 0), C_data random stored ones} × {①, ②, ③},   3 (C_data + 2) entries

The network is updated as soon as more than C_thre samples are stored. A sample is stored if the
robot is at rest and the sample differs from every stored one by more than a threshold, in θ or in
T. Both presets share this rule (`learning/samples.py`, `learning/rest.py`).

"The number of batches C_batch = 10" has two readings. Ten such batches, each with its own random
samples, are repeated for ten epochs: 100 steps of 36 entries. Or one batch of 36 entries is split
into mini-batches of ten: 4 × 10 steps. We chose the first. The text calls the 36 entries "a batch",
and under the second reading an update would use only ten stored samples.

The paper does not state the following, which we chose. The loss is L_initial of equation (3), with
the weights of that equation. The optimiser is Adam with the step size of initial training, and it
keeps its moments between updates.
"""

import numpy as np
import torch

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.scheduler import Job, Update
from musculoskeletal_ae.learning.updater import Updater
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import from_mae
from musculoskeletal_ae.mae.optimiser import Optimiser
from musculoskeletal_ae.mae.training import one_thread
from musculoskeletal_ae.paper.constants import (
    DATA,
    ONLINE_BATCHES,
    ONLINE_EPOCHS,
    STEP_SIZE,
    THRESHOLD,
)
from musculoskeletal_ae.paper.initial_training import loss
from musculoskeletal_ae.robot.robot import Robot


def draw_batch(values: Array, rng: np.random.Generator) -> Array:
    """Return the rows of a batch, repeated for each mask ①, ② and ③: (3 (C_data + 2), D+2M).

    Args:
        values: Stored samples, scaled (θ, T, l), the newest last, (N, D+2M).
        rng: Random generator that draws C_data of the stored samples.
    """
    stored = rng.choice(len(values) - 1, DATA, replace=False)
    nothing = np.zeros(values.shape[1])
    return np.tile(np.vstack([values[-1], nothing, values[stored]]), (3, 1))


class OnlineLearning(Updater):
    """Trains the whole network in every update, once more than C_thre samples are stored."""

    def __init__(self, robot: Robot, mae: Mae, seed: int = 0) -> None:
        super().__init__(robot, mae, seed)
        self._network = from_mae(mae)
        self._optimiser = Optimiser(self._network, STEP_SIZE, muon=False)
        self._rng = np.random.default_rng([seed, 0x9A])
        self._steps = 0

    def _learn(self, job: Job) -> Update:
        # The paper has no relearned muscles, so use only samples in which all values are known.
        observed = job.observed.with_all_angles()
        values = observed[np.flatnonzero(observed.known.all(axis=1))].state().scaled()
        count = ONLINE_BATCHES if len(values) > THRESHOLD else 0
        batches = [
            torch.as_tensor(draw_batch(values, self._rng), dtype=torch.float32)
            for _ in range(count)
        ]
        mask = torch.arange(3).repeat_interleave(DATA + 2)
        losses = []
        with one_thread():
            for batch in ONLINE_EPOCHS * batches:
                value = loss(self._network, batch, mask)
                value.backward()
                self._optimiser.step()
                losses.append(value.item())
        self._steps += len(losses)
        last = float(np.mean(losses[-ONLINE_BATCHES:])) if losses else np.nan
        unchanged = (
            f'preset paper needs more than {THRESHOLD} samples with all joint angles and muscles, '
            f'and has {len(values)}'
        )
        return Update(
            self._published(self._network, 'paper', self._steps, job),
            last,
            unchanged='' if losses else unchanged,
        )
