# SPDX-License-Identifier: Apache-2.0
"""Measurements that are not part of the product: kills, soak, timings, calibration."""

# Before numpy: it sets one BLAS thread, as everywhere else.
import musculoskeletal_ae  # noqa: F401
