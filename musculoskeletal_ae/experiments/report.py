# SPDX-License-Identifier: Apache-2.0
"""report.html: one page that needs nothing else, from the result.json and plots of a folder."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from musculoskeletal_ae.experiments.results import failures, read, table
from musculoskeletal_ae.experiments.runner import EXPERIMENTS
from musculoskeletal_ae.experiments.table import NOTHING, individuals

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
    environment.filters.update(flat=_flat, cell=_cell, individuals=individuals)
    page = environment.get_template(TEMPLATE).render(
        results=results,
        failures=failures(results),
        measured={name: result for name, result in results.items() if result['seeds']},
        experiments=EXPERIMENTS,
        about=next(iter(results.values()))['about'],
        table=[line for line in table(results) if line.default != NOTHING],
        images={
            f'{file.parent.name}/{file.name}': base64.b64encode(file.read_bytes()).decode('ascii')
            for file in folder.glob('*/*.png')
        },
    )
    file = folder / 'report.html'
    file.write_text(page, encoding='utf-8')
    return file


def _flat(values: Mapping[str, Any], before: str = '') -> dict[str, Any]:
    """Return nested numbers by their path."""
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
