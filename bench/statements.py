# SPDX-License-Identifier: Apache-2.0
"""Collects the statements of all nodes about the arm in one list, for benches.

The statements are the conditions of the cores, with the muscles and joints that each concerns.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, NamedTuple

from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.remedy_steps import Step
from musculoskeletal_ae.robot.robot import Robot


class Statement(NamedTuple):
    """One statement of a node.

    Attributes:
        owner: Name of the node.
        identifier: Identifier of the condition that is stated.
        level: 'ok', 'warn' or 'error'.
        text: The statement as users read it.
        steps: The steps that users are advised to take.
        subjects: The muscles and joints that the statement names.
    """

    owner: str
    identifier: str
    level: str
    text: str
    steps: tuple[Step, ...] = ()
    subjects: frozenset[str] = frozenset()


def statements(
    estimator: Estimator, controller: Controller, learner: Learner, now: float
) -> list[Statement]:
    """Return the statements of the nodes at the time `now` of the steady clock [s]."""
    cores: dict[str, Any] = {
        'estimator': estimator,
        'controller': controller,
        'learner': learner,
    }
    robot = estimator.robot
    body = {*robot.muscles, *robot.joints}  # conditions also name topics and nodes
    return [
        Statement(
            owner,
            each.identifier,
            each.level,
            each.text,
            each.steps,
            frozenset(body.intersection(each.subjects)) or named(robot, each.text),
        )
        for owner, core in cores.items()
        for each in core.conditions(now)
    ]


def troubles(all_statements: Iterable[Statement]) -> list[Statement]:
    """Return the statements that are warnings or errors."""
    return [each for each in all_statements if each.level != 'ok']


def named(robot: Robot, text: str) -> frozenset[str]:
    """Return the muscles and joints that a text names."""
    names = (*robot.muscles, *robot.joints)
    return frozenset(
        name for name in names if re.search(rf'(?<![\w-]){re.escape(name)}(?![\w-])', text)
    )
