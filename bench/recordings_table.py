# SPDX-License-Identifier: Apache-2.0
"""Tables of the results of `bench recordings`, for doc/results.md."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from bench.recordings_read import repositories

ALL_ROWS = ', of all rows'
#: label of the one row that stands for all polynomials fitted to all rows of the training runs
OF_ALL_ROWS = 'best polynomial of all training rows (chosen by its test error)'


class Result(NamedTuple):
    """The error of one model on one split."""

    recording: str
    split: str
    samples: int
    model: str
    error_rad: float


def table(results: list[Result]) -> str:
    """Return the errors of one recording as a Markdown table.

    The polynomials that were fitted to all rows share one row of the table, which contains the
    smallest of their errors for each split. The best model from the rest samples is in bold.
    """
    errors, samples = dict[tuple[str, str], float](), dict[str, int]()
    for result in results:
        label = OF_ALL_ROWS if result.model.endswith(ALL_ROWS) else result.model
        before = errors.get((result.split, label), np.inf)
        errors[result.split, label] = min(before, result.error_rad)
        samples[result.split] = result.samples
    labels = [*dict.fromkeys(label for _, label in errors if label != OF_ALL_ROWS)]
    best = {s: min(e for (k, m), e in errors.items() if k == s and m in labels) for s in samples}
    heads = [f'{split} ({count} rests)' for split, count in samples.items()]
    lines = [f'| mean error [rad] | {" | ".join(heads)} |', '|---' * (len(heads) + 1) + '|']
    if any(label == OF_ALL_ROWS for _, label in errors):
        labels.append(OF_ALL_ROWS)
    for label in labels:
        cells = []
        for split in samples:
            value = errors.get((split, label), np.nan)
            text = '–' if np.isnan(value) else f'{value:.3f}' if value < 1.0 else '> 1'
            cells.append(f'**{text}**' if value == best[split] else text)
        lines.append(f'| {label} | {" | ".join(cells)} |')
    return '\n'.join(lines)


def tables(document: dict[str, Any]) -> str:
    """Return the tables of a result.json of `bench recordings` as Markdown."""
    results = [Result(**row) for row in document['errors']]
    parts = []
    for repository in repositories():
        own = [result for result in results if result.recording == repository.recording]
        if own:
            link = f'[{repository.name}](https://github.com/{repository.name})'
            head = f'**{link}** ({repository.licence}): {repository.robot}.'
            parts.append(f'{head}\n\n{table(own)}')
    return '\n\n'.join(parts)
