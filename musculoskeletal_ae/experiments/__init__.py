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
    'layers',
    'motion',
    'resilience',
    'robustness',
    'sensors',
)
#: those that repeat an experiment or a statement of the paper
PAPER = NAMES[:7]
