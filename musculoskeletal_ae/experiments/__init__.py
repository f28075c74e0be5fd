# SPDX-License-Identifier: Apache-2.0
"""Measurements: protocols, plots and reports."""
