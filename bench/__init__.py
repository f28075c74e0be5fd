# SPDX-License-Identifier: Apache-2.0
"""Benchmarks and long tests of the package. They are not installed with it."""

import sys
from pathlib import Path

# Import this before numpy, because it limits BLAS to one thread.
import musculoskeletal_ae  # noqa: F401

# Benches import modules of test/ that create hostile networks and robots.
sys.path.append(str(Path(__file__).resolve().parent.parent / 'test'))
