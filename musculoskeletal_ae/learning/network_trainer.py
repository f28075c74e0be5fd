# SPDX-License-Identifier: Apache-2.0
"""How preset `default` trains the network online: a few steps at a time, averaged."""

import copy

import numpy as np
import torch
from torch import Tensor

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.synthetic import TrainingData
from musculoskeletal_ae.mae.network import Network
from musculoskeletal_ae.mae.optimiser import Optimiser
from musculoskeletal_ae.mae.training import TINY, one_thread
from musculoskeletal_ae.mae.units import LENGTH_SCALE

STEP_SIZE = 2e-3
BATCH = 128
#: averaged over this share of the steps so far, but at least and at most so many steps
AVERAGED_SHARE, LEAST_AVERAGED, MOST_AVERAGED = 0.1, 20.0, 2000.0
#: the step size falls to a half after so many steps, and at last to this share of itself, below
#: which the average no longer wanders but a slowly changing body is still followed
CALMING, LEAST_CALM = 2000.0, 0.1


class NetworkTrainer:
    """Trains the network a few steps at a time, for as long as the robot lives.

    What is published is the average of the weights over about the last tenth of all steps, and the
    step size falls as steps add up, so that the network follows a body that is still being found
    out and becomes calm when it is known. (At a constant step size even the average wanders: ±10 %
    of the error of an arm over hours.)
    """

    def __init__(self, network: Network, seed: int = 0, steps: int = 0) -> None:
        """Go on from a network's weights, as calmly as after so many `steps`."""
        self.network = network  # the average: what is published
        self._restless = copy.deepcopy(network)
        self._weights = [*zip(network.parameters(), self._restless.parameters())]
        self._optimiser = Optimiser(self._restless, STEP_SIZE, muon=True)
        self._rng = np.random.default_rng([seed, 0x7A])
        self.steps = steps  # taken so far, in former lives too

    def train(self, data: TrainingData, steps: int) -> float:
        """Take steps on batches of the data; return the mean loss of the last half of them."""
        entered, true = (torch.as_tensor(part, dtype=torch.float32) for part in data)
        mask = torch.arange(3).repeat_interleave(BATCH)
        losses = []
        with one_thread():
            for _ in range(steps):
                rows = torch.as_tensor(self._rng.integers(len(entered), size=BATCH))
                value = _loss(self._restless, entered[rows], true[rows], mask)
                value.backward()
                self._optimiser.step(max(LEAST_CALM, 1.0 / (1.0 + self.steps / CALMING)))
                self.steps += 1
                self._average()
                losses.append(value.item())
        return float(np.mean(losses[len(losses) // 2 :]))

    def move(self, length: Array) -> None:
        """Go on as the network of an arm whose lengths are all longer by so much [m], (M,)."""
        for network in (self.network, self._restless):
            network.mean[-len(length) :] += torch.as_tensor(LENGTH_SCALE * length)

    def restart(self) -> None:
        """Take large steps again and average few: the body has changed."""
        self.steps = min(self.steps, int(LEAST_AVERAGED / AVERAGED_SHARE))

    def _average(self) -> None:
        span = min(max(AVERAGED_SHARE * self.steps, LEAST_AVERAGED), MOST_AVERAGED)
        with torch.no_grad():
            for mean, now in self._weights:
                mean.lerp_(now, 1.0 / span)


def _loss(network: Network, entered: Tensor, true: Tensor, mask: Tensor) -> Tensor:
    """Return the three norms, each in units of the spread of the data, all three masks entered."""
    error = network.decoder(network.encode(entered.repeat(3, 1), mask))
    error = error - ((true - network.mean) / network.std).repeat(3, 1)  # (3N, D+2M)
    parts = error.square().split([network.joints, network.muscles, network.muscles], dim=1)
    return torch.stack([(part.sum(dim=1) + TINY).sqrt().mean() for part in parts]).sum()
