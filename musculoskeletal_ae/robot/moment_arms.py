# SPDX-License-Identifier: Apache-2.0
"""Moment arms of the muscles, and what is wrong with them.

    r(θ) = −G(θ)    [m]

is the joint torque that one newton of tension makes: r > 0 turns the joint in its positive
direction. An optional third file of a robot directory, `moment_arms.csv`, declares the action the
designer meant (columns muscle, joint, sign), so that a route on the wrong side of a joint is found
even where the arm could still hold itself.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.files import read_csv
from musculoskeletal_ae.robot.description import RobotDescription
from musculoskeletal_ae.robot.entries import listed, refusal

DECLARATION_FILE = 'moment_arms.csv'
COLUMNS = ['muscle', 'joint', 'sign']
MATTERS = 0.003  # [m]; a shorter moment arm makes less than 1 N·m with 300 N
TOLERATED_SHARE = 0.05  # of the postures, in which a sign or a direction may be missing


class Finding(NamedTuple):
    """Something about a robot that a person should know.

    Attributes:
        kind: One word for the kind of finding, e.g. 'wrong_sign'.
        message: What was found, naming muscles and joints.
        remedy: What to do about it.
    """

    kind: str
    message: str
    remedy: str


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
                    f'{where}: unknown {column} {cell!r}; legal: {listed(names)}'
                )
        muscle, joint, sign = (names.index(cell) for cell, names in zip(row, legal, strict=True))
        if (muscle, joint) in actions:
            raise RobotDescriptionError(f'{where}: {row[0]} at {row[1]} is declared twice')
        actions[muscle, joint] = 1 - 2 * sign
    return actions


def moment_arm_faults(description: RobotDescription, moment_arms: Array) -> Iterator[Finding]:
    """Yield what makes an arm unsound.

    Args:
        description: Names, and the directory of the declared actions.
        moment_arms: r in N postures [m], shape (N, M, D).

    Raises:
        RobotDescriptionError: If `moment_arms.csv` is not valid.
    """
    yield from _wrong_signs(description, moment_arms)
    yield from _one_way_joints(description, moment_arms)
    for name, arm in zip(description.muscles, np.abs(moment_arms).max(axis=(0, 2)), strict=True):
        if arm < MATTERS:
            yield Finding(
                'useless_muscle',
                f'muscle {name!r} never matters: its longest moment arm is {1e3 * arm:.1f} mm',
                f'lead it at least {1e3 * MATTERS:g} mm past the axis of a joint, or remove it',
            )


def _wrong_signs(description: RobotDescription, moment_arms: Array) -> Iterator[Finding]:
    """Declared actions that too many postures contradict."""
    for (muscle, joint), sign in read_declared_actions(description).items():
        arm = moment_arms[:, muscle, joint]
        against = np.mean(arm * sign <= 0.0)
        expected, actual = ('+', '-') if sign > 0 else ('-', '+')
        if not arm.any():
            actual = '0, it does not cross the joint,'
        if against > TOLERATED_SHARE:
            yield Finding(
                'wrong_sign',
                f'muscle {description.muscles[muscle]!r} has a moment arm of wrong sign at joint '
                f'{description.joints[joint]!r}: expected {expected}, found {actual} in '
                f'{100 * against:.0f} % of postures (median {1e3 * np.median(arm):+.1f} mm)',
                'lead its route along the other side of the joint axis, or correct '
                f'{DECLARATION_FILE}',
            )


def _one_way_joints(description: RobotDescription, moment_arms: Array) -> Iterator[Finding]:
    """Joints that too often have muscles on one side only."""
    lacks = {
        '+': np.max(moment_arms, axis=1) <= MATTERS,
        '-': np.min(moment_arms, axis=1) >= -MATTERS,
    }
    median, longest = np.median(moment_arms, axis=0), np.abs(moment_arms).max(axis=0)
    for joint in np.flatnonzero(np.mean(lacks['+'] | lacks['-'], axis=0) > TOLERATED_SHARE):
        missing = ' and '.join(
            f'{sign} (in {100 * lacking[:, joint].mean():.0f} % of postures)'
            for sign, lacking in lacks.items()
            if lacking[:, joint].any()
        )
        acting = ', '.join(
            f'{description.muscles[m]} ({1e3 * median[m, joint]:+.0f} mm)'
            for m in np.flatnonzero(longest[:, joint] > MATTERS)
        )
        yield Finding(
            'one_way_joint',
            f'joint {description.joints[joint]!r} has no muscle that pulls in direction '
            f'{missing}; muscles that act on it: {acting or "none"}',
            'a wire only pulls: lead a muscle along the other side of its axis',
        )


def moment_arm_warnings(description: RobotDescription, moment_arms: Array) -> Iterator[Finding]:
    """Yield the muscles whose main action changes sign over the range; arguments as for faults."""
    median = np.median(moment_arms, axis=0)
    for m, joint in enumerate(np.abs(median).argmax(axis=1)):
        against = (moment_arms[:, m, joint] * np.sign(median[m, joint]) < 0.0).mean()
        if against > TOLERATED_SHARE:
            yield Finding(
                'flipping_muscle',
                f'muscle {description.muscles[m]!r} changes the sign of its main action, '
                f'at joint {description.joints[joint]!r}, in {100 * against:.0f} % of postures',
                'lead it further from the axis of that joint',
            )
