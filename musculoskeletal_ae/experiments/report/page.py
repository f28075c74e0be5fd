# SPDX-License-Identifier: Apache-2.0
"""report.html: one page that needs nothing else, from the result.json and plots of a folder."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from musculoskeletal_ae.experiments.report.limits import limits_section
from musculoskeletal_ae.experiments.report.readme import results_in
from musculoskeletal_ae.experiments.report.rows import (
    ROWS,
    Results,
    aim,
    missed_by,
    shown,
    value,
    verdict,
)
from musculoskeletal_ae.experiments.report.texts import TEXTS

STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #222; margin: 0 auto; padding: 1rem;
       max-width: 76rem; }
h1 { font-size: 1.7rem; line-height: 1.2; } h2 { margin-top: 2.5rem; border-top: 1px solid #ccc;
     padding-top: 1rem; }
p, li, figcaption { max-width: 46rem; overflow-wrap: anywhere; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; margin: .5rem 0; }
th, td { border-bottom: 1px solid #ddd; padding: .25rem .6rem; text-align: right;
         vertical-align: top; }
th:first-child, td:first-child { text-align: left; min-width: 9rem; }
thead th { border-bottom: 2px solid #888; }
.met { color: #00703c; } .missed { color: #b3261e; } .ours { font-weight: 600; }
figure { margin: 1rem 0; } figure img { max-width: 100%; height: auto; border: 1px solid #eee; }
figcaption { font-size: .9rem; color: #444; }
@media (max-width: 50rem) { figure img { max-width: none; width: 46rem; } }
pre { background: #f4f4f4; padding: .6rem; overflow-x: auto; } code { font-size: .9em; }
.note { background: #fff4ce; padding: .5rem .8rem; max-width: 46rem; }
"""


def write_page(folder: Path) -> Path:
    """Write report.html of a folder; return the file."""
    results = results_in(folder)
    parts = [_head(results), _summary(results), limits_section(results)]
    for name, result in results.items():
        parts.append(_section(name, result, folder / name))
    body = '\n'.join(parts)
    page = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<link rel="icon" href="data:,">\n'
        '<title>musculoskeletal_ae: the paper’s experiments</title>\n'
        f'<style>{STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n'
    )
    file = folder / 'report.html'
    file.write_text(page, encoding='utf-8')
    return file


def command(name: str, about: Mapping[str, Any]) -> str:
    """Return the command that repeats a result."""
    seeds = ','.join(map(str, about['seeds']))
    quick = ' --quick' if about['quick'] else ''
    return (
        f'ros2 run musculoskeletal_ae experiment {name} --robot {about["robot"]} '
        f'--preset {about["preset"]} --seeds {seeds} --minutes {about["minutes"]:g}{quick}'
    )


def _head(results: Results) -> str:
    abouts = [result['about'] for result in results.values()]
    about = abouts[0]
    names = ['all'] if len(results) == len(TEXTS) else list(results)
    commands = '\n'.join(
        command(name, results.get(name, {'about': about})['about']) for name in names
    )
    quick = (
        '<p class="note">A run with --quick: one short taste of everything. Its numbers say '
        'nothing about what the method can do.</p>'
        if any(each['quick'] for each in abouts)
        else ''
    )
    mixed = (
        '<p class="note">The experiments below come from calls with different options; each '
        'section names its own.</p>'
        if any(each != about for each in abouts)
        else ''
    )
    return (
        '<h1>The paper’s experiments on emulated arms</h1>'
        '<p>Musculoskeletal AutoEncoder (Kawaharazuka et al.). The paper’s numbers are of the real '
        'robot Musashi; ours are of emulated individuals that differ from the geometric model as '
        'Musashi does from its own: attachments millimetres off, wires round bones, other elastic '
        'units, friction, noisy sensors. The emulator was calibrated once, so that preset paper '
        'starts with the paper’s error before learning; nothing else was fitted to it. '
        f'Robot {html.escape(about["robot"])}; means over the individuals with seeds '
        f'{", ".join(map(str, about["seeds"]))}.</p>'
        f'<p>To repeat it:</p><pre>{html.escape(commands)}</pre>{quick}{mixed}'
    )


def _summary(results: Results) -> str:
    lines = []
    for row in ROWS:
        ours = value(results, row, row.default)
        if ours is None:
            continue
        missed = missed_by(results, row)
        kind = '' if missed is None else 'met' if missed <= 0.0 else 'missed'
        cells = [
            _code(row.quantity),
            _code(row.printed),
            shown(value(results, row, row.paper), row.digits),
            f'<span class="ours">{shown(ours, row.digits)}</span>',
            shown(value(results, row, row.bound), row.digits),
            aim(row),
            f'<span class="{kind}">{verdict(results, row)}</span>',
        ]
        lines.append('<tr>' + ''.join(f'<td>{cell}</td>' for cell in cells) + '</tr>')
    if not lines:
        return ''
    preset = next(iter(results.values()))['about']['preset']
    heads = ['', 'paper, on Musashi', 'preset paper', f'preset {preset}', 'oracle or bound', 'aim']
    head = ''.join(f'<th>{text}</th>' for text in (*heads, ''))
    return (
        '<h2>Beside the paper</h2><div class="wide"><table><thead><tr>'
        f'{head}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'
        '<p>Oracle: least squares on the true body. Bounds: the least ‖T‖ that can hold the '
        'target; the true body without friction as simulator. Time to detection: the slowest '
        'muscle of the worst individual. ‖T‖ of an arm that sags can be less than the bound.</p>'
    )


def _section(name: str, result: Mapping[str, Any], folder: Path) -> str:
    text = TEXTS[name]
    plots = ''.join(
        f'<figure><div class="wide"><img alt="{html.escape(plot["caption"])}" '
        f'src="{_inline(folder / plot["file"])}"></div>'
        f'<figcaption>{_code(plot["caption"])}</figcaption></figure>'
        for plot in result['plots']
        if (folder / plot['file']).is_file()
    )
    return (
        f'<h2 id="{name}">{text.title}</h2><p><b>Paper.</b> {_code(text.paper)}</p>'
        f'<p><b>Here.</b> {_code(text.here)}</p>'
        f'<pre>{html.escape(command(name, result["about"]))}</pre>'
        f'{plots}<details><summary>All numbers</summary>{_numbers(result)}</details>'
    )


def _numbers(result: Mapping[str, Any]) -> str:
    seeds: Mapping[str, Any] = result['seeds']
    flat = {seed: dict(_flat(numbers)) for seed, numbers in seeds.items()}
    means = dict(_flat({k: v for k, v in result.items() if k not in ('seeds', 'about', 'plots')}))
    head = ''.join(f'<th>{seed}</th>' for seed in flat)
    lines = [
        f'<tr><td>{html.escape(key)}</td><td>{_cell(mean)}</td>'
        + ''.join(f'<td>{_cell(numbers.get(key))}</td>' for numbers in flat.values())
        + '</tr>'
        for key, mean in means.items()
    ]
    return (
        f'<div class="wide"><table><thead><tr><th>key</th><th>mean or total</th>{head}</tr></thead>'
        f'<tbody>{"".join(lines)}</tbody></table></div>'
    )


def _flat(values: Mapping[str, Any], before: str = '') -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for key, found in values.items():
        path = f'{before}{key}'
        if isinstance(found, Mapping):
            rows += _flat(found, f'{path}.')
        else:
            rows.append((path, found))
    return rows


def _cell(found: Any) -> str:
    if isinstance(found, list):
        return ' '.join(map(_cell, found))
    if isinstance(found, float):
        return f'{found:.4g}'
    return '' if found is None else html.escape(str(found))


def _code(text: str) -> str:
    """Return text as HTML, with what stands between backquotes as code."""
    parts = html.escape(text).split('`')
    return ''.join(f'<code>{part}</code>' if i % 2 else part for i, part in enumerate(parts))


def _inline(file: Path) -> str:
    return 'data:image/png;base64,' + base64.b64encode(file.read_bytes()).decode('ascii')
