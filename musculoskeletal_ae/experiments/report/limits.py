# SPDX-License-Identifier: Apache-2.0
"""Where an aim is missed, what limits it: from measurements that take one cause away at a time."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Any

from musculoskeletal_ae.experiments.report.rows import ROWS, Results, missed_by, shown


def limits_section(results: Results) -> str:
    """Return the part of the page that says what limits the results."""
    parts = [
        explain(results[name])
        for name, explain in (
            ('online_learning', _estimate),
            ('estimation', _anomaly),
            ('control', _control),
            ('simulation', _simulation),
        )
        if name in results
    ]
    if not parts:
        return ''
    missed = [row.quantity for row in ROWS if (missed_by(results, row) or 0.0) > 0.0]
    said = 'Every aim that was measured is met.'
    if missed:
        said = f'Aims missed: {html.escape("; ".join(missed)).replace("`", "")}.'
    return f'<h2>What limits it</h2><p>{said}</p>' + ''.join(parts)


def _estimate(found: Mapping[str, Any]) -> str:
    steps = [
        ('sensors: least squares on the true body, messages made without friction', 'sensor_rad'),
        ('and hysteresis: the oracle, the same on the messages as they came', 'oracle_rad'),
        ('and samples: least squares on the body that the learner fitted', 'body_rad'),
        ('and network: the autoencoder after learning', 'after_rad'),
    ]
    lines, before = [], 0.0
    for text, key in steps:
        error = float(found[key])
        lines.append(f'<tr><td>{text}</td><td>{error:.3f}</td><td>{error - before:+.3f}</td></tr>')
        before = error
    return (
        '<h3>Estimate</h3><p>Mean error on the held-out motion, each line with one cause more '
        'than the line above. A step below zero means that what comes with it helps: a learner '
        'sees what the sensors’ zeros and the friction’s mean are, the oracle does not.</p>'
        '<div class="wide"><table><thead><tr><th>what acts</th><th>error [rad]</th><th>step</th>'
        f'</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'
    )


def _anomaly(found: Mapping[str, Any]) -> str:
    cuts = found['cuts']
    slow = [name for name, cut in cuts.items() if cut['detected'] < 1.0]
    misnamed = [name for name, cut in cuts.items() if cut['named'] < 1.0]
    rows = ''.join(
        f'<tr><td>{text}</td><td>{_auroc(found, letter, "before_"):.4f}</td>'
        f'<td>{_auroc(found, letter, ""):.4f}</td></tr>'
        for text, letter in (
            ('cut, the module winds in: A of the paper', 'a'),
            ('cut, the module winds in: d of the detector', 'd'),
            ('switched off, l as it was: A of the paper', 'a_slack'),
        )
    )
    return (
        '<h3>Anomaly</h3><p>How well messages of a faulty muscle can be told from healthy ones '
        '(AUROC). Here a cut wire lets its module wind in to the end, which even an untaught '
        'network notices; the paper’s muscle was switched off, and A hardly rose before learning. '
        'The last line is that case: messages of the loaded motion with the tension of one '
        'carrying muscle taken for none.</p>'
        '<div class="wide"><table><thead><tr><th></th><th>before learning</th>'
        f'<th>after learning</th></tr></thead><tbody>{rows}</tbody></table></div>'
        f'<p>Largest healthy A {found["a_before_healthy_max"]:.2f} before and '
        f'{found["a_healthy_max"]:.2f} after learning, smallest A of a cut '
        f'{found["a_before_ruptured_min"]:.2f} and {found["a_ruptured_min"]:.2f}. '
        f'Not found on some individual: {", ".join(slow) or "none"}. Not always named: '
        f'{", ".join(misnamed) or "none"}.</p>'
    )


def _auroc(found: Mapping[str, Any], letter: str, when: str) -> float:
    kind, _, case = letter.partition('_')
    return float(found[f'{kind}_{when}{case}_auroc' if case else f'{kind}_{when}auroc'])


def _control(found: Mapping[str, Any]) -> str:
    rows = ''.join(
        f'<tr><td>{name}</td><td>{shown(row["error_rad"], 3)}</td>'
        f'<td>{shown(row["common_rad"], 3)}</td><td>{shown(row["scatter_rad"], 3)}</td>'
        f'<td>{shown(row["tension_n"], 0)}</td><td>{shown(row["tension_to_bound"], 2)}</td>'
        f'<td>{shown(row["bound_reached_n"], 0)}</td></tr>'
        for name, row in found.items()
        if isinstance(row, Mapping) and 'error_rad' in row
    )
    causes, shape = found['proposed_causes'], found['proposed']
    why = (
        f'‖T‖ of <code>proposed</code> beside the bound: {causes["planned_to_bound"]:.2f} as '
        'planned on the learnt body (beyond 1: the error of its muscle Jacobian), '
        f'{causes["frictionless_to_bound"]:.2f} on the same arm without friction (with '
        f'{causes["frictionless_rad"]:.3f} rad left), {shape["tension_to_bound"]:.2f} on the arm: '
        'the difference is friction, which adds to what the module measures in wires wound in.'
    )
    return (
        '<h3>Control</h3><p>What all starts of a target have in common is the error of the '
        'learnt body and of the command; their scatter is hysteresis, which no model at rest can '
        f'foresee. QP bound at the targets: {found["qp_bound_n"]:.0f} N.</p>'
        '<div class="wide"><table><thead><tr><th>method</th><th>error [rad]</th>'
        '<th>in common [rad]</th><th>scatter [rad]</th><th>‖T‖ [N]</th><th>‖T‖ / bound</th>'
        f'<th>bound where it rests [N]</th></tr></thead><tbody>{rows}</tbody></table></div>'
        f'<p>{why}</p>'
    )


def _simulation(found: Mapping[str, Any]) -> str:
    return (
        '<h3>Simulation</h3><p>The true body without friction, given the same commands, is already '
        f'{found["frictionless_rad"]:.3f} rad and {found["frictionless_n"]:.0f} N away from the '
        'arm: hysteresis that a simulator without memory of it cannot follow. What the learnt '
        f'simulator has beyond that, {found["after_rad"] - found["frictionless_rad"]:+.3f} rad and '
        f'{found["after_n"] - found["frictionless_n"]:+.0f} N, is the network’s and that of motion '
        'taken as a sequence of rests.</p>'
    )
