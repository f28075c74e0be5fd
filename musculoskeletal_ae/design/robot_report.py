# SPDX-License-Identifier: Apache-2.0
"""Prints the report of `check_robot`, and draws its figure."""

from argparse import Namespace
from typing import Any

import numpy as np

from musculoskeletal_ae.design.checks import (
    COUNTED_ARM,
    REQUIRED_SHARE,
    RobotCheck,
    arm_terms,
    check_robot,
    required_stiffness,
    rounded_text,
)
from musculoskeletal_ae.design.holding_remedies import remedies
from musculoskeletal_ae.design.suggestion import suggest, write
from musculoskeletal_ae.figures import save_plot
from musculoskeletal_ae.robot.actuation import DESIRED_SHARE
from musculoskeletal_ae.robot.description import shown
from musculoskeletal_ae.robot.joint_units import SLIDE
from musculoskeletal_ae.robot.robot import Robot


def check(args: Namespace) -> int:
    """Check a robot and print the report; return the exit status."""
    robot = Robot.load(args.robot)
    name = robot.description.directory.name
    result = check_robot(robot, args.postures, args.seed)
    if not args.quiet:
        print(summary(robot, result, args.seed))
        print(moment_arm_table(robot, result))
    save_plot(args.plot, lambda: plot(robot, result))
    for text in robot.description.warnings:
        print(f'warning: {text}')
    for warning in result.warnings:
        print(f'warning: {warning.text}; {warning.remedy}')
    for fault in result.faults:
        print(f'fault: {fault.text}')
        for remedy in [fault.remedy] if fault.remedy else remedies(result, fault):
            print(f'    remedy: {remedy}')
    count = len(result.faults)
    print(f'{name}: not sound, {count} fault{"s" * (count > 1)}' if count else f'{name}: sound')
    if not (count and args.suggest):
        return 1 if count else 0
    args.out.mkdir(parents=True)  # raises an error before the search, which takes minutes
    try:
        return _suggested(robot, args)
    finally:
        if not any(args.out.iterdir()):
            args.out.rmdir()


def _suggested(robot: Robot, args: Namespace) -> int:
    """Search for a sound arm, write the best arm that was found, and return the exit status.

    The status is that of the check of the written arm, or 1 if no arm was written.
    """
    change, before, after = suggest(robot, args.reach, args.postures, args.seed)
    far, routes = 1e3 * np.linalg.norm(change, axis=1), robot.routes
    if not before:
        print('moving via points cannot remedy these faults; nothing was written')
        return 1
    if after:
        reach = f'{1e3 * args.reach:g} mm'
        problem = f'moving each via point by at most {reach} does not'
        if after >= before:
            print(f'{problem} reduce the number of faults; nothing was written')
            return 1
        print(f'{problem} make the robot sound; the best candidate is written')
    write(robot, change, args.out)
    print(
        f'{args.out}: {np.sum(far > 0.0)} of {len(far)} points moved, by up to {far.max():.1f} mm'
    )
    for m, name in enumerate(robot.muscles):
        own = routes.muscle == m
        if (moved := far[np.union1d(routes.first[own], routes.second[own])]).any():
            print(f'    {name}, point by point: {", ".join(f"{each:.1f}" for each in moved)} mm')
    return check(Namespace(**{**vars(args), 'robot': args.out, 'plot': None, 'suggest': False}))


def summary(robot: Robot, result: RobotCheck, seed: int) -> str:
    """Return the summary of the report: in how many postures the arm is held and stiff enough."""
    count, held = len(result.setting.theta), result.held
    share = f'{100 * REQUIRED_SHARE:.0f} %'
    need = (
        f'the muscles must hold the arm in {share} of postures; it must be stiff enough in {share}'
        if result.required
        else f'an equilibrium must be found in {share} of trials; {share} of them must be stable'
    )
    required = required_stiffness(robot, result.required)
    desired = DESIRED_SHARE * robot.tension.limit
    tension = f'T from {shown(robot.tension.bias)} to {shown(robot.tension.limit)} N'
    lines = [
        f'{robot.description.directory}',
        f'{robot.joint_count} joints, {robot.muscle_count} muscles; {count} postures, seed {seed}',
        *robot.description.notes,
        '',
        f'{need}; a posture that is not held counts as not stiff',
        f'held with {tension}, nearest to {shown(desired)} N:  {100 * held.mean():.1f} %',
        (f'stiffness >= {required}' if result.required else 'stable')
        + f':  {100 * result.stiff.mean():.1f} %',
    ]
    if held.any():
        one_sided = (np.nan_to_num(result.one_sided) >= result.required) & held
        singular = np.linalg.svd(result.moment_arms, compute_uv=False)[:, -1]
        lines += [
            f'  one-sided, muscles at bias slack (not judged):  {100 * one_sided.mean():.1f} %',
            '',
            f'{"over the postures":<44}{"min":>9}{"5 %":>9}{"median":>9}{"max":>9}',
        ]
        for title, values in {
            'smallest stiffness eigenvalue [N·m/rad]': result.stiffness[held],
            '  one-sided [N·m/rad]': result.one_sided[held],
            'smallest singular value of G [mm]': 1e3 * singular,
            'highest holding tension [N]': result.tension[held].max(axis=1),
        }.items():
            spread = np.percentile(values, [0, 5, 50, 100])
            texts = [rounded_text(value, 1, np.abs(spread).max()) for value in spread]
            lines.append(f'{title:<44}' + ''.join(f' {text:>8}' for text in texts))
    return '\n'.join(lines)


def moment_arm_table(robot: Robot, result: RobotCheck) -> str:
    """Return a table of min, median and max of every moment arm [mm], one row per muscle."""
    width = max(18, *(len(name) + 2 for name in robot.joints))
    first = max(len(name) for name in robot.muscles) + 2
    scale = np.array([arm_terms(robot, j).scale for j in range(robot.joint_count)])
    arms, matters = scale * result.moment_arms, result.matters
    longest = np.abs(result.moment_arms).max(axis=(0, 1))
    decimals = [arm_terms(robot, j).decimals(arm) for j, arm in enumerate(longest.tolist())]
    spread = np.stack([arms.min(axis=0), np.median(arms, axis=0), arms.max(axis=0)], axis=-1)
    sliders = ', '.join(np.array(robot.joints)[robot.units.slides])
    has_short_arms = bool((matters < COUNTED_ARM).any())
    tenth = ', and below a tenth of the longest at that joint,' * has_short_arms
    lines = [
        '',
        'moment arms [mm]: min, median, max; + moves the joint in its positive direction',
        f'"." = below {1e3 * COUNTED_ARM:g} mm{tenth} in every posture',
    ]
    if sliders:
        least = f'"." = below {100 * COUNTED_ARM / SLIDE.radian:g} %'
        lines.append(
            f'prismatic joints ({sliders}): share of the tension along the axis [%], {least}'
        )
    lines.append(' ' * first + ''.join(name.rjust(width) for name in robot.joints))
    for name, row in zip(robot.muscles, spread):
        cells = [
            '.' if np.abs(cell).max() < least else ' '.join(f'{v:+.{digits}f}' for v in cell)
            for cell, least, digits in zip(row, scale * matters, decimals)
        ]
        lines.append(name.ljust(first) + ''.join(f' {cell.rjust(width - 1)}' for cell in cells))
    return '\n'.join([*lines, ''])


def plot(robot: Robot, result: RobotCheck) -> Any:
    """Return a figure with a panel of moment arms for each joint, and a panel of stiffness."""
    from matplotlib.figure import Figure

    columns = min(3, robot.joint_count + 1)
    rows = -(-(robot.joint_count + 1) // columns)
    figure = Figure(figsize=(5.2 * columns, 3.8 * rows), layout='constrained')
    axes = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    dots = {'s': 5, 'alpha': 0.6, 'linewidths': 0}
    for j, (panel, name) in enumerate(zip(axes, robot.joints)):
        terms = arm_terms(robot, j)
        label, shown_as = 'joint angle [deg]', 180.0 / np.pi
        if robot.units.slides[j]:
            label, shown_as = 'position [mm]', 1e3 * robot.units[j].radian
        for m, muscle in enumerate(robot.muscles):
            arm = result.moment_arms[:, m, j]
            if np.abs(arm).max() >= result.matters[j]:
                look = dots | {'color': f'C{m % 10}', 'label': muscle}
                panel.scatter(shown_as * result.setting.theta[:, j], terms.scale * arm, **look)
        panel.axhline(0.0, color='black', linewidth=0.8)
        panel.set(title=name, xlabel=label, ylabel=f'{terms.name} −G [{terms.unit}]')
        if panel.collections:
            panel.legend(fontsize=6, ncols=2, markerscale=2, loc='best')
    last, held = axes[robot.joint_count], result.held
    if held.any():
        last.hist(result.stiffness[held], bins=30, label='all muscles', color='C0')
        last.hist(result.one_sided[held], bins=30, label='one-sided', histtype='step', color='C1')
    last.axvline(result.required, color='black', linestyle='--', label='required')
    last.set(
        title=f'held {100 * held.mean():.1f} %, stiff {100 * result.stiff.mean():.1f} %',
        xlabel='smallest stiffness eigenvalue [N·m/rad]',
        ylabel='postures',
    )
    last.legend(fontsize=7)
    for unused in axes[robot.joint_count + 1 :]:
        unused.set_axis_off()
    figure.suptitle(robot.description.directory.name)
    return figure
