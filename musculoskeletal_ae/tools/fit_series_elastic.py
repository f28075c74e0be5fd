# SPDX-License-Identifier: Apache-2.0
"""`fit_series_elastic`: fits L_e(l_abs, T) to the table of a one-muscle testbed."""

from __future__ import annotations

import math
import sys
from argparse import Namespace
from pathlib import Path

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError, RobotDescriptionError
from musculoskeletal_ae.files import read_csv
from musculoskeletal_ae.options import Parser, exit_status
from musculoskeletal_ae.robot.series_elastic import DEFAULT, SeriesElastic

COLUMNS = ['tension', 'absolute_length', 'elongation']
EXAMPLE_TENSIONS = (5.0, 15.0, 30.0, 60.0, 110.0, 200.0, 330.0, 500.0)  # [N]
EXAMPLE_LENGTHS = (0.15, 0.30, 0.45, 0.60)  # [m]
EXAMPLE_NOISE = 1e-4  # [m], what a caliper on a testbed resolves


def main(argv: list[str] | None = None) -> int:
    """Fit a table, or write the synthetic example table."""
    parser = Parser(
        'fit_series_elastic',
        'Fits the elongation L_e(l_abs, T) of a muscle to a testbed table and prints the constants '
        'as a line for muscles.yaml.',
    )
    parser.add_argument(
        'table', type=Path, help=f'CSV with the columns {", ".join(COLUMNS)} [N, m, m]'
    )
    parser.add_plot('picture of table and fit', 'fit_<table>.png')
    parser.add_argument(
        '--make-example',
        action='store_true',
        help='write a synthetic table to TABLE instead (never over an existing file)',
    )
    parser.add_seed('of the example noise')
    args = parser.parse_args(argv)
    if args.make_example:
        return exit_status(lambda: write_example(args.table, args.seed))
    return exit_status(lambda: fit(args))


def fit(args: Namespace) -> None:
    """Fit a table and print the constants."""
    table = read_table(args.table)
    try:
        constants = fit_series_elastic(*table.T)
    except ValueError as error:
        raise _refusal(args.table, str(error)) from error
    residual = 1e3 * (table[:, 2] - constants.elongation(table[:, 1], table[:, 0]))
    rms = math.sqrt(float(np.mean(residual**2)))
    print(yaml_line(constants))
    print(f'residual: rms {rms:.3f} mm, largest {np.abs(residual).max():.3f} mm, {len(table)} rows')
    if not args.no_plot:
        file = args.plot or Path(f'fit_{args.table.stem}.png')
        plot(table, constants, residual, file)
        print(f'plot: {file}')


def fit_series_elastic(tension: Array, absolute_length: Array, elongation: Array) -> SeriesElastic:
    """Fit L_e to a testbed table by least squares.

    Args:
        tension: Tensions of the table [N], shape (N,).
        absolute_length: Muscle lengths of the table [m], shape (N,).
        elongation: Measured elongations [m], shape (N,).

    Returns:
        Constants of one muscle (arrays of shape (1,)).

    Raises:
        ValueError: If there are fewer than four rows, or they do not pin down three constants.
    """
    from scipy.optimize import least_squares

    table = np.column_stack([tension, absolute_length, elongation])
    if len(table) < 4 or not np.isfinite(table).all():
        raise ValueError(f'a testbed table needs at least 4 finite rows, got {len(table)} rows')
    if np.ptp(tension) <= 0.0 or np.ptp(absolute_length) <= 0.0:
        raise ValueError('a testbed table needs several tensions at several muscle lengths')

    def model(log_constants: Array) -> SeriesElastic:
        force, rate, stretch = np.exp(log_constants)[:, None]
        return SeriesElastic(force, rate, stretch)

    def residual(log_constants: Array) -> Array:
        return 1e3 * (model(log_constants).elongation(absolute_length, tension) - elongation)

    start = np.log(list(DEFAULT.values()))
    return model(least_squares(residual, start, x_scale='jac').x)


def read_table(file: Path) -> Array:
    """Read a testbed table: rows (tension [N], absolute length [m], elongation [m]), (N, 3).

    Raises:
        RobotDescriptionError: Naming the file and the row.
    """
    rows = []
    for number, line, cells in read_csv(file, COLUMNS, _refusal):
        try:
            values = [float(cell) for cell in cells]
        except ValueError:
            values = []
        if len(values) != len(COLUMNS) or not all(map(math.isfinite, values)):
            raise _refusal(file, f'row {number}: expected 3 finite numbers, got {line[:80]!r}')
        if values[0] < 0.0 or values[1] <= 0.0:
            problem = f'row {number}: expected tension >= 0 and absolute_length > 0, got {line!r}'
            raise _refusal(file, problem)
        rows.append(values)
    return np.array(rows, dtype=float).reshape(-1, len(COLUMNS))


def _refusal(file: Path, problem: str) -> RobotDescriptionError:
    return RobotDescriptionError(f'{file}: {problem}')


def yaml_line(constants: SeriesElastic) -> str:
    """Return the constants as the line that goes into muscles.yaml."""
    return (
        f'series_elastic: {{force: {constants.force[0]:.2f}, rate: {constants.rate[0]:.3f}, '
        f'wire_stretch: {constants.wire_stretch[0]:.4e}}}'
    )


def write_example(file: Path, seed: int) -> None:
    """Write a synthetic table: the package's default constants and measurement noise."""
    true = SeriesElastic(*(np.array([value]) for value in DEFAULT.values()))
    rng = np.random.default_rng(seed)
    with file.open('x', encoding='utf-8') as stream:
        stream.write(
            '# SYNTHETIC one-muscle testbed table, not a measurement: the default constants '
            f'(force {DEFAULT["force"]:g} N,\n# rate {DEFAULT["rate"]:g} /m, wire_stretch '
            f'{DEFAULT["wire_stretch"]:g} /N) with {1e3 * EXAMPLE_NOISE:g} mm of noise. Made by\n'
            f'#   fit_series_elastic --make-example --seed {seed} {file.name}\n'
            '# Units: N, m, m.\n' + ','.join(COLUMNS) + '\n'
        )
        for length in EXAMPLE_LENGTHS:
            for tension in EXAMPLE_TENSIONS:
                exact = true.elongation(np.array([length]), np.array([tension]))[0]
                measured = exact + EXAMPLE_NOISE * rng.standard_normal()
                stream.write(f'{tension:g},{length:g},{measured:.5f}\n')
    print(f'wrote {file}')


def plot(table: Array, constants: SeriesElastic, residual: Array, file: Path) -> None:
    """Draw the fit over tension, one curve a muscle length, and the residual."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.2), layout='constrained')
    fit, rest = figure.subplots(1, 2)
    tension = np.linspace(0.0, table[:, 0].max(), 200)
    lengths = np.unique(table[:, 1])
    for i, length in enumerate(lengths):
        rows = table[:, 1] == length
        colour = f'C{i % 10}'
        # A table with a length of its own in every row has no curves worth a legend.
        label = f'{length:.3g} m' if len(lengths) <= 10 else None
        curve = 1e3 * constants.elongation(np.full_like(tension, length), tension)
        fit.plot(tension, curve, color=colour, linewidth=1.0, label=label)
        fit.plot(table[rows, 0], 1e3 * table[rows, 2], 'o', color=colour, markersize=4)
        rest.plot(table[rows, 0], residual[rows], 'o', color=colour, markersize=4)
    fit.set(xlabel='tension [N]', ylabel='elongation [mm]', title='fit (lines) and table (dots)')
    if len(lengths) <= 10:
        fit.legend(title='muscle length')
    rest.axhline(0.0, color='black', linewidth=0.8)
    rest.set(xlabel='tension [N]', ylabel='table − fit [mm]', title='residual')
    try:
        figure.savefig(file, dpi=110)
    except (OSError, ValueError) as error:  # a ValueError is an ending of no picture
        raise MusculoskeletalError(f'plot {file} cannot be written: {error}') from error


if __name__ == '__main__':
    sys.exit(main())
