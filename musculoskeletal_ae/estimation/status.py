# SPDX-License-Identifier: Apache-2.0
"""The estimator's status on /diagnostics."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from musculoskeletal_ae.remedy import REMEDY_STEPS, identifiers, sentence
from musculoskeletal_ae.report import MUSCLE_STATES, WAITS_FOR, Report
from musculoskeletal_ae.signals.body_state import KNOWN

if TYPE_CHECKING:
    from musculoskeletal_ae.estimation.estimator import Estimator
    from musculoskeletal_ae.mae.mae import Mae

UNKNOWN_TENSION = 'unknown: tension_source is none'
#: key of the names of the isolated muscles with their faults, such as 'biceps (ruptured)'
ISOLATION = 'isolated muscles with faults'
CALIBRATION = 'calibration'  # key of what a length calibration needs: one of the next two values
GENTLE_MOTION, STANDING = 'gentle_motion', 'standing'
#: time without a message after which the status is a warning, and after which the filter of the
#: contact estimator starts again [s]
SILENCE = 1.0


def report(core: Estimator, now: float) -> Report:
    """Return the status of an estimator; `now` is the time of a steady clock [s].

    The values `state`, `finding` and `verification` are identifiers for programs, and `last
    outcome` is one of `verification.Outcome`.
    """
    mae = core.state.mae
    if mae is None:
        return Report('warn', 'waiting for a checkpoint', {'state': 'no_checkpoint'})
    values = {
        **_network(core, mae),
        **_suspects(core),
        **_residuals(core),
        **_contact(core),
        **_offsets(core),
        **_familiarity(core),
    }
    if core.suspects.finding is not None:
        text = f'anomaly detected: {core.cause}; {core.advice}'
        return Report('error', text, {**values, 'state': 'anomaly'})
    if now - core.stepped_at > SILENCE:
        waits = {'state': 'no_muscle_states', WAITS_FOR: MUSCLE_STATES}
        return Report('warn', 'no muscle_states', values | waits)
    if core.calibration is not None:
        progress = core.calibration.progress
        text = f'calibrating the lengths: {progress}'
        values[CALIBRATION] = STANDING if core.calibration.is_standing else GENTLE_MOTION
        if core.calibration.problem:
            values['calibration problem'] = core.calibration.problem
            if steps := core.calibration.remedy:
                values[REMEDY_STEPS] = identifiers(steps)
        return Report('warn', text, {**values, 'state': 'calibrating'})
    calibrated = '' if core.health.residual.is_calibrated else ', uncalibrated'
    if core.heat.changed:
        changes = (
            f'the module of {core.robot.muscles[muscle]} {change}'
            for muscle, change in core.heat.changed.items()
        )
        text = f'thermal drift: {"; ".join(changes)}'
        return Report('warn', text, {**values, 'state': 'thermal_drift'})
    if core.body.isolated:
        isolated = core.robot.names(core.body.isolated)
        text = f'estimating{calibrated} without {isolated}'
        return Report('warn', text, {**values, 'state': 'isolated'})
    return Report('ok', f'estimating{calibrated}', {**values, 'state': 'estimating'})


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
        values[ISOLATION] = ', '.join(_isolation(core, muscle) for muscle in core.body.isolated)
    values['finding'] = 'none' if suspects.finding is None else suspects.finding.kind.value
    if suspects.finding is not None:
        values['evidence'] = suspects.finding.evidence
        if steps := core.remedy:
            values['remedy'] = sentence(steps)
            values[REMEDY_STEPS] = identifiers(steps)
    values['verification'] = 'none' if suspects.verification is None else 'running'
    if suspects.last_verdict is not None:
        values['last verified'] = suspects.last_verification
        values['last outcome'] = suspects.last_verdict[1].outcome.value
    return values


def _isolation(core: Estimator, muscle: int) -> str:
    """Return the name of an isolated muscle, with its fault if a verification has found one."""
    name, fault = core.robot.muscles[muscle], core.suspects.faults.get(muscle)
    return name if fault is None else f'{name} ({fault})'


def _residuals(core: Estimator) -> dict[str, str]:
    residual, output = core.health.residual, core.output
    if output is None or residual.reading is None:
        return {}
    suspect = next(iter(core.heat.changed), residual.reading.suspect)
    if core.suspects.finding is not None:
        suspect = core.suspects.finding.muscle
    values = {
        'A': f'{output.anomaly:.4f}',
        'd': f'{residual.reading.distance:.1f}',
        'suspect muscle': core.robot.muscles[suspect],
    }
    if residual.is_calibrated:
        limit = residual.limit(output.state.theta, output.sample.model_tension)
        values[f'{residual.symbol} limit'] = f'{limit:.3g}'
    return values


def _contact(core: Estimator) -> dict[str, str]:
    if not core.robot.tension_source.is_known:
        return {'contact': UNKNOWN_TENSION, 'tension': UNKNOWN_TENSION}
    contact = None if core.output is None else core.output.contact
    if contact is None:
        return {}
    count = str(core.contact.count)
    if not core.contact.is_calibrated:
        return {'contact': 'not calibrated', 'contacts': count}
    force = f'{np.linalg.norm(contact.force()):.0f} N at the hand'
    return {'contact': force if contact.is_contact else 'none', 'contacts': count}


def _offsets(core: Estimator) -> dict[str, str]:
    offsets, values = core.body.offsets, dict[str, str]()
    if not offsets.known:
        unknown = np.flatnonzero(~(offsets.deviation < KNOWN))
        values['unknown length offsets'] = core.robot.names(unknown)
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
