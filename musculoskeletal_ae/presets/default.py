# SPDX-License-Identifier: Apache-2.0
"""Preset `default`: the most accurate methods of this project."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING

from musculoskeletal_ae.presets.preset import DEFAULT

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


class DefaultPreset:
    """The methods of this project; see `Preset` for the meaning of each part."""

    name = DEFAULT
    least_samples = 2
    methods_without_tension: tuple[str, ...] = 'geometric', 'first', 'proposed'

    def initial_steps(self, robot: Robot) -> int:
        """Return a number of mini-batches that grows with D + M of the network's largest block."""
        from musculoskeletal_ae.mae.default_training import default_steps, divided

        return default_steps(divided(robot)[0])

    def training_states(self, robot: Robot, count: int, rng: np.random.Generator) -> State:
        """Return random states, some of which exceed the tension limit."""
        from musculoskeletal_ae.mae.default_training import overload_states

        return overload_states(robot, count, rng)

    def train_initial(
        self, robot: Robot, seed: int, steps: int, progress: Progress | None
    ) -> Network:
        """Train on lengths and muscle Jacobians under all masks, with Muon."""
        from musculoskeletal_ae.mae.default_training import train

        return train(robot, seed, steps, progress)

    def make_updater(self, robot: Robot, mae: Mae, seed: int) -> Updater:
        """Return an updater that fits the calibrated body model."""
        from musculoskeletal_ae.learning.body_updater import BodyUpdater

        return BodyUpdater(robot, mae, seed)

    def residual_detectors(self, robot: Robot) -> tuple[ResidualDistance, list[Detector]]:
        """Return detectors of large residuals, slack tendons and modules not following commands."""
        from musculoskeletal_ae.estimation.detectors.module_following import (
            ModuleFollowing,
            PositionFollowing,
        )
        from musculoskeletal_ae.estimation.detectors.residual_distance import ResidualDistance
        from musculoskeletal_ae.estimation.detectors.slack_tendon import (
            SlackTendon,
            StretchedTendon,
        )

        slack = robot.actuation.choose(SlackTendon, StretchedTendon)(robot)
        following = robot.actuation.choose(ModuleFollowing, PositionFollowing)(robot)
        return ResidualDistance(robot, slack), [slack, following]

    def length_methods(self) -> Mapping[str, LengthMethod]:
        """Return the paper's methods except `proposed`.

        In this preset, `proposed` is not a length method, because it follows trajectories.
        """
        from musculoskeletal_ae.paper.control import METHODS

        return {name: method for name, method in METHODS.items() if name != 'proposed'}

    def exploration(self) -> Callable[[Robot, np.random.Generator], Iterable[Goal]]:
        """Return a function that draws the paper's three steps.

        In the targets, some joints are at their limits. The tensions of the third step press these
        joints against their stops.
        """
        from musculoskeletal_ae.motion.explored_postures import posture_at_limits, pressing_tension
        from musculoskeletal_ae.paper.exploration import three_steps

        return partial(three_steps, posture=posture_at_limits, constant_tension=pressing_tension)

    def make_simulator(self, robot: Robot) -> SimulatedBody:
        """Return a simulator that solves the balance of torques."""
        from musculoskeletal_ae.simulation.equilibrium import QuasiStatics

        return QuasiStatics(robot)
