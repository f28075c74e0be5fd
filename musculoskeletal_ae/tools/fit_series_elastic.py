# SPDX-License-Identifier: Apache-2.0
"""`fit_series_elastic`: fits the elongation of a series elastic element to a testbed's table."""

import math
from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.figures import save_plot
from musculoskeletal_ae.files import file_error, read_csv
from musculoskeletal_ae.gauss_newton import minimise_each
from musculoskeletal_ae.options import Parser, exit_status
from musculoskeletal_ae.robot.series_elastic import DEFAULT, SeriesElastic

COLUMNS = ['tension', 'absolute_length', 'elongation']
NOISE = 1e-4  # assume this standard deviation of elongations [m]: the resolution of a caliper
LEAST_FORCE, MOST_FORCE = 1e-3, 1e3  # keep `force` in this range, relative to the highest tension
ROUNDS = 200  # end the fit after this many Gauss–Newton steps
#: end the fit if a step lowers the sum of squares by less than this, relative to the noise
ENOUGH = 1e-9
#: reject a smaller elongation than this [m]; noise can make an elongation slightly negative
LEAST_ELONGATION = -0.002
#: reject a longer muscle on a testbed [m]; larger numbers are probably in another unit
LONGEST = 10.0


def main(argv: list[str] | None = None) -> int:
    """Fit a table."""
    parser = Parser(
        'fit_series_elastic',
        'Fits the elongation L_e(l_abs, T) of a muscle to a testbed table and prints the constants '
        'as a line for muscles.yaml.',
    )
    text = f'CSV with the columns {", ".join(COLUMNS)} [N, m, m]'
    parser.add_argument('table', type=Path, help=text)
    parser.add_plot('table and fit')
    args = parser.parse_args(argv)
    return exit_status(lambda: fit(args))


def fit(args: Namespace) -> None:
    """Fit a table and print the constants."""
    table = read_table(args.table)
    try:
        constants = fit_series_elastic(*table.T)
    except ValueError as error:
        raise file_error(args.table, str(error)) from error
    residual = 1e3 * (table[:, 2] - constants.elongation(table[:, 1], table[:, 0]))
    rms = math.sqrt(float(np.mean(residual**2)))
    fitted = {name: float(f'{values[0]:.6g}') for name, values in vars(constants).items()}
    line = yaml.safe_dump(fitted, default_flow_style=True, sort_keys=False).strip()
    print(
        f'series_elastic: {line}\n'
        f'residual: rms {rms:.3f} mm, largest {np.abs(residual).max():.3f} mm, {len(table)} rows'
    )
    save_plot(args.plot, lambda: plot(table, constants, residual))


def fit_series_elastic(tension: Array, absolute_length: Array, elongation: Array) -> SeriesElastic:
    """Fit the constants of a series elastic element to N rows of measurements.

    Args:
        tension: Tensions T [N], (N,).
        absolute_length: Absolute lengths l_abs [m], (N,).
        elongation: Elongations L_e [m], (N,).

    Returns:
        The constants, each of shape (1,).

    Raises:
        ValueError: If there are fewer than four rows, if a number is not finite, or if the rows do
            not describe a spring.
    """
    table = np.column_stack([tension, absolute_length, elongation])
    if (finite := int(np.isfinite(table).all(axis=1).sum())) < len(table) or finite < 4:
        raise ValueError(
            'a testbed table needs at least 4 rows, all of finite numbers; got '
            f'{len(table)} rows, {finite} of them finite'
        )
    if np.ptp(tension) <= 0.0 or np.ptp(absolute_length) <= 0.0:
        raise ValueError('a testbed table needs several tensions at several muscle lengths')
    if elongation @ (tension - tension.mean()) <= 0.0:
        raise ValueError(
            'elongation does not grow with tension; check its sign, and that each row has the '
            'elongation at its own tension'
        )

    def model(log_constants: Array) -> SeriesElastic:
        return SeriesElastic(*np.exp(log_constants)[:, None])

    def residuals(log_constants: Array) -> tuple[Array, Array]:
        elastic = model(log_constants)
        error = elastic.elongation(absolute_length, tension) - elongation
        slope = elastic.by_logarithms(absolute_length, tension)
        return error / NOISE, slope / NOISE

    # Without bounds, a linear spring would get an infinite `force`, and a tendon without an element
    # an infinite `rate`.
    most = tension.max()
    low, high = np.log([[LEAST_FORCE * most, 1e-3, 1e-12], [MOST_FORCE * most, 1e6, 1.0]])
    start = np.log(list(DEFAULT.values()))
    return model(minimise_each(residuals, start, 1.0, ROUNDS, bounds=(low, high), enough=ENOUGH))


def read_table(file: Path) -> Array:
    """Read a table; return its rows (tension [N], absolute length [m], elongation [m]), (N, 3)."""
    rows = []
    for number, line, cells in read_csv(file, COLUMNS):
        try:
            values = [float(cell) for cell in cells]
        except ValueError:
            values = []
        if len(values) != len(COLUMNS) or not all(map(math.isfinite, values)):
            raise file_error(file, f'row {number}: expected 3 finite numbers, got {line[:80]!r}')
        if values[0] < 0.0:
            raise file_error(file, f'row {number}: expected tension >= 0 [N], got {line!r}')
        if not 0.0 < values[1] <= LONGEST:
            legal = f'absolute_length > 0, at most {LONGEST:g} m'
            problem = f'row {number}: expected {legal}, got {line!r}'
            raise file_error(file, f'{problem}; divide lengths in mm by 1000')
        if values[2] < LEAST_ELONGATION:
            problem = f'row {number}: expected elongation >= 0 [m], got {line!r}'
            raise file_error(file, f'{problem}; state how much longer the muscle is than at 0 N')
        if values[2] >= values[1]:
            problem = f'row {number}: expected elongation below absolute_length, got {line!r}'
            raise file_error(file, f'{problem}; divide lengths in mm by 1000')
        rows.append(values)
    return np.array(rows, dtype=float).reshape(-1, len(COLUMNS))


def plot(table: Array, constants: SeriesElastic, residual: Array) -> Any:
    """Return a figure of the fit over tension, one curve per muscle length, and the residual."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.2), layout='constrained')
    fit, rest = figure.subplots(1, 2)
    tension = np.linspace(0.0, table[:, 0].max(), 200)
    lengths = np.unique(table[:, 1])
    for i, length in enumerate(lengths):
        rows = table[:, 1] == length
        dots = {'marker': 'o', 'linestyle': '', 'markersize': 4, 'color': f'C{i % 10}'}
        curve = 1e3 * constants.elongation(np.full_like(tension, length), tension)
        fit.plot(tension, curve, color=f'C{i % 10}', linewidth=1.0, label=f'{length:.3g} m')
        fit.plot(table[rows, 0], 1e3 * table[rows, 2], **dots)
        rest.plot(table[rows, 0], residual[rows], **dots)
    fit.set(xlabel='tension [N]', ylabel='elongation [mm]', title='fit (lines) and table (dots)')
    # Tables with a different length in every row would have a very long legend.
    if len(lengths) <= 10:
        fit.legend(title='muscle length')
    rest.axhline(0.0, color='black', linewidth=0.8)
    rest.set(xlabel='tension [N]', ylabel='table − fit [mm]', title='residual')
    return figure
