# SPDX-License-Identifier: Apache-2.0
"""Preset `paper`: the methods of the paper, from the folder `paper/`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING

from musculoskeletal_ae.paper.constants import HIDDEN, INITIAL_STEPS, THRESHOLD
from musculoskeletal_ae.presets.preset import PAPER_PRESET

if TYPE_CHECKING:
    import numpy as np

    from musculoskeletal_ae.estimation.detectors.residual_distance import ResidualDistance
    from musculoskeletal_ae.estimation.finding import Detector
    from musculoskeletal_ae.learning.updater import Updater
    from musculoskeletal_ae.mae.mae import Mae
    from musculoskeletal_ae.mae.network import Network
    from musculoskeletal_ae.mae.training import Progress
    from musculoskeletal_ae.mae.units import State
    from musculoskeletal_ae.motion.methods import Goal, LengthMethod
    from musculoskeletal_ae.robot.robot import Robot
    from musculoskeletal_ae.simulation.simulation import SimulatedBody


class PaperPreset:
    """The methods of the paper; see `Preset` for the meaning of each part.

    `hidden` contains the number of units of each hidden layer of the encoder. The default is the
    paper's choice; `experiments/layers.py` varies it.
    """

    name = PAPER_PRESET
    least_samples = THRESHOLD + 1
    methods_without_tension: tuple[str, ...] = 'geometric', 'first'

    def __init__(self, hidden: tuple[int, ...] = HIDDEN) -> None:
        self._hidden = hidden

    def initial_steps(self, robot: Robot) -> int:  # noqa: ARG002
        """Return the paper's number of mini-batches, which is the same for any body (§III-B)."""
        return INITIAL_STEPS

    def training_states(self, robot: Robot, count: int, rng: np.random.Generator) -> State:
        """Return random states with tensions up to T_max (§III-B)."""
        from musculoskeletal_ae.paper.initial_training import random_states

        return random_states(robot, count, rng)

    def train_initial(
        self, robot: Robot, seed: int, steps: int, progress: Progress | None
    ) -> Network:
        """Train on L_initial with Adam (§III-B)."""
        from musculoskeletal_ae.paper.initial_training import train

        return train(robot, seed, steps, progress, self._hidden)

    def make_updater(self, robot: Robot, mae: Mae, seed: int) -> Updater:
        """Return an updater that learns from the samples alone (§III-C)."""
        from musculoskeletal_ae.paper.online_learning import OnlineLearning

        return OnlineLearning(robot, mae, seed)

    def residual_detectors(self, robot: Robot) -> tuple[ResidualDistance, list[Detector]]:
        """Return a detector that decides by A alone (§III-D), and no physics-based detectors."""
        from musculoskeletal_ae.paper.state_estimation import AnomalyNorm

        return AnomalyNorm(robot), []

    def length_methods(self) -> Mapping[str, LengthMethod]:
        """Return the paper's four control methods (§III-E)."""
        from musculoskeletal_ae.paper.control import METHODS

        return METHODS

    def exploration(self) -> Callable[[Robot, np.random.Generator], Iterable[Goal]]:
        """Return the function that draws the three steps of random motion (§IV-A)."""
        from musculoskeletal_ae.paper.exploration import three_steps

        return three_steps

    def make_simulator(self, robot: Robot) -> SimulatedBody:
        """Return a simulator that descends in the latent space (§III-F)."""
        from musculoskeletal_ae.paper.simulation import LatentSimulation

        return LatentSimulation(robot)
