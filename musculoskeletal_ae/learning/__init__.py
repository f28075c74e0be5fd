# SPDX-License-Identifier: Apache-2.0
"""Online learning: collecting samples, fitting the calibrated body, updating the network."""
