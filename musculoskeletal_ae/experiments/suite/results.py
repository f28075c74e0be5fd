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
from musculoskeletal_ae.experiments.suite.study import Study

#: counted in all, not per individual: the hour of healthy motion is spread over the seeds
TOTALS = ('false_alarms', 'false_alarms_beside_cuts', 'healthy_s', 'counted_cuts')
DIGITS = 6  # significant; more is noise


def combined(study: Study, by_seed: Mapping[int, Mapping[str, Any]]) -> dict[str, Any]:
    """Return result.json of one experiment."""
    result: dict[str, Any] = _mean(list(by_seed.values()))
    result['about'] = {
        'robot': Path(study.robot).name,
        'preset': study.preset,
        'minutes': study.minutes,
        'quick': study.quick,
        'seeds': list(by_seed),
    }
    result['seeds'] = {str(seed): numbers for seed, numbers in by_seed.items()}
    return rounded(result)


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


def rounded(value: Any) -> Any:
    """Return the same with floats shortened.

    Raises:
        MusculoskeletalError: If one is not finite, which JSON cannot say.
    """
    if isinstance(value, Mapping):
        return {key: rounded(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [rounded(part) for part in value]
    if isinstance(value, (np.generic, np.ndarray)):
        return rounded(value.tolist())
    if isinstance(value, float):
        if not math.isfinite(value):
            raise MusculoskeletalError('an experiment brought a number that is not finite')
        return float(f'{value:.{DIGITS}g}')
    return value


def write(result: Mapping[str, Any], file: Path) -> None:
    """Write result.json."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(result, indent=1, ensure_ascii=False) + '\n', encoding='utf-8')


def read(file: Path) -> dict[str, Any]:
    """Read result.json."""
    found: dict[str, Any] = json.loads(file.read_text(encoding='utf-8'))
    return found
