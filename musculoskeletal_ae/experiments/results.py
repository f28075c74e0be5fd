# SPDX-License-Identifier: Apache-2.0
"""From the numbers of individuals to result.json: means over them, and each of them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments.plots import DPI
from musculoskeletal_ae.experiments.runner import EXPERIMENTS, Everything
from musculoskeletal_ae.experiments.study import Individuals, Study

#: result.json of every experiment that was run, by name
Results = Mapping[str, Mapping[str, Any]]

#: counted in all, not per individual: the hour of healthy motion is spread over the seeds
TOTALS = ('false_alarms', 'false_alarms_beside_cuts', 'healthy_s', 'counted_cuts')
DIGITS = 6  # significant; more is noise


def write(study: Study, measured: Everything, out: Path) -> list[Path]:
    """Write result.json and plots of every experiment below a folder; return the files.

    Raises:
        MusculoskeletalError: If a number is not finite.
    """
    robot, files = study.body(), []
    for name, rows in measured.items():
        folder = out / name
        result = combined(study, {seed: row.numbers for seed, row in rows.items()})
        plots = EXPERIMENTS[name].plot(Individuals(study, robot, rows))
        result['plots'] = [{'file': f'{p.name}.png', 'caption': p.caption} for p in plots]
        folder.mkdir(parents=True, exist_ok=True)
        files.append(folder / 'result.json')
        text = json.dumps(result, indent=1, ensure_ascii=False)
        files[-1].write_text(text + '\n', encoding='utf-8')
        for plot in plots:
            files.append(folder / f'{plot.name}.png')
            plot.figure.savefig(files[-1], dpi=DPI)
    return files


def read(folder: Path) -> Results:
    """Return every result.json below a folder, by experiment."""
    files = {name: folder / name / 'result.json' for name in EXPERIMENTS}
    return {
        name: json.loads(file.read_text(encoding='utf-8'))
        for name, file in files.items()
        if file.is_file()
    }


def combined(study: Study, by_seed: Mapping[int, Mapping[str, Any]]) -> dict[str, Any]:
    """Return result.json of one experiment, without its plots."""
    result: dict[str, Any] = _mean(list(by_seed.values()))
    result['about'] = {
        'robot': Path(study.robot).name,
        'preset': study.preset,
        'minutes': study.minutes,
        'quick': study.quick,
        'seeds': list(by_seed),
    }
    result['seeds'] = {str(seed): numbers for seed, numbers in by_seed.items()}
    rounded: dict[str, Any] = _rounded(result)
    return rounded


def _mean(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key, first in rows[0].items():
        values = [row[key] for row in rows if key in row]
        if isinstance(first, Mapping):
            result[key] = _mean(values)
        elif isinstance(first, str):
            result[key] = first if len(set(values)) == 1 else sorted(set(values))
        elif key in TOTALS:
            result[key] = sum(values)
        elif isinstance(first, list):
            result[key] = np.mean(values, axis=0).tolist()
        else:
            result[key] = float(np.mean(values))
    return result


def _rounded(value: Any) -> Any:
    """Return the same with floats shortened; JSON cannot say what is not finite."""
    if isinstance(value, Mapping):
        return {key: _rounded(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_rounded(part) for part in value]
    if isinstance(value, float):
        if not math.isfinite(value):
            raise MusculoskeletalError('an experiment brought a number that is not finite')
        return float(f'{value:.{DIGITS}g}')
    return value
