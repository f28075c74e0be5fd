# SPDX-License-Identifier: Apache-2.0
"""Benchmarks and long tests that are not part of the package: kills, soak, timings, calibration."""

import sys
from pathlib import Path

# Import this before numpy, because it limits BLAS to one thread.
import musculoskeletal_ae  # noqa: F401

# The tests' support code creates hostile networks and robots.
sys.path.append(str(Path(__file__).resolve().parent.parent / 'test'))
