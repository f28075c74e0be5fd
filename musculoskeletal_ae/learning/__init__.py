# SPDX-License-Identifier: Apache-2.0
"""Learning the body online: what counts as a sample, the calibrated body, the network's updates."""
