# SPDX-License-Identifier: Apache-2.0
"""What a preset chooses: one strategy for each part in which presets differ.

A preset only names its strategies; they live where their subject is. Each method imports what it
returns, because options and parameters are read without numpy and torch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import numpy as np

    from musculoskeletal_ae.control.exploration import Step
    from musculoskeletal_ae.control.methods import LengthMethod
    from musculoskeletal_ae.estimation.detectors.residual_distance import ResidualDistance
    from musculoskeletal_ae.estimation.finding import Detector
    from musculoskeletal_ae.estimation.settings import Detection
    from musculoskeletal_ae.learning.updater import Updater
    from musculoskeletal_ae.mae.mae import Mae
    from musculoskeletal_ae.mae.training import Progress, TrainedNetwork
    from musculoskeletal_ae.mae.units import State
    from musculoskeletal_ae.robot.groups import Group
    from musculoskeletal_ae.robot.robot import Robot
    from musculoskeletal_ae.simulation.simulation import SimulatedBody


class Preset(Protocol):
    """Everything in which two presets differ.

    Attributes:
        name: As users choose it.
        least_samples: From how many samples on a network is updated online.
        validates_updates: Whether the learner validates what it learned before it publishes it
            (`estimation/checkpoint_validation.py`).
        simulates_on_devices: Whether the simulator can compute on a device of torch.
    """

    name: str
    least_samples: int
    validates_updates: bool
    simulates_on_devices: bool

    # -- network and initial training -----------------------------------------------------------

    def initial_steps(self, groups: Iterable[Group]) -> int:
        """Return the mini-batches of initial training for a robot's groups."""

    def training_states(self, robot: Robot, count: int, rng: np.random.Generator) -> State:
        """Return random states of the geometric model, such as initial training uses."""

    def train_initial(
        self, robot: Robot, seed: int, steps: int, progress: Progress | None
    ) -> TrainedNetwork:
        """Train a new network on the geometric model."""

    # -- online learning ------------------------------------------------------------------------

    def make_updater(self, robot: Robot, mae: Mae, seed: int) -> Updater:
        """Return what learns online, going on from a network."""

    # -- anomalies ------------------------------------------------------------------------------

    def residual_detectors(
        self, robot: Robot, settings: Detection
    ) -> tuple[ResidualDistance, list[Detector]]:
        """Return the detector that decides by the network's residual.

        With it come the detectors by physics, if there are any, which count before it.
        """

    # -- control --------------------------------------------------------------------------------

    def length_methods(self) -> Mapping[str, LengthMethod]:
        """Return the control methods that ramp to one length command, by name.

        All other methods are followers of trajectories or command tensions.
        """

    def exploration(self) -> Callable[[Robot, np.random.Generator], Iterable[Step]]:
        """Return what draws the next steps of exploration."""

    # -- simulation -----------------------------------------------------------------------------

    def make_simulator(self, robot: Robot) -> SimulatedBody:
        """Return what steps simulated arms of a robot."""
