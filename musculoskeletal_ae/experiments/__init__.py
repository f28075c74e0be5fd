# SPDX-License-Identifier: Apache-2.0
"""The experiments of the paper on emulated arms: protocols, plots and reports."""

#: names of the experiments in the order of the report; all others need the results of the first
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
#: names of the experiments that repeat an experiment of the paper or test one of its statements
PAPER = NAMES[:7]
