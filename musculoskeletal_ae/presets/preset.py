# SPDX-License-Identifier: Apache-2.0
"""The interface of a preset: one strategy for each part in which the presets differ.

A preset only selects strategies, which are implemented beside related code. Each method imports its
strategy when it is called, so that reading options and parameters imports neither numpy nor torch.
`registry.py` has the presets by name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Protocol

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


DEFAULT = 'default'  # name of the preset with the most accurate methods of this project
#: name of the preset that follows the paper, with which experiments compare other presets
PAPER_PRESET = 'paper'
PRESET_NAMES = DEFAULT, PAPER_PRESET  # legal values of parameters and options that name a preset


class Preset(Protocol):
    """All parts in which the presets differ.

    Attributes:
        name: Name by which users select the preset.
        least_samples: Smallest number of samples with which a network is updated online.
        methods_without_tension: Names of the control methods that need no measured tension.
    """

    name: str
    least_samples: int
    methods_without_tension: tuple[str, ...]

    # -- network and initial training -----------------------------------------------------------

    def initial_steps(self, robot: Robot) -> int:
        """Return the number of mini-batches of initial training for a robot."""

    def training_states(self, robot: Robot, count: int, rng: np.random.Generator) -> State:
        """Return `count` random states of the geometric model, drawn as for initial training."""

    def train_initial(
        self, robot: Robot, seed: int, steps: int, progress: Progress | None
    ) -> Network:
        """Train a new network on the geometric model."""

    # -- online learning ------------------------------------------------------------------------

    def make_updater(self, robot: Robot, mae: Mae, seed: int) -> Updater:
        """Return an updater for online learning, which starts from the network `mae`."""

    # -- anomalies ------------------------------------------------------------------------------

    def residual_detectors(self, robot: Robot) -> tuple[ResidualDistance, list[Detector]]:
        """Return the detector that decides by the network's residual, and physics-based detectors.

        The physics-based detectors, if there are any, take precedence.
        """

    # -- control --------------------------------------------------------------------------------

    def length_methods(self) -> Mapping[str, LengthMethod]:
        """Return, by name, the control methods that ramp to a single length command.

        All other methods follow trajectories or command tensions.
        """

    def exploration(self) -> Callable[[Robot, np.random.Generator], Iterable[Goal]]:
        """Return a function that draws the next steps of exploration.

        Its arguments are the robot and a random generator.
        """

    # -- simulation -----------------------------------------------------------------------------

    def make_simulator(self, robot: Robot) -> SimulatedBody:
        """Return a simulator for any number of arms of this robot."""
