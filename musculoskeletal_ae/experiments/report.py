# SPDX-License-Identifier: Apache-2.0
"""report.html: one page that needs nothing else, from the result.json and plots of a folder."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from musculoskeletal_ae.experiments.results import read
from musculoskeletal_ae.experiments.runner import EXPERIMENTS
from musculoskeletal_ae.experiments.table import ROWS

TEMPLATE = 'report.html.jinja'  # beside this file


def write_report(folder: Path) -> Path:
    """Write report.html from all that is in a folder, of this call or an earlier one."""
    results = read(folder)
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(command=_command, flat=_flat, cell=_cell)
    about = next(iter(results.values()))['about']
    table = [row for row in ROWS if row.number(results, row.default) is not None]
    page = environment.get_template(TEMPLATE).render(
        results=results,
        experiments=EXPERIMENTS,
        about=about,
        mixed=any(result['about'] != about for result in results.values()),
        quick=any(result['about']['quick'] for result in results.values()),
        table=table,
        missed=[row.quantity for row in table if (row.missed(results) or 0.0) > 0.0],
        images={
            (name, plot['file']): base64.b64encode(file.read_bytes()).decode('ascii')
            for name, result in results.items()
            for plot in result['plots']
            if (file := folder / name / plot['file']).is_file()
        },
    )
    file = folder / 'report.html'
    file.write_text(page, encoding='utf-8')
    return file


def _command(name: str, about: Mapping[str, Any]) -> str:
    """Return the command that repeats a result."""
    seeds = ','.join(map(str, about['seeds']))
    quick = ' --quick' if about['quick'] else ''
    return (
        f'ros2 run musculoskeletal_ae experiment {name} --robot {about["robot"]} '
        f'--preset {about["preset"]} --seeds {seeds} --minutes {about["minutes"]:g}{quick}'
    )


def _flat(values: Mapping[str, Any], before: str = '') -> dict[str, Any]:
    """Return nested numbers by their path, without what is not a number of the experiment."""
    rows: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            rows.update(_flat(value, f'{before}{key}.'))
        else:
            rows[f'{before}{key}'] = value
    return rows


def _cell(value: Any) -> str:
    if isinstance(value, list):
        return ' '.join(map(_cell, value))
    return f'{value:.4g}' if isinstance(value, float) else str(value)
