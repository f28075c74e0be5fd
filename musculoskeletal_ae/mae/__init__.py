# SPDX-License-Identifier: Apache-2.0
"""The network, its units and masks, checkpoints and initial training."""
