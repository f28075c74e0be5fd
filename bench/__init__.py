# SPDX-License-Identifier: Apache-2.0
"""Measurements that are not part of the product: kills, soak, timings, calibration."""

import sys
from pathlib import Path

# Before numpy: it sets one BLAS thread, as everywhere else.
import musculoskeletal_ae  # noqa: F401

# Hostile networks and robots are made by the tests' own support.
sys.path.append(str(Path(__file__).resolve().parent.parent / 'test'))
