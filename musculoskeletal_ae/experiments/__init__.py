# SPDX-License-Identifier: Apache-2.0
"""Measurements: protocols, plots and reports."""

#: of the experiments, in the order of the report; the first one makes what the others need
NAMES = (
    'online_learning',
    'estimation',
    'control',
    'simulation',
    'loss_change',
    'body_change',
    'motion',
    'resilience',
    'robustness',
    'sensors',
)
