# SPDX-License-Identifier: Apache-2.0
"""What control says of itself, in words for /diagnostics."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.control.stiffness import StiffnessSolution
from musculoskeletal_ae.robot.robot import Robot

NOTABLE = 0.05  # [N·m] of missing torque


class Report(NamedTuple):
    """Level ('ok', 'warn' or 'error'), one line, and named values."""

    level: str
    message: str
    values: dict[str, str]


def control_report(robot: Robot, control: Controller, now: float) -> Report:
    """Say what control is doing and what is in its way."""
    chosen, posture = control.settings, control.posture
    values = {'method': chosen.method, 'preset': chosen.preset}
    warnings = []
    if control.clamped:
        values['target clamped at'] = ', '.join(control.clamped)
        warnings.append('target clamped to the joint limits')
    if posture.stiffness is not None:
        values |= stiffness_values(robot, chosen, posture.stiffness)
    if posture.effort.any() and chosen.method in ('geometric', 'first', 'second'):
        warnings.append(f'method {chosen.method} exerts no effort')
    in_tension = chosen.method == 'tension' and not posture.exploring
    missing = control.torque.missing_torque if in_tension else posture.missing_torque
    if np.abs(missing).max() > NOTABLE:
        values['missing torque'] = ', '.join(
            f'{name} {torque:.2f} N·m' for name, torque in zip(robot.joints, missing)
        )
        warnings.append('the target needs more torque than the muscles have')
    hot = [n for n, limit in zip(robot.muscles, control.limit) if limit < robot.tension.max]
    if hot:
        values['tension limited by heat'] = ', '.join(
            f'{name} {limit:.0f} N'
            for name, limit in zip(robot.muscles, control.limit)
            if name in hot
        )
        warnings.append(f'hot: {", ".join(hot)}')
    if control.safety.cause:
        return Report('error', f'stopped: {control.safety.cause}', values)
    waiting = control.present_cause(now)
    if waiting:
        return Report('warn', f'waiting: {waiting}', values)
    if posture.exploring:
        doing = 'exploring'
    elif posture.theta is not None:
        doing = 'holding'
    else:
        doing = 'no target'
    if warnings:
        values['doing'] = doing
        return Report('warn', '; '.join(warnings), values)
    return Report('ok', doing, values)


def stiffness_values(robot: Robot, chosen: Settings, found: StiffnessSolution) -> dict[str, str]:
    """Return, for each joint, expected and reachable stiffness, and whether a wish was clamped."""
    values = {}
    wishes = (*chosen.joint_stiffness, *[0.0] * robot.joint_count)
    expected = found.stiffness.diagonal()
    for name, wish, got, low, high in zip(
        robot.joints, wishes, expected, found.lowest, found.highest
    ):
        said = f'{got:.2f} N·m/rad, reachable {low:.2f} to {high:.2f}'
        if wish > 0.0 and not low <= wish <= high:
            said += f', wish {wish:.2f} clamped'
        values[f'joint stiffness {name}'] = said
    return values
