# SPDX-License-Identifier: Apache-2.0
"""Tables that compare this package with other methods, from the committed results.

The models of the recordings are those of `results/recordings/result.json`, which `bench recordings`
writes. Their errors are means over the draws.
"""

import json
from pathlib import Path
from statistics import mean
from typing import Any

from musculoskeletal_ae.experiments.results import Results, read

RESULTS = Path(__file__).resolve().parent / 'results'
PACKAGE = 'this package'
MISSING = '–'
#: names of the models of `bench recordings` in the tables
MODELS = {
    'geometry': 'network of the geometric model, without learning',
    'polynomial': 'polynomial (cross-validation)',
    'kernel ridge': 'kernel ridge regression (cross-validation)',
    'GP': 'Gaussian process (evidence)',
    'statics': 'statics with learned springs, payload known',
    PACKAGE: PACKAGE,
}
RECORDINGS = {
    'soft_neck': 'soft neck',
    'soft_arm': 'soft arm',
    'continuum_stand': 'continuum robot',
    'cable_platform': 'cable platform',
}
#: columns of recordings: heading, recording, and the cases whose mean error is shown
RECORDED = (
    (
        'soft neck, new payloads',
        'soft_neck',
        (
            'rests at 0 g, 1000 g → 500 g',
            'rests at 0 g, 500 g → 1000 g',
            'rests at 500 g, 1000 g → 0 g',
        ),
    ),
    ('soft arm, 22 rests', 'soft_arm', ('rests at 0 g → other files, 0 g',)),
    ('soft arm, 75 rests', 'soft_arm', ('rests at 0 g, 500 g → 200 g, 300 g',)),
    ('continuum robot, 20 poses', 'continuum_stand', ('20 random poses → all others',)),
    ('continuum robot, 100 poses', 'continuum_stand', ('100 random poses → all others',)),
    ('cable platform, 50 rests', 'cable_platform', ('50 random rests of one run → other runs',)),
)


def _recorded() -> dict[tuple[str, str, str], dict[str, float]]:
    """Return the mean error [rad] of each model, by recording, case and inputs."""
    document = json.loads((RESULTS / 'recordings' / 'result.json').read_text('utf-8'))
    errors: dict[tuple[str, str, str], dict[str, list[float]]] = {}
    for row in document['errors']:
        case = errors.setdefault((row['recording'], row['case'], row['inputs']), {})
        case.setdefault(row['model'], []).append(row['error_rad'])
    return {
        case: {model: mean(values) for model, values in models.items()}
        for case, models in errors.items()
    }


def recorded_errors() -> dict[str, list[float | None]]:
    """Return the error [rad] of each model from lengths alone in each column of RECORDED.

    An error is None if it was not measured in each of the column's cases.
    """
    errors = _recorded()
    columns = [
        [errors.get((recording, case, 'lengths'), {}) for case in cases]
        for _, recording, cases in RECORDED
    ]
    return {
        name: [
            mean(case[model] for case in column) if all(model in case for case in column) else None
            for column in columns
        ]
        for model, name in MODELS.items()
    }


def random_rows() -> str:
    """Return the table of errors after learning random rows, beside the best other model."""
    errors, cells = _recorded(), dict[tuple[str, str], dict[int, str]]()
    for (recording, case, inputs), models in errors.items():
        number = case.partition(' random ')[0]
        if not number.isdecimal():
            continue
        own = models[PACKAGE]
        best, rival = min((error, model) for model, error in models.items() if model != PACKAGE)
        text = f'{own:.4f}, {rival} {best:.4f}: {own / best:.2f}'
        cells.setdefault((recording, inputs), {})[int(number)] = text
    counts = sorted({count for row in cells.values() for count in row})
    lines = [
        f'| recording, inputs | {" | ".join(f"{count} rows" for count in counts)} |',
        '|---' * (len(counts) + 1) + '|',
    ]
    for (recording, inputs), row in cells.items():
        texts = [row.get(count, MISSING) for count in counts]
        lines.append(f'| {RECORDINGS[recording]}, {inputs} | {" | ".join(texts)} |')
    return '\n'.join(lines)


def estimates() -> str:
    """Return the table of README: the best other method beside this package."""
    results, recorded = read(RESULTS), recorded_errors()
    estimation, foreign = results['estimation'], results['robustness']['foreign']
    ours = recorded.pop(PACKAGE)
    lines = [
        '| | best rival in the same measurement | this package | measured by |',
        '|---|---|---|---|',
    ]

    def add(case: str, other: float, method: str, own: float, command: str) -> None:
        cells = [f'{other:.3f}', f'{own:.3f}']
        least = min(cells, key=float)
        cells = [f'**{cell}**' if cell == least else cell for cell in cells]
        lines.append(f'| {case} | {cells[0]}: {method} | {cells[1]} | `{command}` |')

    add(
        'angles of the easy emulated arm [rad]',
        estimation['baselines']['polynomial mapping, EKF']['after_rad'],
        'polynomials with a Kalman filter',
        estimation['after_held_out_rad'],
        'experiment estimation',
    )
    add(
        'angles of the hard emulated arm [rad]',
        foreign['paper_after_rad'],
        'network of the paper (regressions were not measured)',
        foreign['after_rad'],
        'experiment robustness',
    )
    for place, what in (
        (0, 'bend of a real soft neck, with payloads that were not learned [rad]'),
        (1, 'bend of a real soft arm, in files that were not learned [rad]'),
        (2, 'bend of a real soft arm, with payloads that were not learned [rad]'),
        (4, 'bend of a real continuum robot with slack tendons, 100 postures [rad]'),
        (5, 'orientation of a real platform on four cables, 50 postures [rad]'),
    ):
        measured = {name: row[place] for name, row in recorded.items()}
        error, method = min((e, name) for name, e in measured.items() if e is not None)
        own = ours[place]
        assert own is not None, f'{PACKAGE} has no error for {RECORDED[place][0]}'
        add(what, error, method, own, 'python -m bench recordings')
    ruptures = [_ruptures(estimation, preset) for preset in ('paper_', '')]
    lines.append(
        '| ruptures of loaded muscles, easy emulated arm: muscle named | '
        f'{ruptures[0]}: anomaly score of the paper | **{ruptures[1]}** | '
        '`experiment estimation` |'
    )
    return '\n'.join(lines)


def _ruptures(estimation: dict[str, Any], preset: str) -> str:
    """Return how many ruptures a preset named, and how fast; '' is preset `default`."""
    counted = estimation['counted_cuts']
    named = round(estimation[f'{preset}named_share'] * counted)
    alarms = estimation[f'{preset}false_alarms']
    seconds = estimation[f'{preset}detection_s']
    return f'{named} of {counted} after {seconds:.2f} s; {alarms} false alarms in 1 h'


def methods() -> str:
    """Return the table of all methods on all kinds of data."""
    results, recorded = read(RESULTS), recorded_errors()
    headings = ['`kin`', '`foreign`', *(heading for heading, *_ in RECORDED)]
    rows = {**_emulated(results), **{name: [None, None, *row] for name, row in recorded.items()}}
    rows[PACKAGE] = [*_emulated(results)[PACKAGE][:2], *recorded[PACKAGE]]
    rows[PACKAGE] = rows.pop(PACKAGE)  # the last row
    rows = {name: row for name, row in rows.items() if any(error is not None for error in row)}
    best = [
        min(f'{row[place]:.3f}' for row in rows.values() if row[place] is not None)
        for place in range(len(headings))
    ]
    lines = [f'| | {" | ".join(headings)} |', '|---' * (len(headings) + 1) + '|']
    for name, row in rows.items():
        cells = []
        for error, least in zip(row, best):
            cell = MISSING if error is None else f'{error:.3f}' if error < 1.0 else '> 1'
            cells.append(f'**{cell}**' if cell == least else cell)
        lines.append(f'| {name} | {" | ".join(cells)} |')
    return '\n'.join(lines)


def _emulated(results: Results) -> dict[str, list[float | None]]:
    """Return each method's errors [rad] on `kin`, on `foreign` and, as None, on the recordings."""
    kin, foreign = (results['robustness'][reality] for reality in ('kin', 'foreign'))
    baselines = results['estimation']['baselines']

    def after(baseline: str) -> float:
        error: float = baselines[baseline]['after_rad']
        return error

    emulated: dict[str, tuple[float, float | None]] = {
        'geometric model, least squares, without learning': (
            kin['least_squares_rad'],
            foreign['least_squares_rad'],
        ),
        'true routes and springs, least squares': (kin['oracle_rad'], foreign['oracle_rad']),
        'search in a table of the rest samples': (after('table search'), None),
        'polynomials with an EKF': (after('polynomial mapping, EKF'), None),
        'network trained further on the measurements (preset `paper`)': (
            kin['paper_after_rad'],
            foreign['paper_after_rad'],
        ),
        'this package': (kin['after_rad'], foreign['after_rad']),
        'the joint sensors themselves': (
            kin['joint_sensors_rad'],
            foreign['joint_sensors_rad'],
        ),
    }
    return {name: [*errors, *[None] * len(RECORDED)] for name, errors in emulated.items()}
