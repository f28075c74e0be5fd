# SPDX-License-Identifier: Apache-2.0
"""Reports the estimator's status for /diagnostics: faults of the body, and present estimates."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from musculoskeletal_ae.conditions import Condition, ConditionKind
from musculoskeletal_ae.estimation.suspect_verification import LONGEST
from musculoskeletal_ae.remedy_steps import Step
from musculoskeletal_ae.report import Report

if TYPE_CHECKING:
    from musculoskeletal_ae.estimation.estimator import Estimator
    from musculoskeletal_ae.mae.mae import Mae

#: blame the joint sensor itself if at least this share of its readings is impossible; with a
#: smaller share, a second publisher or a loose contact may be the cause
ALL = 0.9
#: report this value of `contact` and `tension` for a robot that does not measure tensions
UNKNOWN_TENSION = 'unknown: tension_source is none'


def report(core: Estimator, now: float) -> Report:
    """Report the status of an estimator; `now` is the time on a steady clock [s].

    The value `verification` is 'none' or 'running', and `last outcome` is a value of
    `suspect_verification.Outcome`, so that programs can read both.
    """
    mae, present = core.mae, conditions(core, now)
    if mae is None:
        return Report('', {}, present)
    values = {
        **_network(core, mae),
        **_suspects(core),
        **_residuals(core),
        **_contact(core),
        **_offsets(core),
        **_familiarity(core),
        **_joint_sensors(core),
    }
    if core.calibration is not None:
        return Report('calibrating the lengths', values, present)
    calibrated = '' if core.health.residual.is_calibrated else ', uncalibrated'
    return Report(f'estimating{calibrated}', values, present)


def conditions(core: Estimator, now: float) -> tuple[Condition, ...]:
    """Return all conditions of the readings, the body and the network; `now` is as in `report`."""
    present = [*_finding(core), *_isolated(core), *_unknown_offsets(core)]
    present += [*core.health.conditions(), *_unreadable_joints(core, now)]
    if reason := core.rejected_because(now):
        present.append(ConditionKind.READINGS_REJECTED.condition(reason))
    if weakness := core.networks.unsuitable_because:
        present.append(ConditionKind.UNSUITABLE_NETWORK.condition(weakness))
    if core.mae is None:
        present.append(ConditionKind.NO_CHECKPOINT.condition(steps=[Step.PROVIDE_CHECKPOINT]))
    return tuple(present)


def _finding(core: Estimator) -> Iterator[Condition]:
    """Yield the condition of the latched finding, with the steps by which a user ends it."""
    finding = core.suspects.finding
    if finding is None:
        return
    names = [core.robot.muscles[muscle] for muscle in finding.muscles]
    detail = f'{", ".join(names)}: {finding.evidence}'
    if core.suspects.verification is not None:
        detail += f' (the muscle is being verified; this ends by itself within {LONGEST:g} s)'
    yield finding.kind.condition(detail, names, level='error', steps=core.remedy)


def _isolated(core: Estimator) -> Iterator[Condition]:
    """Yield a condition for each isolated muscle, except one that is only being verified.

    A further condition names the remaining muscles that the estimate needs.
    """
    isolated = [muscle for muscle in core.body.isolated if muscle != core.body.verified]
    for muscle in isolated:
        name, fault = core.robot.muscles[muscle], core.suspects.faults.get(muscle)
        detail = name if fault is None else f'{name} ({fault})'
        # Advise no repair of a muscle that a user has isolated, because it need not be faulty.
        steps = None if fault is not None else (Step.RESTORE_MUSCLES,)
        yield ConditionKind.MUSCLE_ISOLATED.condition(detail, [name], steps=steps)
    if isolated and (needed := core.needed_muscles):
        detail = ', '.join(f'{name} ({joints})' for name, joints in needed.items())
        yield ConditionKind.MUSCLE_NEEDED.condition(detail, needed)


def _unknown_offsets(core: Estimator) -> Iterator[Condition]:
    """Yield conditions on unknown length offsets, with the reason and a calibration's progress."""
    kind, calibration, finding = ConditionKind, core.calibration, core.suspects.finding
    steps: tuple[Step, ...] = (Step.CALIBRATE_LENGTHS,)
    if calibration is not None:
        steps = ()
    elif finding is not None and finding.kind.is_damage:
        steps = ()  # the lengths are calibrated after the repair
    for reason, muscles in core.trust.doubts.items():
        names = [core.robot.muscles[muscle] for muscle in muscles]
        detail = f'{", ".join(names)}: {reason}'
        if calibration is not None:
            detail = f'{detail}; calibrating: {calibration.progress}'
        yield kind.LENGTH_OFFSETS_UNKNOWN.condition(detail, names, steps=steps)
    if calibration is not None and calibration.problem:
        stuck, wiring = kind.LENGTH_CALIBRATION_STUCK, calibration.wiring
        faulty = () if wiring is None or not wiring.is_faulty else wiring.faulty
        names = [core.robot.muscles[muscle] for muscle in faulty]
        steps = calibration.remedy or stuck.steps
        yield stuck.condition(calibration.problem, names, steps=steps)


def _unreadable_joints(core: Estimator, now: float) -> Iterator[Condition]:
    """Yield conditions on joints with lasting impossible readings, or without any readings."""
    if series := core.joint_stream.impossible(now):
        names = [core.robot.joints[j] for j in series]
        impossible = sum(each.impossible for each in series.values())
        share = impossible / sum(each.total for each in series.values())
        detail, steps = f'{", ".join(names)}: {share:.0%} of the readings', list[Step]()
        if share < ALL:
            detail += '; a second program may publish joint angles, or a contact is loose'
            steps = [Step.STOP_SECOND_PUBLISHER]
        kind = ConditionKind.JOINT_READINGS_IMPOSSIBLE
        yield kind.condition(detail, names, steps=[*kind.steps, *steps])
    if missing := core.joint_stream.missing:
        yield ConditionKind.JOINT_READINGS_MISSING.condition(', '.join(missing), missing)


def _joint_sensors(core: Estimator) -> dict[str, str]:
    values = dict[str, str]()
    if impossible := core.joint_stream.text:
        values['impossible joint readings'] = impossible
    return values


def _network(core: Estimator, mae: Mae) -> dict[str, str]:
    values = {
        'checkpoint version': str(mae.version),
        'anomaly calibrated': str(core.health.residual.is_calibrated),
    }
    if mae.covariance is not None:
        spread = np.sqrt(np.diag(mae.covariance))
        values['joint uncertainty'] = core.robot.posture_text(spread, 3)
    return values


def _suspects(core: Estimator) -> dict[str, str]:
    suspects, values = core.suspects, dict[str, str]()
    if core.body.isolated:
        values['isolated muscles'] = core.robot.names(core.body.isolated)
    values['verification'] = 'none' if suspects.verification is None else 'running'
    if suspects.last_verdict is not None:
        values['last verified'] = suspects.last_verification
        values['last outcome'] = suspects.last_verdict[1].outcome.value
    return values


def _residuals(core: Estimator) -> dict[str, str]:
    residual, output = core.health.residual, core.output
    if output is None or residual.reading is None:
        return {}
    suspect = next(iter(core.health.heat.changed), residual.reading.suspect)
    if core.suspects.finding is not None:
        suspect = core.suspects.finding.muscle
    values = {
        'A': f'{output.anomaly:.4f}',
        'd': f'{residual.reading.distance:.1f}',
        'suspect muscle': core.robot.muscles[suspect],
    }
    if residual.is_calibrated:
        limit = residual.limit(output.state.theta, output.sample)
        values[f'{residual.symbol} limit'] = f'{limit:.3g}'
    return values


def _contact(core: Estimator) -> dict[str, str]:
    if not core.robot.tension_source.is_known:
        return {'contact': UNKNOWN_TENSION, 'tension': UNKNOWN_TENSION}
    contact = core.load
    if contact is None:
        return {}
    count = str(core.contact.count)
    if math.isinf(core.contact.threshold):
        return {'contact': 'not calibrated', 'contacts': count}
    force = f'{np.linalg.norm(contact.force()):.0f} N at the hand'
    return {'contact': force if contact.is_contact else 'none', 'contacts': count}


def _offsets(core: Estimator) -> dict[str, str]:
    offsets, values = core.body.offsets, dict[str, str]()
    if not offsets.offset.any():
        return values
    rows = zip(core.robot.muscles, 1e3 * offsets.offset, 1e3 * offsets.deviation)
    each = (f'{name} {offset:.1f} ± {deviation:.1f} mm' for name, offset, deviation in rows)
    return {**values, 'length offsets': ', '.join(each)}


def _familiarity(core: Estimator) -> dict[str, str]:
    residual, far = core.health.residual, 0.0
    if residual.is_calibrated and core.output is not None:
        far = residual.unfamiliarity(core.output.state.theta)
    return {'posture': f'unfamiliar ({far:.1f})' if far > 1.0 else 'familiar'}
