# SPDX-License-Identifier: Apache-2.0
"""Plots of what the experiments measured; each is the counterpart of a figure of the paper."""
