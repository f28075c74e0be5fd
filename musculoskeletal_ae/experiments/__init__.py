# SPDX-License-Identifier: Apache-2.0
"""The experiments of the paper on emulated arms: protocols, plots and reports."""

#: names of the experiments in the order of the report; the others need the results of the first
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
