# SPDX-License-Identifier: Apache-2.0
"""Check whether the muscles of an arm can hold it (`check_robot`).

In postures drawn uniformly in the joint limits, the tension nearest to 0.3 T_limit within [bias,
limit] that holds the arm's own weight; the joint stiffness under muscle stiffness control at that
tension; and the moment arms

    r(θ) = −G(θ)    [m],

the joint torque that one newton of tension makes: r > 0 turns the joint in its positive direction.
So that all joints have one unit, one that slides is taken as if a pinion of radius RACK turned it:
where a wire lies along it, r is RACK. doc/explanation/method.md ("An arm must be holdable")
defines a sound arm. Beside it, not judged: the one-sided stiffness, in which muscles at the bias
tension count as slack.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.files import read_csv, read_table
from musculoskeletal_ae.robot.description import RobotDescription, Wrap, refusal, shown
from musculoskeletal_ae.robot.jumps import jumping_muscles
from musculoskeletal_ae.robot.kinematics import RACK
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.stiffness import joint_stiffness, muscle_hessian
from musculoskeletal_ae.robot.tension import least_tension
from musculoskeletal_ae.schema import Strict

DESIRED_SHARE = 0.3  # of T_limit: 60 N where that is 200 N
REQUIRED_SHARE = 0.95
REQUIRED_STIFFNESS = 5.0  # [N·m/rad], and …
REQUIRED_BY_LOAD = 2.0  # [1/rad] times the largest load of a joint, where that is less: a tenth
# more or less of that load is to turn no joint by more than 0.05 rad
LEAST_INERTIA = 1e-12  # [kg·m²]; less is rounding. Emulated modules add inertia of their own.
SLACK_MARGIN = 1e-3  # [N] above bias; the solver meets a bound only to rounding
MATTERS = 0.003  # [m]; a shorter moment arm makes less than 1 N·m with 300 N; or …
MATTERS_SHARE, MATTERS_LEAST = 0.1, 1e-4  # … of the longest at its joint, if that is less; [m]
SHORT = 0.015  # [m]; shorter moment arms are off by half of it or more in emulated individuals
TOLERATED_SHARE = 0.05  # of the postures, in which a sign or a direction may be missing
TOUCHED = 1e-6  # [m] by which what a wire wraps round makes it longer; less is rounding
LONGEST_ARM = 1.0  # [m]; a longer moment arm is one in millimetres
WIDEST = 4.0 * np.pi, 10.0  # limits further apart are degrees [rad] or millimetres [m]
DECLARATION_FILE = 'moment_arms.csv'
COLUMNS = ['muscle', 'joint', 'sign']


class FindingTexts(Strict, frozen=True, array_like=True):
    """An entry of findings.yaml."""

    message: str
    remedy: str


#: texts by kind; what stands after a comma distinguishes variants of one kind
FINDINGS = read_table(__file__, 'findings.yaml', dict[str, FindingTexts])


class Finding(NamedTuple):
    """A fault or warning about a robot, with its remedy."""

    kind: str  # one word, such as 'wrong_sign'
    message: str  # names muscles and joints
    remedy: str = ''  # '' for 'not_held' and 'not_stiff', whose remedies `remedies` finds
    joint: int = -1  # for 'not_held' and 'not_stiff': the joint that is the weakest most often


class Setting(NamedTuple):
    """A robot in N postures, with the quantities that determine holding and stiffness.

    All quantities but θ treat a prismatic joint as if a pinion of radius RACK moved it.
    """

    robot: Robot
    theta: Array  # [rad] or [m], (N, D)
    jacobian: Array  # G [m/rad], (N, M, D)
    hessian: Array  # ∂²l/∂θ² [m/rad²], (N, M, D, D)
    torque: Array  # g [N·m], (N, D)

    @classmethod
    def of(cls, robot: Robot, theta: Array) -> Setting:
        """Return the setting of a robot in postures θ (N, D)."""
        jacobian, radian = robot.routes.muscle_jacobian, robot.kinematics.radian
        hessian = radian[:, None] * muscle_hessian(jacobian, theta) * radian
        torque = radian * robot.kinematics.holding_torque(theta)
        return cls(robot, theta, radian * jacobian(theta), hessian, torque)


@dataclass(frozen=True)
class RobotCheck:
    """Results of the check in N postures."""

    setting: Setting
    moment_arms: Array  # r [m], (N, M, D)
    tension: Array  # holding tension [N], (N, M); NaN where the posture is not held
    missing_torque: Array  # torque lacking where a posture is not held [N·m], (N, D)
    stiffness: Array  # smallest joint-stiffness eigenvalue [N·m/rad], (N,); NaN if not held
    one_sided: Array  # the same with muscles at the bias tension slack, (N,)
    required: float  # required stiffness [N·m/rad]
    matters: Array  # smallest moment arm at each joint that is taken into account [m], (D,)
    faults: tuple[Finding, ...]  # why the arm is not sound; empty if it is
    warnings: tuple[Finding, ...]  # questionable points that do not make the arm unsound

    @property
    def held(self) -> Bools:
        """Whether each posture is held, shape (N,)."""
        return np.isfinite(self.stiffness)

    @property
    def stiff(self) -> Bools:
        """Whether each posture is held and stiff enough, shape (N,)."""
        return self.stiffness >= self.required


def check_robot(robot: Robot, postures: int = 200, seed: int = 0) -> RobotCheck:
    """Check a robot in random postures.

    Args:
        robot: The robot.
        postures: Number of postures.
        seed: Random seed of the postures.

    Raises:
        RobotDescriptionError: If the directory's `moment_arms.csv` is not valid.
    """
    theta = robot.random_postures(postures, np.random.default_rng(seed))
    result = judge(Setting.of(robot, theta))
    arms = result.moment_arms
    suspicious = (
        *_other_units(robot, arms),
        *_small_joints(robot, arms),
        *_jumping_muscles(robot),
        *_idle_objects(robot, theta),
    )
    faults = (*result.faults, *_inertia_faults(robot, theta))
    return replace(result, faults=faults, warnings=(*result.warnings, *suspicious))


def judge(setting: Setting) -> RobotCheck:
    """Check the muscles of a robot in the postures of a setting; errors as for `check_robot`."""
    robot, theta, jacobian, hessian, torque = setting
    bias, limit, arms = robot.tension.bias, robot.tension.limit, -jacobian
    tension, missing = np.full(arms.shape[:2], np.nan), np.zeros(torque.shape)
    load = float(robot.joint_load(torque, jacobian).max())
    required = min(REQUIRED_STIFFNESS, REQUIRED_BY_LOAD * load)
    longest = np.abs(arms).max(axis=(0, 1))
    matters = np.clip(MATTERS_SHARE * longest, MATTERS_LEAST, MATTERS)
    for n, (at, weight) in enumerate(zip(jacobian, torque, strict=True)):
        found = least_tension(at, weight, bias, limit, DESIRED_SHARE * limit)
        missing[n] = found.missing_torque
        tension[n] = np.nan if missing[n].any() else found.tension
    held = np.isfinite(tension[:, 0])
    stiffness, one_sided = np.full((2, len(theta)), np.nan)
    k = robot.muscle_stiffness(theta[held], tension[held])
    taut = np.where(tension[held] > bias + SLACK_MARGIN, k, 0.0)
    full, sided = (
        joint_stiffness(jacobian[held], hessian[held], x, tension[held]) for x in (k, taut)
    )
    values, vectors = np.linalg.eigh(full)
    stiffness[held], one_sided[held] = values[:, 0], np.linalg.eigvalsh(sided)[:, 0]
    softest = np.abs(vectors[:, :, 0]).argmax(axis=1)[values[:, 0] < required]
    faults = (
        *_wrong_signs(robot, arms),
        *_one_way_joints(robot, arms, matters),
        *_useless_muscles(robot, arms, matters),
        *_holding_faults(robot, stiffness, required, softest, missing),
    )
    warnings = tuple(_flipping_muscles(robot, arms))
    measured = tension, missing, stiffness, one_sided, required, matters
    return RobotCheck(setting, arms, *measured, faults, warnings)


class Words(NamedTuple):
    """How a moment arm at a joint is told: where it slides, as a share of the tension."""

    scale: float
    unit: str
    name: str
    long: str  # what it is where it is large
    other: str  # where a wire pulls the other way
    better: str  # where it pulls more surely

    def decimals(self, longest: float) -> int:
        """Return how many decimals tell moment arms beside the longest of them [m]."""
        return int(self.scale * longest < 10.0)


def words(robot: Robot, joint: int) -> Words:
    """Return how moment arms at a joint are told."""
    if robot.kinematics.slides[joint]:
        return Words(100.0 / RACK, '%', 'pull', 'strong', 'towards the other end of', 'more along')
    return Words(1e3, 'mm', 'moment arm', 'long', 'along the other side of', 'further from')


def required_stiffness(robot: Robot, required: float) -> str:
    """Say the least eigenvalue [N·m/rad], and what that is where a joint slides."""
    sliding = f' (where it slides, {required / RACK**2:.0f} N/m)'
    return f'{required:.2g} N·m/rad' + sliding * bool(robot.kinematics.slides.any())


def figure(value: float, least: int = 1, largest: float | None = None) -> str:
    """Return a value with two digits of the largest told beside it (default: of itself).

    It has `least` decimals or more, and no sign where it is told as zero.
    """
    size = abs(value if largest is None else largest)
    decimals = max(least, 1 - int(np.floor(np.log10(size)))) if size else least
    return f'{round(value, decimals) + 0.0:.{decimals}f}'


def read_declared_actions(description: RobotDescription) -> dict[tuple[int, int], int]:
    """Return (muscle, joint) → ±1 of `moment_arms.csv`; nothing if there is no such file.

    Raises:
        RobotDescriptionError: Naming the file, the line and the legal values.
    """
    file = description.directory / DECLARATION_FILE
    legal = (description.muscles, description.joints, ('+', '-'))
    actions: dict[tuple[int, int], int] = {}
    if not os.path.lexists(file):
        return actions
    for line, text, cells in read_csv(file, COLUMNS, refusal):
        where = f'{file}: line {line}'
        if len(cells) != len(COLUMNS):
            raise RobotDescriptionError(f'{where}: expected 3 values, got {text.strip()!r}')
        row = [*cells[:2], cells[2].replace('−', '-')]
        for column, cell, names in zip(COLUMNS, row, legal, strict=True):
            if cell not in names:
                raise RobotDescriptionError(
                    f'{where}: unknown {column} {cell!r}; legal: {", ".join(names)}'
                )
        muscle, joint, sign = (names.index(cell) for cell, names in zip(row, legal, strict=True))
        if (muscle, joint) in actions:
            raise RobotDescriptionError(f'{where}: {row[0]} at {row[1]} is declared twice')
        actions[muscle, joint] = 1 - 2 * sign
    return actions


def _finding(key: str, **seen: object) -> Finding:
    """Return one of the FINDINGS, with what its texts name."""
    texts = FINDINGS[key]
    kind = key.partition(',')[0]
    return Finding(kind, texts.message.format(**seen), texts.remedy.format(**seen))


def _wrong_signs(robot: Robot, moment_arms: Array) -> Iterator[Finding]:
    """Declared actions that too many postures contradict."""
    for (muscle, joint), sign in read_declared_actions(robot.description).items():
        arm, told = moment_arms[:, muscle, joint], words(robot, joint)
        against = np.mean(arm * sign <= 0.0)
        expected, actual = '+-' if sign > 0 else '-+'
        if not arm.any():
            actual = '0, it does not cross the joint,'
        if against > TOLERATED_SHARE:
            yield _finding(
                'wrong_sign', muscle=robot.muscles[muscle], joint=robot.joints[joint], told=told,
                expected=expected, actual=actual, against=100 * against,
                median=told.scale * np.median(arm), file=DECLARATION_FILE,
            )  # fmt: skip


def _one_way_joints(robot: Robot, moment_arms: Array, matters: Array) -> Iterator[Finding]:
    """Joints that too often have muscles on one side only."""
    lacks = {
        '+': np.max(moment_arms, axis=1) <= matters,
        '-': np.min(moment_arms, axis=1) >= -matters,
    }
    median, longest = np.median(moment_arms, axis=0), np.abs(moment_arms).max(axis=0)
    one_way = np.mean(lacks['+'] | lacks['-'], axis=0) > TOLERATED_SHARE
    for joint in np.flatnonzero(one_way).tolist():
        missing = ' and '.join(
            f'{sign} (in {100 * lacking[:, joint].mean():.0f} % of postures)'
            for sign, lacking in lacks.items()
            if lacking[:, joint].any()
        )
        told = words(robot, joint)
        decimals = told.decimals(longest[:, joint].max())
        acting = ', '.join(
            f'{robot.muscles[m]} ({told.scale * median[m, joint]:+.{decimals}f} {told.unit})'
            for m in np.flatnonzero(longest[:, joint] > matters[joint])
        )
        seen = {'joint': robot.joints[joint], 'missing': missing, 'acting': acting, 'told': told}
        yield _finding('one_way_joint' if acting else 'one_way_joint, idle', **seen)


def _useless_muscles(robot: Robot, moment_arms: Array, matters: Array) -> Iterator[Finding]:
    along = ', along one that slides' * bool(robot.kinematics.slides.any())
    for muscle, arms in zip(robot.muscles, np.abs(moment_arms).max(axis=0), strict=True):
        if (arms < matters).all():
            told, least = words(robot, int(arms.argmax())), 1e3 * matters.max()
            seen = {'arm': told.scale * arms.max(), 'least': least, 'along': along}
            yield _finding('useless_muscle', muscle=muscle, told=told, **seen)


def main_actions(moment_arms: Array) -> tuple[Ints, Array]:
    """Return the joint that each muscle acts on most, and where it acts the other way, both (M,).

    That is a share of the postures; moment arms (N, M, D).
    """
    median, muscles = np.median(moment_arms, axis=0), np.arange(moment_arms.shape[1])
    main = np.abs(median).argmax(axis=1)
    against = moment_arms[:, muscles, main] * np.sign(median[muscles, main]) < 0.0
    return main, against.mean(axis=0)


def _flipping_muscles(robot: Robot, moment_arms: Array) -> Iterator[Finding]:
    """Muscles whose main action changes sign over the range."""
    for m, (joint, against) in enumerate(zip(*main_actions(moment_arms), strict=True)):
        if against > TOLERATED_SHARE:
            names = {'muscle': robot.muscles[m], 'joint': robot.joints[joint]}
            told = words(robot, joint)
            yield _finding('flipping_muscle', **names, against=100 * against, told=told)


def _other_units(robot: Robot, moment_arms: Array) -> Iterator[Finding]:
    """Numbers that look like millimetres or degrees."""
    longest, slides = np.abs(moment_arms).max(axis=0), robot.kinematics.slides
    for m, j in np.argwhere((longest > LONGEST_ARM) & ~slides).tolist():
        names = {'muscle': robot.muscles[m], 'joint': robot.joints[j]}
        yield _finding('other_units, arm', **names, arm=longest[m, j])
    for j, (low, high) in enumerate(zip(robot.lower, robot.upper)):
        if high - low > WIDEST[int(slides[j])]:
            wrong = 'metres, not millimetres' if slides[j] else 'radians, not degrees'
            told = {'low': low, 'high': high, 'unit': robot.units[j].theta, 'wrong': wrong}
            yield _finding('other_units, limits', joint=robot.joints[j], **told)


def _small_joints(robot: Robot, moment_arms: Array) -> Iterator[Finding]:
    """Joints beside whose moment arms the errors that are emulated and learned are no small ones.

    A joint on which no muscle acts is a fault of its own.
    """
    longest = np.abs(moment_arms).max(axis=(0, 1))
    small = np.flatnonzero((longest > MATTERS_LEAST) & (longest < SHORT)).tolist()
    if small:
        each = ', '.join(f'{robot.joints[j]} ({1e3 * longest[j]:.1f} mm)' for j in small)
        yield _finding('small_joints', joints=each)


def _jumping_muscles(robot: Robot) -> Iterator[Finding]:
    """Muscles whose wire slips to the other side of what it wraps round."""
    for m, size, theta in jumping_muscles(robot):
        turns = np.flatnonzero(robot.routes.crossed[m])
        place = ', '.join(f'{robot.joints[j]} {theta[j]:.2f}' for j in turns)
        yield _finding('jumping_muscle', muscle=robot.muscles[m], size=1e3 * size, place=place)


def _idle_objects(robot: Robot, theta: Array) -> Iterator[Finding]:
    """What wires should wrap round, and touch in no posture."""
    described = [
        f'{muscle} ({"sphere" if item.axis is None else "cylinder"} of '
        f'{round(1e3 * item.radius, 1):g} mm on {item.link})'
        for muscle, route in zip(robot.muscles, robot.description.routes, strict=True)
        for item in route
        if isinstance(item, Wrap)
    ]
    touched = robot.routes.wound(theta).max(axis=0, initial=0.0) > TOUCHED
    if idle := [told for told, touches in zip(described, touched, strict=True) if not touches]:
        yield _finding('idle_object', objects=', '.join(idle))


def _inertia_faults(robot: Robot, theta: Array) -> Iterator[Finding]:
    kin = robot.kinematics
    least = np.min([kin.joint_inertia(posture) for posture in theta], axis=0)
    for j in np.flatnonzero(kin.radian**2 * least < LEAST_INERTIA):
        told = f'{least[j]:.2g} kg' if kin.slides[j] else f'inertia {least[j]:.2g} kg·m²'
        yield _finding('no_inertia', joint=robot.joints[j], moved=told)


def _holding_faults(
    robot: Robot, stiffness: Array, least: float, softest: Ints, missing: Array
) -> Iterator[Finding]:
    """Shares that are too low, with the least stiffness eigenvalue [N·m/rad] that is enough.

    `softest` is of the postures that are held but not stiff.
    """
    held, stiff = np.isfinite(stiffness), stiffness >= least
    required, worst = 100 * REQUIRED_SHARE, -1
    if held.mean() < REQUIRED_SHARE:
        lack = np.abs(missing[~held])
        most = lack.argmax(axis=1)
        counts = Counter(sorted(most.tolist())).most_common()
        own, units = lack / robot.kinematics.radian, robot.units
        each = {k: figure(own[most == k, k].max(), 2) for k, _ in counts}
        where = ', '.join(
            f'{robot.joints[k]} in {count} (up to {each[k]} {units[k].torque})'
            for k, count in counts
        )
        worst = counts[0][0]
        yield _finding(
            'not_held', held=100 * held.mean(), bias=shown(robot.tension.bias),
            limit=shown(robot.tension.limit), required=required, others=len(lack),
            force='torque' + ' or force' * bool(robot.kinematics.slides.any()), where=where,
        )._replace(joint=worst)  # fmt: skip
    if stiff.mean() < REQUIRED_SHARE:
        counts = Counter(sorted(softest.tolist())).most_common()
        where = ', '.join(f'{robot.joints[k]} ({count})' for k, count in counts) or 'none'
        told = 'not stiff'
        if (unstable := stiffness < 0.0).any():
            told = f'unstable in {100 * unstable.mean():.1f} % of postures, with an eigenvalue of '
            lowest = figure(stiffness[unstable].min())
            told += f'its stiffness down to {lowest} N·m/rad, and not stiff'
        yield _finding(
            'not_stiff', told=told, stiff=100 * stiff.mean(),
            least=required_stiffness(robot, least), required=required, where=where,
        )._replace(joint=counts[0][0] if counts else worst)  # fmt: skip
