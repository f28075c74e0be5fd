# SPDX-License-Identifier: Apache-2.0
"""Online training of the network in preset `default`: few steps per update, averaged weights."""

import copy

import numpy as np
import torch
from torch import Tensor

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.body_model.synthetic import TrainingData
from musculoskeletal_ae.mae.network import Network
from musculoskeletal_ae.mae.optimiser import Optimiser
from musculoskeletal_ae.mae.training import TINY, one_thread
from musculoskeletal_ae.mae.units import LENGTH_SCALE

STEP_SIZE = 2e-3  # begin online training with this step size of the optimiser
BATCH = 128  # train on this many samples at once
#: publish an average of the weights over this share of all steps so far, because single steps are
#: noisy
AVERAGED_SHARE = 0.1
LEAST_AVERAGED = 20.0  # average the weights over at least this many steps
MOST_AVERAGED = 2000.0  # average the weights over at most this many steps
HALVING_STEPS = 2000.0  # divide the step size by 1 + steps/HALVING_STEPS: by 2 at this step
#: Lower the step size to no less than this share of the initial one. The weight average then no
#: longer drifts, but the network still follows a slowly changing body.
LEAST_STEP_SHARE = 0.1
#: Give the error of θ, estimated from T and l, this weight in the loss; all other errors have the
#: weight 1. The target of this estimate is rougher than the lengths of a body.
ESTIMATE_WEIGHT = 3.0


class NetworkTrainer:
    """Trains the network a few steps at a time over the whole life of a robot.

    The published network is a weight average over about the last tenth of all steps. The step size
    decreases with the number of steps: the network first follows a body that is still being
    learned, and settles when the body is known. At a constant step size, even the averaged
    network's error varies by ±10 % over hours.
    """

    def __init__(self, network: Network, seed: int = 0, steps: int = 0) -> None:
        """Continue from a network that has been trained online for `steps` steps."""
        self.network = network  # weight average, which is published
        self._raw = copy.deepcopy(network)
        self._weights = [*zip(network.parameters(), self._raw.parameters())]
        self._optimiser = Optimiser(self._raw, STEP_SIZE, muon=True)
        self._rng = np.random.default_rng([seed, 0x7A])
        self.steps = steps  # number of steps so far, including those before a restart

    def train(self, data: TrainingData, steps: int) -> float:
        """Train for `steps` steps on random batches; return the mean loss in the second half."""
        entered, true = (torch.as_tensor(part, dtype=torch.float32) for part in data)
        mask = torch.arange(3).repeat_interleave(BATCH)
        losses = []
        with one_thread():
            for _ in range(steps):
                rows = torch.as_tensor(self._rng.integers(len(entered), size=BATCH))
                value = _loss(self._raw, entered[rows], true[rows], mask)
                value.backward()
                share = 1.0 / (1.0 + self.steps / HALVING_STEPS)
                self._optimiser.step(max(LEAST_STEP_SHARE, share))
                self.steps += 1
                self._average()
                losses.append(value.item())
        return float(np.mean(losses[len(losses) // 2 :]))

    def move(self, length: Array) -> None:
        """Add `length` [m], (M,), to all lengths that the network computes, without training."""
        for network in (self.network, self._raw):
            network.mean[-len(length) :] += torch.as_tensor(LENGTH_SCALE * length)

    def restart(self) -> None:
        """Restart with a large step size and a short weight average, because the body has changed.

        The weights are kept.
        """
        self.steps = min(self.steps, int(LEAST_AVERAGED / AVERAGED_SHARE))

    def _average(self) -> None:
        span = min(max(AVERAGED_SHARE * self.steps, LEAST_AVERAGED), MOST_AVERAGED)
        with torch.no_grad():
            for average, raw in self._weights:
                average.lerp_(raw, 1.0 / span)


def _loss(network: Network, entered: Tensor, true: Tensor, mask: Tensor) -> Tensor:
    """Return the training loss: the weighted sum of the error norms of standardised θ, T and l.

    The means are taken over the samples and over all three masks of the network's inputs. The error
    of the estimate of θ from T and l has the weight ESTIMATE_WEIGHT.
    """
    error = network.decoder(network.encode(entered.repeat(3, 1), mask))
    error = error - ((true - network.mean) / network.std).repeat(3, 1)  # (3N, D+2M)
    parts = error.square().split([network.joints, network.muscles, network.muscles], dim=1)
    norms = torch.stack([(part.sum(dim=1) + TINY).sqrt() for part in parts])  # (3, 3N)
    of_estimate = norms[0].view(3, -1)[1]  # masks come one after the other (`Mask`)
    return norms.mean(dim=1).sum() + (ESTIMATE_WEIGHT - 1.0) / 3.0 * of_estimate.mean()
