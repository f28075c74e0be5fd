# SPDX-License-Identifier: Apache-2.0
"""The controller's status: what the arm does, why it stands still, and warnings."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.conditions import Condition, ConditionKind
from musculoskeletal_ae.control.holding import away_text
from musculoskeletal_ae.control.supervisor import Activity
from musculoskeletal_ae.motion import holdable_paths
from musculoskeletal_ae.motion.follower import Follower
from musculoskeletal_ae.remedy_steps import Step
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.description import NO_TENSION
from musculoskeletal_ae.signals.heat import soon

if TYPE_CHECKING:
    from musculoskeletal_ae.control.controller import Controller

NOTABLY = 1.01  # state that a trajectory was slowed if it lasts longer by this factor
#: below this share of the requested speed, state the duration of a slowed trajectory instead of its
#: speed [%]
LEAST_SHARE = 10.0
#: report a tension limit that heat lowers below this share of `tension.limit`; a healthy arm that
#: explores may be some newtons below it all the time
COOL = 0.9
#: what the arm does during each activity, as a text for users
DOING = {
    Activity.IDLE: 'no target',
    Activity.HOLDING: 'holding',
    Activity.MOVING: 'following a trajectory',
    Activity.EXPLORING: 'exploring',
    Activity.CALIBRATING: 'exploring gently',
    Activity.GRAVITY_COMPENSATION: 'gravity compensation',
}
_OF_READINGS = ConditionKind.IMPLAUSIBLE_ESTIMATE, ConditionKind.STALE_ESTIMATE
#: conditions that follow from each cause, and need no remedy of their own while it is present: a
#: faulty muscle makes readings and estimates implausible, and without usable readings there are no
#: estimates
CONSEQUENCES = {
    ConditionKind.ANOMALY: (ConditionKind.IMPLAUSIBLE_MUSCLE_STATES, *_OF_READINGS),
    ConditionKind.IMPLAUSIBLE_MUSCLE_STATES: (ConditionKind.STALE_MUSCLE_STATES, *_OF_READINGS),
    ConditionKind.STALE_MUSCLE_STATES: _OF_READINGS,
}
ONLY_RESET = (Step.RESET_CONTROLLER,)


def report(core: Controller, now: float) -> Report:
    """Return the status for /diagnostics; `now` is the time of a steady clock [s].

    The values `mode` and `stop cause` are stable identifiers for programs.
    """
    supervisor = core.supervisor
    values = {
        'mode': supervisor.mode,
        'method': core.settings.method,
        'preset': core.settings.preset,
    }
    if core.mae is not None:
        values['checkpoint version'] = str(core.mae.version)
    if supervisor.condition is not None:
        values['stop cause'] = supervisor.condition.identifier
    _add_motion(core, values)
    _add_body(core, values)
    _add_heat(core, values)
    # The conditions of a stop state what the arm does: it is stopped, pauses or waits.
    doing = _doing(core) if supervisor.is_running and not core.stop_conditions(now) else ''
    return Report(doing, values, conditions(core, now))


def _doing(core: Controller) -> str:
    if core.estimate is None and not core.stream.body.offsets.known:
        return 'waiting for the first estimate of the length calibration'
    return DOING[core.supervisor.activity]


def conditions(core: Controller, now: float) -> tuple[Condition, ...]:
    """Return all conditions that the controller reports; `now` is as in `report`."""
    return (*_stop(core, now), *_exploration(core), *_target(core), *_heat(core))


def _stop(core: Controller, now: float) -> Iterator[Condition]:
    """Yield every cause of a stop, of a pause, or of waiting before the first command."""
    supervisor, present = core.supervisor, core.stop_conditions(now)
    followed = {kind: each.kind for each in present for kind in CONSEQUENCES.get(each.kind, ())}

    def text(each: Condition) -> str:
        cause = followed.get(each.kind)
        return each.text if cause is None else f'{each.text}, because {cause.text}'

    if supervisor.is_running:
        for each in present:
            steps = () if each.kind in followed else each.steps
            needed = tuple(step for step in steps if step is not Step.RESET_CONTROLLER)
            yield each._replace(level='warn', text=f'waiting: {text(each)}', steps=needed)
        return
    causes = supervisor.causes(present)
    if not supervisor.is_latched:  # the arm continues by itself
        for each in causes:
            yield each._replace(level='warn', text=f'paused: {text(each)}', steps=())
        return
    for each in causes:
        steps = each.steps
        if supervisor.ends_by_itself:
            steps = ()
        elif each.kind in followed:
            steps = ONLY_RESET
        yield each._replace(level='error', text=f'stopped: {text(each)}', steps=steps)


def _exploration(core: Controller) -> Iterator[Condition]:
    """Yield why the arm does not explore although it should, and what starts the exploration."""
    supervisor, known = core.supervisor, core.stream.body.offsets.known
    if supervisor.lacks_exploration:
        step = Step.EXPLORE if known else Step.EXPLORE_GENTLY
        yield ConditionKind.NOT_EXPLORING.condition(steps=[step])
    elif not known and supervisor.is_running and not supervisor.explores:
        unknown = core.stream.body.offsets.not_known
        names = [core.robot.muscles[muscle] for muscle in unknown]
        yield ConditionKind.GENTLE_ONLY.condition(subjects=names)


def _target(core: Controller) -> Iterator[Condition]:
    """Yield every way in which the arm deviates from what its target demands."""
    target, robot, kind = core.target_state, core.robot, ConditionKind
    if target.clamped:
        yield kind.TARGET_CLAMPED.condition(', '.join(target.clamped), target.clamped)
    if target.effort.any() and not core.settings.control_method.uses_effort:
        yield kind.EFFORT_IGNORED.condition(f'method `{core.settings.method}` does not use it')
    follower = core.activities.follower
    if core.is_following and follower.progress.is_moving and (slow := slowed(follower)):
        yield kind.TRAJECTORY_SLOWED.condition(f'trajectory {slow}')
    missing = _missing_torque(core)
    if missing is not None and np.abs(missing).max() > holdable_paths.NOTABLE:
        yield kind.TORQUE_MISSING.condition()
    if target.unreachable_reason:
        yield kind.OUT_OF_REACH.condition(target.unreachable_reason)
    joint = core.holding.farthest if core.holding.is_away else None
    if joint is not None and core.mae is not None and core.estimate is not None:
        text = away_text(core.holding, robot, core.mae, core.estimate)
        yield kind.AWAY_FROM_TARGET.condition(text, [robot.joints[joint]])
    if core.resting_load.has_changed:
        yield kind.LOAD_CHANGED.condition(core.resting_load.text)


def _heat(core: Controller) -> Iterator[Condition]:
    """Yield which tensions are limited by heat."""
    if hot := _limited_by_heat(core):
        limits = ', '.join(f'{name} at most {tension:.0f} N' for name, tension in hot.items())
        muscles = [core.robot.muscles.index(name) for name in hot]
        rest = core.watchdog.heat.heat.rest_needed(
            core.settings.temperature_limit, core.robot.tension.limit
        )
        detail = f'{limits}; at rest, all have cooled {soon(float(rest[muscles].max()))}'
        yield ConditionKind.TENSION_LIMITED_BY_HEAT.condition(detail, hot)


def _missing_torque(core: Controller) -> Array | None:
    control = core.activities.entered
    return None if control is None else control.missing_torque


def _limited_by_heat(core: Controller) -> dict[str, float]:
    """Return the tension limits [N] that heat lowers noticeably, by the name of the muscle."""
    robot = core.robot
    limits = zip(robot.muscles, core.watchdog.heat.planned, robot.tension.limit)
    return {name: float(limit) for name, limit, largest in limits if limit < COOL * largest}


def _add_motion(core: Controller, values: dict[str, str]) -> None:
    robot, target = core.robot, core.target_state
    if target.clamped:
        values['target clamped at'] = ', '.join(target.clamped)
    _add_stiffness(core, values)
    if core.is_following:
        lag = core.activities.follower.winches.lag
        values['lag of the winches'] = f'{1000.0 * lag:.0f} ms'
    missing = _missing_torque(core)
    if missing is not None and np.abs(missing).max() > holdable_paths.NOTABLE:
        each = zip(robot.joints, missing, robot.units)
        values['missing torque'] = ', '.join(f'{n} {unit.torque_text(m)}' for n, m, unit in each)
    if distance := core.holding.text:
        values['distance from the target'] = distance


def _add_body(core: Controller, values: dict[str, str]) -> None:
    robot = core.robot
    if robot.isolated:
        values['isolated muscles'] = robot.names(robot.isolated)
    if not core.stream.body.offsets.known:
        values['unknown length offsets'] = robot.names(core.stream.body.offsets.not_known)
    if not robot.tension_source.is_known:
        values['tension'] = f'tension_source: none: {NO_TENSION}'
    elif robot.tension_source.is_current:
        values['tension'] = f'tension_source: current: {_learned(core)}'


def _add_heat(core: Controller, values: dict[str, str]) -> None:
    robot, windings = core.robot, core.watchdog.heat.heat.core
    is_known = np.isfinite(windings)
    if is_known.any():
        each = zip(robot.muscles, windings)
        texts = (f'{n} {c:.0f} °C' if np.isfinite(c) else f'{n} unknown' for n, c in each)
        values['temperature of windings'] = ', '.join(texts)
    if not is_known.all():
        names = 'any muscle' if not is_known.any() else robot.names(np.flatnonzero(~is_known))
        values['not protected from heat'] = f'no temperature is measured for {names}'
    if hot := _limited_by_heat(core):
        values['tension limited by heat'] = ', '.join(f'{n} {t:.0f} N' for n, t in hot.items())


def _learned(core: Controller) -> str:
    """Return a text on what was learned about the motor currents: scale and friction."""
    drive = None if core.mae is None else core.mae.transmission.drive
    if drive is None:
        return 'the friction of the drives has not been learned; tensions are inaccurate'
    each = zip(core.robot.muscles, np.exp(drive[0]), drive[2], strict=True)
    return 'learned scale and friction of the drives: ' + ', '.join(
        f'{name} {scale:.2f} and {friction:.0f} N' for name, scale, friction in each
    )


def _add_stiffness(core: Controller, values: dict[str, str]) -> None:
    solution = core.activities.follower.plan.solution
    is_stiff = core.settings.control_method.sets_stiffness
    if not is_stiff or solution is None or solution.stiffness is None:
        return
    expected, *reachable = solution.stiffness
    robot = core.robot
    desired = core.settings.desired_stiffness(robot.units)
    rows = zip(robot.joints, robot.units, desired, expected.diagonal(), *reachable)
    for name, unit, wanted, planned, low, high in rows:
        one = unit.radian**2
        reachable_text = f'{low / one:.2f} to {high / one:.2f}'
        text = f'{unit.stiffness_text(planned)}, reachable {reachable_text}'
        if wanted > 0.0 and not low <= wanted <= high:
            text += f', desired {wanted / one:.2f} clamped'
        values[f'joint stiffness {name}'] = text


def slowed(follower: Follower) -> str:
    """Return a text on how much the last trajectory was slowed; '' if it was hardly slowed."""
    last = follower.progress.latest
    if last is None or last.slowed < NOTABLY:
        return ''
    share = 100.0 / last.slowed
    if share < LEAST_SHARE:
        requested, slowed_duration = last.duration / last.slowed, last.duration
        return (
            f'of {requested:.3g} s takes {slowed_duration:.3g} s because of the limits of '
            'the muscle modules'
        )
    return f'slowed to {share:.0f} % of its speed because of the limits of the muscle modules'
