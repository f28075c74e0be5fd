# SPDX-License-Identifier: Apache-2.0
"""Read out of the network at every message: joint angles, and whether the body is healthy."""
