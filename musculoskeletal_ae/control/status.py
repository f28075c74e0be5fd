# SPDX-License-Identifier: Apache-2.0
"""What control says of itself: what it is doing, and what is in its way."""

import numpy as np

from musculoskeletal_ae.control import reach
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.methods import Solution, TorqueControl
from musculoskeletal_ae.control.motion import MotionControl
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.description import shown


def report(core: Controller, now: float) -> Report:
    """Return the state that /diagnostics shows: a stop, else why it waits, else all warnings."""
    chosen, posture, motion, robot = core.settings, core.posture, core.motion, core.robot
    solution = motion.solution if core.follows else posture.solution
    at_work: MotionControl | TorqueControl | Solution | None
    at_work = motion if core.follows else core.by_tension or solution
    missing = np.zeros(robot.joint_count) if at_work is None else at_work.missing_torque
    values, warnings = {'method': chosen.method, 'preset': chosen.preset}, []
    if core.clamped:
        values['target clamped at'] = ', '.join(core.clamped)
        warnings.append('target clamped to the joint limits')
    if chosen.method == 'stiffness' and solution is not None and solution.stiffness is not None:
        expected, *reachable = solution.stiffness
        desired = chosen.desired_stiffness(robot.kinematics.radian)
        for row in zip(robot.joints, robot.units, desired, expected.diagonal(), *reachable):
            name, unit, wanted, planned, low, high = row
            text = f'{planned:.2f} {unit.stiffness}, reachable {low:.2f} to {high:.2f}'
            if wanted > 0.0 and not low <= wanted <= high:
                text += f', desired {wanted:.2f} clamped'
            values[f'joint stiffness {name}'] = text
    if posture.effort.any() and chosen.method in ('geometric', 'first', 'second'):
        warnings.append(f'method {chosen.method} exerts no effort')
    if core.follows:
        values['lag of the winches'] = f'{1000.0 * motion.winches.lag:.0f} ms'
        if motion.moving and (slow := slowed(motion)):
            warnings.append(f'trajectory {slow}')
    if np.abs(robot.kinematics.radian * missing).max() > reach.NOTABLE:
        lacks = zip(robot.joints, missing, robot.units)
        values['missing torque'] = ', '.join(f'{n} {lack:.2f} {u.torque}' for n, lack, u in lacks)
        warnings.append('the target needs more torque than the muscles have')
    if core.short:
        warnings.append(f'out of reach: {core.short}')
    if core.follows and motion.fallen:
        warnings.append(_lying(core))
    if robot.isolated:
        values['isolated muscles'] = robot.names(robot.isolated)
    if not core.safety.zeroed:
        warnings.append('length zeros are unknown: the arm only explores, gently')
    if tense := core.watch.tense:
        warnings.append(f'tension above {shown(robot.tension.limit)} N: {", ".join(tense)}')
    if np.isfinite(hottest := core.watch.heat.core).any():
        windings = (f'{n} {c:.0f} °C' for n, c in zip(robot.muscles, hottest))
        values['temperature of windings'] = ', '.join(windings)
    limited = zip(robot.muscles, core.watch.limit, robot.tension.limit)
    hot = {name: limit for name, limit, most in limited if limit < most}
    if hot:
        values['tension limited by heat'] = ', '.join(f'{n} {t:.0f} N' for n, t in hot.items())
        warnings.append(f'hot: {", ".join(hot)}')
    still = 'no target' if posture.theta is None else 'holding'
    doing = 'exploring' if posture.exploring else still
    doing = 'floating' if chosen.method == 'float' else doing
    if core.follows and motion.moving:
        doing = 'following a trajectory'
    if cause := core.safety.cause:
        if core.safety.passing:
            return Report('warn', f'holding: {cause}', values)
        return Report('error', f'stopped: {cause}', values)
    if waiting := core.watch.present_cause(now):
        return Report('warn', f'waiting: {waiting}', values)
    if warnings:
        return Report('warn', '; '.join(warnings), {**values, 'doing': doing})
    return Report('ok', doing, values)


def slowed(motion: MotionControl) -> str:
    """Return by how much the last trajectory was slowed, or ''."""
    last = motion.latest
    if last is None or last.slowed == 1.0:
        return ''
    return f'slowed to {100.0 / last.slowed:.0f} % of its speed for the winches'


def _lying(core: Controller) -> str:
    """Return how far from its target an arm rests that fell, and what keeps it there."""
    mae, estimate, off, robot = core.mae, core.estimate, core.motion.error, core.robot
    assert mae is not None and estimate is not None  # it has moved
    joint = int(np.abs(off / robot.kinematics.radian).argmax())
    far = f'{abs(off[joint]):.2f} {robot.units[joint].theta}'
    told = f'fallen: {robot.joints[joint]} rests {far} off its target'
    lacks = reach.lacking(robot, mae, estimate)
    return f'{told}, where the muscles lack {lacks}; lift it by hand' if lacks else told
