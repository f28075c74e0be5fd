# SPDX-License-Identifier: Apache-2.0
"""Checks whether the muscles of an arm can hold it (`check_robot`).

For postures drawn uniformly within the joint limits, the check computes

- the tension nearest to 0.3 T_limit within [T_bias, T_limit] that holds weight and springs,
- the joint stiffness at that tension (`stiffness`), with the springs, and
- the moment arms r(θ) = −∂l/∂θ [m], the joint torque for one newton of tension. A muscle with
  r > 0 moves the joint in its positive direction.

A tendon parallel to the axis of a prismatic joint has r = RACK (`robot/joint_units.py`).

An arm without faults is called sound; doc/explanation/method.md ("An arm must be holdable") states
the requirements. A joint with a spring or a passive tendon may have muscles on one side only, if
these muscles can hold the joint. The report also shows the one-sided stiffness, for information
only. It regards muscles at the tension that their modules maintain (T_bias, or 0 for
position-controlled modules) as slack.

A suspended robot, such as a platform that hangs on four tendons, is judged in its equilibria only
(`equilibria.py`), and need only be stable there.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.design.equilibria import Equilibria, equilibria, is_suspended
from musculoskeletal_ae.design.route_jumps import jumping_muscles, limit_without_jumps
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.files import read_csv
from musculoskeletal_ae.problems import Problem, read_problems
from musculoskeletal_ae.robot.actuation import DESIRED_SHARE
from musculoskeletal_ae.robot.description import RobotDescription, Wrap, refusal, shown, written
from musculoskeletal_ae.robot.joint_units import SLIDE
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.stiffness import joint_stiffness, muscle_hessian
from musculoskeletal_ae.robot.tension import least_tension

#: report a fault if the muscles hold the arm in less than this share of the postures, or if it is
#: stiff enough in less than this share
REQUIRED_SHARE = 0.95
#: require this smallest eigenvalue of the joint stiffness [N·m/rad], or less if the load of the
#: joints is small (STIFFNESS_PER_LOAD)
REQUIRED_STIFFNESS = 5.0
#: require no more stiffness than this multiple of the largest load of a joint [1/rad]: a change of
#: that load by a tenth then moves no joint by more than 0.05 rad
STIFFNESS_PER_LOAD = 2.0
LEAST_INERTIA = 1e-12  # regard a smaller inertia of a joint as a rounding error [kg·m²]
#: for the one-sided stiffness, treat a muscle as slack up to this much above the tension that its
#: module maintains [N], because the solver rounds
SLACK_MARGIN = 1e-3
#: treat a muscle as acting on a joint if its moment arm exceeds this [m]: 300 N then produce about
#: 1 N·m
COUNTED_ARM = 0.003
#: treat a muscle as acting on a joint also if its moment arm exceeds this share of the longest
#: moment arm at the joint
COUNTED_ARM_SHARE = 0.1
LEAST_COUNTED_ARM = 1e-4  # but ignore every moment arm below this [m]
#: warn about a joint all of whose moment arms are shorter than this [m]: in emulated individuals,
#: they deviate by half or more
SHORT_ARM = 0.015
#: tolerate this share of postures in which a muscle acts with the wrong sign, or a joint lacks
#: muscles on one side
TOLERATED_SHARE = 0.05
#: conclude that a tendon touches a wrapped object if the object lengthens its route by more than
#: this [m]; less is a rounding error
LEAST_DETOUR = 1e-6
LONGEST_ARM = 1.0  # warn about a longer moment arm [m]: its points are probably in millimetres
#: report a fault if half of the muscles have a longer moment arm than this [m]: all points are then
#: in millimetres
MILLIMETRES = 5.0
#: warn about a wider range of a joint: its limits are probably in degrees (revolute, [rad]) or in
#: millimetres (prismatic, [m])
WIDEST_RANGES = 4.0 * np.pi, 10.0
#: file of a robot directory in which a user declares signs of moment arms
DECLARATION_FILE = 'moment_arms.csv'
COLUMNS = ['muscle', 'joint', 'sign']  # require these columns in this file
PROBLEMS = read_problems(__file__, 'robot_problems.yaml')


class Setting(NamedTuple):
    """A robot in N postures, with the quantities that determine holding and stiffness."""

    robot: Robot
    theta: Array  # joint angles [rad], (N, D)
    jacobian: Array  # muscle Jacobian G = ∂l/∂θ [m/rad], (N, M, D)
    hessian: Array  # its derivative ∂²l/∂θ² [m/rad²], (N, M, D, D)
    torque: Array  # g + K θ − b + h, which holds the arm against weight and springs [N·m], (N, D)
    weight: Array  # torque g that holds the arm against its weight [N·m], (N, D)
    springs: Array  # stiffness of springs and passive tendons [N·m/rad], (N, D, D)

    @classmethod
    def of(cls, robot: Robot, theta: Array) -> Setting:
        """Return a robot in postures θ [rad], (N, D), with all quantities computed."""
        weight = robot.kinematics.weight_torque(theta)
        elasticity = robot.kinematics.elasticity
        torque = weight + elasticity.holding_torque(theta)
        slopes = _slopes(robot, theta)
        springs = elasticity.stiffness_at(theta)
        return cls(robot, theta, *slopes, torque, weight, springs)

    def rerouted(self, robot: Robot) -> Setting:
        """Return the quantities of a robot that differs from this one only in its routes."""
        jacobian, hessian = _slopes(robot, self.theta)
        return self._replace(robot=robot, jacobian=jacobian, hessian=hessian)


def _slopes(robot: Robot, theta: Array) -> tuple[Array, Array]:
    """Return the first and second derivatives of the lengths, `jacobian` and `hessian`."""
    jacobian = robot.routes.muscle_jacobian
    return jacobian(theta), muscle_hessian(jacobian, theta)


@dataclass(frozen=True)
class RobotCheck:
    """Results of `check_robot` in N postures."""

    setting: Setting
    moment_arms: Array  # moment arm r of each muscle at each joint [m], (N, M, D)
    tension: Array  # holding tension [N], (N, M); NaN where the posture is not held
    missing_torque: Array  # torque that the muscles lack to hold a posture [N·m], (N, D)
    stiffness: Array  # smallest joint-stiffness eigenvalue [N·m/rad], (N,); NaN if not held
    #: like `stiffness`, but without muscles at the tension that their modules maintain, (N,)
    one_sided: Array
    required: float  # smallest eigenvalue of the joint stiffness that is required [N·m/rad]
    matters: Array  # smallest moment arm with which a muscle acts on each joint [m], (D,)
    softest: Ints  # index of the softest joint in each posture that is held but not stiff
    faults: tuple[Problem, ...] = ()  # reasons why the arm is not sound; empty if it is sound
    warnings: tuple[Problem, ...] = ()  # questionable properties that do not make it unsound

    @property
    def held(self) -> Bools:
        """Whether the muscles hold the arm in each posture, shape (N,)."""
        return np.isfinite(self.stiffness)

    @property
    def stiff(self) -> Bools:
        """Whether the arm is held and stiff enough in each posture, shape (N,)."""
        return self.stiffness >= self.required


def check_robot(robot: Robot, postures: int = 200, seed: int = 0) -> RobotCheck:
    """Check the muscles of a robot in random postures, and its description for suspicious values.

    Args:
        robot: The robot.
        postures: Number of postures.
        seed: Random seed of the postures.

    Raises:
        RobotDescriptionError: If the directory's `moment_arms.csv` is not valid.
    """
    theta = robot.random_postures(postures, np.random.default_rng(seed))
    if is_suspended(robot):
        found = equilibria(robot, theta)
        theta = found.theta
        result = _judge_suspended(Setting.of(robot, theta), found)
    else:
        result = judge(Setting.of(robot, theta))
    arms = result.moment_arms
    if wrong_unit := tuple(_millimetres(arms)):
        return replace(result, faults=wrong_unit, warnings=())
    suspicious = (
        *_other_units(robot, arms),
        *_small_joints(robot, arms),
        *_jumping_muscles(robot),
        *_idle_objects(robot, theta),
    )
    faults = (*result.faults, *_inertia_faults(robot, theta))
    return replace(result, faults=faults, warnings=(*result.warnings, *suspicious))


def judge(setting: Setting) -> RobotCheck:
    """Judge whether the muscles of a robot hold and stiffen it in given postures.

    Args:
        setting: The robot and the postures.

    Raises:
        RobotDescriptionError: If the directory's `moment_arms.csv` is not valid.
    """
    result, robot = measure(setting), setting.robot
    arms, matters = result.moment_arms, result.matters
    faults = (
        *_wrong_signs(robot, arms),
        *_one_way_joints(robot, arms, matters),
        *_useless_muscles(robot, arms, matters),
        *_holding_faults(result),
    )
    return replace(result, faults=faults, warnings=tuple(_flipping_muscles(robot, arms)))


def counted_arm(arms: Array) -> Array:
    """Return the smallest moment arm that counts at each joint [m], (D,).

    Args:
        arms: Moment arms in N postures [m], (N, M, D).
    """
    longest = np.abs(arms).max(axis=(0, 1))
    return np.clip(COUNTED_ARM_SHARE * longest, LEAST_COUNTED_ARM, COUNTED_ARM)


def measure(setting: Setting) -> RobotCheck:
    """Measure tensions, stiffness and moment arms in given postures, without judging them."""
    robot, _, jacobian, _, torque, *_ = setting
    bias, limit = robot.tension.bias, robot.tension.limit
    tension, missing = np.full(jacobian.shape[:2], np.nan), np.zeros(torque.shape)
    load = float(robot.joint_load(setting.weight, jacobian).max())
    required = min(REQUIRED_STIFFNESS, STIFFNESS_PER_LOAD * load)
    for n, (at, weight) in enumerate(zip(jacobian, torque, strict=True)):
        exertion = least_tension(at, weight, bias, limit, DESIRED_SHARE * limit)
        missing[n] = exertion.missing_torque
        tension[n] = np.nan if missing[n].any() else exertion.tension
    return _at_tensions(setting, tension, missing, required, setting.springs)


def _at_tensions(
    setting: Setting, tension: Array, missing: Array, required: float, passive: Array
) -> RobotCheck:
    """Return the check of a robot at known holding tensions, without faults and warnings.

    Args:
        setting: The robot and the postures.
        tension: Holding tensions [N], (N, M); NaN where the posture is not held.
        missing: Torque that the muscles lack [N·m], (N, D).
        required: Required stiffness [N·m/rad].
        passive: Stiffness that does not come from the muscles [N·m/rad], (N, D, D).
    """
    robot, theta, jacobian, hessian, *_ = setting
    arms = -jacobian
    matters = counted_arm(arms)
    held = np.isfinite(tension[:, 0])
    stiffness, one_sided = np.full((2, len(theta)), np.nan)
    k = robot.muscle_stiffness(theta[held], tension[held])
    # A position-controlled module holds its length, so its muscle resists even at T_bias and counts
    # as taut.
    is_taut = tension[held] > robot.actuation.kept_tension + SLACK_MARGIN
    taut = np.where(is_taut, k, 0.0)
    full, sided = (
        passive[held] + joint_stiffness(jacobian[held], hessian[held], x, tension[held])
        for x in (k, taut)
    )
    values, vectors = np.linalg.eigh(full)
    stiffness[held], one_sided[held] = values[:, 0], np.linalg.eigvalsh(sided)[:, 0]
    softest = np.abs(vectors[:, :, 0]).argmax(axis=1)[values[:, 0] < required]
    return RobotCheck(
        setting, arms, tension, missing, stiffness, one_sided, required, matters, softest
    )


def _judge_suspended(setting: Setting, found: Equilibria) -> RobotCheck:
    """Judge a suspended robot in its equilibria, which need only be stable (`equilibria`)."""
    robot = setting.robot
    symmetric = 0.5 * (found.gradient + found.gradient.swapaxes(-1, -2))
    result = _at_tensions(setting, found.tension, found.missing, 0.0, symmetric)
    arms, held, stable = result.moment_arms, result.held, result.stiff
    fields = {
        'joints': robot.joint_count, 'muscles': robot.muscle_count, 'count': len(held),
        'required': 100 * REQUIRED_SHARE, 'bias': shown(robot.tension.bias),
        'limit': shown(robot.tension.limit),
    }  # fmt: skip
    faults = [
        *_wrong_signs(robot, arms),
        *_one_way_joints(robot, arms, result.matters, is_suspended=True),
        *_useless_muscles(robot, arms, result.matters),
    ]
    if held.mean() < REQUIRED_SHARE:
        faults.append(PROBLEMS['no_equilibrium'].filled(share=100 * held.mean(), **fields))
    elif stable.mean() < REQUIRED_SHARE:
        faults.append(PROBLEMS['unstable'].filled(share=100 * stable.mean(), **fields))
    warnings = PROBLEMS['suspended'].filled(**fields), *_flipping_muscles(robot, arms)
    return replace(result, faults=tuple(faults), warnings=warnings)


class ArmTerms(NamedTuple):
    """Unit and wording for moment arms at a joint.

    At a prismatic joint, a moment arm is shown as the share of the tension that acts along the axis
    of the joint.
    """

    scale: float  # factor from a moment arm in metres to the shown number [1/m]
    unit: str  # unit of the shown number, 'mm' or '%'
    name: str  # what the number is called, such as 'moment arm'
    other: str  # where to route a muscle that must act in the other direction
    better: str  # where to route a muscle for a larger moment arm
    guided: str  # how to keep a tendon on one side of the joint, as the end of a sentence, or ''

    def decimals(self, longest: float) -> int:
        """Return the number of decimals for moment arms of at most `longest` [m]."""
        return int(self.scale * longest < 10.0)


def arm_terms(robot: Robot, joint: int) -> ArmTerms:
    """Return unit and wording for moment arms at a joint."""
    if robot.units.slides[joint]:
        scale, other, better = 100.0 / SLIDE.radian, 'towards the other end of', 'more parallel to'
        return ArmTerms(scale, '%', 'force share', other, better, '')
    guided = ', or keep it on one side of the axis by `wrap: cylinder` around the axis'
    return ArmTerms(1e3, 'mm', 'moment arm', 'to the other side of', 'further from', guided)


def required_stiffness(robot: Robot, required: float) -> str:
    """Return the required joint stiffness as a text, such as '5 N·m/rad'.

    If the robot has prismatic joints, the text also states the value in N/m.

    Args:
        robot: The robot.
        required: Smallest permitted eigenvalue of the joint stiffness [N·m/rad].
    """
    text = f'{required:.2g} N·m/rad'
    if robot.units.slides.any():
        text += f' ({SLIDE.stiffness_text(required, ".0f")} for prismatic joints)'
    return text


def rounded_text(value: float, least: int = 1, largest: float | None = None) -> str:
    """Return a value as text, with the decimals that give `largest` two significant digits.

    Args:
        value: The value.
        least: Smallest number of decimals.
        largest: The largest of the values that are shown together; by default `value`.

    Returns:
        The number as text, without a sign if it rounds to zero.
    """
    size = abs(value if largest is None else largest)
    decimals = max(least, 1 - int(np.floor(np.log10(size)))) if size else least
    return f'{round(value, decimals) + 0.0:.{decimals}f}'


def read_declared_actions(description: RobotDescription) -> dict[tuple[int, int], int]:
    """Read the signs of moment arms (±1) that `moment_arms.csv` declares.

    The keys are pairs of indices (muscle, joint). The result is empty if there is no such file.

    Raises:
        RobotDescriptionError: If the file is invalid; the message names the line and the legal
            values.
    """
    file = description.directory / DECLARATION_FILE
    legal = (description.muscles, description.joints, ('+', '-'))
    actions: dict[tuple[int, int], int] = {}
    if not os.path.lexists(file):
        return actions
    for line, text, cells in read_csv(file, COLUMNS, refusal):
        where = f'{file}: line {line}'
        if len(cells) != len(COLUMNS):
            expected = f'3 values ({",".join(COLUMNS)})'
            raise RobotDescriptionError(f'{where}: expected {expected}, got {text.strip()!r}')
        row = [*cells[:2], cells[2].replace('−', '-')]
        for column, cell, names in zip(COLUMNS, row, legal, strict=True):
            if cell not in names:
                raise RobotDescriptionError(
                    f'{where}: unknown {column} {cell!r}; legal: {", ".join(names)}'
                )
        muscle, joint, sign = (names.index(cell) for cell, names in zip(row, legal, strict=True))
        if (muscle, joint) in actions:
            problem = f'the sign of {row[0]} at {row[1]} is declared twice; remove one line'
            raise RobotDescriptionError(f'{where}: {problem}')
        actions[muscle, joint] = 1 - 2 * sign
    return actions


def _wrong_signs(robot: Robot, moment_arms: Array) -> Iterator[Problem]:
    """Yield a fault for each moment arm whose declared sign is wrong in too many postures."""
    for (muscle, joint), sign in read_declared_actions(robot.description).items():
        arm, terms = moment_arms[:, muscle, joint], arm_terms(robot, joint)
        against = np.mean(arm * sign <= 0.0)
        expected, actual = '+-' if sign > 0 else '-+'
        if not arm.any():
            actual = '0 (it does not cross the joint)'
        if against > TOLERATED_SHARE:
            yield PROBLEMS['wrong_sign'].filled(
                muscle=robot.muscles[muscle], joint=robot.joints[joint], terms=terms,
                expected=expected, actual=actual, against=100 * against,
                median=terms.scale * np.median(arm), file=DECLARATION_FILE,
            )  # fmt: skip


def _one_way_joints(
    robot: Robot, moment_arms: Array, matters: Array, *, is_suspended: bool = False
) -> Iterator[Problem]:
    """Yield a fault for each joint that lacks necessary muscles in too many postures.

    A joint needs muscles on both sides, or on one side if it has a spring or a passive tendon. The
    joints of a suspended robot need any muscle.
    """
    lacks = {
        '+': np.max(moment_arms, axis=1) <= matters,
        '-': np.min(moment_arms, axis=1) >= -matters,
    }
    median, longest = np.median(moment_arms, axis=0), np.abs(moment_arms).max(axis=0)
    one_way = np.mean(lacks['+'] | lacks['-'], axis=0) > TOLERATED_SHARE
    # A joint with a spring needs muscles on one side only, because the spring turns it back.
    has_muscle = np.mean(lacks['+'] & lacks['-'], axis=0) <= TOLERATED_SHARE
    one_way &= ~(robot.kinematics.elasticity.is_sprung & has_muscle)
    for joint in np.flatnonzero(one_way).tolist():
        missing = ' and '.join(
            f'{sign} (in {100 * lacking[:, joint].mean():.0f} % of postures)'
            for sign, lacking in lacks.items()
            if lacking[:, joint].any()
        )
        if is_suspended and (longest[:, joint] > matters[joint]).any():
            continue
        terms = arm_terms(robot, joint)
        decimals = terms.decimals(longest[:, joint].max())
        acting = ', '.join(
            f'{robot.muscles[m]} ({terms.scale * median[m, joint]:+.{decimals}f} {terms.unit})'
            for m in np.flatnonzero(longest[:, joint] > matters[joint])
        )
        key = 'one_way_joint' if acting else 'one_way_joint, idle'
        yield PROBLEMS[key].filled(
            joint=robot.joints[joint], missing=missing, acting=acting, terms=terms
        )


def _useless_muscles(robot: Robot, moment_arms: Array, matters: Array) -> Iterator[Problem]:
    """Yield a fault for each muscle that acts on no joint: all its moment arms are too short."""
    along = ', or parallel to that of a prismatic joint' * bool(robot.units.slides.any())
    for muscle, arms in zip(robot.muscles, np.abs(moment_arms).max(axis=0), strict=True):
        if (arms < matters).all():
            terms, least = arm_terms(robot, int(arms.argmax())), 1e3 * matters.max()
            fields = {'arm': terms.scale * arms.max(), 'least': least, 'along': along}
            yield PROBLEMS['useless_muscle'].filled(muscle=muscle, terms=terms, **fields)


def main_actions(moment_arms: Array) -> tuple[Ints, Array]:
    """Return the joint on which each muscle acts most, and how often its action is reversed there.

    Args:
        moment_arms: Moment arms in N postures [m], (N, M, D).

    Returns:
        Index of the joint, (M,), and the share of the postures in which the moment arm at this
        joint has the opposite sign of its median, (M,).
    """
    median, muscles = np.median(moment_arms, axis=0), np.arange(moment_arms.shape[1])
    main = np.abs(median).argmax(axis=1)
    against = moment_arms[:, muscles, main] * np.sign(median[muscles, main]) < 0.0
    return main, against.mean(axis=0)


def _flipping_muscles(robot: Robot, moment_arms: Array) -> Iterator[Problem]:
    """Yield a warning for each muscle whose main action changes its sign within joint limits."""
    for m, (joint, against) in enumerate(zip(*main_actions(moment_arms), strict=True)):
        if against > TOLERATED_SHARE:
            names = {'muscle': robot.muscles[m], 'joint': robot.joints[joint]}
            terms = arm_terms(robot, joint)
            yield PROBLEMS['flipping_muscle'].filled(**names, against=100 * against, terms=terms)


def _millimetres(moment_arms: Array) -> Iterator[Problem]:
    """Yield a fault if most route points seem to be in millimetres instead of metres.

    All other faults would then be consequences of this one.
    """
    typical = float(np.median(np.abs(moment_arms).max(axis=(0, 2))))
    if typical > MILLIMETRES:
        yield PROBLEMS['other_units, points'].filled(arm=typical)


def _other_units(robot: Robot, moment_arms: Array) -> Iterator[Problem]:
    """Yield a warning for each moment arm or joint limit that looks like millimetres or degrees."""
    longest, units = np.abs(moment_arms).max(axis=0), robot.units
    slides, ends = units.slides, (units.to_position(robot.lower), units.to_position(robot.upper))
    for m, j in np.argwhere((longest > LONGEST_ARM) & ~slides).tolist():
        names = {'muscle': robot.muscles[m], 'joint': robot.joints[j]}
        yield PROBLEMS['other_units, arm'].filled(**names, arm=longest[m, j])
    for j, (low, high) in enumerate(zip(*ends)):
        if high - low > WIDEST_RANGES[int(slides[j])]:
            wrong = 'metres, not millimetres' if slides[j] else 'radians, not degrees'
            limits = {'low': low, 'high': high, 'unit': units[j].position}
            yield PROBLEMS['other_units, limits'].filled(
                joint=robot.joints[j], wrong=wrong, **limits
            )


def _small_joints(robot: Robot, moment_arms: Array) -> Iterator[Problem]:
    """Yield a warning about the joints at which all moment arms are shorter than 15 mm."""
    # Skip joints without muscles, which are reported as one-way joints.
    longest = np.abs(moment_arms).max(axis=(0, 1))
    small = np.flatnonzero((longest > LEAST_COUNTED_ARM) & (longest < SHORT_ARM)).tolist()
    if small:
        each = ', '.join(f'{robot.joints[j]} ({1e3 * longest[j]:.1f} mm)' for j in small)
        yield PROBLEMS['small_joints'].filled(joints=each)


def _jumping_muscles(robot: Robot) -> Iterator[Problem]:
    """Yield a warning for each muscle whose length jumps where its tendon slips over an object."""
    for jump in jumping_muscles(robot):
        low, high = jump.theta.min(axis=0), jump.theta.max(axis=0)
        place = ', '.join(
            f'{robot.joints[j]} from {robot.units[j].range_text(low[j], high[j])}'
            for j in np.flatnonzero(robot.routes.crossed[jump.muscle])
        )
        limit = limit_without_jumps(robot, jump)
        yield PROBLEMS['jumping_muscle'].filled(
            muscle=robot.muscles[jump.muscle], size=1e3 * jump.size, place=place,
            limit=f'limit {limit}, or ' if limit else '',
        )  # fmt: skip


def _idle_objects(robot: Robot, theta: Array) -> Iterator[Problem]:
    """Yield a warning about wrapped objects that the tendon touches in none of the postures."""
    described = [
        f'{muscle} ({written(item)["wrap"]} of {round(1e3 * item.radius, 1):g} mm on {item.link})'
        for muscle, route in zip(robot.muscles, robot.description.routes, strict=True)
        for item in route
        if isinstance(item, Wrap)
    ]
    touched = robot.routes.wound(theta).max(axis=0, initial=0.0) > LEAST_DETOUR
    if idle := [text for text, touches in zip(described, touched, strict=True) if not touches]:
        yield PROBLEMS['idle_object'].filled(objects=', '.join(idle))


def _inertia_faults(robot: Robot, theta: Array) -> Iterator[Problem]:
    """Yield a fault for each joint that moves almost no mass."""
    kin = robot.kinematics
    least = np.min([kin.joint_inertia(posture) for posture in theta], axis=0)
    for j in np.flatnonzero(least < LEAST_INERTIA):
        moved = f'inertia {least[j]:.2g} kg·m²'
        if robot.units.slides[j]:
            moved = f'{least[j] / robot.units[j].radian ** 2:.2g} kg'
        yield PROBLEMS['no_inertia'].filled(joint=robot.joints[j], moved=moved)


def _holding_faults(check: RobotCheck) -> Iterator[Problem]:
    """Yield a fault if the arm is held in too few postures, and one if it is stiff in too few."""
    robot, stiffness, least = check.setting.robot, check.stiffness, check.required
    held, stiff = check.held, check.stiff
    required, worst = 100 * REQUIRED_SHARE, -1
    if held.mean() < REQUIRED_SHARE:
        lack = np.abs(check.missing_torque[~held])
        most = lack.argmax(axis=1)
        counts = Counter(sorted(most.tolist())).most_common()
        own, units = robot.units.to_effort(lack), robot.units
        each = {k: rounded_text(own[most == k, k].max(), 2) for k, _ in counts}
        where = ', '.join(
            f'{robot.joints[k]} (in {count}, up to {each[k]} {units[k].torque})'
            for k, count in counts
        )
        worst = counts[0][0]
        yield PROBLEMS['not_held'].filled(
            robot.joints[worst], held=100 * held.mean(), bias=shown(robot.tension.bias),
            limit=shown(robot.tension.limit), required=required, others=len(lack),
            force='torque' + ' or force' * bool(robot.units.slides.any()), where=where,
        )  # fmt: skip
    if stiff.mean() < REQUIRED_SHARE:
        counts = Counter(sorted(check.softest.tolist())).most_common()
        where = ', '.join(f'{robot.joints[k]} ({count})' for k, count in counts) or 'none'
        problem = 'not stiff'
        if (unstable := stiffness < 0.0).any():
            lowest = rounded_text(stiffness[unstable].min())
            problem = (
                f'unstable in {100 * unstable.mean():.1f} % of postures, with a stiffness '
                f'eigenvalue down to {lowest} N·m/rad, and not stiff'
            )
        yield PROBLEMS['not_stiff'].filled(
            robot.joints[counts[0][0] if counts else worst], problem=problem,
            stiff=100 * stiff.mean(), least=required_stiffness(robot, least), required=required,
            where=where,
        )  # fmt: skip
