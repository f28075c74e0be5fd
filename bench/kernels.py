# SPDX-License-Identifier: Apache-2.0
"""Runs the tests with the arithmetic of other processors: several BLAS and torch kernels.

Other processors select other kernels, which add numbers in another order, so the last bits of a
result differ. No test may depend on these. Tests must therefore pass with each combination of
kernels that this processor can run.
"""

import itertools
import os
import subprocess
import sys
import time
from pathlib import Path

from musculoskeletal_ae.options import Parser

BLAS = ('Haswell', 'SkylakeX', 'Zen', 'Prescott')
TORCH = ('default', 'avx2')
ROOT = Path(__file__).resolve().parent.parent


def runs(environment: dict[str, str]) -> bool:
    """Whether this processor has the instructions that the kernels of an environment need."""
    multiply = 'import numpy as np; a = np.ones((64, 64)); assert (a @ a == 64).all()'
    return subprocess.run([sys.executable, '-c', multiply], env=environment).returncode == 0


def main(argv: list[str]) -> int:
    """Run pytest once for each combination; return how many failed."""
    parser = Parser('kernels', 'Runs the tests with the arithmetic of other machines.')
    parser.add_argument('--blas', nargs='+', default=BLAS, help='values of OPENBLAS_CORETYPE')
    parser.add_argument('--torch', nargs='+', default=TORCH, help='values of ATEN_CPU_CAPABILITY')
    options, pytest = parser.parse_known_args(argv)
    rows = []
    for blas, torch in itertools.product(options.blas, options.torch):
        environment = os.environ | {'OPENBLAS_CORETYPE': blas, 'ATEN_CPU_CAPABILITY': torch}
        begun = time.monotonic()
        verdict = 'this processor cannot run it'
        if runs(environment):
            command = [sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', *pytest]
            status = subprocess.run(command, cwd=ROOT, env=environment).returncode
            verdict = 'passed' if status == 0 else f'FAILED (status {status})'
        rows.append((blas, torch, verdict, time.monotonic() - begun))
        print(f'{blas:10} {torch:8} {verdict}, {rows[-1][3]:.0f} s', flush=True)
    print('\nOPENBLAS_CORETYPE  ATEN_CPU_CAPABILITY  result')
    for blas, torch, verdict, seconds in rows:
        print(f'{blas:18} {torch:20} {verdict}, {seconds:.0f} s')
    return sum('FAILED' in verdict for _, _, verdict, _ in rows)
