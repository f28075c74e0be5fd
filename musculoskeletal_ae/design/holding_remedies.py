# SPDX-License-Identifier: Apache-2.0
"""Finds remedies for an arm that is not holdable or not stiff, by testing each of them.

The postures of the check are evaluated again with other values in muscles.yaml, less mass, longer
moment arms or narrower limits. Each of these changes has several steps. If a change is sufficient
alone, its smallest sufficient step is suggested. Otherwise all changes that help are suggested, and
then a combination of changes.

The search for the combination starts with the largest step of every change. It goes through the
changes twice, beginning with the costliest one. The first time it sets each change to its best
step, the second time to the smallest step that gives the same result.
"""

from copy import copy
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.design import checks
from musculoskeletal_ae.design.checks import REQUIRED_SHARE, RobotCheck, Setting, measure
from musculoskeletal_ae.problems import Problem
from musculoskeletal_ae.robot.description import shown

#: suggest a change only if it raises the share of held or stiff postures by at least this
LEAST_GAIN = 0.01
#: try these changes of joint limits, moment arms, masses of links or keys of muscles.yaml, from the
#: one that costs the user most to the cheapest, because combinations reduce the first ones first;
#: each with the factors by which it multiplies the value, the smallest change first
CHANGES = {
    'limits': (0.8, 0.6),
    'moment arms': (1.25, 1.5, 2.0),
    'mass': (0.75, 0.5, 0.25),
    'series_elastic.wire_stretch': (0.5, 0.2),
    'series_elastic.rate': (1.5, 2.0, 5.0, 20.0),
    'tension.limit': (1.5, 2.0, 3.0, 5.0),
    'stiffness': (2.0, 5.0, 20.0),
    'tension.bias': (2.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0),
}


def remedies(check: RobotCheck, fault: Problem) -> list[str]:
    """Return texts on remedies for an arm that is not held or not stiff in enough postures.

    Each text states the share of postures that are held or stiff with the remedy.

    Args:
        check: The result of `check_robot`.
        fault: The fault of this check to remedy, of the kind 'not_held' or 'not_stiff'.
    """
    kind = fault.kind.removeprefix('not_')
    # The subject of these faults is the joint that is most often the weakest.
    (weakest,) = map(check.setting.robot.joints.index, fault.subjects)

    @cache
    def attempt(*steps: int) -> tuple[float, str]:
        """Check the arm with a combination of changes.

        Args:
            steps: For each entry of CHANGES, the number of the applied step, from 1; 0 for no
                change.

        Returns:
            The share of postures that are then held or stiff, and a text that states the changes
            and this share.
        """
        setting, texts = check.setting, list[str]()
        for (what, factors), step in zip(CHANGES.items(), steps, strict=True):
            if step:
                setting, text = changed(setting, what, factors[step - 1], weakest)
                texts.insert(0, text)
        share = float(getattr(measure(setting), kind).mean())
        return share, f'{", ".join(texts)} → {100 * share:.3g} % {kind}'

    nothing, steps = [0] * len(CHANGES), [len(factors) for factors in CHANGES.values()]
    (before, _), alone = attempt(*nothing), list[tuple[float, str]]()
    for i, most in enumerate(steps):
        ways = [attempt(*nothing[:i], step, *nothing[i + 1 :]) for step in range(1, most + 1)]
        best, _ = max(ways)
        wanted = REQUIRED_SHARE if best >= REQUIRED_SHARE else best - LEAST_GAIN
        alone.insert(0, next(way for way in ways if way[0] >= wanted))
    if enough := [text for share, text in alone if share >= REQUIRED_SHARE]:
        return enough
    texts = [f'{text}, not enough alone' for share, text in alone if share >= before + LEAST_GAIN]
    for pick in (-1, 0):
        for i, most in enumerate(steps):
            ways = [attempt(*steps[:i], step, *steps[i + 1 :]) for step in range(most + 1)]
            shares = np.minimum([share for share, _ in ways], REQUIRED_SHARE)
            steps[i] = int(np.flatnonzero(shares == shares.max())[pick])
    share, text = attempt(*steps)
    if share >= REQUIRED_SHARE:
        return [*texts, f'together: {text}']
    if share > max(alone)[0]:
        texts.append(f'even all of these together are not enough: {text}')
    texts = texts or [f'none of these helps: {", ".join(CHANGES)}']
    return [*texts, 'other routes may help: try `check_robot --suggest`']


def rounded(values: Array) -> Array:
    """Return values with two significant digits."""
    return np.array([float(f'{value:.2g}') for value in values])


def changed(setting: Setting, what: str, factor: float, joint: int) -> tuple[Setting, str]:
    """Return a changed robot in N postures, and a text that describes the change.

    Args:
        setting: The unchanged robot and its postures.
        what: The change, a key of CHANGES.
        factor: Factor by which the change multiplies a value.
        joint: Index of the joint to which 'limits' and 'moment arms' apply.
    """
    robot = copy(setting.robot)
    if what == 'mass':
        text = f'links at {100 * factor:g} % of their mass'
        weight = factor * setting.weight
        torque = setting.torque - setting.weight + weight
        return setting._replace(torque=torque, weight=weight), text
    if what == 'moment arms':
        scale = np.where(np.arange(robot.joint_count) == joint, factor, 1.0)
        hessian = scale[:, None] * setting.hessian * scale
        terms = checks.arm_terms(robot, joint)
        text = f'{terms.name}s at {robot.joints[joint]} {factor:g} times as large'
        return setting._replace(jacobian=setting.jacobian * scale, hessian=hessian), text
    if what == 'limits':  # scale the postures with the limits
        theta, middle = setting.theta.copy(), 0.5 * (robot.lower + robot.upper)[joint]
        # Round as the user would write the limits into the file.
        unit, digits = robot.units[joint], 4 if robot.units.slides[joint] else 2
        low, high = (
            round(float(middle + factor * (end[joint] - middle)) * unit.radian, digits)
            for end in (robot.lower, robot.upper)
        )
        low, high = low / unit.radian, high / unit.radian
        text = unit.range_text(low, high, f'.{digits}f')
        share = (theta[:, joint] - robot.lower[joint]) / (robot.upper - robot.lower)[joint]
        theta[:, joint] = low + share * (high - low)
        return Setting.of(robot, theta), f'limits of {robot.joints[joint]} {text}'
    owner, _, part = what.rpartition('.')
    of: Any = getattr(robot, owner) if owner else robot
    # Use the rounded number that a user would write into the file.
    values = rounded(factor * getattr(of, part))
    vars(robot).update({owner: replace(of, **{part: values})} if owner else {part: values})
    more = ' (and max)' if part == 'limit' and (values > robot.tension.max).any() else ''
    return setting._replace(robot=robot), f'{what} {shown(values)}{more}'
