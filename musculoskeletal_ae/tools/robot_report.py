# SPDX-License-Identifier: Apache-2.0
"""What `check_robot` prints and draws."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.checks import (
    DESIRED_TENSION,
    REQUIRED_SHARE,
    REQUIRED_STIFFNESS,
    RobotCheck,
)
from musculoskeletal_ae.robot.moment_arms import MATTERS
from musculoskeletal_ae.robot.robot import Robot


def summary(robot: Robot, result: RobotCheck, seed: int) -> str:
    """Return the holding and stiffness part of the report."""
    count, held = len(result.postures), result.held
    need = f'required of both: {100 * REQUIRED_SHARE:.0f} % of postures'
    tension = f'T in [{robot.tension.bias:g}, {robot.tension.limit:g}] N'
    lines = [
        f'{robot.description.directory}',
        f'{robot.joint_count} joints, {robot.muscle_count} muscles; {count} postures, seed {seed}',
        '',
        f'{need}; a posture that is not held counts as not stiff',
        f'held with {tension}, nearest to {DESIRED_TENSION:g} N:  {100 * held.mean():.1f} %',
        f'stiffness >= {REQUIRED_STIFFNESS:g} N·m/rad:  {100 * result.stiff.mean():.1f} %',
    ]
    if held.any():
        one_sided = (np.nan_to_num(result.one_sided) >= REQUIRED_STIFFNESS) & held
        singular = np.linalg.svd(result.moment_arms, compute_uv=False)[:, -1].astype(float)
        lines += [
            f'  one-sided, muscles at bias slack (not judged):  {100 * one_sided.mean():.1f} %',
            '',
            f'{"over the postures":<44}{"min":>9}{"5 %":>9}{"median":>9}{"max":>9}',
            _spread('smallest stiffness eigenvalue [N·m/rad]', result.stiffness[held]),
            _spread('  one-sided [N·m/rad]', result.one_sided[held]),
            _spread('smallest singular value of G [mm]', 1e3 * singular),
            _spread('highest holding tension [N]', result.tension[held].max(axis=1)),
        ]
    return '\n'.join(lines)


def _spread(title: str, values: Array) -> str:
    numbers = np.percentile(values, [0, 5, 50, 100])
    return f'{title:<44}' + ''.join(f'{value:9.1f}' for value in numbers)


def moment_arm_table(robot: Robot, result: RobotCheck) -> str:
    """Return min, median and max of every moment arm [mm], one row a muscle."""
    width = max(18, *(len(name) + 2 for name in robot.joints))
    first = max(len(name) for name in robot.muscles) + 2
    arms = 1e3 * result.moment_arms
    spread = np.stack([arms.min(axis=0), np.median(arms, axis=0), arms.max(axis=0)], axis=-1)
    lines = [
        '',
        'moment arms [mm]: min, median, max; + turns the joint in its positive direction',
        f'"." = below {1e3 * MATTERS:g} mm in every posture',
        ' ' * first + ''.join(name.rjust(width) for name in robot.joints),
    ]
    for m, name in enumerate(robot.muscles):
        cells = [
            '.' if np.abs(cell).max() < 1e3 * MATTERS else ''.join(f'{v:+5.0f}' for v in cell)
            for cell in spread[m]
        ]
        lines.append(name.ljust(first) + ''.join(cell.rjust(width) for cell in cells))
    return '\n'.join([*lines, ''])


def plot(robot: Robot, result: RobotCheck, file: Path) -> None:
    """Draw the moment arms over the range of each joint, the stiffness and the held share."""
    from matplotlib.figure import Figure

    joints = robot.joint_count
    columns = min(3, joints + 1)
    rows = -(-(joints + 1) // columns)
    figure = Figure(figsize=(5.2 * columns, 3.8 * rows), layout='constrained')
    axes = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    colours = [f'C{m % 10}' for m in range(robot.muscle_count)]
    angle = np.rad2deg(result.postures)
    for k, name in enumerate(robot.joints):
        for m, muscle in enumerate(robot.muscles):
            arm = 1e3 * result.moment_arms[:, m, k]
            if np.abs(arm).max() >= 1e3 * MATTERS:
                axes[k].scatter(
                    angle[:, k], arm, s=5, color=colours[m], label=muscle, alpha=0.6, linewidths=0
                )
        axes[k].axhline(0.0, color='black', linewidth=0.8)
        axes[k].set(title=name, xlabel='joint angle [deg]', ylabel='moment arm −G [mm]')
        if axes[k].collections:
            axes[k].legend(fontsize=6, ncols=2, markerscale=2, loc='best')
    last = axes[joints]
    held = result.held
    if held.any():
        last.hist(result.stiffness[held], bins=30, label='all muscles', color='C0')
        last.hist(result.one_sided[held], bins=30, label='one-sided', histtype='step', color='C1')
    last.axvline(REQUIRED_STIFFNESS, color='black', linestyle='--', label='required')
    last.set(
        title=f'held {100 * held.mean():.1f} %, stiff {100 * result.stiff.mean():.1f} %',
        xlabel='smallest stiffness eigenvalue [N·m/rad]',
        ylabel='postures',
    )
    last.legend(fontsize=7)
    for unused in axes[joints + 1 :]:
        unused.set_axis_off()
    figure.suptitle(robot.description.directory.name)
    figure.savefig(file, dpi=110)
