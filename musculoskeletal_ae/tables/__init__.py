# SPDX-License-Identifier: Apache-2.0
"""Readings of an arm as tables, from arrays or CSV files."""
