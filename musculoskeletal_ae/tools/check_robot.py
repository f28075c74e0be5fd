# SPDX-License-Identifier: Apache-2.0
"""`check_robot`: says whether a robot description is sound, and where it is not."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from musculoskeletal_ae import options
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.robot.checks import (
    DESIRED_TENSION,
    REQUIRED_SHARE,
    REQUIRED_STIFFNESS,
    RobotCheck,
    check_robot,
)
from musculoskeletal_ae.robot.directories import shipped_robots
from musculoskeletal_ae.robot.moment_arms import MATTERS
from musculoskeletal_ae.robot.robot import Robot


def main(argv: list[str] | None = None) -> int:
    """Check one robot; exit status 0 if it is sound, 1 if it is not or cannot be read."""
    parser = argparse.ArgumentParser(
        prog='check_robot',
        description='Says whether a robot description is sound, and where it is not. '
        'Exit status 0: sound, 1: not sound.',
    )
    parser.add_argument(
        'robot', help=f'a directory, or a shipped robot: {", ".join(sorted(shipped_robots()))}'
    )
    parser.add_argument(
        '--postures', type=options.whole(1, 1_000_000), default=200, help='random postures (200)'
    )
    parser.add_argument('--seed', type=options.seed, default=0, help='seed of the postures (0)')
    parser.add_argument('--plot', type=Path, metavar='FILE.png', help='check_<robot>.png')
    parser.add_argument('--no-plot', action='store_true', help='write no plot')
    parser.add_argument('--quiet', action='store_true', help='print the verdict only')
    args = parser.parse_args(argv)
    try:
        robot = Robot.load(args.robot)
        result = check_robot(robot, args.postures, args.seed)
    except RobotDescriptionError as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    if not args.quiet:
        print(summary(robot, result, args.seed))
        print(moment_arm_table(robot, result))
    if not args.no_plot:
        file = args.plot or Path(f'check_{robot.description.directory.name}.png')
        try:
            plot(robot, result, file)
            print(f'plot: {file}')
        except (OSError, ValueError) as error:
            print(f'error: plot {file} cannot be written: {error}', file=sys.stderr)
            return 1
    for warning in result.warnings:
        print(f'warning: {warning.message}; {warning.remedy}')
    for fault in result.faults:
        print(f'fault: {fault.message}\n    remedy: {fault.remedy}')
    name = robot.description.directory.name
    count = len(result.faults)
    print(f'{name}: not sound, {count} fault{"s" * (count > 1)}' if count else f'{name}: sound')
    return 1 if count else 0


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
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    joints = robot.joint_count
    columns = min(3, joints + 1)
    rows = -(-(joints + 1) // columns)
    figure = Figure(figsize=(5.2 * columns, 3.8 * rows), layout='constrained')
    FigureCanvasAgg(figure)
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


if __name__ == '__main__':
    sys.exit(main())
