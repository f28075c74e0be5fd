# SPDX-License-Identifier: Apache-2.0
"""The advice on a refused trajectory is followed by the message that the user sends next.

test_motion.py follows that on poses of the hand (`unreachable`), and test_message_reading.py has a
legal message beside each illegal one.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from remedies import check_remedy, members

from musculoskeletal_ae.control.followed_goal import read_tolerances
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.messages.message_reading import TrajectoryPoints
from musculoskeletal_ae.motion.trajectory import Setpoint, Trajectory
from musculoskeletal_ae.robot.robot import Robot

ROBOT = Robot.load('arm26')
MIDDLE, BOTH = 0.5 * (ROBOT.lower + ROBOT.upper), np.array([0, 1])
TOP = ROBOT.upper - 0.02


def sent(time, position, velocity=None, passed=0.0):
    """Plan a trajectory that arrives `passed` seconds after its start, and check its limits."""
    points = TrajectoryPoints(BOTH, np.array(time), np.array(position), velocity, None)
    Trajectory.through(Setpoint.resting(MIDDLE), points, passed).check(ROBOT)


def at_speed(speed):
    """Return a message with a point near the limits that is passed at a speed [rad/s]."""
    return {'velocity': np.array([[speed, speed], [0.0, 0.0]])}


TWO = {'time': [1.0, 2.0], 'position': [TOP, TOP]}
SLOWER = 'send more points or smaller velocities'
#: what is sent, the advice of its refusal, and what is sent then
ROWS = {
    'points at nearly the same time': (
        {'time': [0.001, 3e5, 3e5 + 1e-9], 'position': [MIDDLE, MIDDLE, TOP]},
        'send one of them only',
        [{'time': [0.001, 3e5], 'position': [MIDDLE, TOP]}],
    ),
    'late message': (
        TWO | {'passed': 5.0},
        r'send a later header\.stamp, or 0',
        [TWO | {'passed': 1.5}, TWO],
    ),
    'fast near the limits': (
        TWO | at_speed(3.0),
        SLOWER,
        [
            TWO | at_speed(0.01),
            {'time': [0.5, 1.0, 1.5, 2.0], 'position': [0.5 * (MIDDLE + TOP), TOP, TOP, TOP],
             'velocity': np.zeros((4, 2))},
        ],
    ),
    'not finite between the points': (
        TWO | at_speed(1e308),
        'send smaller velocities and accelerations',
        [TWO | at_speed(0.01)],
    ),
}  # fmt: skip


@pytest.mark.parametrize('name', ROWS)
def test_a_trajectory_is_accepted_after_the_advice(name):
    with np.errstate(all='ignore'):
        check_remedy(lambda message: sent(**message), *ROWS[name], MessageError)


def test_a_tolerance_is_accepted_for_each_joint_that_the_refusal_names():
    check_remedy(
        lambda name: read_tolerances([SimpleNamespace(name=name, position=0.1)], ROBOT.units),
        'knee',
        'legal: (.*)$',
        members(),
        MessageError,
    )
