# SPDX-License-Identifier: Apache-2.0
"""Exploration: random motion that collects training data.

Each preset of settings has its own random steps (`Preset.exploration`). Preset `default` puts the
targets of some joints at their limits, because the learner identifies joint-sensor offsets from
joints at their stops (`body_model.sensor_offsets`). For each posture, this preset draws several
random sets of tensions and uses the one that presses these joints most strongly against their
stops.
"""

from collections.abc import Iterator

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Setup
from musculoskeletal_ae.motion.activities import ActivityControl, Command, Inputs
from musculoskeletal_ae.motion.methods import FIRST, Goal
from musculoskeletal_ae.motion.ramps import LengthRamps
from musculoskeletal_ae.presets.registry import preset_named


class Exploration:
    """An endless random sequence of exploration steps, reproducible by its seed.

    A new iterator does not repeat the sequence: it continues the sequence at a new posture.
    """

    def __init__(self, setup: Setup, seed: int) -> None:
        """Prepare to draw the random steps of a preset, with the random seed `seed`."""
        self._setup, self._rng = setup, np.random.default_rng([seed, 0xE8])

    def __iter__(self) -> Iterator[Goal]:
        while True:
            draw = preset_named(self._setup.settings.preset).exploration()
            yield from draw(self._setup.robot, self._rng)


class Exploring(ActivityControl):
    """The activity of exploring, which executes random steps with ramps of muscle lengths."""

    def __init__(self, exploration: Exploration, ramps: LengthRamps) -> None:
        self.stream, self.ramps = exploration, ramps
        self._steps: Iterator[Goal] | None = None

    def enter(self, inputs: Inputs) -> None:
        """Begin the exploration, or continue it after a pause, from the present tensions."""
        self.ramps.start_from(inputs.length)
        self._steps = self._steps or iter(self.stream)

    def step(self, inputs: Inputs) -> Command | None:
        """Advance by one control step and return the next command.

        Raises:
            RobotDescriptionError: If too few postures are holdable.
        """
        assert self._steps is not None
        if self.ramps.is_over_after(inputs.dt):
            goal = next(self._steps)
            # All other methods use the present tension.
            self.ramps.pursue([goal if goal.method == FIRST else goal._replace(tension=None)])
        return self.ramps.step(inputs)

    def leave(self) -> None:
        """Leave the exploration; the next exploration starts with another posture."""
        self._steps = None

    @property
    def missing_torque(self) -> Array | None:
        """Torque [N·m], (D,), that the muscles cannot exert at the present goal."""
        return self.ramps.missing_torque
