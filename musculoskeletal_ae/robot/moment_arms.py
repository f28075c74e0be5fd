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
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.files import read_csv
from musculoskeletal_ae.robot.description import RobotDescription
from musculoskeletal_ae.robot.entries import refusal

DECLARATION_FILE = 'moment_arms.csv'
COLUMNS = ['muscle', 'joint', 'sign']
MATTERS = 0.003  # [m]; a shorter moment arm makes less than 1 N·m with 300 N
TOLERATED_SHARE = 0.05  # of the postures, in which a sign or a direction may be missing
SIGNS = {'+': 1, '-': -1, '−': -1}


class Action(NamedTuple):
    """What a muscle is meant to do: turn joint `joint` in direction `sign` (indices, ±1)."""

    muscle: int
    joint: int
    sign: int


@dataclass(frozen=True)
class Finding:
    """Something about a robot that a person should know.

    Attributes:
        kind: One word for the kind of finding, e.g. 'wrong_sign'.
        message: What was found, naming muscles and joints.
        remedy: What to do about it.
    """

    kind: str
    message: str
    remedy: str


def read_declared_actions(description: RobotDescription) -> tuple[Action, ...]:
    """Read `moment_arms.csv` of a robot directory; none declared if there is no such file.

    Raises:
        RobotDescriptionError: Naming the file, the line and the legal values.
    """
    file = description.directory / DECLARATION_FILE
    if not os.path.lexists(file):
        return ()
    legal = (description.muscles, description.joints, tuple(SIGNS)[:2])
    actions: list[Action] = []
    for line, text, cells in read_csv(file, COLUMNS, refusal):
        where = f'{file}: line {line}'
        if len(cells) != len(COLUMNS):
            raise RobotDescriptionError(f'{where}: expected 3 values, got {text.strip()!r}')
        cells[2] = '-' if cells[2] == '−' else cells[2]
        for column, cell, names in zip(COLUMNS, cells, legal, strict=True):
            if cell not in names:
                raise RobotDescriptionError(
                    f'{where}: unknown {column} {cell!r}; legal: {", ".join(names)}'
                )
        muscle, joint = legal[0].index(cells[0]), legal[1].index(cells[1])
        if any((a.muscle, a.joint) == (muscle, joint) for a in actions):
            raise RobotDescriptionError(f'{where}: {cells[0]} at {cells[1]} is declared twice')
        actions.append(Action(muscle, joint, SIGNS[cells[2]]))
    return tuple(actions)


def wrong_signs(
    moment_arms: Array, actions: tuple[Action, ...], description: RobotDescription
) -> list[Finding]:
    """Return a fault for each declared action that too many postures contradict.

    Args:
        moment_arms: r [m], shape (N, M, D).
        actions: Declared actions.
        description: Names.
    """
    faults = []
    for muscle, joint, sign in actions:
        arm = moment_arms[:, muscle, joint]
        against = np.mean(arm * sign <= 0.0)
        if against <= TOLERATED_SHARE:
            continue
        expected, found = ('+', '-') if sign > 0 else ('-', '+')
        if not arm.any():
            found = '0, it does not cross the joint,'
        faults.append(
            Finding(
                'wrong_sign',
                f'muscle {description.muscles[muscle]!r} has a moment arm of wrong sign at joint '
                f'{description.joints[joint]!r}: expected {expected}, found {found} in '
                f'{100 * against:.0f} % of postures (median {1e3 * np.median(arm):+.1f} mm)',
                'lead its route along the other side of the joint axis, or correct '
                f'{DECLARATION_FILE}',
            )
        )
    return faults


def useless_muscles(moment_arms: Array, description: RobotDescription) -> list[Finding]:
    """Return a fault for each muscle whose moment arms are short at every joint and posture."""
    longest = np.abs(moment_arms).max(axis=(0, 2))
    return [
        Finding(
            'useless_muscle',
            f'muscle {name!r} never matters: its longest moment arm is {1e3 * arm:.1f} mm',
            f'lead it at least {1e3 * MATTERS:g} mm past the axis of a joint, or remove it',
        )
        for name, arm in zip(description.muscles, longest, strict=True)
        if arm < MATTERS
    ]


def one_way_joints(moment_arms: Array, description: RobotDescription) -> list[Finding]:
    """Return a fault for each joint that too often has muscles on one side only."""
    lacks_positive = np.max(moment_arms, axis=1) <= MATTERS
    lacks_negative = np.min(moment_arms, axis=1) >= -MATTERS
    share = np.mean(lacks_positive | lacks_negative, axis=0)
    faults = []
    for joint in np.flatnonzero(share > TOLERATED_SHARE):
        lacking = {
            '+': float(np.mean(lacks_positive[:, joint])),
            '-': float(np.mean(lacks_negative[:, joint])),
        }
        missing = ' and '.join(
            f'{sign} (in {100 * part:.0f} % of postures)'
            for sign, part in lacking.items()
            if part > 0.0
        )
        median = np.median(moment_arms[:, :, joint], axis=0)
        acting = ', '.join(
            f'{description.muscles[m]} ({1e3 * median[m]:+.0f} mm)'
            for m in np.flatnonzero(np.abs(moment_arms[:, :, joint]).max(axis=0) > MATTERS)
        )
        faults.append(
            Finding(
                'one_way_joint',
                f'joint {description.joints[joint]!r} has no muscle that pulls in direction '
                f'{missing}; muscles that act on it: {acting or "none"}',
                'a wire only pulls: lead a muscle along the other side of its axis',
            )
        )
    return faults


def flipping_muscles(moment_arms: Array, description: RobotDescription) -> list[Finding]:
    """Return a warning for each muscle whose main action changes sign over the range."""
    median = np.median(moment_arms, axis=0)
    warnings = []
    for m, joint in enumerate(np.abs(median).argmax(axis=1)):
        against = (moment_arms[:, m, joint] * np.sign(median[m, joint]) < 0.0).mean()
        if against > TOLERATED_SHARE:
            warnings.append(
                Finding(
                    'flipping_muscle',
                    f'muscle {description.muscles[m]!r} changes the sign of its main action, '
                    f'at joint {description.joints[joint]!r}, in {100 * against:.0f} % of postures',
                    'lead it further from the axis of that joint',
                )
            )
    return warnings
