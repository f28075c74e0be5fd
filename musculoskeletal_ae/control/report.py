# SPDX-License-Identifier: Apache-2.0
"""What control says of itself, in words for /diagnostics."""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.robot import Robot

NOTABLE = 0.05  # [N·m] of missing torque


def control_report(robot: Robot, control: Controller, now: float) -> Report:
    """Say what control is doing and what is in its way."""
    chosen, posture = control.settings, control.posture
    values = {'method': chosen.method, 'preset': chosen.preset}
    warnings = []
    if control.clamped:
        values['target clamped at'] = ', '.join(control.clamped)
        warnings.append('target clamped to the joint limits')
    values |= _stiffness_values(robot, control)
    if posture.effort.any() and chosen.method in ('geometric', 'first', 'second'):
        warnings.append(f'method {chosen.method} exerts no effort')
    missing = _missing_torque(control)
    if np.abs(missing).max(initial=0.0) > NOTABLE:
        values['missing torque'] = ', '.join(
            f'{name} {torque:.2f} N·m' for name, torque in zip(robot.joints, missing)
        )
        warnings.append('the target needs more torque than the muscles have')
    hot = {n: t for n, t in zip(robot.muscles, control.limit) if t < robot.tension.max}
    if hot:
        values['tension limited by heat'] = ', '.join(f'{n} {t:.0f} N' for n, t in hot.items())
        warnings.append(f'hot: {", ".join(hot)}')
    if control.safety.cause:
        return Report('error', f'stopped: {control.safety.cause}', values)
    waiting = control.present_cause(now)
    if waiting:
        return Report('warn', f'waiting: {waiting}', values)
    if posture.exploring:
        doing = 'exploring'
    else:
        doing = 'no target' if posture.theta is None else 'holding'
    if warnings:
        values['doing'] = doing
        return Report('warn', '; '.join(warnings), values)
    return Report('ok', doing, values)


def _missing_torque(control: Controller) -> Array:
    posture = control.posture
    if control.settings.method == 'tension' and not posture.exploring:
        return control.torque.missing_torque
    return np.zeros(0) if posture.solution is None else posture.solution.missing_torque


def _stiffness_values(robot: Robot, control: Controller) -> dict[str, str]:
    """Return each joint's expected and reachable stiffness, and whether the desired one is not."""
    solution = control.posture.solution
    if solution is None or solution.stiffness is None:
        return {}
    values = {}
    rows = zip(
        robot.joints,
        control.settings.desired_stiffness(robot.joint_count),
        solution.stiffness.expected.diagonal(),
        solution.stiffness.lowest,
        solution.stiffness.highest,
    )
    for name, desired, expected, low, high in rows:
        text = f'{expected:.2f} N·m/rad, reachable {low:.2f} to {high:.2f}'
        if desired > 0.0 and not low <= desired <= high:
            text += f', desired {desired:.2f} clamped'
        values[f'joint stiffness {name}'] = text
    return values
