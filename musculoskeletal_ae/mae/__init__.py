# SPDX-License-Identifier: Apache-2.0
"""The network, its units and masks, checkpoint and initial training."""
