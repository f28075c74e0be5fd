# SPDX-License-Identifier: Apache-2.0
"""An emulated arm under control, closed as on the real one: sense → estimate → control → command.

It steps the same core as the nodes, faster than real time.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.safety import LENGTH, Command, Muscles
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.mae.mae import Mae

PERIOD = 0.01  # [s], 100 Hz as the modules report


class ControlLoop:
    """Emulated arm, estimator and controller.

    Attributes:
        arm: The arm.
        settings: Of control.
        core: Control itself.
        command: What it commanded last.
        now: Time [s].
    """

    def __init__(self, arm: EmulatedArm, mae: Mae, settings: Settings | None = None) -> None:
        """Close the loop around an arm, with one network for estimate and control."""
        self.arm, self.settings = arm, settings or Settings()
        self._mae = mae
        self.core = Controller(arm.robot, self.settings)
        self.core.use(mae)
        self.command: Command | None = None
        self.now = 0.0

    def target(self, theta: Array, effort: Array | None = None) -> None:
        """Go to a posture [rad] (D,), exerting a torque [N·m] (D,) there."""
        torque = np.zeros(len(theta)) if effort is None else effort
        names = self.arm.robot.joints
        self.core.target(dict(zip(names, zip(theta.tolist(), torque.tolist()))))

    def run(self, seconds: float) -> None:
        """Let time pass."""
        for _ in range(round(seconds / PERIOD)):
            read = self.arm.sense()
            theta = self._mae.estimate(read.tension, read.length).theta
            self.core.muscles(Muscles(read.length, read.tension, read.temperature), self.now)
            self.core.estimated(theta, self.now)
            self.command = self.core.step(self.now)
            if self.command is not None:
                if self.command.kind == LENGTH:
                    self.arm.command_length(self.command.value)
                else:
                    self.arm.command_tension(self.command.value)
            self.arm.step(PERIOD)
            self.now += PERIOD
