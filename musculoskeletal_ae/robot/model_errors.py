# SPDX-License-Identifier: Apache-2.0
"""How much muscle lengths of a real arm differ from those of its geometric model.

A real tendon is attached some millimetres beside the route points of the model, and does not run
straight between them. At θ = 0, attachments cause no error, because lengths are relative to that
posture. The variance of the error of a length in the posture θ is

    s² = SHAPE_FACTOR² (SMOOTH² + σ² Σ over the route points of ‖∂f/∂p(θ) − ∂f/∂p(0)‖²)

where f is the length of the route, p a route point in the frame of its joint, and σ the muscle's
`attachment_spread`. The names in capitals are constants of this file. Errors of different muscles
are independent.
"""

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot

#: assume at most this standard deviation of each coordinate of each route point [m]
ATTACHMENT = 0.007
#: Assume at most this share of the muscle's typical moment arm as that standard deviation. 7 mm are
#: as much as the moment arms of a finger, and small limbs are described and built more exactly.
ATTACHMENT_SHARE = 0.3
#: assume at least this standard deviation of each coordinate [m], also without any moment arm
LEAST_ATTACHMENT = 0.0005
ELASTIC = 0.2  # assume this standard deviation of an elongation, relative to the elongation
#: assume this standard deviation of a length, because tendons do not run straight between route
#: points [m]
SMOOTH = 0.003
#: Multiply the standard deviation by this, because tendons make detours around bones. Without this
#: factor, lengths of four emulated arms with small detours (`kin`) differ from the model as
#: expected, and those of four arms with larger detours (`foreign`) by 1.4 to 2.1 times as much.
SHAPE_FACTOR = 1.7
#: treat a difference between a measured length and the geometric model as a fault if it is larger
#: than this [m]; healthy lengths of the emulated individuals 0 to 9 of arm26 and musashi_left_arm
#: differ by up to 42 mm (notes/removed_benches.md)
LARGEST = 0.045


def attachment_spread(robot: Robot) -> Array:
    """Return the standard deviation of each muscle's route points, per coordinate [m], (M,)."""
    relative = ATTACHMENT_SHARE * robot.routes.typical_arms
    return np.clip(relative, LEAST_ATTACHMENT, ATTACHMENT)


def length_variances(robot: Robot, theta: Array) -> Array:
    """Return the variance of each muscle's length error in the geometric model [m²], (N, M).

    `theta` are the joint angles in N postures [rad], (N, D).
    """
    routes, tree = robot.routes, robot.kinematics.tree
    slopes = routes.moved(tree.joint_poses(theta), routes.point)[1]
    at_zero = routes.moved(tree.joint_poses(np.zeros_like(theta[:1])), routes.point)[1]
    by_point = np.square(slopes - at_zero).sum(axis=-1)
    variance = np.full((len(theta), robot.muscle_count), SMOOTH**2)
    for m, spread in enumerate(attachment_spread(robot)):
        own = routes.muscle == m
        points = np.union1d(routes.first[own], routes.second[own])
        variance[:, m] += spread**2 * by_point[:, points].sum(axis=1)
    return SHAPE_FACTOR**2 * variance
