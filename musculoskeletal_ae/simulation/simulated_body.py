# SPDX-License-Identifier: Apache-2.0
"""The interface of all simulators; each preset has one with its own equations."""

from typing import Protocol

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.equilibrium import ArmState


class SimulatedBody(Protocol):
    """Steps N simulated arms of one robot; `Preset.make_simulator` returns an instance."""

    def use(self, mae: Mae, robot: Robot) -> None:
        """Use a network, and the robot with the currently isolated muscles."""

    def step(
        self, state: ArmState, command: Array, h: float, wrench: Array, fixed: Array
    ) -> ArmState:
        """Return the state of the arms after a step.

        Args:
            state: Present state of the arms.
            command: l_target [m], (N, M); PAID_OUT (∞) for muscles without a command.
            h: Duration of the step [s].
            wrench: Wrench on the end effectors in axes of the root link [N, N·m], (N, 6).
            fixed: Angles that joints are forced to [rad], (N, D); NaN for a free joint.
        """
