# SPDX-License-Identifier: Apache-2.0
"""Fill numba's cache by one step of both emulator models and of the simulator.

A node that compiles at run time cannot keep its rate, and cannot be stopped meanwhile.
"""

from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.simulation import Simulation

robot = Robot.load('arm26')
for reality in ('kin', 'foreign'):
    make_arm(robot, seed=0, reality=reality).step(0.001)
Simulation(robot, initial_mae(robot, steps=1).mae).step(0.01)
