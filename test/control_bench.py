# SPDX-License-Identifier: Apache-2.0
"""A controller without an arm: sensor data is made up, time is counted by the test."""

from dataclasses import replace

import numpy as np
from exact_mae import ExactMae, rest_readings

from musculoskeletal_ae.control import status
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.safety import Muscles
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.robot.robot import Robot

ROBOT = Robot.load('arm26')
DT = 0.01
REST = np.array([-0.3, -1.0])
OTHER = np.array([0.1, -0.5])
COLD = np.full(ROBOT.muscle_count, 30.0)


class Bench:
    """A controller that is fed healthy sensor data unless told otherwise."""

    def __init__(self, mae=None, **chosen):
        # Ramps of lengths need no arm that comes along.
        self.core = Controller(ROBOT, Settings(**{'target_duration': 0.0, **chosen}))
        self.mae = mae or ExactMae(ROBOT)
        self.core.use(self.mae)
        self.now, self.dt = 100.0, DT
        self.theta, self.tension, self.temperature = REST, None, COLD
        self.blind = set()

    def step(self, count=1):
        """Return the commands of some steps."""
        sent = []
        for _ in range(count):
            self.now += self.dt
            if 'muscles' not in self.blind:
                length, tension = rest_readings(ROBOT, self.theta, self.tension)
                self.core.muscles(Muscles(length, tension, self.temperature), self.now)
            if 'estimate' not in self.blind:
                self.core.estimated(self.theta, self.now)
            sent.append(self.core.step(self.now))
        return sent

    def configure(self, **chosen):
        self.core.configure(replace(self.core.settings, **chosen))

    def target(self, theta, effort=(0.0, 0.0)):
        self.core.target(dict(zip(ROBOT.joints, zip(theta, effort))))

    def report(self):
        return status.report(self.core, self.now)


def values(commands):
    return np.array([command.value for command in commands])
