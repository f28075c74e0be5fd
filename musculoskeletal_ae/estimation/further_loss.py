# SPDX-License-Identifier: Apache-2.0
"""Names the muscles that the estimate of the posture still needs while a muscle is isolated.

If too few muscles cross a joint, its angle follows from the training data rather than from the
readings, and the covariance of the fitted posture is large (`Mae.posture_covariance`). The
covariance is therefore computed in advance for the loss of each further muscle.
"""

import numpy as np

from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

#: call a joint undetermined in a posture if the standard deviation of its angle exceeds this [rad]
UNDETERMINED = 0.1
POSTURES = 50  # compute the covariance in this many random postures
#: name a joint only if it is undetermined in more than this share of the postures
NOTABLE_SHARE = 0.05


def needed_muscles(robot: Robot, mae: Mae) -> dict[str, str]:
    """Return which further muscles the estimate needs while a muscle is isolated.

    Args:
        robot: The robot.
        mae: The network in use, without the isolated muscles.

    Returns:
        By the name of each such muscle, a text with the joints that would be undetermined without
        the muscle; empty if no muscle is isolated.
    """
    if not mae.isolated:
        return {}
    theta = robot.random_postures(POSTURES, np.random.default_rng(0))
    jacobian = mae.muscle_jacobian(theta, np.tile(robot.tension.bias, (POSTURES, 1)))
    needed = dict[str, str]()
    for muscle, name in enumerate(robot.muscles):
        if muscle in mae.isolated:
            continue
        covariance = mae.without((*mae.isolated, muscle)).posture_covariance(jacobian)
        variance = np.diagonal(covariance, axis1=-2, axis2=-1)
        share = (variance > UNDETERMINED**2).mean(axis=0)
        joints = np.flatnonzero(share > NOTABLE_SHARE)
        if joints.size:
            shares = (f'{robot.joints[j]} in {share[j]:.0%} of the postures' for j in joints)
            needed[name] = ', '.join(shares)
    return needed
