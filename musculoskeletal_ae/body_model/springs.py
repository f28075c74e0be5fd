# SPDX-License-Identifier: Apache-2.0
"""Learned springs of the joints: corrections of the springs that muscles.yaml states.

    K = S K̄ S,  S = diag(e^{α/2}),      b = e^α b̄ + β

K̄ and b̄ are the stated stiffness and preload. α are logarithmic errors of the stiffnesses, and β
errors of the torques at θ = 0 [N·m]. In this form, K has no negative eigenvalue for any α. Only
joints with a spring or a passive tendon in muscles.yaml have these two parameters; α does not
change the passive tendons. Both follow from the torque balance of rest samples
(`posture_model`), and therefore only from samples with tensions.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.robot.joint_elasticity import JointElasticity

#: assume this standard deviation of α, the logarithm of the ratio of a spring's true stiffness to
#: the stated one
STIFFNESS_SPREAD = 0.5
#: assume that the angle at which a spring exerts no torque differs from that of the robot
#: description by this standard deviation [rad]
REST_SPREAD = 0.2
LARGEST_LOG = 2.0  # clip the logarithmic error |α| of a stiffness to this, a factor of about 7


def none_learned(joint_count: int) -> Array:
    """Return the corrections α and β of springs that have not been learned: zeros, (2, D)."""
    return np.zeros((2, joint_count))


def prior_spread(nominal: JointElasticity) -> Array:
    """Return the prior spread of α and of β [N·m], (2, D); `nominal` are those of muscles.yaml."""
    stiffness = nominal.typical_stiffness
    return np.stack([np.full(len(stiffness), STIFFNESS_SPREAD), stiffness * REST_SPREAD])


def learned(nominal: JointElasticity, springs: Array) -> JointElasticity:
    """Return the springs `nominal` of muscles.yaml, corrected by α and β in `springs` (2, D)."""
    if not nominal.is_present:
        return nominal
    log = np.clip(springs[0], -LARGEST_LOG, LARGEST_LOG)
    scale = np.exp(0.5 * log)
    stiffness = scale[:, None] * nominal.stiffness * scale
    preload = np.exp(log) * nominal.preload + springs[1]
    return JointElasticity(stiffness, preload, nominal.damping, nominal.tendons)


def slope(nominal: JointElasticity, springs: Array, theta: Array, joints: Ints) -> Array:
    """Return the derivatives of K θ − b with respect to α and β, (N, D, 2 · joints).

    The derivatives with respect to α of all `joints` come first, then those with respect to β.

    Args:
        nominal: The springs that muscles.yaml states.
        springs: α and β of all joints, (2, D).
        theta: θ of all joints [rad], (N, D).
        joints: The joints, indices in θ.
    """
    now = learned(nominal, springs)
    count, places = theta.shape
    result = np.zeros((count, places, 2 * len(joints)))
    # Differentiate K by α: α of joint j scales row and column j of K by e^{α/2} each.
    result[:, :, : len(joints)] = 0.5 * now.stiffness[:, joints] * theta[:, None, joints]
    torque = theta @ now.stiffness
    for k, j in enumerate(joints.tolist()):
        result[:, j, k] += 0.5 * torque[:, j] - now.preload[j] + springs[1, j]
        result[:, j, len(joints) + k] = -1.0
    return result
