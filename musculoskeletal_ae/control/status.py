# SPDX-License-Identifier: Apache-2.0
"""The controller's status: its mode, stop causes and warnings."""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.control import reach, stops
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.follower import Follower
from musculoskeletal_ae.control.holding import away_text
from musculoskeletal_ae.control.supervisor import Activity
from musculoskeletal_ae.remedy import REMEDY_STEPS, REPAIR, Step, identifiers, sentence
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.description import NO_TENSION
from musculoskeletal_ae.signals.body_state import KNOWN

#: fraction of the requested speed below which a slowed trajectory is reported by its duration [%]
LEAST_SHARE = 10.0
#: what the arm does during each activity, as a text for users
DOING = {
    Activity.IDLE: 'no target',
    Activity.HOLDING: 'holding',
    Activity.MOVING: 'following a trajectory',
    Activity.EXPLORING: 'exploring',
    Activity.CALIBRATING: 'exploring',
    Activity.TORQUE: 'holding',
    Activity.GRAVITY_COMPENSATION: 'gravity compensation',
}


def report(core: Controller, now: float) -> Report:
    """Return the status for /diagnostics.

    The message describes a stop or, without a stop, what control waits for. If control does not
    wait either, the message contains all warnings, or states what the arm does.

    The values `mode`, `stop cause`, `stop causes`, `waits for` and `remedy steps` are stable
    identifiers for programs. The message and the values `stop` and `remedy` are texts for users.
    """
    supervisor = core.supervisor
    values = {
        'mode': supervisor.mode,
        'method': core.settings.method,
        'preset': core.settings.preset,
    }
    warnings = _warnings(core, values)
    condition, present = supervisor.condition, core.conditions(now)
    if condition is not None:
        # Name every cause that is present, with its present details, because each one prevents a
        # reset.
        causes = {condition.cause: condition} | {each.cause: each for each in present}
        text = '; also '.join(map(str, causes.values()))
        # An anomaly that has ended needs no repair.
        of_finding = REPAIR if core.watchdog.has_anomaly else ()
        explored = supervisor.awaits_exploration
        settled = stops.CONSEQUENCES if supervisor.has_had_anomaly else frozenset()
        if not core.watchdog.has_anomaly:  # what has outlasted the anomaly needs its own steps
            settled -= {each.cause for each in present}
        steps = stops.remedy_of(causes, explored, of_finding, settled)
        values |= {
            'stop cause': condition.cause.identifier,
            stops.STOP_CAUSES: ', '.join(cause.identifier for cause in causes),
            'stop': text,
            'remedy': sentence(steps),
            REMEDY_STEPS: identifiers(steps),
        }
        if supervisor.is_latched:
            return Report('error', f'stopped: {text}', values)
        return Report('warn', f'paused: {text}', values)
    if present:
        values['waits for'] = present[0].cause.identifier
        return Report('warn', f'waiting: {present[0]}', values)
    doing = DOING[supervisor.activity]
    if supervisor.awaits_exploration:
        step = Step.EXPLORE if core.stream.body.offsets.known else Step.EXPLORE_GENTLY
        values |= {'remedy': step.text, REMEDY_STEPS: step.identifier}
        warnings.insert(0, f'not exploring, mode {supervisor.mode} (to go on: {step.text})')
    if warnings:
        return Report('warn', '; '.join(warnings), {**values, 'doing': doing})
    return Report('ok', doing, values)


def _warnings(core: Controller, values: dict[str, str]) -> list[str]:
    """Return all warnings, and add their details to `values`."""
    target, robot = core.target_state, core.robot
    warnings = []
    if target.clamped:
        values['target clamped at'] = ', '.join(target.clamped)
        warnings.append(f'target clamped to the joint limits: {", ".join(target.clamped)}')
    _add_stiffness(core, values)
    if target.effort.any() and core.settings.method in ('geometric', 'first', 'second'):
        warnings.append(f'method `{core.settings.method}` ignores the effort of the target')
    follower = core.activities.follower
    if core.is_following:
        values['lag of the winches'] = f'{1000.0 * follower.winches.lag:.0f} ms'
        if follower.progress.is_moving and (slow := slowed(follower)):
            warnings.append(f'trajectory {slow}')
    control = core.activities.of(core.supervisor.activity, core.settings)
    missing = None if control is None else control.missing_torque
    if missing is not None and np.abs(robot.kinematics.radian * missing).max() > reach.NOTABLE:
        each = zip(robot.joints, missing, robot.units)
        values['missing torque'] = ', '.join(f'{n} {m:.2f} {unit.torque}' for n, m, unit in each)
        warnings.append('the target needs more torque than the muscles can exert')
    if target.unreachable_reason:
        warnings.append(f'out of reach: {target.unreachable_reason}')
    if farthest := core.holding.farthest:
        values['distance from the target'] = farthest
    if core.holding.is_away and core.mae is not None and core.estimate is not None:
        warnings.append(away_text(core.holding, robot, core.mae, core.estimate))
    if robot.isolated:
        values['isolated muscles'] = robot.names(robot.isolated)
    if not core.stream.body.offsets.known:
        unknown = np.flatnonzero(~(core.stream.body.offsets.deviation < KNOWN))
        values['unknown length offsets'] = robot.names(unknown)
        waits = 'waits for the first estimate of the length calibration'
        doing = waits if core.estimate is None else 'can only explore gently'
        warnings.append(f'the length offsets are unknown, so the arm {doing}')
    if not robot.tension_source.is_known:
        values['tension'] = f'tension_source: none: {NO_TENSION}'
    elif robot.tension_source.is_current:
        values['tension'] = f'tension_source: current: {_learned(core)}'
    if tense := core.watchdog.overload.tense:
        warnings.append(f'too much tension: {", ".join(tense)}')
    return warnings + _heat_warnings(core, values)


def _learned(core: Controller) -> str:
    """Return a text on what was learned about the motor currents: scale and friction."""
    drive = None if core.mae is None else core.mae.transmission.drive
    if drive is None:
        return 'the friction of the drives has not been learned; tensions are inaccurate'
    each = zip(core.robot.muscles, np.exp(drive[0]), drive[2], strict=True)
    return 'learned scale and friction of the drives: ' + ', '.join(
        f'{name} {scale:.2f} and {friction:.0f} N' for name, scale, friction in each
    )


def _heat_warnings(core: Controller, values: dict[str, str]) -> list[str]:
    robot, heat = core.robot, core.watchdog.heat
    windings = heat.heat.core
    is_known = np.isfinite(windings)
    if is_known.any():
        each = zip(robot.muscles, windings)
        texts = (f'{n} {c:.0f} °C' if np.isfinite(c) else f'{n} unknown' for n, c in each)
        values['temperature of windings'] = ', '.join(texts)
    if not is_known.all():
        names = 'any muscle' if not is_known.any() else robot.names(np.flatnonzero(~is_known))
        values['not protected from heat'] = f'no temperature is measured for {names}'
    limits = zip(robot.muscles, heat.planned, robot.tension.limit)
    hot = {name: limit for name, limit, largest in limits if limit < largest}
    if not hot:
        return []
    values['tension limited by heat'] = ', '.join(f'{n} {t:.0f} N' for n, t in hot.items())
    return [f'heat limits the tension of {", ".join(hot)}']


def _add_stiffness(core: Controller, values: dict[str, str]) -> None:
    solution = core.activities.follower.plan.solution
    if core.settings.method != 'stiffness' or solution is None or solution.stiffness is None:
        return
    expected, *reachable = solution.stiffness
    robot = core.robot
    desired = core.settings.desired_stiffness(robot.kinematics.radian)
    rows = zip(robot.joints, robot.units, desired, expected.diagonal(), *reachable)
    for name, unit, wanted, planned, low, high in rows:
        text = f'{planned:.2f} {unit.stiffness}, reachable {low:.2f} to {high:.2f}'
        if wanted > 0.0 and not low <= wanted <= high:
            text += f', desired {wanted:.2f} clamped'
        values[f'joint stiffness {name}'] = text


def slowed(follower: Follower) -> str:
    """Return a text on how much the last trajectory was slowed; '' if it was not slowed."""
    last = follower.progress.latest
    if last is None or last.slowed == 1.0:
        return ''
    share = 100.0 / last.slowed
    if share < LEAST_SHARE:
        requested, slowed_duration = last.duration / last.slowed, last.duration
        return (
            f'of {requested:.3g} s takes {slowed_duration:.3g} s because of the limits of '
            'the muscle modules'
        )
    return f'slowed to {share:.0f} % of its speed because of the limits of the muscle modules'
