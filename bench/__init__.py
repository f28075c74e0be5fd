# SPDX-License-Identifier: Apache-2.0
"""Measurements that are not part of the product: kills, soak, fuzz, timings, calibration."""
