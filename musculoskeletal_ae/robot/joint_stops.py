# SPDX-License-Identifier: Apache-2.0
"""Which mechanical joint stops support an arm, when muscle tensions are chosen (`tension`)."""

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot

#: let a stop support a joint that is nearer to its limit than this [rad]; a joint with a target
#: nearer than this may come to rest at the stop instead
AT_STOP = 0.02
LEAVING = 1e-3  # no stop supports a joint that is to move away from it faster than this [rad/s]
#: no stop supports a joint that is to push away from it with more than this torque [N·m]
PUSHING = 1e-3


def supporting_stops(
    robot: Robot, theta: Array, velocity: Array | float = 0.0, effort: Array | float = 0.0
) -> Array:
    """Return the stops that support joints at θ, as the rows of a Jacobian (S, D).

    A stop pushes its joint back with any torque, but does not pull it. It is therefore modelled as
    a muscle that turns its joint away from the limit, and whose tension is the torque. A joint that
    is to move or push away from its stop needs its muscles for that.

    Args:
        robot: The robot.
        theta: Joint angles θ [rad], (D,) or (N, D). A stop supports a joint that is at the stop in
            all N postures, for example in the present one and in its target.
        velocity: Velocity θ̇ with which the joints are to move [rad/s], (D,).
        effort: Torque that the joints are to exert beyond gravity and inertia [N·m], (D,).
    """
    postures = np.atleast_2d(theta)
    velocity, effort = np.asarray(velocity), np.asarray(effort)
    is_low = (postures < robot.lower + AT_STOP).all(axis=0)
    is_high = (postures > robot.upper - AT_STOP).all(axis=0)
    is_low &= (velocity < LEAVING) & (effort < PUSHING)
    is_high &= (velocity > -LEAVING) & (effort > -PUSHING)
    joints = np.eye(robot.joint_count)
    return np.concatenate([-joints[is_low], joints[is_high]])
