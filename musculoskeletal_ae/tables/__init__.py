# SPDX-License-Identifier: Apache-2.0
"""Readings of an arm as tables: arrays, and CSV files."""
