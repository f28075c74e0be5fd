# SPDX-License-Identifier: Apache-2.0
"""Whether an arm can be held by its muscles: what `check_robot` measures and judges.

In postures drawn uniformly in the joint limits, the tension nearest to 60 N within [bias, limit]
that holds the arm's own weight; the joint stiffness under muscle stiffness control at that tension;
and the moment arms. An arm is sound when at least 95 % of the postures are held, at least 95 % have
a smallest stiffness eigenvalue of at least 5 N·m/rad (a posture that is not held counts as not
stiff), and no moment arm is at fault. Beside it, not judged: the one-sided stiffness, in which
muscles at the bias tension count as slack.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.exceptions import InfeasibleError
from musculoskeletal_ae.robot.moment_arms import Finding, moment_arm_faults, moment_arm_warnings
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.stiffness import joint_stiffness, muscle_hessian
from musculoskeletal_ae.robot.tension import TensionProgramme

DESIRED_TENSION = 60.0  # [N]
REQUIRED_SHARE = 0.95
REQUIRED_STIFFNESS = 5.0  # [N·m/rad]
LEAST_INERTIA = 1e-6  # [kg·m² or kg]; with less a joint cannot be simulated
SLACK_MARGIN = 1e-3  # [N] above bias; the solver meets a bound only to rounding


@dataclass(frozen=True)
class RobotCheck:
    """What was measured in N postures, and what is wrong.

    Attributes:
        postures: θ [rad], shape (N, D).
        moment_arms: r = −G [m], shape (N, M, D).
        tension: Holding tension [N], shape (N, M); NaN where the posture is not held.
        missing_torque: Torque lacking where a posture is not held [N·m], shape (N, D).
        stiffness: Smallest joint-stiffness eigenvalue [N·m/rad], shape (N,); NaN if not held.
        one_sided: Smallest eigenvalue with muscles at the bias tension slack, shape (N,).
        faults: Why the arm is not sound; empty if it is.
        warnings: What deserves a look but is not judged.
    """

    postures: Array
    moment_arms: Array
    tension: Array
    missing_torque: Array
    stiffness: Array
    one_sided: Array
    faults: tuple[Finding, ...]
    warnings: tuple[Finding, ...]

    @property
    def held(self) -> Bools:
        """Whether each posture is held, shape (N,)."""
        return np.isfinite(self.stiffness)

    @property
    def stiff(self) -> Bools:
        """Whether each posture is held and stiff enough, shape (N,)."""
        return self.stiffness >= REQUIRED_STIFFNESS


def check_robot(robot: Robot, postures: int = 200, seed: int = 0) -> RobotCheck:
    """Measure and judge a robot in random postures.

    Args:
        robot: The nominal body.
        postures: How many postures are drawn.
        seed: Random seed of the postures.

    Raises:
        RobotDescriptionError: If the directory's `moment_arms.csv` is not valid.
    """
    theta = robot.random_postures(postures, np.random.default_rng(seed))
    jacobian = robot.routes.muscle_jacobian(theta)
    torque = robot.kinematics.holding_torque(theta)
    measured = [_measure(robot, *at) for at in zip(theta, jacobian, torque, strict=True)]
    tension, missing, stiffness, softest, one_sided = map(np.array, zip(*measured, strict=True))
    return RobotCheck(
        postures=theta,
        moment_arms=-jacobian,
        tension=tension,
        missing_torque=missing,
        stiffness=stiffness,
        one_sided=one_sided,
        faults=(
            *moment_arm_faults(robot.description, -jacobian),
            *_inertia_faults(robot, theta),
            *_holding_faults(robot, stiffness, softest, missing),
        ),
        warnings=tuple(moment_arm_warnings(robot.description, -jacobian)),
    )


def _measure(
    robot: Robot, theta: Array, jacobian: Array, torque: Array
) -> tuple[Array, Array, float, int, float]:
    """Return tension, missing torque, stiffness, softest joint, one-sided stiffness at θ (D,)."""
    bias = robot.tension.bias
    programme = TensionProgramme(jacobian, torque, bias, robot.tension.limit)
    try:
        tension = programme.nearest(DESIRED_TENSION)
    except InfeasibleError:
        missing = programme.compromise().missing_torque
        return np.full(robot.muscle_count, np.nan), missing, np.nan, -1, np.nan
    hessian = muscle_hessian(robot.routes.muscle_jacobian, theta)
    k = robot.muscle_stiffness(theta, tension)
    taut = np.where(tension > bias + SLACK_MARGIN, k, 0.0)
    values, vectors = np.linalg.eigh(joint_stiffness(jacobian, hessian, k, tension))
    one_sided = np.linalg.eigvalsh(joint_stiffness(jacobian, hessian, taut, tension))[0]
    softest = int(np.abs(vectors[:, 0]).argmax())
    return tension, np.zeros(robot.joint_count), values[0], softest, one_sided


def _inertia_faults(robot: Robot, theta: Array) -> Iterator[Finding]:
    least = np.min([robot.kinematics.joint_inertia(posture) for posture in theta], axis=0)
    for name, value in zip(robot.joints, least, strict=True):
        if value < LEAST_INERTIA:
            yield Finding(
                'no_inertia',
                f'joint {name!r} moves no mass (inertia {value:.2g} kg·m²)',
                'give the links it carries an <inertial> in robot.urdf',
            )


def _holding_faults(
    robot: Robot, stiffness: Array, softest: Ints, missing: Array
) -> Iterator[Finding]:
    held, stiff = np.isfinite(stiffness), stiffness >= REQUIRED_STIFFNESS
    required = f'required {100 * REQUIRED_SHARE:.0f} %'
    if held.mean() < REQUIRED_SHARE:
        lack = np.abs(missing[~held])
        worst = lack.argmax(axis=1)
        where = ', '.join(
            f'{robot.joints[k]} in {count} (up to {lack[worst == k, k].max():.2f} N·m)'
            for k, count in Counter(sorted(worst.tolist())).most_common()
        )
        yield Finding(
            'not_held',
            f'the arm is not held: {100 * held.mean():.1f} % of postures hold their own '
            f'weight with T in [{robot.tension.bias:g}, {robot.tension.limit:g}] N, '
            f'{required}; of the {len(lack)} others torque lacks most at {where}',
            'lengthen the moment arms of the muscles at these joints, raise tension.limit '
            'or lighten the links',
        )
    if stiff.mean() < REQUIRED_SHARE:
        counts = Counter(sorted(softest[held & ~stiff].tolist()))
        where = ', '.join(f'{robot.joints[k]} ({count})' for k, count in counts.items())
        yield Finding(
            'not_stiff',
            f'the arm is not stiff: {100 * stiff.mean():.1f} % of postures have a smallest '
            f'stiffness eigenvalue >= {REQUIRED_STIFFNESS:g} N·m/rad, {required} '
            '(a posture that is not held counts as not stiff); softest joint of the held ones, '
            f'in postures: {where or "none"}',
            'lengthen the moment arms at these joints on both sides, or raise stiffness',
        )
